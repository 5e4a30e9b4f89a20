# SPDX-License-Identifier: Apache-2.0
"""
Write the pages that are made from declarations in the code: `make docs` does it before it builds.

`test/test_docs.py` holds that the pages in the repository are these.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from importlib.resources import files
import json
from pathlib import Path
import re
from typing import Any

from ctsid_core.model.estimate import Status
from ctsid_ros.config.parameter_text import parameters_markdown
from ctsid_ros.messages.interface import OUTPUTS, SERVICES, SHARED

FOLDER = Path(__file__).resolve().parent
_HEAD = '<!-- Written from the declarations in the code; do not edit. -->'


def topics() -> str:
    """Return the page of the topics and services of the node."""
    return _page(
        '# Topics and services', '',
        'What the node declares; [node.md](node.md) says how it is meant, '
        '[consuming.md](consuming.md) how to use it.', '',
        '## Published', '',
        *_table(('topic', 'type', 'when', 'content'), (
            (f'`~/{name}`', f'`{of.type}`', of.when, of.meaning) for name, of in OUTPUTS.items())),
        '', 'These are reliable and latched: transient local, depth 1. Subscribe with transient '
        'local to get the last one at once.', '',
        *_table(('topic', 'type', 'when', 'content'), (
            (f'`{name}`', f'`{of.type}`', of.when, of.meaning) for name, of in SHARED.items())),
        '', '## Subscribed', '',
        'The topics of the channels, `NAME.topic` in [parameters.md](parameters.md), and '
        '`/clock` with `use_sim_time`.', '',
        '## Services', '', 'All are `std_srvs/srv/Trigger`.', '',
        *_table(('service', 'what it does'),
                ((f'`~/{name}`', meaning) for name, meaning in SERVICES.items())))


def model_json() -> str:
    """Return the page of the keys of `model.json`, and of the statuses."""
    schema = json.loads((files('ctsid_core.model') / 'model.schema.json').read_text('utf-8'))
    meanings = _meanings()
    rows = ((f'`{path}`', kind, words or meanings.get(path, ''))
            for path, kind, words in _keys(schema, schema['$defs'], ''))
    return _page(
        '# Keys of `model.json`', '', schema['description'], '',
        'Made from the JSON Schema [`model.schema.json`](../ctsid_core/model/model.schema.json); '
        'more on the quantities is in [glossary.md](glossary.md).', '',
        *_table(('key', 'type', 'meaning'), rows), '',
        '## Statuses', '', 'The value of `status`, and the sentence in `message`.', '',
        *_table(('status', 'message'), ((f'`{s.name}`', s.value) for s in Status)))


def _meanings() -> dict[str, str]:
    """Return what the glossary says of keys that the schema does not describe."""
    found, column = {}, 0
    for line in (FOLDER / 'glossary.md').read_text('utf-8').splitlines():
        cells = line.split('|')
        if line.startswith('| quantity'):
            column = [cell.strip() for cell in cells].index('meaning')
        elif match := re.search(r'JSON `(verdict\.[\w.\[\]]+)`', cells[-2] if cells[2:] else ''):
            found[match[1]] = f'{cells[1].strip()}: {cells[column].strip()}'
    return found


def _keys(schema: Mapping[str, Any], known: Mapping[str, Any], prefix: str
          ) -> Iterator[tuple[str, str, str]]:
    """Yield path, type and meaning of each key of an object, inner ones after it."""
    for key, of in schema.get('properties', {}).items():
        path = f'{prefix}{key}'
        inner, kind = _resolved(of, known)
        words = of.get('description', '') if isinstance(of, dict) else ''
        yield path, kind, words or inner.get('description', '')
        if path != 'rejected_model':  # as model
            yield from _keys(inner, known, f'{path}{"[]" if kind.startswith("list") else ""}.')


def _resolved(of: Any, known: Mapping[str, Any]) -> tuple[Mapping[str, Any], str]:
    """Return the object that a key holds, or the items of its list, and its type in words."""
    if not isinstance(of, dict):
        return {}, 'any'
    if '$ref' in of:
        name = of['$ref'].rpartition('/')[2]
        return ({}, 'number') if name == 'number' else (known[name], name)
    if 'anyOf' in of:
        inner, kind = _resolved(of['anyOf'][0], known)
        return inner, f'{kind} or null'
    if of.get('type') == 'array':
        inner, kind = _resolved(of.get('items', True), known)
        return inner, f'list of {kind}'
    if 'enum' in of or 'const' in of:
        return {}, ', '.join(f'`{value}`' for value in of.get('enum', [of.get('const')]))
    return of, of.get('type', 'any')


def _page(*lines: str) -> str:
    return '\n'.join((_HEAD, *lines)) + '\n'


def _table(head: tuple[str, ...], rows: Iterator[tuple[str, ...]]) -> Iterator[str]:
    yield f'| {" | ".join(head)} |'
    yield '|' + '---|' * len(head)
    for row in rows:
        yield '| ' + ' | '.join(cell.replace('|', '\\|') for cell in row) + ' |'


PAGES: Mapping[str, Callable[[], str]] = {
    'parameters.md': parameters_markdown, 'topics.md': topics, 'model_json.md': model_json}


if __name__ == '__main__':
    for name, page in PAGES.items():
        (FOLDER / name).write_text(page(), encoding='utf-8')
