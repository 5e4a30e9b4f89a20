# SPDX-License-Identifier: Apache-2.0
"""A model as MATLAB script that makes an `ss` with InputDelay; it runs in Octave as well."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import re

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_ros.export.content import Content, named

_SYSTEM = """\
properties = {'InputName', input_names, 'OutputName', output_names};
if exist('OCTAVE_VERSION', 'builtin')
  pkg load control  % its ss knows neither dead times nor units: see delay and input_units
  sys = ss(A, B, C, D, properties{:});
else
  sys = ss(A, B, C, D, 'InputDelay', delay, 'InputUnit', input_units, ...
           'OutputUnit', output_units, 'TimeUnit', 'seconds', properties{:});
end
"""


def matlab_script(content: Content) -> str:
    """
    Return the text of the script.

    It sets A, B, C, D, K, delay, x_trim, y_trim, names and units, and `sys`: the deviation model
    from u to y for Control System Toolbox and the block LTI System of Simulink.
    """
    return '\n'.join([*(f'% {line}' for line in content.comments()), '', *_lines(content),
                      _SYSTEM])


def _lines(content: Content) -> Iterator[str]:
    model = content.model
    for name in ('A', 'B', 'C', 'D', 'K'):
        yield f'{name} = {_matrix(getattr(model, name))};'
    for name, unit in (('delay', ' [s]'), ('x_trim', ''), ('y_trim', '')):
        column = np.asarray(getattr(model, name), dtype=float)[:, np.newaxis]
        yield f'{name} = {_matrix(column)};  % one per row{unit}'
    yield f'input_names = {_cell(named(model.input_names, "u"))};'
    yield f'input_units = {_cell(model.input_units)};'
    yield f'output_names = {_cell(named(model.output_names, "y"))};'
    yield f'output_units = {_cell(model.output_units)};'


def _matrix(matrix: Array) -> str:
    if not matrix.size:
        return f'zeros({matrix.shape[0]}, {matrix.shape[1]})'
    return '[' + '; '.join(' '.join(map(repr, row)) for row in matrix.tolist()) + ']'


def _cell(texts: Sequence[str]) -> str:
    return '{' + '; '.join(map(_string, texts)) + '}' if texts else 'cell(0, 1)'


def _string(text: str) -> str:
    """Return a string of MATLAB; control characters by their codes, a line break would end it."""
    shown = ''.join(c if c.isprintable() or c < '\x80' else c.encode('unicode_escape').decode()
                    for c in text)
    parts = [f'char({ord(part)})' if part < ' ' or part == '\x7f' else
             "'" + part.replace("'", "''") + "'"
             for part in re.split('([\\x00-\\x1f\\x7f])', shown) if part]
    return parts[0] if len(parts) == 1 else '[' + ', '.join(parts) + ']' if parts else "''"
