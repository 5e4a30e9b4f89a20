# SPDX-License-Identifier: Apache-2.0
"""The page of a report: one HTML file that needs no other, interactive where plotly is there."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ctsid_ros.report.document import (
    Bullets,
    Command,
    Explorer,
    Figure,
    Gallery,
    Headline,
    Picture,
    Section,
)
from ctsid_ros.report.drawing import Drawing
from ctsid_ros.report.interactive import figure, plotly_js
from ctsid_ros.report.static import NARROW, WIDE, inline_svg
from ctsid_ros.report.tables import Table
from ctsid_ros.report.words import cell, parts, printable

if TYPE_CHECKING:
    from jinja2 import Template

STATIC = ('The drawings of this page are fixed because plotly is not installed; '
          '`python3 -m pip install plotly`, and the next report has zoom, hover and linked axes.')
_FOLDER = Path(__file__).with_name('page')
_ALL_POINTS = 120_000   # of all curves: what a page of a few megabytes can hold


def to_html(title: str, sections: Sequence[Section], headline: Headline | None = None,
            series: Mapping[str, Any] | None = None) -> str:
    """
    Return a report as one HTML file that needs no other.

    Parameters
    ----------
    title : str
    sections : sequence of Section
    headline : Headline, optional
    series : mapping, optional
        What the explorer shows of each window or order: see `explorer.series`.
    """
    drawn = bool(_all(sections) or series)
    drawings = _Drawings(plotly_js() if drawn else None, sections)
    blocks = [{'title': section.title, 'folded': section.folded,
               'parts': [drawings.block(part) for part in section.parts]}
              for section in sections if any(
                  drawings.library or not isinstance(part, Explorer) for part in section.parts)]
    text: str = _template().render(
        title=title, headline=headline, blocks=blocks, library=drawings.library,
        figures=drawings.figures, series=series or {'frames': [], 'windows': []},
        style=_file('page.css'), script=_file('page.js'), static=STATIC * drawn)
    return text


class _Drawings:
    """Parts of a report as the template wants them; drawings are gathered on the way."""

    def __init__(self, library: str | None, sections: Sequence[Section]) -> None:
        self.library = library
        self.figures: list[dict[str, Any]] = []
        curves = sum(len(panel.curves) for drawing in _all(sections) for panel in drawing.panels)
        self._points = max(min(4000, _ALL_POINTS // max(curves, 1)), 300)

    def block(self, part: object) -> dict[str, Any]:
        if isinstance(part, Table):
            return {'kind': 'table', 'head': part.head, 'rows': part.rows, 'left': part.left}
        if isinstance(part, Bullets):
            return {'kind': 'list', 'items': part.items}
        if isinstance(part, Command):
            return {'kind': 'command', 'line': part.line}
        if isinstance(part, Gallery):
            return {'kind': 'gallery', 'columns': part.columns,
                    'figures': [self._figure(one) for one in part.figures]}
        if isinstance(part, Figure):
            return {'kind': 'gallery', 'columns': 1, 'figures': [self._figure(part)]}
        if isinstance(part, Picture):       # as an image: nothing in it is run
            return {'kind': 'picture', 'title': part.title,
                    'data': b64encode(part.svg).decode()}
        if isinstance(part, Explorer):
            return {'kind': 'explorer', 'first': part.first, 'what': part.what}
        return {'kind': 'text', 'text': part}

    def _figure(self, part: Figure) -> dict[str, Any]:
        drawing = part.drawing
        found: dict[str, Any] = {'title': part.title, 'caption': part.caption,
                                 'legend': drawing.legend, 'link': drawing.link,
                                 'picks': drawing.picks, 'wide': drawing.wide}
        if self.library is None:
            from markupsafe import Markup  # made by matplotlib, which escapes all words

            widths = (NARROW, WIDE) if drawing.wide else (NARROW,)
            return found | {'svg': [Markup(inline_svg(drawing, width)) for width in widths]}
        self.figures.append(figure(drawing, self._points))
        return found | {'number': len(self.figures) - 1,
                        'height': self.figures[-1]['layout']['height']}


def _all(sections: Sequence[Section]) -> list[Drawing]:
    found = [part for section in sections for part in section.parts]
    return [one.drawing for part in found for one in (
        part.figures if isinstance(part, Gallery) else [part] if isinstance(part, Figure) else [])]


@cache
def _template() -> Template:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(loader=FileSystemLoader(_FOLDER), autoescape=True,
                              undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {'cell': cell, 'printable': printable,
                            'code': lambda text: parts(printable(text))}
    return environment.get_template('page.html')


@cache
def _file(name: str) -> str:
    return (_FOLDER / name).read_text(encoding='utf-8')
