# SPDX-License-Identifier: Apache-2.0
"""
Predictors from a regression of the outputs on what was just before: where predictions start.

With outputs at nearly uniform instants, the innovations form says that y_k is a sum over the last
samples of outputs and inputs. Least squares finds the weights, the products of the predictor's
observability and controllability follow, and a singular value decomposition gives predictors of
every order at once (PBSID in discrete time). It is consistent in closed loop, too. Inputs are
shifted by dead times from a grid, so that few states are left to stand in for what is not on it.

References
----------
Chiuso 2007, Automatica 43; van der Veen et al. 2013, IET Control Theory and Applications 7.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ctsid_core.likelihood.output_error import Free
from ctsid_core.likelihood.pole_steps import bounded
from ctsid_core.likelihood.samples import RecordSamples, Samples
from ctsid_core.linear.tall_qr import triangle
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.search.by_order import POINT
from ctsid_core.search.pole_grid import cell_means

_WEIGHTS = 60         # of a prediction, at most: more would fit the noise
_ROWS = 4             # equations for each weight, at least
_SHIFTS = (0, 1, 2, 3, 4, 6, 8, 12, 16)     # dead times on the grid, in samples
_RIDGE = 1e-8         # of the power of the signals
_WORK = 4.0           # for each number and column of the regression, in operations
_SHORTEST = 1e-3      # of a state that is left after a sample, at least


@dataclass(frozen=True, eq=False)
class Start:
    """
    A predictor of the regression, as modes in continuous time.

    Parameters
    ----------
    score : float
        -2 log likelihood: of one order the least is most likely.
    poles : ndarray, shape (m,)
        Real ones, and one of each pair [rad/s].
    b : ndarray, shape (m, nu + ny)
        By inputs and by the outputs' own past.
    delay : ndarray, shape (nu,)
        [s]
    """

    score: float
    poles: ComplexArray
    b: ComplexArray
    delay: Array


def regressed(samples: Samples, step: float, highest: int, known: Array,
              free: Free) -> dict[int, Start]:
    """
    Return the best predictor of every order that the samples can tell; few samples: none.

    Parameters
    ----------
    samples : Samples
    step : float
        Sample interval of the slowest output [s].
    highest : int
        Order.
    known : ndarray, shape (nu,)
        Dead times that are given; 0 where they are free [s].
    free : Free
        Of the predictors, whose further inputs are the outputs' own past.
    """
    found: dict[int, Start] = {}
    late = np.array(free.delays[:samples.nu])
    shifts = [k * step for k in _SHIFTS if k * step <= free.longest] if late.any() else [0.0]
    for shift in shifts:
        if found and samples.effort.beyond(POINT):
            break
        delay = np.where(late, shift, known)
        for n, one in enumerate(_at(samples, step, highest, delay, free), 1):
            if n not in found or one.score < found[n].score:
                found[n] = one
    return found


def _at(samples: Samples, step: float, highest: int, delay: Array,
        free: Free) -> Iterator[Start]:
    """Yield predictors of all orders with given dead times."""
    signals = [_signals(r, samples.ny, step, delay) for r in samples.records]
    ny, width = samples.ny, samples.nu + samples.ny
    past = min(_WEIGHTS, sum(len(z) for z in signals) // _ROWS) // width
    signals = [z for z in signals if len(z) > past]
    if past < 2 or not signals:
        return
    size = np.sqrt(np.mean(np.vstack(signals) ** 2, axis=0)) + 1e-300
    stacked = np.vstack([np.hstack([z[past - i:len(z) - i] for i in range(past + 1)])
                         for z in (z / size for z in signals)])
    samples.effort.spend(_WORK * stacked.size * stacked.shape[1])
    R = triangle(stacked)
    now, before, after = R[:, :width], R[:, width:], R[:, :-width]
    ridge = np.sqrt(_RIDGE * len(stacked)) * np.eye(before.shape[1])
    theta = np.linalg.lstsq(np.vstack((before, ridge)), np.vstack(
        (now[:, -ny:], np.zeros((len(ridge), ny)))), rcond=None)[0].T.reshape(ny, past, width)
    product = np.zeros((past * ny, past * width))
    for i in range(past):
        product[i * ny:(i + 1) * ny, :(past - i) * width] = theta[:, i:].reshape(ny, -1)
    left, s, _ = np.linalg.svd(product @ before.T, full_matrices=False)
    for n in range(1, min(highest, past * ny - 1) + 1):
        to_state = ((left[:, :n] / np.sqrt(s[:n])).T @ product).T
        x, following = before @ to_state, after @ to_state
        C = np.linalg.lstsq(x, now[:, -ny:], rcond=None)[0]
        power = np.sum((now[:, -ny:] - x @ C) ** 2, axis=0) / len(stacked)
        move = np.linalg.lstsq(np.hstack((x, now)), following, rcond=None)[0].T
        score = len(stacked) * float(np.sum(np.log(power + 1e-300)))
        yield Start(score, *_modes(move[:, :n], move[:, n:] / size, step, free), delay)


def _modes(F: Array, G: Array, step: float, free: Free) -> tuple[ComplexArray, ComplexArray]:
    """Return poles and b of modes that from sample to sample do what x+ = F x + G z does."""
    values, right = np.linalg.eig(F)
    kept = values.imag >= 0.0
    values, entry = values[kept], np.linalg.solve(right, G.astype(complex))[kept]
    # A mode that changes its sign from sample to sample has no counterpart.
    values = np.where((values.imag == 0.0) & (values.real < 0.0), -values, values)
    values = np.maximum(np.abs(values), _SHORTEST) * np.exp(1j * np.angle(values))
    poles = bounded(np.asarray(np.log(values) / step, dtype=complex), free.limit, free.fastest)
    b = entry * (poles / np.expm1(poles * step))[:, np.newaxis]
    order = np.lexsort((poles.real, np.abs(poles), poles.imag > 0.0))       # as `canonical`
    return poles[order], b[order]


def _signals(record: RecordSamples, ny: int, step: float, delay: Array) -> Array:
    """Return inputs, averaged until the next sample, and the last outputs, less their means."""
    t = min((s.times for s in record.streams), key=len)
    z = np.empty((len(t), len(delay) + ny))
    edges, place = np.append(t, t[-1] + step), 0
    for s in record.inputs:
        for j in range(s.width):
            z[:, place] = cell_means(s, edges - delay[place])[j]
            place += 1
    for stream in record.streams:
        at = np.searchsorted(stream.times, t, side='right') - 1
        z[:, len(delay):][:, stream.channels] = stream.y[np.maximum(at, 0)]
    return np.asarray(z - z.mean(axis=0))
