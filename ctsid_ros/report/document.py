# SPDX-License-Identifier: Apache-2.0
"""A report once, rendered three times: for the terminal, as Markdown, as one HTML file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
import re
import textwrap

from ctsid_ros.report.tables import Table

WIDTH = 99

GLOSSARY = 'Each quantity is explained in docs/glossary.md of ctsid.'


@dataclass(frozen=True)
class Bullets:
    """A list of sentences."""

    items: tuple[str, ...]


@dataclass(frozen=True)
class Figure:
    """A drawing (SVG) with its caption; in HTML only."""

    svg: str
    caption: str


Part = str | Table | Bullets | Figure


@dataclass(frozen=True)
class Section:
    """
    A heading and what comes below.

    Parameters
    ----------
    title : str
    parts : tuple
        Paragraphs, tables, lists and figures.
    brief : bool
        Whether it belongs on the terminal too.
    """

    title: str
    parts: tuple[Part, ...]
    brief: bool = True


def to_text(sections: Sequence[Section]) -> str:
    """Return the brief sections as text for a terminal."""
    blocks = []
    for section in sections:
        parts = [_text(part) for part in section.parts if not isinstance(part, Figure)]
        if section.brief and parts:
            blocks.append('\n'.join([section.title, *parts]) if section.title
                          else '\n'.join(parts))
    return '\n\n'.join(blocks)


def _text(part: Part) -> str:
    if isinstance(part, Table):
        return part.text()
    if isinstance(part, Bullets):
        return '\n'.join(wrapped(item, '  - ', '    ') for item in part.items)
    return wrapped(part, '  ', '  ') if isinstance(part, str) else ''


def wrapped(text: str, first: str = '', rest: str = '') -> str:
    """Return text in lines of a terminal's width."""
    return textwrap.fill(text, WIDTH, initial_indent=first, subsequent_indent=rest,
                         break_long_words=False, break_on_hyphens=False)


def to_markdown(title: str, sections: Sequence[Section]) -> str:
    """Return all sections as Markdown, without figures."""
    blocks = [f'# {title}']
    for section in sections:
        parts = [_markdown(part) for part in section.parts if not isinstance(part, Figure)]
        if parts:
            blocks += [f'## {section.title}'] if section.title else []
            blocks += parts
    return '\n\n'.join(blocks) + '\n'


def _markdown(part: Part) -> str:
    if isinstance(part, Table):
        return part.markdown()
    if isinstance(part, Bullets):
        return '\n'.join(f'- {item}' for item in part.items)
    return part if isinstance(part, str) else ''


def to_html(title: str, sections: Sequence[Section]) -> str:
    """Return all sections as one HTML file that needs no other."""
    blocks = []
    for section in sections:
        if section.parts:
            head = f'<h2>{escape(section.title)}</h2>\n' if section.title else ''
            blocks.append(f'<section>\n{head}' + '\n'.join(map(_html, section.parts))
                          + '\n</section>')
    return _PAGE.format(title=escape(title), style=_STYLE, body='\n'.join(blocks))


def _html(part: Part) -> str:
    if isinstance(part, Table):
        return part.html()
    if isinstance(part, Bullets):
        return '<ul>' + '\n'.join(f'<li>{_inline(item)}</li>' for item in part.items) + '</ul>'
    if isinstance(part, Figure):
        caption = f'<figcaption>{_inline(part.caption)}</figcaption>' if part.caption else ''
        return f'<figure>{part.svg}{caption}</figure>'
    return f'<p>{_inline(part)}</p>'


def _inline(text: str) -> str:
    """Return a paragraph with its `code` marked."""
    return re.sub(r'`([^`]+)`', r'<code>\1</code>', escape(text, quote=False))


_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
{style}
</style>
</head>
<body>
<h1>{title}</h1>
{body}
</body>
</html>
"""

_STYLE = """:root { --ink: #1c2733; --soft: #5b6b7b; --line: #dde3e9; --paper: #ffffff;
  --back: #f4f6f8; --c0: #6b7a89; --c1: #1769c4; --c2: #c2410c; --c3: #15803d; --c4: #7e22ce;
  --c5: #b45309; --c6: #0e7490; --shade: #1769c4; }
@media (prefers-color-scheme: dark) { :root { --ink: #e4e9ee; --soft: #9aa8b5; --line: #33404c;
  --paper: #1a222b; --back: #12181f; --c0: #8b9aa9; --c1: #5aa9ff; --c2: #fb923c; --c3: #4ade80;
  --c4: #c084fc; --c5: #fbbf24; --c6: #22d3ee; --shade: #5aa9ff; } }
body { font: 15px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--back);
  max-width: 980px; margin: 0 auto; padding: 24px 16px 48px; }
h1 { font-size: 24px; margin: 8px 0 16px; overflow-wrap: anywhere; }
h2 { font-size: 17px; margin: 0 0 10px; }
section { background: var(--paper); border: 1px solid var(--line); border-radius: 8px;
  padding: 18px 20px; margin: 14px 0; }
p, ul { margin: 8px 0; } ul { padding-left: 20px; }
code { font: 13px ui-monospace, monospace; background: var(--back); padding: 1px 4px;
  border-radius: 4px; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; margin: 6px 0; }
th, td { text-align: right; padding: 4px 12px 4px 0; white-space: nowrap; }
th { font-weight: 600; color: var(--soft); border-bottom: 1px solid var(--line); font-size: 13px; }
td { border-bottom: 1px solid var(--line); } .l { text-align: left; }
td.l { white-space: normal; }
figure { margin: 14px 0 4px; } figcaption { color: var(--soft); font-size: 13px; }
svg { width: 100%; height: auto; display: block; }
svg text { font: 12px system-ui, sans-serif; fill: var(--soft); }
svg .title { font-weight: 600; fill: var(--ink); }"""
