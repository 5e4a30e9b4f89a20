# SPDX-License-Identifier: Apache-2.0
"""
Tables of text: CSV and its relatives, by the csv module of Python.

Encoding, separator (comma, semicolon, tab, spaces), decimal comma and header are told from the
start of the file. What is no row of numbers is left out, and said.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
import csv
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsid_ros.recordings.recording import Recording
from ctsid_ros.recordings.table_columns import column_of, table_recording

_START = 1 << 16  # bytes that tell how a file is written
_SHOWN = 50  # lines of them
_ROWS = 1 << 15  # that are converted at once: their texts take much memory
_SEPARATORS = '\t;,| '  # where two fit, the comma is a decimal one, and a space stands beside it
_COMMENT = ('#', '%', 'sep=')  # the last one is Excel's
_NOTHING = {'', 'nan', 'null', 'none', 'na', 'n/a', '-'}
_LOGICAL = {'true': 1.0, 'false': 0.0}
_DATE = re.compile(r'\d{4}-\d\d-\d\d([T ]\d\d:\d\d.*)?')
_DECIMAL_COMMA = re.compile(r'[+-]?\d*,\d+([eE][+-]?\d+)?')
_DECIMAL_POINT = re.compile(r'[+-]?\d*\.\d+([eE][+-]?\d+)?')
_CONTROL = re.compile(r'[\x00-\x08\x0e-\x1f]')
_ODD = 0.05  # of the characters of a text that is damaged; of binary data more are
_EXACT = 2.0**53  # whole numbers above are not exact as floats: nanoseconds


def scan_csv(path: Path, time: Sequence[str] = ()) -> Recording | None:
    """
    Read a table of text; None if it is none.

    Parameters
    ----------
    path : Path
    time : sequence of str
        Names of the columns that are times.

    Raises
    ------
    BagError
        If no column is a time, or none is left beside it.
    """
    form = _form(path)
    if form is None:
        return None
    cells = [_Cells(i in form.dates) for i in range(len(form.titles))]
    damage = _Damage(len(form.titles))
    with path.open(encoding=form.encoding, errors='replace', newline='') as file:
        rows = damage.sound(islice(file, form.skipped, None), form)
        while chunk := list(islice(rows, _ROWS)):
            for column, texts in zip(cells, zip(*chunk, strict=True), strict=True):
                column.take(texts, form.decimal)
    notes = damage.notes()
    columns = [column_of(title or f'column_{i + 1}', cells[i].joined())
               for i, title in enumerate(form.titles)]
    words = {c.name: texts.first for c, texts in zip(columns, cells, strict=True)
             if texts.strange > np.count_nonzero(c.known)}
    strange = [f'{texts.strange} in {c.name} ({texts.first!r})'
               for c, texts in zip(columns, cells, strict=True)
               if texts.strange and c.name not in words]
    if words:
        notes.append(f'left out, for they hold text: {", ".join(words)}')
    if strange:
        notes.append(f'cells that are no numbers were left out: {", ".join(strange)}')
    if form.above:
        notes.append(f'lines above its titles were left out: {form.above}')
    if not form.has_header:
        notes.append('it has no header: its columns are called column_1, column_2, and so on')
    kept = [c for c, title in zip(columns, form.titles, strict=True)
            if c.name not in words and (title.strip() or c.known.any())]
    return table_recording(path, kept, time, [f'{path.name}: {note}' for note in notes], words)


@dataclass(frozen=True)
class _Form:
    """How a file is written."""

    encoding: str
    separator: str
    decimal: str
    skipped: int  # lines before the first row of numbers
    titles: Sequence[str]
    has_header: bool
    dates: frozenset[int]  # columns
    above: int  # lines over the titles that are no comments


def _form(path: Path) -> _Form | None:
    """Tell from the start of a file how it is written; None if it is no table."""
    with path.open('rb') as file:
        start = file.read(_START)
        whole = not file.read(1)
    encoding = _encoding(start)
    text = start.decode(encoding, errors='replace')
    if len(_CONTROL.findall(text)) > _ODD * len(text):
        return None
    lines = text.splitlines()
    lines = lines if whole else lines[:-1]
    skipped = next((i for i, line in enumerate(lines)
                    if line.strip() and not line.lstrip().startswith(_COMMENT)), len(lines))
    places = [i for i in range(skipped, len(lines)) if lines[i].strip()][:_SHOWN]
    shown = [lines[i] for i in places]
    separator = max(_SEPARATORS, key=lambda mark: _regular(shown, mark))
    if not _regular(shown, separator):
        return None
    rows = list(_rows(shown, separator))
    counts = [len(row) for row in rows]
    head = counts.index(max(counts, key=counts.count))
    if head and not any(map(_is_value, rows[head])):    # titles below lines on the recording
        rows, skipped = rows[head:], places[head]
    else:
        head = 0
    titles, has_header, body = rows[0], True, rows[1:]
    if _is_body(rows[0]):  # the header may be a comment, as NumPy writes it
        body = rows
        comment = lines[skipped - 1].strip().lstrip('#%').strip() if skipped else ''
        titles = next(_rows([comment], separator), [])
        has_header = len(titles) == len(rows[0])
        titles = titles if has_header else [''] * len(rows[0])
    elif lines[skipped].strip():
        skipped += 1
    cells = [cell.strip() for row in body for cell in row]
    spaces = separator == ' '                       # prose has some as well
    if not (all if spaces and cells else any)(map(_is_value, cells)):
        return None
    if spaces and len(titles) != len(body[0]):      # titles of several words
        titles, has_header = [''] * len(body[0]), False
    comma = separator != ',' and any(map(_DECIMAL_COMMA.fullmatch, cells)) \
        and not any(map(_DECIMAL_POINT.fullmatch, cells))
    dates = frozenset(i for i in range(len(titles))
                      if any(_DATE.fullmatch(row[i].strip()) for row in body if len(row) > i))
    return _Form(encoding, separator, ',' if comma else '.', skipped, titles, has_header, dates,
                 head)


def _encoding(start: bytes) -> str:
    if start.startswith((b'\xff\xfe', b'\xfe\xff')):
        return 'utf-16'
    try:
        start.decode('utf-8')
    except UnicodeDecodeError as error:
        if error.start < len(start) - 4:
            return 'cp1252'  # as a Western Windows writes it
    return 'utf-8-sig'


def _regular(lines: Sequence[str], separator: str) -> int:
    """Return how many lines have as many cells as most have; 0 if that is one."""
    counts = [len(row) for row in _rows(lines, separator)]
    most = max(counts, key=counts.count, default=1)
    return counts.count(most) if most > 1 else 0


def _rows(lines: Iterable[str], separator: str) -> Any:
    """Return a reader of rows; any number of spaces is one separator."""
    if separator == ' ':
        lines = (' '.join(line.split()) for line in lines)
    return csv.reader(lines, delimiter=separator)


def _is_body(row: Sequence[str]) -> bool:
    filled = [cell for cell in row if cell.strip()]
    return bool(filled) and all(map(_is_value, filled))


def _is_value(cell: str) -> bool:
    try:
        float(cell.replace(',', '.'))
    except ValueError:
        return bool(_DATE.fullmatch(cell.strip()))
    return True


@dataclass
class _Damage:
    """Lets rows of the right length pass, and notes the others."""

    width: int
    ragged: int = 0
    first: str = ''
    longest: int = 0  # last cell of a row
    ended: bool = True  # whether the last line has an end
    cut: bool = False

    def sound(self, lines: Iterable[str], form: _Form) -> Iterator[list[str]]:
        # A quotation mark that is not closed would take the rest of the file for one cell.
        reader = _rows((line if line.count('"') % 2 == 0 else line.replace('"', '')
                        for line in self.watched(lines)), form.separator)
        while True:
            try:
                row = next(reader)
            except StopIteration:
                return
            except csv.Error as error:
                self.note(form.skipped + reader.line_num, str(error))
                continue
            if len(row) == self.width:
                length = len(row[-1])
                # A number that is cut off is shorter than it was.
                self.cut = not self.ended and length < self.longest
                if not self.cut:
                    self.longest = max(self.longest, length)
                    yield row
            elif len(row) == self.width + 1 and not row[-1].strip():
                yield row[:-1]  # a separator at the end
            elif row and ''.join(row).strip() and not row[0].lstrip().startswith(_COMMENT):
                self.note(form.skipped + reader.line_num,
                          f'{len(row)} cells instead of {self.width}')

    def watched(self, lines: Iterable[str]) -> Iterator[str]:
        for line in lines:
            self.ended = line.endswith(('\n', '\r'))
            yield line

    def note(self, line: int, what: str) -> None:
        self.ragged += 1
        self.first = self.first or f'line {line}: {what}'

    def notes(self) -> list[str]:
        cut = ['truncated: its last line has no end, and its last number is shorter than others: '
               'it is left out'] if self.cut else []
        if not self.ragged:
            return cut
        return [*cut, f'{self.ragged} {"row" if self.ragged == 1 else "rows"} left out '
                f'({"" if self.ragged == 1 else "the first is "}{self.first})']


@dataclass
class _Cells:
    """One column as it is read."""

    is_date: bool
    parts: list[NDArray[Any]] = field(default_factory=list)
    strange: int = 0  # cells that are neither numbers nor empty
    first: str = ''

    def take(self, texts: Sequence[str], decimal: str) -> None:
        """Convert some cells."""
        if decimal == ',':
            texts = [text.replace(',', '.') for text in texts]
        if self.is_date:
            self.parts.append(np.array([self.date(text) for text in texts], 'datetime64[ns]'))
            return
        try:
            values = np.fromiter(map(float, texts), np.float64, len(texts))
        except ValueError:
            values = np.fromiter(map(self.number, texts), np.float64, len(texts))
        if np.abs(values).max() > _EXACT and all(text.strip().isdecimal() for text in texts):
            values = np.fromiter(map(int, texts), np.int64, len(texts))
        self.parts.append(values)

    def number(self, text: str) -> float:
        try:
            return float(text)
        except ValueError:
            word = text.strip().lower()
            if word in _LOGICAL:
                return _LOGICAL[word]
            return self.nothing(text, word)

    def date(self, text: str) -> np.datetime64:
        try:
            date = datetime.fromisoformat(text.strip())
        except ValueError:
            self.nothing(text, text.strip().lower())
            return np.datetime64('NaT', 'ns')
        date = date.astimezone(UTC).replace(tzinfo=None) if date.tzinfo else date
        return np.datetime64(date, 'ns')

    def nothing(self, text: str, word: str) -> float:
        if word not in _NOTHING:
            self.strange += 1
            self.first = self.first or text[:40]
        return np.nan

    def joined(self) -> NDArray[Any]:
        """Return all of them."""
        return np.concatenate(self.parts) if self.parts else np.empty(0)
