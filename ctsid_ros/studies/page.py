# SPDX-License-Identifier: Apache-2.0
"""
Fill the tables of a page from the files that studies wrote, and take their figures beside it.

    python -m ctsid_ros.studies.page docs/papers.md results/studies

A table stands between `<!-- NAME -->` and `<!-- end -->`; NAME.md is looked for in the folders of
the studies, and every figure that the page shows is copied to the folder `figures` beside it.
Tables of studies that were not run stay as they are, and are named.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
import re
import shutil

_TABLE = re.compile(r'(<!-- (\w+) -->\n).*?(<!-- end -->)', re.DOTALL)


def filled(page: str, tables: Mapping[str, str]) -> tuple[str, list[str]]:
    """
    Return the page with the tables that there are, and the names of those that stay as they are.

    Parameters
    ----------
    page : str
    tables : mapping
        Markdown by name.
    """
    missing = [name for _, name, _ in _TABLE.findall(page) if name not in tables]
    return _TABLE.sub(lambda m: m[0] if m[2] in missing else
                      f'{m[1]}\n{tables[m[2]].strip()}\n\n{m[3]}', page), missing


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
    names = [name for _, name, _ in _TABLE.findall(text)]
    text, missing = filled(text, tables)
    if len(missing) == len(names):
        print(f'no study in {given.results} wrote a table of {given.page} '
              f'({", ".join(names) or "it has none"}); run the studies that it names first')
        return 1
    given.page.write_text(text, encoding='utf-8')
    if missing:
        print(f'left as they are, for no study in {given.results} wrote them: '
              + ', '.join(missing))
    beside = given.page.parent / 'figures'
    beside.mkdir(exist_ok=True)
    for figure in given.results.glob('*/*.svg'):
        if f'figures/{figure.name}' in text:
            shutil.copyfile(figure, beside / figure.name)
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
