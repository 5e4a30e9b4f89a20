# SPDX-License-Identifier: Apache-2.0
"""The page of a study, from the tables and figures that are in its folder."""

from __future__ import annotations

import csv
from pathlib import Path
import re

from ctsid_ros.replay.results import PAGE, write_report
from ctsid_ros.report.document import Command, Part, Picture, Section
from ctsid_ros.report.page import to_html
from ctsid_ros.report.tables import Table


def write_page(folder: Path, title: str, line: str) -> Path | None:
    """
    Write the page of a study, and return its path; None if there is nothing to show.

    Parameters
    ----------
    folder : Path
        Of the study: tables as Markdown and CSV of one name, figures as SVG.
    title : str
    line : str
        The command that repeats it.

    Raises
    ------
    StorageError
        If it cannot be written.
    """
    tables = [Section(_words(path), (_table(path),)) for path in sorted(folder.glob('*.md'))
              if path.with_suffix('.csv').is_file()]
    figures = [Section(_words(path), (Picture(path.read_bytes(), _words(path)),))
               for path in sorted(folder.glob('*.svg'), key=_natural)]
    if not (tables or figures):
        return None
    again: tuple[Part, ...] = (Command(line), 'Tables are beside this page as Markdown and CSV, '
                               'figures as SVG, single runs in `runs.csv`.')
    write_report(folder, {PAGE: to_html(title, [
        *tables, *figures, Section('How to repeat it', again)])})
    return folder / PAGE


def _words(path: Path) -> str:
    """Return the name of a file as words."""
    return path.stem.replace('_', ' ').replace('hd ', '[HD] ').replace('tm ', '[TM] ')


def _natural(path: Path) -> list[tuple[int, str]]:
    """Return what puts figure 9 before figure 10."""
    return [(int(word), '') if word.isdigit() else (0, word)
            for word in re.split(r'(\d+)', path.stem)]


def _table(path: Path) -> Table:
    """Return a table; that of Markdown says which columns are flush left."""
    rule = path.read_text(encoding='utf-8').splitlines()[1].strip('| ').split(' | ')
    with path.with_suffix('.csv').open(newline='', encoding='utf-8') as stream:
        head, *rows = (tuple(row) for row in csv.reader(stream))
    return Table(head, tuple(rows), tuple(name for name, mark in zip(head, rule, strict=True)
                                          if not mark.endswith(':')))
