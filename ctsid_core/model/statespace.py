# SPDX-License-Identifier: Apache-2.0
"""
The linear time-invariant continuous-time model that ctsid identifies.

    dx/dt = A x + B u(t - d) + x_trim + K e
        y = C x + D u(t - d) + y_trim + e

with n states, nu inputs u, ny outputs y, innovations e, one dead time d >= 0 per input, and the
trim: constants that place the model at its operating point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from ctsid_core.errors import DataError
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model import realisation
from ctsid_core.model.simulation import respond
from ctsid_core.settings import Actuator
from ctsid_core.signals.actuators import acting
from ctsid_core.signals.record import Signal


@dataclass(frozen=True, eq=False)
class StateSpace:
    """
    A continuous-time state-space model in innovation form, with dead times and trim.

    What is not given is zero, or nameless. Arrays are copied and read-only. Models are equal (==)
    if all of their entries are.

    Parameters
    ----------
    A : ndarray, shape (n, n)
        [1/s]
    B : ndarray, shape (n, nu)
    C : ndarray, shape (ny, n)
    D : ndarray, shape (ny, nu)
        Direct feedthrough.
    K : ndarray, shape (n, ny)
        Gain of the innovations [1/s]: of the filter that predicts y. Zero: all noise is
        measurement noise.
    delay : tuple of float, length nu
        Dead time of each input [s].
    actuators : tuple of Actuator, length nu
        What lies between each input, if it is held, and what acts: its timeout, dead zone, limit,
        backlash and rate limit; 0: none.
    x_trim : ndarray, shape (n,)
        Constant drive of the states [state/s].
    y_trim : ndarray, shape (ny,)
        Constant offset of the outputs.
    input_names, input_units : tuple of str, length nu
    output_names, output_units : tuple of str, length ny
    noise : ndarray, shape (ny, ny), or None
        Intensity (two-sided spectral density) of the innovations e [unit^2 s]; None: unknown.

    Raises
    ------
    DataError
        If a shape does not fit or an entry is not finite.

    Examples
    --------
    >>> motor = StateSpace([[0.0, 1.0], [0.0, -2.0]], [[0.0], [6.0]], [[1.0, 0.0]])
    >>> motor.poles.real.tolist()
    [0.0, -2.0]
    """

    A: Array
    B: Array
    C: Array
    D: Array = field(default_factory=lambda: np.empty(0))
    K: Array = field(default_factory=lambda: np.empty(0))
    delay: tuple[float, ...] = ()
    actuators: tuple[Actuator, ...] = field(default=(), kw_only=True)
    x_trim: Array = field(default_factory=lambda: np.empty(0))
    y_trim: Array = field(default_factory=lambda: np.empty(0))
    input_names: tuple[str, ...] = ()
    output_names: tuple[str, ...] = ()
    input_units: tuple[str, ...] = ()
    output_units: tuple[str, ...] = ()
    noise: Array | None = None

    def __post_init__(self) -> None:
        A, B, C = (_numbers(name, getattr(self, name)) for name in 'ABC')
        if not A.ndim == B.ndim == C.ndim == 2:
            raise DataError(f'A has shape {A.shape}, B has shape {B.shape}, C has shape {C.shape};'
                            ' wanted are matrices (n, n), (n, nu), (ny, n)')
        n, nu, ny = len(A), B.shape[1], len(C)
        wanted = {'A': (n, n), 'B': (n, nu), 'C': (ny, n), 'D': (ny, nu), 'K': (n, ny),
                  'x_trim': (n,), 'y_trim': (ny,)} | ({} if self.noise is None else
                                                      {'noise': (ny, ny)})
        for name, shape in wanted.items():
            object.__setattr__(self, name, _shaped(name, getattr(self, name), shape))
        delay = tuple(float(d) for d in self.delay) or (0.0,) * nu
        if len(delay) != nu or not all(0 <= d < float('inf') for d in delay):
            raise DataError(f'`delay` is {delay}; wanted are {nu} dead times in s, one per '
                            'input, none negative')
        object.__setattr__(self, 'delay', delay)
        # None are none of any number of inputs: `replace` need not name them.
        given = self.actuators if any(map(any, self.actuators)) else (Actuator(),) * nu
        if len(given) != nu or not all(0 <= v < float('inf') for own in given for v in own):
            raise DataError(f'`actuators` is {given}; wanted are {nu}, one per input, with no '
                            'negative number')
        object.__setattr__(self, 'actuators', tuple(Actuator(*map(float, own)) for own in given))
        for name, count in (('input_names', nu), ('input_units', nu),
                            ('output_names', ny), ('output_units', ny)):
            words = getattr(self, name)
            if isinstance(words, str) or len(words) not in (0, count):
                raise DataError(f'`{name}` is {words!r}; wanted are {count}, one per channel')
            object.__setattr__(self, name, tuple(words) or ('',) * count)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, StateSpace):
            return NotImplemented
        return all(np.array_equal(getattr(self, f.name), getattr(other, f.name))
                   for f in fields(self))

    def __hash__(self) -> int:
        # + 0.0 because -0.0 equals 0.0 and has to have the same hash
        return hash(((self.A + 0.0).tobytes(), (self.B + 0.0).tobytes(), self.delay))

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.A)

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return int(self.B.shape[1])

    @property
    def ny(self) -> int:
        """Number of outputs."""
        return len(self.C)

    @cached_property
    def poles(self) -> ComplexArray:
        """
        Eigenvalues of A, complex, shape (n,) [rad/s].

        Sorted by magnitude; conjugate pairs stay together, the negative imaginary part first.
        Poles of equal magnitude: by the size of the imaginary part, then real part.
        """
        values = np.linalg.eigvals(self.A).astype(complex)
        values = values[realisation.pole_order(values)]
        values.setflags(write=False)
        return values

    @property
    def natural_frequency(self) -> Array:
        """Magnitude of each pole, shape (n,), in the order of `poles` [rad/s]."""
        return np.abs(self.poles)

    @property
    def damping(self) -> Array:
        """
        Damping ratio of each pole, shape (n,), in the order of `poles`.

        1 for a stable real pole, -1 for an unstable one, NaN for a pole at 0.
        """
        size = self.natural_frequency
        ratio: Array = np.full(self.n, np.nan)
        np.divide(-self.poles.real, size, out=ratio, where=size > 0)
        return ratio

    @property
    def dc_gain(self) -> Array:
        """
        Transfer function at frequency zero, shape (ny, nu).

        Infinite where a pole at 0 is seen. For an unstable model it is a number all the same,
        but not the end of any step response.
        """
        return np.asarray(self.frequency_response(np.zeros(1))[0].real)

    def frequency_response(self, omega: ArrayLike) -> ComplexArray:
        """
        Return G(j omega) = (C (j omega I - A)^-1 B + D) exp(-j omega delay), (M, ny, nu).

        At frequencies omega (M,) [rad/s], also negative ones. Where omega is a pole that the entry
        sees: infinite magnitude, phase NaN (inf + NaN j). Entries that do not see that pole are
        finite and right. Raises `DataError` if omega is not a row of finite numbers.
        """
        omega = np.asarray(omega, dtype=float)
        if omega.ndim != 1 or not np.isfinite(omega).all():
            raise DataError(f'`omega` has shape {omega.shape}; wanted is one row of finite '
                            'frequencies in rad/s')
        return realisation.transfer(self.A, self.B, self.C, self.D, self.delay, omega)

    def simulate(self, inputs: Sequence[Signal], times: ArrayLike,
                 x0: ArrayLike | None = None) -> Array:
        """
        Return the outputs without noise (e = 0), exactly for what the inputs' holds say.

        Parameters
        ----------
        inputs : sequence of Signal
            Together nu channels, each signal with stamps of its own; held before the first and
            after the last.
        times : array_like, shape (M,)
            Where the outputs are wanted, not decreasing [s].
        x0 : array_like, shape (n,), optional
            State at `times[0]`; zero if not given.

        Returns
        -------
        ndarray, shape (M, ny)
            At the very instant of a jump (after the dead time) the new input counts. Infinite
            or NaN once an unstable model has left the range of floating point.

        Raises
        ------
        DataError
            If the channels do not fit the model, an input has no sample, or `times` decreases.
        """
        self.check_width('input', sum(s.width for s in inputs), self.nu)
        start = np.zeros(self.n) if x0 is None else _shaped('x0', x0, (self.n,))
        x, u = respond(self.A, self.B, self.x_trim, acting(inputs, self.actuators),
                       self.delay, np.asarray(times, dtype=float), start)
        with np.errstate(over='ignore', invalid='ignore'):
            return x @ self.C.T + u @ self.D.T + self.y_trim

    @property
    def timeout(self) -> tuple[float, ...]:
        """The timeout of each input [s]; 0: none."""
        return tuple(own.timeout for own in self.actuators)

    @staticmethod
    def check_width(what: str, given: int, wanted: int) -> None:
        """Raise `DataError` unless as many channels are given as the model has."""
        if given != wanted:
            raise DataError(f'{given} {what} channels given, but the model has {wanted}; give '
                            'the same channels in the same order as for the identification')

    def transform(self, T: ArrayLike) -> StateSpace:
        """
        Return the same system with the states z = T x, T (n, n).

        Raises `DataError` if T has another shape or is singular.
        """
        matrix = _shaped('T', T, (self.n, self.n))
        if self.n and not realisation.regular(matrix):
            raise DataError('`T` is singular; a change of states needs independent rows')
        return replace(
            self, A=np.linalg.solve(matrix.T, (matrix @ self.A).T).T, B=matrix @ self.B,
            C=np.linalg.solve(matrix.T, self.C.T).T, K=matrix @ self.K,
            x_trim=matrix @ self.x_trim)

    def pade(self, order: int) -> StateSpace:
        """
        Return a model without dead time, each one replaced by its Pade approximation.

        It has `order` more states per delayed input, 0 to 10, and is good up to about omega *
        delay = order [rad]; 0: the dead times are dropped. Raises `DataError` for another order.
        """
        if not 0 <= order <= 10:
            raise DataError(f'`order` of the Pade approximation is {order}; choose 0 to 10')
        A, B, C, D = realisation.with_pade(self.A, self.B, self.C, self.D, self.delay, order)
        extra = len(A) - self.n
        return replace(self, A=A, B=B, C=C, D=D, delay=(0.0,) * self.nu,
                       K=np.vstack([self.K, np.zeros((extra, self.ny))]),
                       x_trim=np.concatenate([self.x_trim, np.zeros(extra)]))


def _numbers(name: str, value: ArrayLike) -> Array:
    """Return a copy as float64; raise `DataError` unless all entries are finite numbers."""
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise DataError(f'`{name}` is not an array of numbers: {error}') from error
    if not np.isfinite(array).all():
        raise DataError(f'`{name}` holds NaN or infinity; every entry must be finite')
    return array


def _shaped(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Return a read-only copy of the wanted shape, or raise `DataError`."""
    # An empty row stands for zeros where a matrix may be left out (D, K, x_trim, y_trim).
    array = _numbers(name, value)
    if array.shape == (0,) and name in ('D', 'K', 'x_trim', 'y_trim'):
        array = np.zeros(shape)  # not given
    if array.shape != shape:
        raise DataError(f'`{name}` has shape {array.shape}, wanted is {shape}: A is (n, n), '
                        'B (n, nu), C (ny, n), D (ny, nu), K (n, ny)')
    array.setflags(write=False)
    return array
