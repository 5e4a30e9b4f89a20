# SPDX-License-Identifier: Apache-2.0
"""
A controller from an identified model: linear-quadratic gains, an observer, and their robustness.

The controller measures y and commands u:

    dz/dt = A z + B u + x_trim + L (y - C z - D u - y_trim)         u = -F z

F weighs outputs against inputs, L is the Kalman gain for the noise that was identified and some
more at the input. Whether the two together are robust does not follow from their optimality, so
it is computed: see `design`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice, product

import numpy as np
from scipy.linalg import solve_continuous_are

from ctsid_core.errors import DataError
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.statespace import StateSpace

DEVIATIONS = 3.0  # how far poles are moved, in standard deviations
_PADE = 3  # order of the approximation by which a dead time becomes states
_CORNERS = 500  # combinations of moved poles that are tried at most
_POINTS = 400  # frequencies of the loop's response


@dataclass(frozen=True)
class Weights:
    """
    What is wanted of the controller, in the units of the signals (Bryson's rule).

    Parameters
    ----------
    outputs : tuple of float, length ny
        Deviation of each output that is as unwelcome as ...
    inputs : tuple of float, length nu
        ... this use of each input. Smaller outputs or larger inputs: a faster controller.
    disturbance : float
        Unmeasured drive at the inputs: standard deviation of its mean over one second, as a
        fraction of `inputs`. Larger: the observer trusts the measurements more.

    Raises
    ------
    DataError
        If a number is not positive.
    """

    outputs: tuple[float, ...]
    inputs: tuple[float, ...]
    disturbance: float = 0.02

    def __post_init__(self) -> None:
        for name in ('outputs', 'inputs', 'disturbance'):
            if not np.all(np.asarray(getattr(self, name)) > 0):
                raise DataError(f'`{name}` is {getattr(self, name)!r}; wanted are positive '
                                'numbers')


@dataclass(frozen=True)
class Gains:
    """
    A controller.

    Parameters
    ----------
    feedback : ndarray, shape (nu, n)
        F. With dead times n counts the states that approximate them too; they come last.
    observer : ndarray, shape (n, ny)
        L [1/s].
    controller : StateSpace
        From the outputs to the inputs of the plant, complete: it needs no knowledge of the
        coordinates in which F and L are given.
    """

    feedback: Array
    observer: Array
    controller: StateSpace


@dataclass(frozen=True)
class Design:
    """
    Gains, or why there are none.

    Parameters
    ----------
    gains : Gains or None
    verdict : str
        A sentence.
    margin, worst_margin : float
        Disc margin of the model's loop, and the smallest with moved poles; NaN if not computed.
    """

    gains: Gains | None
    verdict: str
    margin: float = float('nan')
    worst_margin: float = float('nan')


def design(model: StateSpace, pole_std: Array, weights: Weights, least_margin: float = 0.4,
           ) -> Design:
    """
    Design a controller and try whether it survives what is not known of the model.

    Parameters
    ----------
    model : StateSpace
        Feedthrough is handled exactly. Dead times are approximated (Pade, order 3) in the design
        and in the test of stability, and exact in the margins.
    pole_std : ndarray, shape (n,)
        As of `Estimate`: standard deviation of each pole [rad/s], in the order of `model.poles`.
    weights : Weights
    least_margin : float
        Smallest disc margin that is accepted, 0 to 2. A margin m bears a loop gain between
        (2 - m) / (2 + m) and its inverse, a phase of 2 atan(m / 2), and mixtures of both.

    Returns
    -------
    Design
        Refused if no gains exist, or if the loop of the model or one with moved poles is not
        stable or has less margin. Every real pole is moved by 0 and +-3 standard deviations,
        every pair by 0 and by 3 in four directions, in all combinations (up to 500); what lies
        between them and the uncertainty of all but the poles is not looked at: the margin is
        what is kept in reserve for it.

    Raises
    ------
    DataError
        If weights or deviations do not fit the model.

    References
    ----------
    P. Seiler, A. Packard, P. Gahinet, "An Introduction to Disk Margins", IEEE Control Systems
    Magazine 40 (2020).
    """
    _check(model, pole_std, weights)
    if not np.isfinite(pole_std).all():
        return Design(None, 'Refused: how sure the poles are is not known.')
    try:
        gains = compute_gains(model, weights)
    except np.linalg.LinAlgError as error:
        return Design(None, f'Refused: there are no stabilising gains for this model ({error}).')
    margin = disc_margin(model, gains, weights)
    if margin < least_margin:
        return Design(None, f'Refused: the loop has a disc margin of {margin:.2f} only, wanted '
                      f'is {least_margin:g}; allow larger deviations of the outputs.', margin)
    worst, moved = margin, model
    for corner in corners(model, pole_std):
        at_corner = disc_margin(corner, gains, weights)
        if at_corner < worst:
            worst, moved = at_corner, corner
    if worst < least_margin:
        poles = ', '.join(f'{pole:.3g}' for pole in moved.poles if pole.imag >= 0)
        return Design(None, f'Refused: with poles within {DEVIATIONS:g} standard deviations, at '
                      f'{poles} rad/s, the loop has a disc margin of {worst:.2f} only, wanted '
                      f'is {least_margin:g}.', margin, worst)
    return Design(gains, f'Accepted: disc margin {margin:.2f}, {worst:.2f} at worst with poles '
                  f'within {DEVIATIONS:g} standard deviations{_late(model)}.', margin, worst)


def compute_gains(model: StateSpace, weights: Weights) -> Gains:
    """
    Return the linear-quadratic gains and the Kalman gain of a model.

    Raises
    ------
    LinAlgError
        If there are none: a state that is not stable and cannot be controlled, or not observed.
    """
    plant = model.pade(_PADE)
    A, B, C, D, K = plant.A, plant.B, plant.C, plant.D, plant.K
    Q = np.diag(1 / np.square(weights.outputs))
    R = np.diag(1 / np.square(weights.inputs)) + D.T @ Q @ D  # the cost is y'Qy + u'Ru
    S = C.T @ Q @ D
    F = np.linalg.solve(R, B.T @ solve_continuous_are(A, B, C.T @ Q @ C, R, s=S) + S.T)
    noise = _noise(model)
    drive = B * weights.disturbance * np.asarray(weights.inputs)
    # Innovations drive states and outputs alike: hence the cross term.
    P = solve_continuous_are(A.T, C.T, K @ noise @ K.T + drive @ drive.T, noise, s=K @ noise)
    L = np.linalg.solve(noise, (P @ C.T + K @ noise).T).T
    controller = StateSpace(
        A=A - B @ F - L @ C + L @ D @ F, B=L, C=-F, x_trim=plant.x_trim - L @ plant.y_trim,
        input_names=model.output_names, output_names=model.input_names,
        input_units=model.output_units, output_units=model.input_units)
    return Gains(F, L, controller)


def corners(model: StateSpace, pole_std: Array) -> Iterator[StateSpace]:
    """
    Yield the model with its poles moved by `DEVIATIONS` standard deviations.

    In modal coordinates, where B, C and K stay as they are. Up to 500 combinations; if there are
    more, the first 500 in a fixed random order.
    """
    values, vectors = np.linalg.eig(model.A)
    reach = DEVIATIONS * np.array([pole_std[np.argmin(abs(model.poles - p))] for p in values])
    upper = np.flatnonzero(values.imag >= 0)
    moves: list[tuple[complex, ...]] = [
        (0, 1, -1) if values[i].imag == 0 else (0, 1, -1, 1j, -1j) for i in upper]
    for combination in islice(_shuffled(moves), _CORNERS):
        shift = np.zeros(model.n, dtype=complex)
        for i, move in zip(upper, combination, strict=True):
            shift[i] = reach[i] * move
            shift[np.argmin(abs(values - values[i].conj()))] = np.conj(reach[i] * move)
        change = np.linalg.solve(vectors.T, (vectors * shift).T).T
        yield replace(model, A=model.A + change.real)


def disc_margin(model: StateSpace, gains: Gains, weights: Weights) -> float:
    """
    Return the smaller of the loop's disc margins at the plant's inputs and at its outputs.

    Signals are scaled by the weights. 0 if the loop is not stable. The frequencies are a grid
    with all resonances in it, not a search.
    """
    own = gains.controller
    plant = model.pade(_PADE)
    closed = np.block([[plant.A, plant.B @ own.C],
                       [own.B @ plant.C, own.A + own.B @ plant.D @ own.C]])
    poles = np.linalg.eigvals(closed)
    if poles.real.max() >= 0:
        return 0.0
    omega = _frequencies(poles)
    G = model.frequency_response(omega) * np.asarray(weights.inputs)  # scaled signals
    G /= np.asarray(weights.outputs)[:, np.newaxis]
    H = -own.frequency_response(omega) * np.asarray(weights.outputs)
    H /= np.asarray(weights.inputs)[:, np.newaxis]
    return 1 / max(_largest(H @ G), _largest(G @ H))


def _largest(loop: ComplexArray) -> float:
    """Return the largest singular value of (S - T) / 2, with S = (I + loop)^-1, T = I - S."""
    unit = np.eye(loop.shape[1])
    return float(np.max(np.linalg.norm(np.linalg.inv(unit + loop) - unit / 2, 2, axis=(1, 2))))


def _frequencies(poles: ComplexArray) -> Array:
    """Return a grid around the poles of the closed loop, near which the margin is smallest."""
    sizes = np.abs(poles)
    grid = np.geomspace(0.01 * sizes.min(), 100 * sizes.max(), _POINTS)
    return np.unique(np.concatenate([grid, sizes, poles.imag[poles.imag > 0]]))


def _shuffled(moves: list[tuple[complex, ...]]) -> Iterator[tuple[complex, ...]]:
    """Yield all combinations, or many in a fixed random order if there are too many."""
    if np.prod([float(len(own)) for own in moves]) <= _CORNERS:
        yield from product(*moves)
        return
    rng = np.random.default_rng(0)
    while True:
        yield tuple(own[rng.integers(len(own))] for own in moves)


def _noise(model: StateSpace) -> Array:
    """Return the intensity of the innovations, as far as it is known and regular."""
    if model.noise is None:
        return np.eye(model.ny)
    return model.noise if np.linalg.cond(model.noise) < 1e12 else \
        model.noise + 1e-12 * max(np.trace(model.noise), 1e-300) * np.eye(model.ny)


def _late(model: StateSpace) -> str:
    late = max(model.delay, default=0.0)
    return f'; the dead time of {late:g} s was approximated in the design' if late else ''


def _check(model: StateSpace, pole_std: Array, weights: Weights) -> None:
    for name, given, wanted in (('weights.outputs', len(weights.outputs), model.ny),
                                ('weights.inputs', len(weights.inputs), model.nu),
                                ('pole_std', len(pole_std), model.n)):
        if given != wanted:
            raise DataError(f'`{name}` has {given} numbers, but the model wants {wanted}; give '
                            'one for each of its signals or poles')
