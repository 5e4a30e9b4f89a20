# SPDX-License-Identifier: Apache-2.0
"""SVG of matplotlib in fewer bytes, and the same to the eye."""

from __future__ import annotations

import re

_PLACES = re.compile(r'\b(d|x|y|transform)="([^"]*)"')
_FONTS = re.compile(r'font-family: [^;"]*sans-serif')
_NUMBER = re.compile(r'-?\d+\.\d+')
_FEWEST = 20        # dots of a kind that are worth a path
_USE = r'<use xlink:href="#(\w+)" x="([^"]*)" y="([^"]*)" style="([^"]*)"/>\s*'
_RUN = re.compile(rf'(?:{_USE}){{{_FEWEST},}}')
_DOT = re.compile(_USE)
_FILLED = re.compile(r'fill: (#[0-9a-f]{6})(?:; fill-opacity: ([\d.]+))?')


def compact(text: str, size: float) -> str:
    """
    Return an SVG with coordinates to a hundredth of a point, and with clouds of dots as paths.

    Parameters
    ----------
    text : str
        Of matplotlib.
    size : float
        Of dots: markers that are filled and have no edge [points].
    """
    text = re.sub(r'<metadata>.*?</metadata>\s*', '', text, flags=re.DOTALL)
    text = _FONTS.sub('font-family: sans-serif', text)
    text = _RUN.sub(lambda run: _as_paths(run[0], size), text)
    return _PLACES.sub(lambda found: f'{found[1]}="{_shortened(found[2])}"', text)


def _as_paths(run: str, size: float) -> str:
    """Return dots as points of a round pen, those of one colour together; all else as it is."""
    found, rest = dict[str, list[str]](), []
    for dot in _DOT.finditer(run):
        if _FILLED.fullmatch(dot[4]):
            found.setdefault(dot[4], []).append(f'M{_shortened(dot[2])} {_shortened(dot[3])}h0')
        else:
            rest.append(dot[0])
    paths = []
    for style, points in found.items():
        color, opacity = _FILLED.fullmatch(style).groups()      # type: ignore[union-attr]
        paths.append(f'<path d="{"".join(points)}" style="fill: none; stroke: {color}; '
                     f'stroke-width: {size:g}; stroke-linecap: round'
                     + (f'; stroke-opacity: {opacity}' if opacity else '') + '"/>\n')
    return ''.join((*paths, *rest))


def _shortened(text: str) -> str:
    short = _NUMBER.sub(lambda number: f'{float(number[0]):.2f}'.rstrip('0').rstrip('.'), text)
    return re.sub(r'\s*([MLQCZz])\s*', r'\1', re.sub(r'\s+', ' ', short)).strip()
