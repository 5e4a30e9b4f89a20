# SPDX-License-Identifier: Apache-2.0
"""
How much a loop of plant and controller bears: disc margins, also with poles moved.

Signals are scaled, so that margins do not depend on units. Frequencies are a grid with all
resonances of the closed loop in it, not a search.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice, product

import numpy as np

from ctsid_core.linear.matrix_functions import SOUND
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.statespace import StateSpace

DEVIATIONS = 3.0  # how far poles are moved, in standard deviations
PADE = 3  # order of the approximation by which a dead time becomes states
CORNERS = 500  # combinations of moved poles that are tried at most
_AT_ONCE = 50  # of these together: their responses take some megabytes
_POINTS = 400  # frequencies of the loop's response


def disc_margin(model: StateSpace, controller: StateSpace, inputs: Array, outputs: Array) -> float:
    """
    Return the smaller of the loop's disc margins at the plant's inputs and at its outputs.

    Parameters
    ----------
    model : StateSpace
        The plant. Dead times are exact in the margin, approximated in the test of stability.
    controller : StateSpace
        From the outputs of the plant to its inputs.
    inputs, outputs : ndarray, shapes (nu,), (ny,)
        Scales of the signals.

    Returns
    -------
    float
        0 if the loop is not stable.
    """
    poles: ComplexArray = np.linalg.eigvals(_closed(model, controller)).astype(complex)
    if np.max(poles.real) >= 0:
        return 0.0
    omega = _frequencies(poles[np.newaxis])[0]
    return _margin(model.frequency_response(omega), controller.frequency_response(omega),
                   inputs, outputs)


def moved_poles(model: StateSpace, pole_std: Array) -> ComplexArray:
    """
    Return the eigenvalues of A, moved by `DEVIATIONS` standard deviations: a row per combination.

    Every real pole by 0 and +-, every pair by 0 and in four directions, in all combinations; if
    there are more than 500, 500 in a fixed random order. The first row is that of the model.

    Raises
    ------
    LinAlgError
        If poles lie so close together that A has no sound eigenvectors.
    """
    values, vectors = np.linalg.eig(model.A)
    if not np.linalg.cond(vectors) < SOUND:
        raise np.linalg.LinAlgError('poles coincide')
    reach = DEVIATIONS * np.array([pole_std[np.argmin(abs(model.poles - p))] for p in values])
    upper = np.flatnonzero(values.imag >= 0)
    conjugate = [int(np.argmin(abs(values - values[i].conj()))) for i in upper]
    moves: list[tuple[complex, ...]] = [
        (0, 1, -1) if values[i].imag == 0 else (0, 1, -1, 1j, -1j) for i in upper]
    rows = np.array(list(islice(_combinations(moves), CORNERS)))
    shift = np.zeros((len(rows), model.n), dtype=complex)
    shift[:, upper] = reach[upper] * rows
    shift[:, conjugate] = (reach[upper] * rows).conj()
    moved: ComplexArray = values + shift
    return moved


def moved_matrices(model: StateSpace, poles: ComplexArray) -> Array:
    """Return A with its eigenvectors and these eigenvalues, for each row of `moved_poles`."""
    values, vectors = np.linalg.eig(model.A)
    changes = (vectors * (poles - values)[:, np.newaxis, :]) @ np.linalg.inv(vectors)
    matrices: Array = model.A + changes.real
    return matrices


def worst_margin(model: StateSpace, poles: ComplexArray, controller: StateSpace, inputs: Array,
                 outputs: Array) -> tuple[int, float]:
    """
    Return for which row of `moved_poles` the disc margin is smallest, and that margin.

    In modal coordinates, where B, C and K stay as they are. What lies between the rows is not
    looked at.
    """
    closed = np.tile(_closed(model, controller), (len(poles), 1, 1))
    closed[:, :model.n, :model.n] = moved_matrices(model, poles)
    loops: ComplexArray = np.linalg.eigvals(closed).astype(complex)
    unstable = np.flatnonzero(loops.real.max(axis=1) >= 0)
    if len(unstable):
        return int(unstable[0]), 0.0
    omega = _frequencies(loops)
    margins = [_margin(G, H, inputs, outputs)
               for G, H in _responses(model, poles, controller, omega)]
    worst = int(np.argmin(margins))
    return worst, margins[worst]


def _responses(model: StateSpace, poles: ComplexArray, controller: StateSpace, omega: Array
               ) -> Iterator[tuple[ComplexArray, ComplexArray]]:
    """Yield the responses of plant and controller, a row of frequencies and poles at a time."""
    vectors = np.linalg.eig(model.A)[1]
    left, right = model.C @ vectors, np.linalg.solve(vectors, model.B)
    for first in range(0, len(poles), _AT_ONCE):
        rows = slice(first, first + _AT_ONCE)
        s = 1j * omega[rows]
        modes = 1 / (s[..., np.newaxis] - poles[rows, np.newaxis, :])
        late = np.exp(-s[..., np.newaxis, np.newaxis] * np.asarray(model.delay))
        G = ((modes[..., np.newaxis, :] * left) @ right + model.D) * late
        H = controller.frequency_response(omega[rows].ravel())
        yield from zip(G, H.reshape(*s.shape, model.nu, model.ny), strict=True)


def _closed(model: StateSpace, controller: StateSpace) -> Array:
    """Return the matrix of the closed loop; the states of the model come first."""
    plant, own = model.pade(PADE), controller
    return np.block([[plant.A, plant.B @ own.C],
                     [own.B @ plant.C, own.A + own.B @ plant.D @ own.C]])


def _margin(G: ComplexArray, H: ComplexArray, inputs: Array, outputs: Array) -> float:
    G = G * inputs / outputs[:, np.newaxis]
    H = -H * outputs / inputs[:, np.newaxis]
    return 1 / max(_largest(H @ G), _largest(G @ H))


def _largest(loop: ComplexArray) -> float:
    """Return the largest singular value of (S - T) / 2, with S = (I + loop)^-1, T = I - S."""
    size = loop.shape[1]
    found = np.linalg.inv(np.eye(size) + loop) - np.eye(size) / 2
    squares = np.sum(np.abs(found) ** 2, axis=(1, 2))  # of all singular values together
    if size == 1:
        return float(np.sqrt(squares.max()))
    if size == 2:  # written out: LAPACK would take most of the time of a design
        gap = np.sqrt(np.maximum(squares ** 2 - 4 * np.abs(np.linalg.det(found)) ** 2, 0))
        return float(np.sqrt(np.max(squares + gap) / 2))
    near = found[squares >= squares.max() / size * (1 - 1e-9)]
    return float(np.linalg.norm(near, 2, axis=(1, 2)).max())


def _frequencies(poles: ComplexArray) -> Array:
    """Return grids around the poles of closed loops, near which the margin is smallest."""
    sizes = np.abs(poles)
    grid = np.geomspace(0.01 * sizes.min(axis=1), 100 * sizes.max(axis=1), _POINTS, axis=1)
    damped = np.where(poles.imag > 0, poles.imag, sizes)
    return np.concatenate([grid, sizes, damped], axis=1)


def _combinations(moves: list[tuple[complex, ...]]) -> Iterator[tuple[complex, ...]]:
    """Yield all combinations, or many in a fixed random order if there are too many."""
    if np.prod([float(len(own)) for own in moves]) <= CORNERS:
        yield from product(*moves)
        return
    yield (0,) * len(moves)
    rng = np.random.default_rng(0)
    while True:
        yield tuple(own[rng.integers(len(own))] for own in moves)
