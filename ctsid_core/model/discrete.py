# SPDX-License-Identifier: Apache-2.0
"""
A model at the ticks of a clock, exactly, for inputs that are held from tick to tick.

With the period T and a dead time of (lag + fraction) T, 0 <= fraction < 1, an input changes
within a step, `fraction` T after the tick. Hence, without any approximation,

    x[k+1] = A x[k] + B_now u[k - lag] + B_before u[k - lag - 1] + offset
      y[k] = C x[k] + D u[k - lag - (fraction > 0)] + y_trim

(K. J. Astrom, B. Wittenmark, "Computer-Controlled Systems", 3rd edition, section 2.3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctsid_core.errors import DataError
from ctsid_core.linear.matrix_functions import exponentials
from ctsid_core.linear.types import Array
from ctsid_core.model.statespace import StateSpace

_SAME = 1e-9  # of a period: dead times that differ by less from a whole number of them are one
_MEMORY = 100_000  # past inputs to keep, of all channels; a rate that needs more is a slip
_STATES = 2000  # the same where they become states of full matrices


@dataclass(frozen=True, eq=False)
class Discrete:
    """A model at the ticks of a clock; made by `discretise`."""

    period: float                # [s]
    A: Array                     # (n, n)
    now: Array                   # (n, nu): gains of u[k - lag]
    before: Array                # (n, nu): of the input one tick earlier; 0 for whole dead times
    offset: Array                # (n,): of the trim, per step
    C: Array
    D: Array
    y_trim: Array
    lag: tuple[int, ...]         # whole periods of each dead time
    fraction: tuple[float, ...]  # what remains of it, in periods

    @property
    def memory(self) -> NDArray[np.int_]:
        """How many past inputs each channel needs, shape (nu,)."""
        return np.array(self.lag, dtype=int) + (np.array(self.fraction) > 0)

    def expanded(self) -> tuple[Array, Array, Array, Array]:
        """
        Return A, B, C, D from u to y without dead time: past inputs are further states.

        Raises `DataError` if they are too many for matrices.
        """
        n, nu = self.now.shape
        if self.memory.sum() > _STATES:
            raise DataError(f'the dead times hold {self.memory.sum()} past inputs, too many for '
                            f'states ({_STATES} at most); choose a lower rate')
        first = n + np.concatenate([[0], np.cumsum(self.memory)]).astype(int)
        A = np.zeros((first[-1], first[-1]))
        B, C = np.zeros((first[-1], nu)), np.zeros((len(self.C), first[-1]))
        A[:n, :n], C[:, :n] = self.A, self.C
        for i in range(nu):
            past = np.arange(first[i], first[i + 1])  # the input one, two, ... ticks ago
            for gain, ago in ((self.now, self.lag[i]), (self.before, self.lag[i] + 1)):
                if ago == 0:
                    B[:n, i] = gain[:, i]
                elif ago <= len(past):
                    A[:n, past[ago - 1]] = gain[:, i]
            B[past[:1], i] = A[past[1:], past[:-1]] = 1.0
            C[:, past[-1:]] = self.D[:, [i]]
        return A, B, C, np.where(self.memory, 0.0, self.D)


def discretise(model: StateSpace, rate: float) -> Discrete:
    """
    Return a model at the ticks of a clock of a rate [Hz], exactly for inputs held between them.

    Raises `DataError` if the rate is not positive, or so high that the dead times hold too many
    inputs.
    """
    if not 0 < rate < np.inf:
        raise DataError(f'`rate` is {rate}; give the rate of the clock in Hz, more than 0')
    ratio = np.array(model.delay) * rate
    if ratio.sum() > _MEMORY:
        raise DataError(f'at {rate:g} Hz the dead times hold {ratio.sum():.3g} past inputs; '
                        f'choose a lower rate ({_MEMORY} are kept at most)')
    whole = np.abs(ratio - np.round(ratio)) < _SAME * np.maximum(ratio, 1)
    lag = np.where(whole, np.round(ratio), np.floor(ratio))
    fraction = np.where(whole, 0.0, ratio - lag)
    period = 1 / rate
    steps, integrals = exponentials(
        model.A, period * np.concatenate([[1.0], 1 - fraction, fraction]), 1)
    now, before = np.empty_like(model.B), np.empty_like(model.B)
    for i in range(model.nu):
        now[:, i] = integrals[1 + i] @ model.B[:, i]
        before[:, i] = steps[1 + i] @ integrals[1 + model.nu + i] @ model.B[:, i]
    return Discrete(period, steps[0], now, before, integrals[0] @ model.x_trim, model.C, model.D,
                    model.y_trim, tuple(int(k) for k in lag), tuple(fraction.tolist()))
