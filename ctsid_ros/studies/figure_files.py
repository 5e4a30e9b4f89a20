# SPDX-License-Identifier: Apache-2.0
"""Drawings as SVG files that stand by themselves."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ctsid_ros.svg import Axes, draw

_STYLE = """<style>
svg { --ink: #1c2733; --soft: #5b6b7b; --line: #dde3e9; --shade: #c2410c; --c0: #1c2733;
  --c1: #1769c4; --c2: #c2410c; --c3: #15803d; --c4: #7e22ce; --c5: #0e7490; }
text { font: 12px system-ui, sans-serif; fill: var(--soft); }
.title { font-weight: 600; fill: var(--ink); }
</style>"""


def write_drawings(path: Path, drawings: Sequence[Axes]) -> None:
    """Write drawings of equal width, one below the other, as one file."""
    parts, top = [], 0.0
    for axes in drawings:
        inner = draw(axes).replace('<svg ', f'<svg y="{top:g}" width="{axes.width:g}" '
                                   f'height="{axes.height:g}" ', 1)
        parts.append(inner)
        top += axes.height
    width = max(axes.width for axes in drawings)
    path.write_text(
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {top:g}" '
        f'width="{width:g}" height="{top:g}">{_STYLE}<rect width="100%" height="100%" '
        f'fill="#ffffff"/>{"".join(parts)}</svg>\n', encoding='utf-8')
