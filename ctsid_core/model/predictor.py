# SPDX-License-Identifier: Apache-2.0
"""
The predictor of a model in innovation form, for output channels with stamps of their own.

Let p(t) be any solution of the model for the known inputs without innovations, and r = y - C p -
D u - y_trim what remains of the samples. Then the state is p + xi with

    dxi/dt = A xi + K e,     e = r - C xi.                                                    (1)

Between the samples of a channel its innovation is what the model could not predict at the later
one. With h the time between the two, xi^- and e^- = r - C xi^- before the sample, the state is

    xi = xi^- + h phi_1(Abar h) K e^-,      Abar = A - K C                                    (2)

per channel, which is causal, stays bounded however large K is (then C xi meets the sample), and
does nothing to a model that predicts its data, however sparse they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_continuous_are

from ctsid_core.linear.matrix_functions import exponentials
from ctsid_core.linear.types import Array, Places
from ctsid_core.model.statespace import StateSpace

MEMORY = 5.0  # substitute predictors forget at least this many times within the record
START = 0.1  # the part of the record from which nothing is predicted
_FEWEST = 3  # samples for each number of the initial state
_WAIT = 1000  # samples at least, of which a next one may tell of the initial state a little later
_FORGOTTEN = 1e-10  # of the initial state: less of it is not asked for any more
LONGEST = 2.0  # a sample speaks for at most that many median intervals, gaps or not


@dataclass(frozen=True)
class Stream:
    """Output channels that share their stamps."""

    channels: slice  # which outputs of the model
    rows: Places     # where their stamps stand among the merged stamps of all outputs


def predictor_gain(model: StateSpace, noise: Array, duration: float) -> tuple[Array | None, str]:
    """
    Return a gain K for which the predictor A - K C is stable, and a note if it is not the model's.

    With the model's own K that is so for every model that was identified with its noise. With K =
    0 and an unstable (or integrating) A it is not: no filter forgets its start. The right filter
    for such a model is the steady Kalman filter of the same noise model (Riccati equation with Q =
    K R K^T, S = K R, R the `noise` up to a factor); it turns unstable poles of A - K C into their
    mirror images. To leave the imaginary axis too, A is shifted right by `MEMORY` / duration.

    None if an unstable mode is seen by no output, so that nothing can stabilise it.
    """
    A, C, K = model.A, model.C, model.K
    if _is_stable(A - K @ C):
        return K, ''
    shifted = A + MEMORY / duration * np.eye(model.n)
    try:
        P = solve_continuous_are(shifted.T, C.T, K @ noise @ K.T, noise, s=K @ noise)
        gain = np.linalg.solve(noise, C @ P + noise @ K.T).T
        stable = _is_stable(A - gain @ C)
    except (np.linalg.LinAlgError, ValueError):
        stable = False
    if not stable:
        return None, ('Prediction is not possible: a mode of the model is unstable and seen by '
                      'no output; measure another output, or lower the order.')
    return gain, ('The K of the model does not stabilise its predictor (unstable or integrating '
                  'model without a noise model); a Kalman filter for measurement noise was used '
                  'instead. Identify with process noise for a better one.')


def _is_stable(A: Array) -> bool:
    return bool(np.all(np.real(np.linalg.eigvals(A)) < 0))


def start_rows(times: Array, n: int) -> int:
    """Return how many of the merged stamps are used to start the filter of n states."""
    if not len(times):
        return 0
    rows = int(np.searchsorted(times, times[0] + START * (times[-1] - times[0]), side='right'))
    return min(max(rows, _FEWEST * n, 1), len(times))


def spread(y: Array) -> Array:
    """Return the size of each column (standard deviation, else magnitude, else 1), NaN apart."""
    known = [column[~np.isnan(column)] for column in y.T]
    return np.array([(c.std() or np.abs(c).max() or 1.0) if len(c) else 1.0 for c in known])


def filter_states(model: StateSpace, K: Array, noise: Array, times: Array, rest: Array,
                  streams: Sequence[Stream]) -> tuple[Array, Array, int]:
    """
    Run the predictor over all samples, at the merged stamps (M,) of all outputs [s].

    What K does not forget of the state at the first stamp, every sample tells more of: it is the
    least-squares one for the innovations so far, each over its `noise`, a covariance (ny, ny).
    States depend on samples up to their own stamp only. `rest`, (M, ny), is r of (1), read only
    where a stream has a sample.

    Returns xi, (M, n), the state after the samples of each stamp, NaN during the first `START` of
    the record; the state (n,) at the first stamp before its samples, as this start tells it; and
    the first row whose state is causal.
    """
    steps = exponentials(model.A, np.diff(times, prepend=times[:1]), 0)[0]
    events = _events(model, K, times, streams)
    started = start_rows(times, model.n)
    size = np.sqrt(np.diag(noise))[:, np.newaxis]
    # Column 0: from xi_0 = 0 with the samples; the others: free, from each unit vector.
    state, told = np.eye(model.n, model.n + 1, k=1), list[Array]()
    start, xi_0, largest = np.ones(1), np.zeros(model.n), np.zeros((model.n, model.n))
    xi = np.full((len(times), model.n), np.nan)
    for row in range(len(times)):
        data = np.zeros((model.ny, state.shape[1]))
        data[:, 0] = rest[row]
        state = steps[row] @ state
        error = data - model.C @ state
        state = state + sum((gain @ error[channels] for channels, gain in events[row]),   # (2)
                            np.zeros_like(state))
        if state.shape[1] > 1:
            told += [error[channels] / size[channels] for channels, _ in events[row]]
            left = np.abs(state[:, 1:])
            largest = np.maximum(largest, left)
            if not np.isfinite(told[-1]).all():         # it explodes
                break
            if row >= started - 1 and len(told) * _WAIT > row:
                triangle, start = _likeliest(np.vstack(told))
                told = [triangle]
                if row == started - 1:
                    xi_0 = start[1:]
                if (left <= _FORGOTTEN * largest).all():
                    state, start = (state @ start)[:, np.newaxis], np.ones(1)
        if row >= started - 1:
            xi[row] = state @ start
    return xi, xi_0, started - 1


def _likeliest(told: Array) -> tuple[Array, Array]:
    """Return as few rows that tell as much of the first state, and 1 and that state, (n + 1,)."""
    size = np.abs(told).max(axis=0)
    size[size == 0] = 1
    told = np.linalg.qr(told / size, mode='r')
    xi_0 = -np.linalg.lstsq(told[:, 1:], told[:, 0], rcond=1e-10)[0] * size[0] / size[1:]
    return told * size, np.append(1.0, xi_0)


def _events(model: StateSpace, K: Array, times: Array,
            streams: Sequence[Stream]) -> list[list[tuple[slice, Array]]]:
    """Return what each stamp brings: channels, and their gain on the innovation."""
    events: list[list[tuple[slice, Array]]] = [[] for _ in times]
    closed = model.A - K @ model.C
    for stream in streams:
        if not len(stream.rows):
            continue
        own = times[stream.rows]
        usual = float(np.median(np.diff(own))) if len(own) > 1 else 0.0
        h = np.minimum(np.diff(own, prepend=own[0] - usual), LONGEST * usual)
        mean = exponentials(closed, h, 1)[1]
        for row, gain in zip(stream.rows, mean @ K[:, stream.channels], strict=True):
            events[row].append((stream.channels, gain))
    return events
