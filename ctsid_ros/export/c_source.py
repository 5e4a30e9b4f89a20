# SPDX-License-Identifier: Apache-2.0
"""
A model as C99: a header and a source file without dependencies, heap or globals that change.

The discrete model is exact for inputs that are held from step to step (`model.discrete`). Dead
times are rings of past inputs, so that a step costs the same whatever they are.
"""

from __future__ import annotations

from collections.abc import Iterator
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsid_core.errors import DataError
from ctsid_core.model.discrete import Discrete, discretise
from ctsid_ros.export.content import Content

_NAME = re.compile(r'[A-Za-z][A-Za-z0-9_]*')

_HEADER = """\
#ifndef {NAME}_H
#define {NAME}_H

#define {NAME}_STATES {n}
#define {NAME}_INPUTS {nu}
#define {NAME}_OUTPUTS {ny}
#define {NAME}_PERIOD {period!r} /* [s] */
#define {NAME}_PAST {past} /* inputs that are kept */

#ifdef __cplusplus
extern "C" {{
#endif

typedef struct {{
  double x[{x}];
  double u[{NAME}_PAST][{u}]; /* a ring */
  int now;                    /* its newest entry */
}} {name}_state;

/* States at their origin, and u in all delays. This is rest only if all trims are 0:
 * else step with a constant u until y stands still. */
void {name}_reset({name}_state *state, const double *u);

/* One step: inputs from now on until the next step in, outputs of now out. */
void {name}_step({name}_state *state, const double *u, double *y);

#ifdef __cplusplus
}}
#endif

#endif
"""

_SOURCE = """\
#include "{name}.h"

{constants}

void {name}_reset({name}_state *state, const double *u)
{{
  int i, k;
  for (i = 0; i < {NAME}_STATES; ++i) state->x[i] = 0.0;
  for (k = 0; k < {NAME}_PAST; ++k)
    for (i = 0; i < {NAME}_INPUTS; ++i) state->u[k][i] = u[i];
  state->now = 0;
}}

static double past({name}_state const *state, int i, int ago)
{{
  return state->u[(state->now + {NAME}_PAST - ago) % {NAME}_PAST][i];
}}

void {name}_step({name}_state *state, const double *u, double *y)
{{
  double next[{x}];
  int i, j;
  state->now = (state->now + 1) % {NAME}_PAST;
  for (j = 0; j < {NAME}_INPUTS; ++j) state->u[state->now][j] = u[j];
  for (i = 0; i < {NAME}_OUTPUTS; ++i) {{
    y[i] = y_trim[i];
    for (j = 0; j < {NAME}_STATES; ++j) y[i] += C[i][j] * state->x[j];
    for (j = 0; j < {NAME}_INPUTS; ++j) y[i] += D[i][j] * past(state, j, seen[j]);
  }}
  for (i = 0; i < {NAME}_STATES; ++i) {{
    next[i] = offset[i];
    for (j = 0; j < {NAME}_STATES; ++j) next[i] += A[i][j] * state->x[j];
    for (j = 0; j < {NAME}_INPUTS; ++j)
      next[i] += B_now[i][j] * past(state, j, lag[j])
        + B_before[i][j] * past(state, j, lag[j] + 1);
  }}
  for (i = 0; i < {NAME}_STATES; ++i) state->x[i] = next[i];
}}
"""


def c_files(content: Content, name: str, rate: float) -> tuple[str, str]:
    """
    Return header and source.

    Parameters
    ----------
    content : Content
    name : str
        Of the files, without suffix; all names in them begin with it.
    rate : float
        Of the steps [Hz].

    Raises
    ------
    DataError
        If the name is no identifier of C, or the rate is out of range.
    """
    if not _NAME.fullmatch(name):
        raise DataError(f'{name!r} is to begin the names in C; choose a file name of letters, '
                        'digits and _ that begins with a letter')
    found = discretise(content.model, rate)
    n, nu, ny = (len(found.A), found.now.shape[1], len(found.C))
    # C has no arrays of length 0.
    words = {'name': name, 'NAME': name.upper(), 'n': n, 'nu': nu, 'ny': ny,
             'x': max(n, 1), 'u': max(nu, 1), 'period': found.period,
             'past': max(found.lag, default=0) + 2}
    head = '\n'.join(f'/* {line} */' for line in (
        *content.comments(), f'Discrete and exact at {rate:g} Hz for inputs held between steps.',
        *_dead_times(found)))
    return (f'{head}\n' + _HEADER.format(**words),
            f'{head}\n' + _SOURCE.format(**words, constants='\n'.join(_constants(found))))


def _dead_times(found: Discrete) -> Iterator[str]:
    for i, (lag, fraction) in enumerate(zip(found.lag, found.fraction, strict=True), 1):
        yield f'dead time of input {i}: {lag} steps and {fraction!r} of one'


def _constants(found: Discrete) -> Iterator[str]:
    for name, matrix in (('A', found.A), ('B_now', found.now), ('B_before', found.before),
                         ('C', found.C), ('D', found.D), ('offset', found.offset),
                         ('y_trim', found.y_trim)):
        yield _constant('double', name, matrix)
    yield _constant('int', 'lag', np.array(found.lag, dtype=int))
    yield _constant('int', 'seen', found.memory)


def _constant(kind: str, name: str, values: NDArray[Any]) -> str:
    shape = [max(size, 1) for size in values.shape]
    padded = np.zeros(shape, dtype=values.dtype)
    padded[tuple(slice(size) for size in values.shape)] = values
    sizes = ''.join(f'[{size}]' for size in shape)
    rows = padded.tolist()
    text = ',\n  '.join(map(_row, rows)) if len(shape) == 2 else ', '.join(map(repr, rows))
    return f'static const {kind} {name}{sizes} = {{{text}}};'


def _row(values: list[float]) -> str:
    return '{' + ', '.join(map(repr, values)) + '}'
