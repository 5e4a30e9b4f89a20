# SPDX-License-Identifier: Apache-2.0
"""
Fill the tables of a page from the files that studies wrote, and take their figures beside it.

    python -m ctsid_ros.studies.page docs/papers.md results/studies

A table stands between `<!-- NAME -->` and `<!-- end -->`; NAME.md is looked for in the folders of
the studies, and every figure is copied to the folder `figures` beside the page.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
import re
import shutil

_TABLE = re.compile(r'(<!-- (\w+) -->\n).*?(<!-- end -->)', re.DOTALL)


def filled(page: str, tables: Mapping[str, str]) -> str:
    """
    Return the page with its tables.

    Parameters
    ----------
    page : str
    tables : mapping
        Markdown by name.

    Raises
    ------
    KeyError
        If the page has a table that there is none for.
    """
    return _TABLE.sub(lambda m: f'{m[1]}\n{tables[m[2]].strip()}\n\n{m[3]}', page)


def main(argv: Sequence[str] | None = None) -> int:
    """Fill the page."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('page', type=Path)
    parser.add_argument('results', type=Path, help='folder of the studies, of `ctsid study all`')
    given = parser.parse_args(argv)
    tables = {path.stem: path.read_text(encoding='utf-8')
              for path in given.results.glob('*/*.md')}
    text = given.page.read_text(encoding='utf-8')
    try:
        text = filled(text, tables)
    except KeyError as missing:
        print(f'{given.page} has a table {missing.args[0]}, but no study in {given.results} wrote '
              'it; run `ctsid study all` first')
        return 1
    given.page.write_text(text, encoding='utf-8')
    beside = given.page.parent / 'figures'
    beside.mkdir(exist_ok=True)
    for figure in given.results.glob('*/*.svg'):
        shutil.copyfile(figure, beside / figure.name)
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
