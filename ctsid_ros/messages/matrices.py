# SPDX-License-Identifier: Apache-2.0
"""
Matrices and eigenvalues as messages and back.

A matrix is a `std_msgs/Float64MultiArray` of two dimensions, row by row, whose labels say what
rows and columns are: `x:3` stands for three states, `x:3,y:4` for three states and then four
outputs (x: states, u: inputs, y: outputs).
"""

from __future__ import annotations

import re
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ctsid_core.errors import DataError, StorageError
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.statespace import StateSpace
from ctsid_core.sequence.tracking import Tracked
from ctsid_ros.messages.making import Make, ros_message

EIGENVALUE_COLUMNS = ('re', 'im', 'natural_frequency', 'damping')
_AXES = {'a': 'xx', 'b': 'xu', 'c': 'yx', 'd': 'yu', 'k': 'xy'}  # rows and columns
_COUNT = re.compile(r'([a-z]):(\d+)')
_MODE = re.compile(r'mode (-?\d+)')


class Matrices(NamedTuple):
    """The matrices of a model, without its dead times, trim, names and units."""

    A: Array
    B: Array
    C: Array
    D: Array
    K: Array


class Eigenvalues(NamedTuple):
    """Identity and value [rad/s] of each mode, in the order of the rows."""

    modes: tuple[int, ...]
    values: ComplexArray


def encode_matrix(name: str, matrix: ArrayLike, row_label: str, column_label: str,
                  make: Make = ros_message) -> Any:
    """
    Return a matrix as labelled `std_msgs/Float64MultiArray`.

    Parameters
    ----------
    name : str
        For the message of an error.
    matrix : array_like, shape (rows, columns)
    row_label, column_label : str
        What a row and a column stand for, as a letter: 'x', 'u' or 'y'. The count is added.
    make : Make
        What makes messages, see `messages.making`.

    Raises
    ------
    DataError
        If it is no matrix of finite numbers.
    """
    array = np.asarray(matrix, dtype=float)
    if array.ndim != 2 or not np.isfinite(array).all():
        raise DataError(f'`{name}` has shape {array.shape}; wanted is a matrix of finite numbers')
    return _multi_array(array, f'{row_label}:{len(array)}', f'{column_label}:{array.shape[1]}',
                        make)


def encode_matrices(model: StateSpace, make: Make = ros_message) -> dict[str, Any]:
    """Return the matrices of a model as messages: a, b, c, d and k, the names of their topics."""
    return {name: encode_matrix(name, getattr(model, name.upper()), axes[0], axes[1], make)
            for name, axes in _AXES.items()}


def encode_system_matrix(model: StateSpace, make: Make = ros_message) -> Any:
    """
    Return [A B K; C D I] as `std_msgs/Float64MultiArray`.

    From x, u and the innovations e to dx/dt and y. Rows are labelled like `x:3,y:4`, columns
    like `x:3,u:1,y:4`. Dead times and trim are not in it.
    """
    whole = np.block([[model.A, model.B, model.K], [model.C, model.D, np.eye(model.ny)]])
    x, u, y = f'x:{model.n}', f'u:{model.nu}', f'y:{model.ny}'
    return _multi_array(whole, f'{x},{y}', f'{x},{u},{y}', make)


def encode_eigenvalues(tracked: Tracked, make: Make = ros_message) -> Any:
    """
    Return eigenvalues as `std_msgs/Float64MultiArray`, shape (n, 4), one mode per row.

    Columns: real and imaginary part [rad/s], natural frequency [rad/s], damping ratio (NaN for an
    eigenvalue at 0). Rows are labelled by identities: `mode 4,mode 7`.
    """
    values = np.asarray(tracked.eigenvalues, dtype=complex)
    size = np.abs(values)
    damping = np.full(len(values), np.nan)
    np.divide(-values.real, size, out=damping, where=size > 0)
    rows = ','.join(f'mode {mode}' for mode in tracked.modes)
    return _multi_array(np.column_stack([values.real, values.imag, size, damping]), rows,
                        ','.join(EIGENVALUE_COLUMNS), make)


def _multi_array(matrix: Array, row_label: str, column_label: str, make: Make) -> Any:
    rows, columns = matrix.shape
    # The stride of a dimension is the number of entries in it and all after it (std_msgs)
    layout = make('std_msgs/msg/MultiArrayLayout', data_offset=0, dim=[
        make('std_msgs/msg/MultiArrayDimension', label=label, size=size, stride=stride)
        for label, size, stride in ((row_label, rows, rows * columns),
                                    (column_label, columns, columns))])
    return make('std_msgs/msg/Float64MultiArray', layout=layout, data=matrix.ravel().tolist())


def decode_matrix(msg: Any) -> Array:
    """
    Return the matrix in a `std_msgs/Float64MultiArray` of two dimensions.

    Raises
    ------
    StorageError
        If layout and data contradict each other, or it has not two dimensions.
    """
    try:
        dims, offset = msg.layout.dim, int(msg.layout.data_offset)
        rows, columns = (int(dim.size) for dim in dims)
        stride, data = int(dims[1].stride), np.asarray(msg.data, dtype=float)
    except (AttributeError, TypeError, ValueError) as error:
        raise StorageError('this message is not a std_msgs/Float64MultiArray with two dimensions '
                           f'({error}); check who publishes on the topic') from error
    entries = offset + stride * np.arange(rows)[:, None] + np.arange(columns)
    if stride < columns or (entries >= len(data)).any():
        raise StorageError(f'the layout of this message is {rows} by {columns} with stride '
                           f'{stride} and offset {offset}, which does not fit its {len(data)} '
                           'numbers; check who publishes on the topic')
    matrix: Array = data[entries]
    return matrix


def decode_system_matrix(msg: Any) -> Matrices:
    """
    Return the matrices in a message of the topic `~/system_matrix`.

    Raises
    ------
    StorageError
        If it is not such a message.
    """
    whole = decode_matrix(msg)
    labels = [dim.label for dim in msg.layout.dim]
    rows, columns = ([(letter, int(size)) for letter, size in _COUNT.findall(label)]
                     for label in labels)
    if ([key for key, _ in rows], [key for key, _ in columns]) != (['x', 'y'], ['x', 'u', 'y']):
        raise StorageError(f'this message is not a system matrix: its labels are {labels}, but '
                           'such as x:3,y:4 and x:3,u:1,y:4 are wanted; the topic is '
                           '`~/system_matrix` of an identifier')
    n, nu, ny = (size for _, size in columns)
    if whole.shape != (n + ny, n + nu + ny) or dict(rows) != {'x': n, 'y': ny} or \
            not np.array_equal(whole[n:, n + nu:], np.eye(ny)):
        raise StorageError(f'this message is not a system matrix [A B K; C D I]: it is '
                           f'{whole.shape[0]} by {whole.shape[1]} with the labels {labels}')
    return Matrices(whole[:n, :n], whole[:n, n:n + nu], whole[n:, :n], whole[n:, n:n + nu],
                    whole[:n, n + nu:])


def decode_eigenvalues(msg: Any) -> Eigenvalues:
    """
    Return modes and eigenvalues in a message of the topic `~/eigenvalues`.

    Raises
    ------
    StorageError
        If it is not such a message.
    """
    table = decode_matrix(msg)
    modes = tuple(int(mode) for mode in _MODE.findall(msg.layout.dim[0].label))
    if table.shape != (len(modes), len(EIGENVALUE_COLUMNS)):
        raise StorageError(f'this message is not a table of eigenvalues: it is {table.shape[0]} '
                           f'by {table.shape[1]} with the labels '
                           f'{[dim.label for dim in msg.layout.dim]}; the topic is '
                           '`~/eigenvalues` of an identifier')
    return Eigenvalues(modes, as_complex(table[:, :2]))


def as_complex(pairs: Array) -> ComplexArray:
    """Return pairs of real and imaginary parts, shape (n, 2), as numbers; signs of 0 are kept."""
    values = np.empty(len(pairs), dtype=complex)
    values.real, values.imag = pairs.T
    return values
