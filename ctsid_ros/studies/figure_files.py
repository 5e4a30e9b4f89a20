# SPDX-License-Identifier: Apache-2.0
"""Tables of studies as files: Markdown and CSV."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import csv
from pathlib import Path

from ctsid_ros.report.tables import Table


def write_table(path: Path, table: Table) -> None:
    """Write a table as Markdown and as CSV: two files of that name."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.with_suffix('.md').write_text(table.markdown() + '\n', encoding='utf-8')
    write_csv(path.with_suffix('.csv'), (table.head, *table.rows))


def write_csv(path: Path, rows: Iterable[Sequence[str]]) -> None:
    """Write rows as CSV."""
    with path.open('w', newline='', encoding='utf-8') as stream:
        csv.writer(stream, lineterminator='\n').writerows(rows)
