# SPDX-License-Identifier: Apache-2.0
"""The Takenaka-Malmquist network as a block diagram ([TM] figure 1)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ctsid_ros.report.drawing import INK, PAPER
from ctsid_ros.report.static import write_figure

_WIDE, _HIGH, _GAP = 104.0, 46.0, 62.0
_LEFT, _TOP = 70.0, 40.0
_SUBSCRIPTS = str.maketrans('0123456789', '₀₁₂₃₄₅₆₇₈₉')


def draw_network(path: Path, count: int) -> None:
    """
    Write the diagram of a chain of all-pass filters with a low-pass at each tap.

    Parameters
    ----------
    path : Path
    count : int
        Taps shown; the chain goes on.
    """
    from matplotlib.figure import Figure

    step, low = _WIDE + _GAP, _TOP + _HIGH + 40.0
    right = _LEFT + _GAP + count * step
    width, height = right + 20.0, low + 110.0
    figure = Figure(figsize=(width / 72.0, height / 72.0))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    axes.set_xlim(0.0, width)
    axes.set_ylim(height, 0.0)      # down, as one reads
    axes.text(12.0, 18.0, '[TM] figure 1: the network; every signal x, u, y goes through it',
              fontweight='bold', color=INK)
    at = _TOP + 0.5 * _HIGH
    _word(axes, _LEFT - 46.0, at, 'x(t)')
    _arrow(axes, (_LEFT - 26.0, at), (_LEFT + _GAP, at))
    for k in range(count):
        name, left = f'σ{k}'.translate(_SUBSCRIPTS), _LEFT + _GAP + k * step
        tap = left - 0.5 * _GAP
        _box(axes, left, _TOP, f's − {name}', f's + {name}')
        _box(axes, tap - 0.5 * _WIDE, low, f'√(2{name})', f's + {name}')
        axes.plot(tap, at, 'o', color=INK, markersize=4)
        _arrow(axes, (tap, at), (tap, low))
        _arrow(axes, (tap, low + _HIGH), (tap, low + _HIGH + 26.0))
        _word(axes, tap, low + _HIGH + 38.0, _through(k))
        _arrow(axes, (left + _WIDE, at), (left + step - 14.0 * (k == count - 1), at))
    _word(axes, right - 4.0, at, '…')
    write_figure(path, figure)


def _through(k: int) -> str:
    """Return what the signal at a tap is: M_k W_(k-1) ... W_0 x."""
    before = ''.join(f'W{j}' for j in reversed(range(k)))
    return f'M{k}{before} x'.translate(_SUBSCRIPTS)


def _box(axes: Any, x: float, y: float, above: str, below: str) -> None:
    from matplotlib.patches import Rectangle

    axes.add_patch(Rectangle((x, y), _WIDE, _HIGH, facecolor=PAPER, edgecolor=INK, zorder=2))
    middle, line = x + 0.5 * _WIDE, y + 0.5 * _HIGH
    axes.plot((middle - 30.0, middle + 30.0), (line, line), color=INK, linewidth=1.0)
    _word(axes, middle, y + 0.27 * _HIGH, above)
    _word(axes, middle, y + 0.75 * _HIGH, below)


def _word(axes: Any, x: float, y: float, text: str) -> None:
    axes.text(x, y, text, ha='center', va='center', color=INK, fontsize=11)


def _arrow(axes: Any, start: tuple[float, float], end: tuple[float, float]) -> None:
    axes.annotate('', end, start, arrowprops={'arrowstyle': '->', 'color': INK})
