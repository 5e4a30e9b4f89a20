# SPDX-License-Identifier: Apache-2.0
"""The Takenaka-Malmquist network as a block diagram ([TM] figure 1)."""

from __future__ import annotations

_WIDE, _HIGH, _GAP = 104.0, 46.0, 62.0
_LEFT, _TOP = 70.0, 40.0
_SUBSCRIPTS = str.maketrans('0123456789', '₀₁₂₃₄₅₆₇₈₉')


def network(count: int) -> tuple[str, float, float]:
    """
    Return the diagram of a chain of all-pass filters with a low-pass at each tap.

    Parameters
    ----------
    count : int
        Taps shown; the chain goes on.

    Returns
    -------
    body : str
        SVG elements.
    width, height : float
    """
    step, low = _WIDE + _GAP, _TOP + _HIGH + 40.0
    parts = ['<text class="title" x="12" y="18">[TM] figure 1: the network; every signal '
             'x, u, y goes through it</text>',
             _word(_LEFT - 46.0, _TOP + 27.0, 'x(t)'), _arrow(_LEFT - 26.0, _LEFT + _GAP - 6.0)]
    for k in range(count):
        name, left = f'σ{k}'.translate(_SUBSCRIPTS), _LEFT + _GAP + k * step
        tap, at = left - 0.5 * _GAP, _TOP + 0.5 * _HIGH
        parts += [_box(left, _TOP, f's − {name}', f's + {name}'),
                  _box(tap - 0.5 * _WIDE, low, f'√(2{name})', f's + {name}'),
                  f'<circle cx="{tap:g}" cy="{at:g}" r="3" fill="var(--ink)"/>',
                  _line(tap, at, tap, low), _line(tap, low + _HIGH, tap, low + _HIGH + 24.0),
                  _word(tap, low + _HIGH + 40.0, _through(k)),
                  _arrow(left + _WIDE, left + step - (6.0 if k < count - 1 else 20.0))]
    right = _LEFT + _GAP + count * step
    return ''.join([*parts, _word(right - 6.0, _TOP + 27.0, '…')]), right + 20.0, low + 110.0


def _through(k: int) -> str:
    """Return what the signal at a tap is: M_k W_(k-1) ... W_0 x."""
    before = ''.join(f'W{j}' for j in reversed(range(k)))
    return f'M{k}{before} x'.translate(_SUBSCRIPTS)


def _box(x: float, y: float, above: str, below: str) -> str:
    middle = x + 0.5 * _WIDE
    return (f'<rect x="{x:g}" y="{y:g}" width="{_WIDE:g}" height="{_HIGH:g}" fill="none" '
            f'stroke="var(--ink)"/>{_word(middle, y + 17.0, above)}'
            f'{_line(middle - 30.0, y + 23.0, middle + 30.0, y + 23.0)}'
            f'{_word(middle, y + 38.0, below)}')


def _word(x: float, y: float, text: str) -> str:
    return f'<text x="{x:g}" y="{y:g}" text-anchor="middle">{text}</text>'


def _line(x1: float, y1: float, x2: float, y2: float) -> str:
    return f'<path d="M{x1:g} {y1:g}L{x2:g} {y2:g}" stroke="var(--ink)" fill="none"/>'


def _arrow(x1: float, x2: float) -> str:
    y = _TOP + 0.5 * _HIGH
    return _line(x1, y, x2, y) + (f'<path d="M{x2:g} {y - 4:g}l6 4l-6 4z" '
                                  'fill="var(--ink)"/>')
