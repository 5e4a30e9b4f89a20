# SPDX-License-Identifier: Apache-2.0
"""Many runs of one experiment, over all cores, and what their errors amount to."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
import multiprocessing
import os

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from ctsid_core.identify import identify
from ctsid_core.settings import Settings
from ctsid_core.statespace import StateSpace
from ctsid_ros.blas import use_one_thread
from ctsid_ros.progress import progress
from ctsid_ros.studies.experiments import Run

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class Outcome:
    """
    What came of one run.

    Parameters
    ----------
    error : ndarray, shape (n,)
        Of each true pole, in the order of the true model's; NaN if the order is wrong [rad/s].
    deviation : ndarray, shape (n,)
        What the estimate says of it.
    order : int
        Of the model; 0 if there is none.
    status : str
    """

    error: ComplexArray
    deviation: Array
    order: int
    status: str


def outcome(run: Run, settings: Settings | None = None) -> Outcome:
    """Identify one run; a rejected model counts, and its status is noted."""
    estimate, truth = identify(run.record, settings), run.model.poles
    model = estimate.model or estimate.rejected_model
    error, deviation = np.full(len(truth), np.nan + 0j), np.full(len(truth), np.nan)
    if model is not None and model.n == len(truth):
        columns, rows = linear_sum_assignment(np.abs(truth[:, np.newaxis] - model.poles))
        error[columns] = model.poles[rows] - truth[columns]
        deviation[columns] = np.asarray(estimate.pole_std)[rows]
    return Outcome(error, deviation, 0 if model is None else model.n, estimate.status.name)


@dataclass(frozen=True, eq=False)
class Summary:
    """
    What errors amount to, pole by pole; only of the runs with the right order.

    Parameters
    ----------
    errors : ndarray, shape (runs, n)
    deviation : ndarray, shape (n,)
        Root mean square of what the estimates say.
    right, ok : float
        Part of the runs with the right order; with status OK.
    """

    errors: ComplexArray
    deviation: Array
    right: float
    ok: float

    @property
    def bias(self) -> Array:
        """|mean error| ([HD] eq. 60)."""
        return np.asarray(np.abs(self.errors.mean(axis=0)))

    @property
    def std(self) -> Array:
        """Standard deviation ([HD] eq. 61)."""
        return np.asarray(np.std(self.errors, axis=0, ddof=1))

    @property
    def rmse(self) -> Array:
        """Root mean square error."""
        return np.sqrt(np.mean(np.abs(self.errors) ** 2, axis=0))


def summary(outcomes: Sequence[Outcome]) -> Summary:
    """Return what outcomes amount to."""
    errors, said = (np.array([getattr(o, name) for o in outcomes])
                    for name in ('error', 'deviation'))
    right = np.isfinite(errors).all(axis=1)
    return Summary(errors[right], np.sqrt(np.mean(said[right] ** 2, axis=0)),
                   float(right.mean()), float(np.mean([o.status == 'OK' for o in outcomes])))


def runs(task: Callable[[int], Outcome], count: int, title: str, jobs: int = 0) -> list[Outcome]:
    """
    Return the outcomes of seeds 0, 1, ...

    Parameters
    ----------
    task : callable
        From the seed; of a module, for other processes have to find it.
    count : int
    title : str
        For the line that shows how far it is.
    jobs : int
        Processes; 0: one for each core. 1: this one.
    """
    done: list[Outcome] = []
    with progress(title) as advance:
        for found in _each(task, count, jobs or len(os.sched_getaffinity(0))):
            done.append(found)
            advance(len(done) / count, '')
    return done


def _each(task: Callable[[int], Outcome], count: int, jobs: int) -> Iterator[Outcome]:
    if jobs == 1:
        yield from map(task, range(count))
        return
    use_one_thread()        # of every process that is started from here
    spawn = multiprocessing.get_context('spawn')
    with ProcessPoolExecutor(jobs, mp_context=spawn) as pool:
        yield from pool.map(task, range(count), chunksize=4)


def arguments(doc: str | None, count: int,
              argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Parse the command line that all studies share."""
    parser = argparse.ArgumentParser(description=doc,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--seeds', type=int, default=count, help='runs of each experiment')
    parser.add_argument('--jobs', type=int, default=0, help='processes; 0: one for each core')
    return parser.parse_args(argv)


def of_poles(model: StateSpace) -> list[tuple[str, int]]:
    """Return the name of each pole, one of every pair, and its place among `model.poles`."""
    return [(f'{p.real:.4g}' + (f' ± {p.imag:.4g}i' if p.imag else ''), i)
            for i, p in enumerate(model.poles) if p.imag >= 0.0]
