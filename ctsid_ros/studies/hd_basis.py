# SPDX-License-Identifier: Apache-2.0
"""
Figures 1 to 3 of [HD]: Hermite functions, their effective support, the ball of stable poles.

Nothing is random here. Figure 1: orders 0 to 10. Figure 2: the largest of all functions up to
order 200 at each t, and single ones; they vanish beyond +-sqrt(401). Figure 3: poles inside the
ball are stable for the modified differentiation operator, (lambda + beta) / gamma inside the unit
circle; drawn with beta = 3, gamma = 20 and the poles of section 5.1.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ctsid_core.bases.hermite_functions import hermite_functions
from ctsid_core.linear.types import Array
from ctsid_ros.report.drawing import Axes, Curve, Span
from ctsid_ros.report.static import write_drawings
from ctsid_ros.report.tables import Table
from ctsid_ros.studies.experiments import second_order
from ctsid_ros.studies.figure_files import write_table
from ctsid_ros.studies.runner import arguments

HIGHEST = 200
BETA, GAMMA = 3.0, 20.0
_SIZE = 400.0


def first_functions() -> Axes:
    """Return the Hermite functions of order 0 to 10 ([HD] eq. 16)."""
    t = np.linspace(-7.0, 7.0, 561)
    curves = [Curve(t, h, f'h{n}' if n in (0, 5, 10) else '', n // 5 + 1,
                    opacity=1.0 if n in (0, 5, 10) else 0.35)
              for n, h in enumerate(hermite_functions(10, t))]
    return Axes(curves, title='[HD] figure 1: Hermite functions of order 0 to 10', x_label='t',
                y_label='h_n(t)', height=300.0)


def support() -> float:
    """Return where the effective support ends ([HD] 4.1)."""
    return float(np.sqrt(2.0 * HIGHEST + 1.0))


def largest(t: Array, highest: int = HIGHEST) -> Array:
    """Return the largest |h_n(t)| of all orders up to the highest, at each t."""
    size: Array = np.abs(hermite_functions(highest, t)).max(axis=0)
    return size


def whole_basis() -> Axes:
    """Return the basis of order 200, and where it is numerically significant."""
    t, edge = np.linspace(-25.0, 25.0, 1001), support()
    h = hermite_functions(HIGHEST, t)
    size = largest(t)
    curves = [Curve(t, h[n], '', 1, opacity=0.25) for n in range(0, HIGHEST + 1, 20)]
    curves += [Curve(t, size, 'largest of all', 2), Curve(t, -size, '', 2),
               *(Curve(np.full(2, x), np.array([-1.0, 1.0]), label, 0, 'dashed')
                 for x, label in ((-edge, 'effective support'), (edge, '')))]
    return Axes(curves, title='[HD] figure 2: basis of order 200', x_label='t',
                y_label='h_n(t)', spans=(Span(-edge, edge, 2),), y_limits=(-0.8, 0.8),
                height=300.0)


def ball() -> Axes:
    """Return the region of stable poles in the complex plane ([HD] 4.2)."""
    turn = np.linspace(0.0, 2.0 * np.pi, 361)
    poles = second_order().poles
    return Axes([Curve(-BETA + GAMMA * np.cos(turn), GAMMA * np.sin(turn), 'ball', 1),
                 Curve(np.zeros(2), np.array([-30.0, 30.0]), '', 0, 'dashed'),
                 Curve(np.array([-BETA]), np.zeros(1), '-beta', 2, 'cloud'),
                 Curve(poles.real, poles.imag, 'poles of 5.1', 0, 'cross')],
                title='[HD] figure 3', x_label='Re [rad/s]', y_label='Im [rad/s]',
                x_limits=(-BETA - 1.3 * GAMMA, -BETA + 1.3 * GAMMA),
                y_limits=(-1.3 * GAMMA, 1.3 * GAMMA), width=_SIZE + 76.0, height=_SIZE + 70.0)


def main(argv: Sequence[str] | None = None) -> int:
    """Write the figures, and how large the functions still are around the edge."""
    given = arguments(__doc__, 'hd-basis', None, argv)
    for number, drawing in enumerate((first_functions(), whole_basis(), ball()), 1):
        write_drawings(given.out / f'hd_figure_{number}.svg', [drawing])
    at = np.array([0.5, 0.9, 1.0, 1.05, 1.1, 1.2])
    rows = tuple((f'{k:g}', f'{size:.2g}') for k, size in
                 zip(at, largest(at * support()), strict=True))
    table = Table(('t over the effective support', 'largest function up to order 200'), rows)
    write_table(given.out / 'hd_basis', table)
    print(f'\n{table.text()}\n\nTable and figures: {given.out}')
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
