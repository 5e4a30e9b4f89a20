# SPDX-License-Identifier: Apache-2.0
"""
The compiled kernel, where it was built: evaluations without an interpreter.

A record of a thousand samples takes NumPy most of its time to find out what to do next.
`kernel.c` has the functions of which an evaluation consists, twins of those in NumPy, which
serve where there is no C compiler, or CTSID_KERNEL is 0. Both give the same but for rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import ctypes
from ctypes import CDLL, Structure, c_double, c_int, c_uint, c_void_p
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.util import find_spec
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
import warnings
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from ctsid_core.likelihood.modal_model import ModalModel
from ctsid_core.linear.types import Array, ComplexArray

if TYPE_CHECKING:
    from ctsid_core.model.modal import Drive

VARIABLE = 'CTSID_KERNEL'
_NOTHING = ctypes.c_char * 0
_HIGHEST = 6          # degree of inputs between their stamps; DEGREES in kernel.c is more


class _Drive(Structure):
    _fields_ = [('stamps', c_void_p), ('pieces', c_void_p), ('between', c_void_p),
                ('rates', c_void_p), ('count', c_int), ('width', c_int), ('degree', c_int)]


class _Stream(Structure):
    _fields_ = [('times', c_void_p), ('y', c_void_p), ('count', c_int), ('first', c_int),
                ('channels', c_int), ('record', c_int)]


class _Record(Structure):
    _fields_ = [('start', c_double), ('drive', c_int), ('drives', c_int), ('stream', c_int),
                ('streams', c_int)]


class _Samples(Structure):
    _fields_ = [('record', c_void_p), ('drive', c_void_p), ('stream', c_void_p),
                ('records', c_int), ('streams', c_int), ('nu', c_int), ('ny', c_int)]


class _Shape(Structure):
    _fields_ = [('group', c_void_p), ('modes', c_int), ('single', c_int), ('real', c_int),
                ('pairs', c_int), ('direct', c_int), ('slopes', c_int), ('trim', c_int)]


class Shape(NamedTuple):
    """What columns there are."""

    group: tuple[int, ...]  # of each mode its pole: equal ones share their columns
    real: int               # poles of each kind
    pairs: int
    direct: bool            # whether outputs may follow inputs at once
    slopes: bool            # whether there are derivatives by poles and dead times

    def width(self, nu: int) -> int:
        """Return how many columns there are, the outputs apart."""
        of_modes = (nu + 1) * (self.real + 2 * self.pairs) * (1 + self.slopes)
        return of_modes + nu * (self.direct + self.slopes) + 1


@dataclass(frozen=True, eq=False)
class Layout:
    """Where columns are."""

    shape: Shape
    rows: NDArray[np.intc]  # how many rows each stream has: of a triangle as many as columns
    size: int               # how many numbers there are in all tables
    work: float             # of an evaluation (`effort.py`)

    @cached_property
    def place(self) -> int:
        """Where `rows` are in memory."""
        return _at(self.rows)


@cache
def _library() -> CDLL | None:
    """Return the kernel, or None: there is none, it is not wanted, or LAPACK is not as known."""
    spec = find_spec('ctsid_core.likelihood._kernel')
    if os.environ.get(VARIABLE, '') == '0' or spec is None or not spec.origin:
        return None
    from scipy.linalg import cython_lapack

    try:
        found = CDLL(spec.origin)
        places = [_place(module, name) for module, name in (
            (cython_lapack, 'dtpqrt'), (cython_lapack, 'dgelsy'), (cython_lapack, 'dgeqp3'),
            (cython_lapack, 'dormqr'))]
        found.ctsid_edition.restype = c_uint
        edition = int(found.ctsid_edition())
    except (OSError, KeyError, AttributeError):
        return None
    # Where the source is at hand (`pip install --editable`) it may be newer than what was built.
    source = Path(__file__).with_name('kernel.c')
    if source.exists() and crc32(source.read_bytes()) != edition:
        warnings.warn('the compiled kernel is older than its source, and is left out: '
                      'identification takes twice as long; install ctsid again', stacklevel=2)
        return None
    if not all(places):
        return None
    found.ctsid_lapack(*map(c_void_p, places))
    p = c_void_p
    found.ctsid_columns.argtypes = [p, p, p, p, p]
    found.ctsid_solve.argtypes = [p, p, p, p, p]
    found.ctsid_errors.argtypes = [p, p, p, p, p, p]
    found.ctsid_jacobian.argtypes = [p, p, p, p, p, p, c_int, c_int, c_int, p]
    found.ctsid_slopes.argtypes = [p, p, p, p, p, p, c_int, c_int, p]
    return found


def built() -> bool:
    """Return whether the kernel is there, and serves."""
    return _library() is not None


def _place(module: Any, name: str) -> int:
    """Return where a function of SciPy's LAPACK is; 0 if its integers are not C's int."""
    capsule, api = module.__pyx_capi__[name], ctypes.pythonapi
    api.PyCapsule_GetName.restype = ctypes.c_char_p
    api.PyCapsule_GetPointer.restype = c_void_p
    api.PyCapsule_GetName.argtypes = [ctypes.py_object]
    api.PyCapsule_GetPointer.argtypes = [ctypes.py_object, ctypes.c_char_p]
    signature = api.PyCapsule_GetName(capsule)
    known = signature.replace(b'char *, ', b'').startswith(b'void (int *, int *')
    return int(api.PyCapsule_GetPointer(capsule, signature)) if known else 0


def _at(array: NDArray[Any]) -> int:
    """Return where an array is that may be written; of NumPy's own ways the best takes 2 us."""
    return ctypes.addressof(_NOTHING.from_buffer(array))


class Timed(NamedTuple):
    """The samples of one record: its start, its inputs, and stamps, values and first channels."""

    start: float
    drives: Sequence[Drive]
    streams: Sequence[tuple[Array, Array, int]]


class Kernel:
    """The kernel with the samples of records; made by `kernel_of`."""

    def __init__(self, library: CDLL, records: Sequence[Timed], nu: int, ny: int) -> None:
        self._library, self.nu, self.ny = library, nu, ny
        self._kept: list[object] = []
        self._shapes: dict[tuple[Shape, bool], int] = {}
        drives: list[_Drive] = []
        streams: list[_Stream] = []
        rows: list[_Record] = []
        for r, record in enumerate(records):
            rows.append(_Record(record.start, len(drives), len(record.drives), len(streams),
                                len(record.streams)))
            for d in record.drives:
                between, rates = d.paces
                drives.append(_Drive(*map(self._keep, (d.stamps, d.pieces, between, rates)),
                                     len(d.stamps), d.width, len(d.pieces) - 1))
            for times, y, channel in record.streams:
                streams.append(_Stream(self._keep(times), self._keep(y), len(times), channel,
                                       y.shape[1], r))
        tables = ((_Record * len(rows))(*rows), (_Drive * len(drives))(*drives),
                  (_Stream * len(streams))(*streams))
        self._samples = _Samples(*(ctypes.addressof(t) for t in tables), len(rows), len(streams),
                                 nu, ny)
        self._kept.append(tables)
        self._place, self._records = ctypes.addressof(self._samples), len(rows)
        self._channels = np.array([s.channels for s in streams])

    def _keep(self, values: Array) -> int:
        kept = np.ascontiguousarray(values, dtype=float)
        self._kept.append(kept)
        return int(kept.ctypes.data)            # it may be read only

    def columns(self, layout: Layout, poles: ComplexArray, delay: Array) -> Array:
        """Return all tables in Fortran's order, and the inputs at the start of each record."""
        values = np.empty(layout.size + self._records * self.nu)
        given = np.concatenate((np.ascontiguousarray(poles, dtype=complex).view(float), delay))
        self._done(self._library.ctsid_columns(
            self._place, self._shape(layout, False), _at(given), layout.place, _at(values)))
        return values

    def solve(self, layout: Layout, trim: bool, values: Array, model: ModalModel,
              power: Array) -> tuple[ModalModel, Array]:
        """Return the model with all that is linear at its best, and its errors' mean squares."""
        numbers = _packed(model, power)
        self._done(self._library.ctsid_solve(
            self._place, self._shape(layout, trim), layout.place, _at(values), _at(numbers)))
        found, at = [], 2 * len(model.poles)
        for one in (model.b, model.c, model.x0):
            found.append(numbers[at:at + 2 * one.size].view(complex).reshape(one.shape))
            at += 2 * one.size
        at += self.nu
        for other in (model.D, model.y0, power):
            found.append(numbers[at:at + other.size].reshape(other.shape))
            at += other.size
        b, c, x0, D, y0, own = found
        return ModalModel(model.poles, b, c, x0, D, y0, model.delay), own

    def errors(self, layout: Layout, values: Array, model: ModalModel) -> Array:
        """Return the errors of each output of each stream, one after another."""
        found = np.empty(int(layout.rows @ self._channels))
        numbers = _packed(model, np.ones(self._records * self.ny))
        self._done(self._library.ctsid_errors(
            self._place, self._shape(layout, False), layout.place, _at(values), _at(numbers),
            _at(found)))
        return found

    def jacobian(self, layout: Layout, trim: bool, values: Array, model: ModalModel, power: Array,
                 dp: ComplexArray, late: NDArray[np.intp], count: int) -> tuple[Array, Array]:
        """Return derivatives by so many numbers, and errors; arguments: see kernel.c."""
        height = int(layout.rows @ self._channels)
        found = np.zeros((count + 1, height))
        self._derive(self._library.ctsid_jacobian, layout, trim, values, model, power, dp, late,
                     height, _at(found))
        return found[:-1].T, found[-1]

    def slopes(self, layout: Layout, trim: bool, values: Array, model: ModalModel, power: Array,
               dp: ComplexArray, late: NDArray[np.intp],
               count: int) -> tuple[Array, Array, Array, float]:
        """Return curvature, gradient and squares of so many numbers that move; see kernel.c."""
        found = np.zeros(count * count + 2 * count + 1)
        self._derive(self._library.ctsid_slopes, layout, trim, values, model, power, dp, late,
                     _at(found))
        curvature, of_each = found[:count * count].reshape(count, count), found[-2 * count - 1:]
        return curvature, of_each[:count], of_each[count:-1], float(of_each[-1])

    def _derive(self, function: Callable[..., int], layout: Layout, trim: bool, values: Array,
                model: ModalModel, power: Array, dp: ComplexArray, late: NDArray[np.intp],
                *more: int) -> None:
        place = _at(values)
        numbers = _packed(model, power, dp.ravel().view(float), late.astype(float))
        self._done(function(self._place, self._shape(layout, trim), layout.place, place,
                            place + values.itemsize * layout.size, _at(numbers), len(dp),
                            len(late), *more))

    def _shape(self, layout: Layout, trim: bool) -> int:
        """Return where a shape is told in C; it is kept, for there are few."""
        key = (layout.shape, trim)
        if key not in self._shapes:
            group, *numbers = layout.shape
            modes = (c_int * len(group))(*group)
            shape = _Shape(ctypes.addressof(modes), len(group),
                           sum(pole < layout.shape.real for pole in group), *numbers, trim)
            self._kept += shape, modes
            self._shapes[key] = ctypes.addressof(shape)
        return self._shapes[key]

    @staticmethod
    def _done(failed: int) -> None:
        if failed:
            raise MemoryError('no memory is left for an evaluation; take fewer or shorter records')


def _packed(model: ModalModel, power: Array, *more: Array) -> Array:
    """Return a model, the mean squares of its errors and more as one row of numbers."""
    modes = np.concatenate((model.poles, model.b.ravel(), model.c.ravel(), model.x0.ravel()),
                           dtype=complex)
    return np.concatenate((modes.view(float), model.delay, model.D.ravel(), model.y0.ravel(),
                           power.ravel(), *more))


def kernel_of(records: Sequence[Timed], nu: int, ny: int) -> Kernel | None:
    """Return the kernel with the samples of records of nu inputs and ny outputs; None: NumPy."""
    library = _library()
    if library is None or any(len(d.pieces) > _HIGHEST for r in records for d in r.drives):
        return None
    return Kernel(library, records, nu, ny)
