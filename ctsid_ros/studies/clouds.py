# SPDX-License-Identifier: Apache-2.0
"""Estimates of many runs in one drawing: Bode curves, eigenvalues."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.statespace import StateSpace
from ctsid_ros.report.drawing import Axes, Curve
from ctsid_ros.studies.monte_carlo import Outcome

_SHOWN = 15      # curves; the band tells of all runs
_SPREADS = 4.0   # typical errors of the first method to each side of an eigenvalue
WIDTH = 460.0


def bode(done: Sequence[Outcome], truth: StateSpace, omega: Array, output: int,
         title: str, color: int) -> tuple[Axes, Axes]:
    """
    Return magnitude and phase of one output's response to the first input.

    Parameters
    ----------
    done : sequence of Outcome
    truth : StateSpace
    omega : ndarray, shape (K,)
        [rad/s]
    output : int
    title : str
    color : int

    Returns
    -------
    axes : tuple of Axes
        The truth, single runs, and the band that holds 95 of 100 runs.
    """
    true = truth.frequency_response(omega)[:, output, 0]
    own = np.array([o.model.frequency_response(omega)[:, output, 0]
                    for o in done if o.model is not None]).reshape(-1, len(omega))
    own = own if len(own) else np.full((1, len(omega)), np.nan + 0j)
    sizes = 20.0 * np.log10(np.abs(own))
    return (_one(20.0 * np.log10(np.abs(true)), sizes, omega, title,
                 f'|y{output + 1}/u| [dB]', color),
            _one(phase(true, true), phase(own, true), omega, '',
                 f'phase y{output + 1}/u [deg]', color))


def phase(response: ComplexArray, true: ComplexArray) -> Array:
    """
    Return the phase of a response [deg], without jumps where it is near to the truth.

    Parameters
    ----------
    response : ndarray, shape (..., K)
    true : ndarray, shape (K,)
    """
    turn = np.unwrap(np.angle(true))
    return np.asarray(np.degrees(turn + np.angle(response / np.exp(1j * turn))))


def _one(true: Array, own: Array, omega: Array, title: str, label: str, color: int) -> Axes:
    low, high = np.quantile(own, (0.025, 0.975), axis=0)
    room = 0.35 * np.ptp(true) + 3.0
    curves = [Curve(omega, row, '', color, opacity=0.5) for row in own[:_SHOWN]]
    curves += [Curve(omega, np.median(own, axis=0), '', color, low=low, high=high, opacity=0.0),
               Curve(omega, true, '', 0, 'dashed')]
    return Axes(curves, title=title, x_label='frequency [rad/s]', y_label=label, x_log=True,
                y_limits=(float(np.min(true) - room), float(np.max(true) + room)), width=WIDTH)


def eigenvalues(clouds: Sequence[tuple[str, Sequence[Outcome]]], truth: ComplexArray,
                title: str, around: tuple[float, float, float]) -> list[list[Axes]]:
    """
    Return all estimated eigenvalues in the complex plane, method by method.

    Parameters
    ----------
    clouds : sequence of (label, outcomes)
        Methods; they get the colors 1, 2, ...
    truth : ndarray, shape (n,)
    title : str
    around : (left, right, height)
        What is shown of the plane [rad/s].

    Returns
    -------
    rows : list of list of Axes
        A row for each method: the plane, and each true eigenvalue (one of a pair) close by, at a
        scale that suits the first method and is the same for all. How many lie outside is said.
    """
    left, right, height = around
    places = [i for i, p in enumerate(truth) if p.imag >= 0.0]
    spread = [_SPREADS * _typical([o.error[i] for o in clouds[0][1]]) for i in places]
    rows = []
    for color, (label, done) in enumerate(clouds, 1):
        row = [_plane(np.concatenate([truth + o.error for o in done]), truth, color,
                      f'{title}, {label}', (left, right), (-height, height), 1.1 * WIDTH)]
        for i, room in zip(places, spread, strict=True):
            own = np.array([truth[i] + o.error[i] for o in done])
            x, y = float(truth[i].real), float(truth[i].imag)
            row.append(_plane(own, truth[i:i + 1], color, _shown(complex(truth[i])),
                              (x - room, x + room), (y - room, y + room), 0.7 * WIDTH))
        rows.append(row)
    return rows


def _typical(errors: Sequence[complex]) -> float:
    """Return the size that two in three errors do not exceed."""
    found = np.abs(np.array(errors))
    found = found[np.isfinite(found)]
    return float(np.quantile(found, 2.0 / 3.0)) if len(found) else 1.0


def _shown(pole: complex) -> str:
    return f'{pole.real:.4g}' + (f' + {pole.imag:.4g}i' if pole.imag else '')


def _plane(found: ComplexArray, truth: ComplexArray, color: int, title: str,
           x: tuple[float, float], y: tuple[float, float], width: float) -> Axes:
    found = found[np.isfinite(found)]
    outside = int(np.sum((found.real < x[0]) | (found.real > x[1]) | (found.imag < y[0])
                         | (found.imag > y[1])))
    curves = [Curve(truth.real, truth.imag, '', 0, 'cross'),
              Curve(found.real, found.imag, '', color, 'cloud', opacity=0.6)]
    return Axes(curves, title=title, x_label='Re [rad/s]' + (
        f' ({outside} of {len(found)} outside)' if outside else ''), y_label='Im [rad/s]',
        x_limits=x, y_limits=y, width=width, height=230.0)


def error_bars(x: Array, parts: Sequence[tuple[str, Array, Array, int]], *, title: str,
               x_label: str, y_label: str, log: bool,
               y_limits: tuple[float, float]) -> Axes:
    """
    Return means with a bar of one standard deviation to each side.

    Parameters
    ----------
    x : ndarray, shape (M,)
    parts : sequence of (label, mean, standard deviation, color)
        Drawn a little beside each other.
    title, x_label, y_label : str
    log : bool
        Of x.
    y_limits : (low, high)
    """
    move: Callable[[int], Array] = (lambda k: x * 1.03 ** k) if log else \
        (lambda k: x + 0.006 * float(np.ptp(x)) * k)
    curves = [Curve(move(2 * i - len(parts) + 1), mean, label, color, 'both', mean - std,
                    mean + std, bars=True) for i, (label, mean, std, color) in enumerate(parts)]
    return Axes(curves, title=title, x_label=x_label, y_label=y_label, x_log=log,
                levels=(0.0,), y_limits=y_limits, width=2 * WIDTH)
