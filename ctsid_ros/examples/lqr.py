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

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_continuous_are

from ctsid_core.errors import DataError
from ctsid_core.linear.types import Array
from ctsid_core.model.statespace import StateSpace
from ctsid_core.signals.actuators import in_words
from ctsid_ros.examples.margins import DEVIATIONS, PADE, disc_margin, moved_poles, worst_margin


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
    scales = np.asarray(weights.inputs), np.asarray(weights.outputs)
    margin = disc_margin(model, gains.controller, *scales)
    if margin < least_margin:
        return Design(None, f'Refused: the loop has a disc margin of {margin:.2f} only, wanted '
                      f'is {least_margin:g}; allow larger deviations of the outputs.', margin)
    try:
        poles = moved_poles(model, pole_std)
    except np.linalg.LinAlgError:
        return Design(None, 'Refused: some poles of the model are so close together that they '
                      'cannot be moved one by one; lower its order.', margin)
    corner, worst = worst_margin(model, poles, gains.controller, *scales)
    if worst < least_margin:
        listed = ', '.join(f'{pole:.3g}' for pole in poles[corner] if pole.imag >= 0)
        return Design(None, f'Refused: with poles within {DEVIATIONS:g} standard deviations, at '
                      f'{listed} rad/s, the loop has a disc margin of {worst:.2f} only, wanted '
                      f'is {least_margin:g}.', margin, worst)
    worst = min(worst, margin)
    return Design(gains, f'Accepted: disc margin {margin:.2f}, {worst:.2f} at worst with poles '
                  f'within {DEVIATIONS:g} standard deviations{_late(model)}{_acts(model)}.',
                  margin, worst)


def compute_gains(model: StateSpace, weights: Weights) -> Gains:
    """
    Return the linear-quadratic gains and the Kalman gain of a model.

    Raises
    ------
    LinAlgError
        If there are none: a state that is not stable and cannot be controlled, or not observed.
    """
    plant = model.pade(PADE)
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


def _noise(model: StateSpace) -> Array:
    """Return the intensity of the innovations, as far as it is known and regular."""
    if model.noise is None:
        return np.eye(model.ny)
    return model.noise if np.linalg.cond(model.noise) < 1e12 else \
        model.noise + 1e-12 * max(np.trace(model.noise), 1e-300) * np.eye(model.ny)


def _late(model: StateSpace) -> str:
    late = max(model.delay, default=0.0)
    return f'; the dead time of {late:g} s was approximated in the design' if late else ''


def _acts(model: StateSpace) -> str:
    return ''.join(f'; {words}' for words in in_words(
        model.input_names, model.actuators, model.input_units))


def _check(model: StateSpace, pole_std: Array, weights: Weights) -> None:
    for name, given, wanted in (('weights.outputs', len(weights.outputs), model.ny),
                                ('weights.inputs', len(weights.inputs), model.nu),
                                ('pole_std', len(pole_std), model.n)):
        if given != wanted:
            raise DataError(f'`{name}` has {given} numbers, but the model wants {wanted}; give '
                            'one for each of its signals or poles')
