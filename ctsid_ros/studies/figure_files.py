# SPDX-License-Identifier: Apache-2.0
"""Drawings as SVG files that stand by themselves; tables as Markdown and CSV."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import csv
from pathlib import Path

from ctsid_ros.report.svg import Axes, draw
from ctsid_ros.report.tables import Table

_STYLE = """<style>
svg { --ink: #1c2733; --soft: #5b6b7b; --line: #dde3e9; --shade: #c2410c; --c0: #1c2733;
  --c1: #1769c4; --c2: #c2410c; --c3: #15803d; --c4: #7e22ce; --c5: #0e7490; }
text { font: 12px system-ui, sans-serif; fill: var(--soft); }
.title { font-weight: 600; fill: var(--ink); }
</style>"""


def write_drawings(path: Path, rows: Sequence[Axes | Sequence[Axes]]) -> None:
    """Write drawings, those of a row side by side, as one file."""
    parts, top, width = [], 0.0, 0.0
    for row in rows:
        drawings, left = [row] if isinstance(row, Axes) else list(row), 0.0
        for axes in drawings:
            parts.append(draw(axes).replace(
                '<svg ', f'<svg x="{left:g}" y="{top:g}" width="{axes.width:g}" '
                f'height="{axes.height:g}" ', 1))
            left += axes.width
        top += max(axes.height for axes in drawings)
        width = max(width, left)
    write_svg(path, ''.join(parts), width, top)


def write_svg(path: Path, body: str, width: float, height: float) -> None:
    """Write SVG elements as one file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" '
        f'width="{width:g}" height="{height:g}">{_STYLE}<rect width="100%" height="100%" '
        f'fill="#ffffff"/>{body}</svg>\n', encoding='utf-8')


def write_table(path: Path, table: Table) -> None:
    """Write a table as Markdown and as CSV: two files of that name."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.with_suffix('.md').write_text(table.markdown() + '\n', encoding='utf-8')
    write_csv(path.with_suffix('.csv'), (table.head, *table.rows))


def write_csv(path: Path, rows: Iterable[Sequence[str]]) -> None:
    """Write rows as CSV."""
    with path.open('w', newline='', encoding='utf-8') as stream:
        csv.writer(stream, lineterminator='\n').writerows(rows)
