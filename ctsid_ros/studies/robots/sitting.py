# SPDX-License-Identifier: Apache-2.0
"""One experiment from its making to its row; what is reachable is kept in a file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import hashlib
from pathlib import Path
import signal
import time
from types import FrameType

import numpy as np

from ctsid_core.identify import identify
from ctsid_core.model.estimate import Estimate
from ctsid_core.signals.record import Record
from ctsid_ros.studies.robots.experiment import Experiment
from ctsid_ros.studies.robots.families import experiment
from ctsid_ros.studies.robots.reachable import reachable
from ctsid_ros.studies.robots.regression import prediction_reach
from ctsid_ros.studies.robots.scoring import Row, score

EDITION = b'1'          # another one whenever brute force or regression find something else
LIMIT = 60.0            # of an identification [s of processor]


class TooLate(BaseException):
    """An identification has taken too long."""


@contextmanager
def limited(seconds: float) -> Iterator[None]:
    """Raise `TooLate` after so many seconds of processor; only where there are such alarms."""
    if not hasattr(signal, 'setitimer'):
        yield
        return

    def stop(number: int, frame: FrameType | None) -> None:
        raise TooLate
    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


def identified(given: Experiment, limit: float = LIMIT) -> tuple[Estimate | None, float]:
    """Return the estimate, None if it takes too long, and the seconds of processor."""
    start = time.process_time()
    try:
        with limited(limit):
            estimate: Estimate | None = identify(given.record, given.settings)
    except TooLate:
        estimate = None
    return estimate, time.process_time() - start


class Reach:
    """
    What is reachable, found once for every pair of records.

    Parameters
    ----------
    path : Path or None
        The file; made when something is kept. None: nothing is kept.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._known: dict[str, tuple[float, ...]] = {}
        if path and path.exists():
            for line in path.read_text(encoding='utf-8').splitlines():
                key, _, values = line.partition(' ')
                self._known[key] = tuple(float(x) for x in values.split())

    def of(self, given: Experiment) -> tuple[float, ...]:
        """Return the reachable fit [%]; of predictions what `prediction_reach` says."""
        if given.test is None:
            return ()
        key = _key(given.record, given.test, given.judge)
        if not self._known.get(key):
            found = (reachable(given.record, given.test),) \
                if given.judge == 'simulation' else \
                prediction_reach(given)
            self._known[key] = found
            self._keep(f'{key} {" ".join(str(x) for x in found)}\n')
        return self._known[key]

    def _keep(self, line: str) -> None:
        if self._path:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with self._path.open('a', encoding='utf-8') as stream:
                stream.write(line)


def _key(train: Record, test: Record, judge: str) -> str:
    digest = hashlib.sha256(EDITION + judge.encode())
    for record in (train, test):
        for s in (*record.inputs, *record.outputs):
            digest.update(np.ascontiguousarray(s.time).tobytes()
                          + np.ascontiguousarray(s.values).tobytes())
    return digest.hexdigest()[:20]


def sat(family: str, seed: int, number: int, reach: Reach) -> Row:
    """Return the row of an experiment."""
    given = experiment(family, seed, number)
    within = reach.of(given)
    estimate, seconds = identified(given)
    return score(given, estimate, within, seconds)
