# SPDX-License-Identifier: Apache-2.0
"""
Did the plant change within the window? A score test at every twentieth of it.

The model was made from the whole window. Let its plant move by d1 before an instant and by d2
after it. To first order the prediction errors E = H^-1 (Y - G U) become E - J d, J = H^-1 dG U,
with H as it is (Box and Jenkins' separate noise model): regressors that no noise has touched.
Lines are turned into instants (`bases/instants.py`), so that 'before' and 'after' are columns;
the states at the instant and at the ends of the window and the trim are free on both sides. If
the plant has not changed, d1 = d2, and

    T = mean (d1 - d2)^2 / (v1 / g + v2 / (1 - g))

over the directions of A, B, C, D that both sides determine follows F. g is the share of a
direction's information that lies before; v1 and v2, the variances of the errors, may differ. Gusts
do not alarm: E is white where the model has a K.

No real plant is quite linear, and a record of one, if it is only long enough, gives a small
p-value: the change of the response must matter, too (`Change.matters`).

Sources: a score test for a change at an unknown time is that of Andrews (1993), Econometrica 61;
the local approach to faults that of Basseville (1998), Automatica 34.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from ctsid_core.bases.instants import at_instants, instants
from ctsid_core.bases.projection import Projection, as_real
from ctsid_core.likelihood.prediction_errors import jacobian, simulate_lines
from ctsid_core.likelihood.refine import affordable, growth, whitener
from ctsid_core.linear.free_entries import FreeEntries
from ctsid_core.linear.matrices import Matrices
from ctsid_core.linear.matrix_functions import svd
from ctsid_core.linear.tall_qr import triangle
from ctsid_core.linear.types import Array, Lines
from ctsid_core.settings import Settings

_BLOCKS = 20          # the window is split where two of them meet
_FEWEST = 4           # instants in each
_RANK = 1e-6          # relative singular value below which a direction is not determined
_RIDGE = 1e-6         # weight of a nuisance's prior: none, but no division by zero
_SMOOTHING = 160      # real numbers over which the errors' power is averaged
_BOTH = 0.01          # part of a direction's information that each side must have
_DEFECTIVE = 1e10     # condition of the predictor's modes beyond which they are none
_ENOUGH = 3           # errors to spare, per direction, on each side
_SIGNIFICANT = 1e-5   # p-value below which no more than 1 % of steady windows lie
_LARGE = 0.03         # size: mild nonlinearities of real plants reach 0.02
_SUGGESTIVE = 3e-4    # p-value that is enough ...
_HUGE = 0.15          # ... if the size is this
_GAIN = 0.1           # gain: what two plants leave unexplained, one plant need not explain either
GROWS = 3.0           # growth rate times duration, up to which a plant counts as stable


@dataclass(frozen=True)
class Change:
    """
    The most likely instant of a change of the plant, and the evidence for it.

    Parameters
    ----------
    share : float
        Where, as a part of the window.
    p_value : float
        Of 'the plant is the same on both sides'; the smallest of all instants.
    size : float
        Change of the response to the inputs, over this response, as the predictor sees them.
    gain : float
        Part of the errors' power that two plants explain and one does not.
    """

    share: float = 0.5
    p_value: float = 1.0
    size: float = 0.0
    gain: float = 0.0

    @property
    def matters(self) -> bool:
        """Whether it is certain, and so large that one model is wrong."""
        certain = (self.p_value < _SIGNIFICANT and self.size > _LARGE) or (
            self.p_value < _SUGGESTIVE and self.size > _HUGE)
        return certain and self.gain > _GAIN


@dataclass(frozen=True)
class Side:
    """
    Information from one side of an instant on the tested directions, nuisances projected out.

    Parameters
    ----------
    information : ndarray, shape (r, r)
    pull : ndarray, shape (r,)
        Errors along the directions.
    power : float
        Sum of their squares.
    spare : int
        Degrees of freedom: number of errors less that of nuisances.
    """

    information: Array
    pull: Array
    power: float
    spare: int


def most_likely_change(projection: Projection, m: Matrices, settings: Settings) -> Change:
    """
    Return the instant at which a change of the plant is most likely.

    Parameters
    ----------
    projection : Projection
        Of the whole window, that the model was made from.
    m : Matrices
        At the maximum of the likelihood, or near it.
    settings : Settings
        As used: `nmax` and `feedthrough` matter here.

    Notes
    -----
    Models too large to be refined are not tested, nor are unstable plants: their H shares the
    unstable poles and cannot stay as it is.
    """
    poles, modes = np.linalg.eig(m.A - m.K @ m.C)
    stable = np.max(poles.real) < 0.0 and \
        growth(m) * (projection.end - projection.start) < GROWS
    if not (stable and affordable(projection, len(m.A)) and np.linalg.cond(modes) < _DEFECTIVE):
        return Change()
    whiten = whitener(projection, m)[0]
    rows, tested = _directions(projection, m, settings)
    t = instants(projection, settings.nmax)
    edges = np.linspace(t[0], t[-1], min(_BLOCKS, len(t) // _FEWEST) + 1)
    blocks, step = _blocks(_in_time(rows, settings.nmax), t, edges, (poles, modes, whiten @ m.C))
    free = rows.shape[2] - 1 - tested
    sides = _sides(blocks, step, free)
    counts = len(m.C) * np.searchsorted(t, edges[1:-1])
    response = response_to_inputs(projection, m, settings.nmax)
    changes = [compared(float((edge - projection.start) / (projection.end - projection.start)),
                        _side(before, free + len(m.A), int(count)),
                        _side(after, free + len(m.A), len(m.C) * len(t) - int(count)), response)
               for edge, count, (before, after) in zip(edges[1:-1], counts, sides, strict=True)]
    return min(changes, key=lambda c: (c.p_value, -c.size), default=Change())


def _directions(projection: Projection, m: Matrices, settings: Settings) -> tuple[Array, int]:
    """
    Return nuisances, tested directions and errors (ny, 2 L, columns), and how many are tested.

    Nuisances are orthonormal. So are the tested directions without what nuisances explain.
    """
    flat, error, entries = weighed(projection, m, settings, settings.nmax)
    norm = np.linalg.norm(flat, axis=0)
    plant = entries & (norm > 0.0)
    other = ~entries & (norm > 0.0)
    nuisances = orthonormal(flat[:, other] / norm[other])[0]
    moving = flat[:, plant] / norm[plant]
    turn = orthonormal(moving - nuisances @ (nuisances.T @ moving))[1]
    joined = np.column_stack((nuisances, moving @ turn, error))
    return joined.reshape(len(m.C), -1, joined.shape[1]), turn.shape[1]


def weighed(projection: Projection, m: Matrices, settings: Settings,
            nmax: int) -> tuple[Array, Array, NDArray[np.bool_]]:
    """
    Return derivatives of -E (ny 2 L, entries) and E, white, and which entries are the plant's.

    Parameters
    ----------
    projection : Projection
        Of one record.
    m : Matrices
    settings : Settings
        Of which `feedthrough` matters here.
    nmax : int
    """
    whiten, error = whitener(projection, m)
    amplitude = _noise_amplitude(whiten @ error, nmax)
    columns = np.tensordot(whiten, _sensitivity(projection, m, settings.feedthrough), axes=1)
    columns /= amplitude[:, :, np.newaxis]
    flat = columns.reshape(-1, columns.shape[2])
    return (flat, (whiten @ error / amplitude).ravel(),
            FreeEntries.of(m, settings.feedthrough).mask('A', 'B', 'C', 'D'))


def _noise_amplitude(error: Array, nmax: int) -> Array:
    """
    Return the amplitude of the errors, smoothed over neighbouring lines (ny, 2 L).

    One where errors are white. A model that has not found the process noise leaves coloured
    ones, of which all that a slow direction finds looks certain.
    """
    count = 2 * ((nmax + 2) // 2)
    power = error.reshape(len(error), -1, count) ** 2
    width = min(_SMOOTHING, count)
    sums = np.cumsum(np.pad(power, ((0, 0), (0, 0), (1, 0))), axis=2)
    first = np.clip(np.arange(count) - width // 2, 0, count - width)
    mean = (sums[:, :, first + width] - sums[:, :, first]) / width
    amplitude: Array = np.sqrt(mean.reshape(error.shape)) + 1e-150
    return amplitude


def _sensitivity(projection: Projection, m: Matrices, feedthrough: bool) -> Array:
    """
    Return the derivatives of -E by the plant, from the inputs to the outputs (ny, 2 L, entries).

    With H as it is, they are H^-1 dG U.
    """
    plain = jacobian(projection, replace(m, K=np.zeros_like(m.K)), feedthrough, with_noise=False)
    if not np.any(m.K):
        return plain
    ny, width, entries = plain.shape
    lines = plain[:, 0::2] + 1j * plain[:, 1::2]
    systems = projection.s[:, np.newaxis, np.newaxis] * np.eye(len(m.A)) - (m.A - m.K @ m.C)
    inverse = np.eye(ny) - m.C @ np.linalg.solve(systems, np.broadcast_to(
        m.K, (len(systems), *m.K.shape)))
    found = np.matmul(inverse, np.swapaxes(lines, 0, 1))               # (L, ny, entries)
    seen: Array = np.stack((found.real, found.imag), axis=1).transpose(2, 0, 1, 3)
    return seen.reshape(ny, width, entries)


def orthonormal(columns: Array) -> tuple[Array, Array]:
    """Return an orthonormal basis of columns, and the matrix that makes it of them."""
    if not columns.shape[1]:
        return columns, np.empty((0, 0))
    _, s, right = svd(triangle(columns))
    kept = s > _RANK * max(s[0], 1e-300)
    turn = right[kept].T / s[kept]
    return columns @ turn, turn


def _in_time(rows: Array, nmax: int) -> Array:
    """Return lines (ny, 2 L, columns) at the instants (ny, N, columns)."""
    ny, lines, width = rows.shape
    seen = at_instants(np.swapaxes(rows, 1, 2).reshape(-1, lines), nmax)
    return np.swapaxes(seen.reshape(ny, width, -1), 1, 2)


def _blocks(rows: Array, t: Array, edges: Array, predictor: tuple[Lines, Lines, Array],
            ) -> tuple[list[Array], Array]:
    """
    Return each block's columns, free responses from its start before all others, compressed.

    And what a state at the start of one block has become at the start of the next (n, n).
    The predictor is given by its poles, its modes and its output matrix.
    """
    poles, modes, C = predictor
    inward, root = np.linalg.inv(modes), np.sqrt(np.gradient(t))
    place = np.clip(np.searchsorted(edges, t, side='right'), 1, len(edges) - 1)
    blocks = []
    for k, start in enumerate(edges[:-1], start=1):
        inside = place == k
        decay = np.exp(np.outer(t[inside] - start, poles)) * root[inside, np.newaxis]
        free = ((C @ modes)[:, np.newaxis] * decay @ inward).real
        both = np.concatenate((free, rows[:, inside]), axis=2)
        blocks.append(both.reshape(-1, both.shape[2]))
    n = len(poles)
    size = np.max([np.linalg.norm(b[:, :n], axis=0) for b in blocks], axis=0) + 1e-150
    for block in blocks:
        block[:, :n] /= size
    step = (modes * np.exp(poles * (edges[1] - edges[0])) @ inward).real
    return [_triangle(block) for block in blocks], size[:, np.newaxis] * step / size


def _triangle(*stack: Array) -> Array:
    found: Array = triangle(np.vstack(stack))
    return found


def _sides(blocks: list[Array], step: Array, free: int) -> list[tuple[Array, Array]]:
    """
    Return, for every instant, triangles of what lies before it and of what lies after it.

    Columns are free responses and `free` nuisances, then the tested directions and the errors.
    Before the instant there is no free response; one that began there goes on through all
    later blocks.
    """
    n, width = len(step), blocks[0].shape[1]
    ridge = _RIDGE * np.eye(n + free, width)
    before, after = [ridge], [ridge]
    for block in blocks[:-1]:
        still = block.copy()
        still[:, :n] = 0.0
        before.append(_triangle(before[-1], still))
    for block in blocks[:0:-1]:
        later = after[-1].copy()
        later[:, :n] = later[:, :n] @ step
        after.append(_triangle(ridge, block, later))
    return list(zip(before[1:], after[:0:-1], strict=True))


def _side(triangle: Array, free: int, count: int) -> Side:
    """Return the information of a side, from its triangle, nuisances projected out."""
    left = triangle[free:, free:]
    directions, errors = left[:, :-1], left[:, -1]
    return Side(directions.T @ directions, directions.T @ errors, float(errors @ errors),
                count - free)


def response_to_inputs(projection: Projection, m: Matrices, nmax: int) -> float:
    """Return the norm of the predictor's response to the inputs, in units of the errors."""
    whiten, error = whitener(projection, m)
    amplitude = _noise_amplitude(whiten @ error, nmax)
    return float(np.linalg.norm(whiten @ _response(projection, m) / amplitude))


def _response(projection: Projection, m: Matrices) -> Array:
    """Return the predictor's response to the inputs, without constants (ny, 2 L)."""
    nothing = np.zeros_like
    predictor = Matrices(A=m.A - m.K @ m.C, B=m.B - m.K @ m.D, C=m.C, D=m.D, K=nothing(m.K),
                      tail=nothing(m.tail), x_trim=nothing(m.x_trim), y_trim=nothing(m.y_trim))
    y, ones = as_real(simulate_lines(projection, predictor)), as_real(projection.ones)
    still: Array = (y @ ones.T) / np.sum(ones ** 2, axis=1) @ ones if len(ones) else 0.0 * y
    return y - still


def compared(share: float, before: Side, after: Side, response: float, *,
             alone: bool = False) -> Change:
    """
    Compare two sides; `response` is the norm of the response to the inputs.

    The gain is over all errors, or, if the first side `alone` is in question, over twice its own:
    the same where the sides are alike.
    """
    values, vectors = np.linalg.eigh(before.information + after.information)
    kept = values > _RANK
    turn = vectors[:, kept] / np.sqrt(values[kept])
    g, own = np.linalg.eigh(turn.T @ before.information @ turn)
    known = (g > _BOTH) & (g < 1.0 - _BOTH)
    turn, g, count = (turn @ own)[:, known], g[known], int(known.sum())
    spare = before.spare - count, after.spare - count
    if not count or min(spare) < _ENOUGH * count:
        return Change(share)
    first, second = (turn.T @ before.pull) / g, (turn.T @ after.pull) / (1.0 - g)
    left = (max(before.power - float(g @ first ** 2), 1e-300),
            max(after.power - float((1.0 - g) @ second ** 2), 1e-300))
    one, other = left[0] / spare[0] / g, left[1] / spare[1] / (1.0 - g)
    freedom = np.mean(one + other) ** 2 / (np.mean(one) ** 2 / spare[0]
                                           + np.mean(other) ** 2 / spare[1])    # Satterthwaite
    moved, scatter = (first - second) ** 2, one + other
    excess = float(g * (1.0 - g) @ (moved - scatter)) / (share * (1.0 - share))
    explained = float(g * (1.0 - g) @ moved)
    unexplained = min(left[0] + left[1], 2.0 * left[0]) if alone else left[0] + left[1]
    return Change(share, float(fdtrc(count, freedom, np.mean(moved / scatter))),
                  float(np.sqrt(max(excess, 0.0))) / max(response, 1e-300),
                  explained / (explained + unexplained))
