# SPDX-License-Identifier: Apache-2.0
"""
How much an identification may compute, counted instead of timed, and whether it is still wanted.

Work is what evaluations are known to take: 1 is one floating-point operation of a QR
decomposition. A clock would give another model each time; counted work ends a search at the same
place on every computer, so that a replay has the bits of the node. `RATE` turns it into seconds.

It has one thread of BLAS: the matrices are small, and several threads wait for each other, which
takes twice the time and five times the processor; the last digits depend on how many there are.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext, suppress
from functools import cache
import math
import os
from typing import Any

from ctsid_core.errors import Cancelled, SettingsError

# Work per second of processor: the median of QR decompositions on a core of an AMD EPYC server,
# one BLAS thread, rounded down (5.5e9). A constant, for else models would depend on the computer;
# on one half as fast a budget of 1 s takes 2 s. CTSID_WORK_RATE takes its place where it is set:
# node and replay then need the same value.
RATE = 5e9
VARIABLE = 'CTSID_WORK_RATE'
THREADS = ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS', 'MKL_NUM_THREADS')


class Effort:
    """
    The effort of one identification.

    It may take a budget of processor time [s], as far as `RATE` knows; 0: no limit. `cancelled`
    returns whether nobody wants the result any more; `left_out` are the tests that the budget did
    not last for, in words. Raises `SettingsError` if the environment
    variable CTSID_WORK_RATE is not a positive number.
    """

    def __init__(self, budget: float = 0.0, cancelled: Callable[[], bool] | None = None) -> None:
        self.budget, self._cancelled = budget, cancelled
        self._work, self._kept, self._rate = 0.0, 0.0, work_rate()
        self.left_out: list[str] = []

    def check(self) -> None:
        """Go on, if it is still wanted; else raise `Cancelled`."""
        if self._cancelled is not None and self._cancelled():
            raise Cancelled

    def spend(self, work: float) -> None:
        """Count work that is about to be done; raise `Cancelled` if it is not wanted any more."""
        self.check()
        self._work += work

    def keep(self, work: float) -> None:
        """Keep work of the budget for what has to be done at the end; 0: nothing any more."""
        self._kept = work

    def worth(self, seconds: float) -> float:
        """Return the work that takes so many seconds."""
        return seconds * self._rate

    @property
    def seconds(self) -> float:
        """Processor time that the work so far takes at the rate that counts [s]."""
        return self._work / self._rate

    @property
    def over(self) -> bool:
        """Whether the budget is spent, but for what is kept."""
        return self.beyond(1.0)

    def beyond(self, share: float, work: float = 0.0) -> bool:
        """
        Return whether more than a share of the budget, less what is kept, is spent.

        Or would be, with some more `work`.
        """
        free = max(self.budget - self._kept / self._rate, 0.0)
        return self.budget > 0.0 and share * free <= self.seconds + work / self._rate

    def leaves_out(self, what: str, share: float = 1.0) -> bool:
        """Return whether more than a share is spent, and keep in mind what is not asked then."""
        spent = self.beyond(share)
        if spent and what not in self.left_out:
            self.left_out.append(what)
        return spent


def work_rate() -> float:
    """Return the work per second that counts: `RATE`, or what CTSID_WORK_RATE says."""
    text = os.environ.get(VARIABLE, '')
    if not text:
        return RATE
    try:
        rate = float(text)
    except ValueError:
        rate = math.nan
    if not 0.0 < rate < math.inf:
        raise SettingsError([f'the environment variable {VARIABLE} is {text!r}; set it to a '
                             f'positive number, like {RATE:g}, or unset it'])
    return rate


def one_thread() -> AbstractContextManager[Any]:
    """
    Return a context in which BLAS has one thread, and after which it has as many as before.

    It is of the process: BLAS of other threads has one as long, too. Where several threads
    identify at once, it ends with the first of them; before version 3.8 of threadpoolctl BLAS may
    keep one thread then. Without that package nothing is limited.
    """
    # Programs of ours say so before BLAS is loaded; to look for libraries would lose a Ctrl-C.
    said = all(os.environ.get(name) == '1' for name in THREADS)
    libraries = None if said else _libraries()
    return nullcontext() if libraries is None else libraries.limit(limits=1, user_api='blas')


@cache
def _libraries() -> Any:    # noqa: ANN401 - of a library without types
    """Return what limits the libraries that are loaded, or None."""
    with suppress(ImportError):
        from threadpoolctl import ThreadpoolController

        return ThreadpoolController()
    return None
