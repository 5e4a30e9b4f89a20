# SPDX-License-Identifier: Apache-2.0
"""A model as Python file that makes a `control.StateSpace`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_core.model.discrete import discretise
from ctsid_ros.export.content import Content


def control_program(content: Content, *, pade: int, rate: float | None = None) -> str:
    """
    Return the text of the program; it defines `sys`, the deviation model from u to y.

    Parameters
    ----------
    content : Content
    pade : int
        Order of the Pade approximation of the dead times, if there is no rate.
    rate : float, optional
        Of a clock [Hz]: then `sys` is discrete and exact, with past inputs as further states.

    Raises
    ------
    DataError
        If the order or the rate is out of range.
    """
    model = content.model
    if rate is None:
        whole = model.pade(pade)
        matrices, dt = (whole.A, whole.B, whole.C, whole.D), 0.0
        how = f'as Pade approximations of order {pade}' if any(model.delay) else 'which are 0'
    else:
        found = discretise(model, rate)
        matrices, dt = found.expanded(), found.period
        how = f'exact at {rate:g} Hz, past inputs are the last states'
    labels = ''.join(f', {key}={ascii(list(names))}' for key, names in (
        ('inputs', _labels(model.input_names)),
        ('outputs', _labels(model.output_names))) if names)
    # The first line: else a name in the second could declare another encoding (PEP 263).
    lines = ['# -*- coding: utf-8 -*-', *(f'# {line}' for line in content.comments()),
             f'# dead times: {how}',
             'import control', 'import numpy as np', '',
             *(f'{name} = {_matrix(value)}'
               for name, value in zip('ABCD', matrices, strict=True)),
             f'K = {_matrix(model.K)}  # of the states without those of the dead times',
             f'delay = {list(model.delay)!r}  # [s], in the matrices as said above',
             f'x_trim = {model.x_trim.tolist()!r}', f'y_trim = {model.y_trim.tolist()!r}',
             f'sys = control.ss(A, B, C, D, {dt!r}{labels})']
    return '\n'.join(lines) + '\n'


def _labels(names: Sequence[str]) -> list[str]:
    """Return names of channels as python-control takes them; none unless all differ."""
    labels = [name.replace('.', '_') for name in names]  # '.' is its own
    return labels if all(labels) and len(set(labels)) == len(labels) else []


def _matrix(matrix: Array) -> str:
    if not matrix.size:
        return f'np.zeros({matrix.shape})'
    rows = ',\n    '.join(map(repr, np.asarray(matrix).tolist()))
    return f'np.array([\n    {rows}])'
