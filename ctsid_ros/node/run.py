# SPDX-License-Identifier: Apache-2.0
"""What runs between activation and deactivation of the node, and what it can be asked."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from threading import Lock
import time
from typing import TYPE_CHECKING

from rclpy.node import Node

from ctsid_core.errors import StorageError
from ctsid_core.model.storage import save_model
from ctsid_core.signals.record import Record
from ctsid_ros.config.channels import Config
from ctsid_ros.errors import lacks_bag_package
from ctsid_ros.ingest.feed import Feed
from ctsid_ros.ingest.sim_clock import SimClock
from ctsid_ros.messages.health import Health, Level
from ctsid_ros.messages.models import provenance
from ctsid_ros.node.diagnosis import (
    IngestDiagnosis,
    diagnose_identification,
    no_window,
    with_cause,
)
from ctsid_ros.node.intake import Intake
from ctsid_ros.node.plan import Plan
from ctsid_ros.node.session import Identified, Session
from ctsid_ros.report.tables import join

if TYPE_CHECKING:
    from ctsid_ros.decoding.message_types import MessageType
    from ctsid_ros.recordings.writer import BagWriter

_STOP = 0.3  # time for a thread to end [s]; an identification is broken off within 0.1 s
Answer = tuple[bool, str]  # of a service: whether it did it, and a sentence


@dataclass(frozen=True)
class Run:
    """
    Intake and identification at work; made by `begin`, ended by `stop`.

    Parameters
    ----------
    name : str
        Full name of the node.
    feed : Feed
        To be asked while the lock of the intake is held.
    intake : Intake
    session : Session
    diagnosis : IngestDiagnosis
    recorder : BagWriter or None
    """

    name: str
    feed: Feed
    intake: Intake
    session: Session
    diagnosis: IngestDiagnosis
    recorder: BagWriter | None

    def stop(self, patience: float) -> bool:
        """
        End it; return whether the thread of identification has ended in time [s].

        What is being identified is broken off.

        Raises
        ------
        StorageError
            If the recording cannot be finished; all else has ended then.
        """
        self.session.cancel()  # it ends while the intake does
        self.intake.stop(_STOP)
        ended = self.session.stop(patience)
        if self.recorder is not None:
            self.recorder.close()
        return ended

    def metadata(self, result: Identified) -> dict[str, object]:
        """Return what is published beside an estimate."""
        return provenance(
            self.feed.config, self.name, result.window.number,
            requested=result.window.requested, computing_seconds=result.computing)

    def health(self, timeout: float) -> list[Health]:
        """Return how ingest and identification are; a topic is silent after a timeout [s]."""
        faults = list(self.intake.faults())
        with self.intake.lock:
            ingest = self.diagnosis.look(self.feed, time.time_ns(), timeout, faults,
                                         self.intake.failure)
            filled = self.feed.filled
        progress = self.session.progress
        gone = 'no messages come in' if ingest.level is Level.STALE else \
            no_window(progress, timeout, filled)
        return [ingest, with_cause(diagnose_identification(progress), gone,
                                   self.diagnosis.causes)]

    def identify(self) -> Answer:
        """Identify the last window of data now, out of turn."""
        with self.intake.lock:
            record = self.feed.latest()
            if record is not None:
                _submit(record, self.session, self.feed, requested=True)
                return True, ('the last window is identified next, unless a newer one is due by '
                              'then; see ~/model')
        length = self.feed.config.settings.window_length
        return False, f'there are no {length:g} s of data of all channels yet; see /diagnostics'

    def reset(self) -> Answer:
        """Forget all data and models."""
        with self.intake.lock:  # no window of before is handed over in between
            self.feed.reset()
            self.session.reset()
        return True, 'data and models are forgotten'

    def save(self, folder: Path) -> Answer:
        """Write the last accepted model into a folder, and tell its grade."""
        accepted = self.session.progress.accepted
        if accepted is None:
            return False, 'there is no accepted model yet; see /diagnostics'
        estimate = accepted.tracked.estimate
        moment = datetime.fromtimestamp(estimate.end_ns // 10**9, UTC).strftime('%Y%m%dT%H%M%SZ')
        node = self.name.strip('/').replace('/', '-')
        path = folder / f'{node}-{moment}-{accepted.window.number}.json'
        try:
            folder.mkdir(parents=True, exist_ok=True)
            save_model(path, estimate, self.metadata(accepted), force=True)
        except (StorageError, OSError) as error:
            return False, f'not written: {error}'
        words = f'window {accepted.window.number} is written to {path.absolute()}'
        return True, f'GOOD: {words}' if estimate.good else (
            f'{words}, but it is {estimate.verdict.grade.name}: {estimate.verdict.reason} Save '
            'again after a window that is GOOD')


def begin(node: Node, plan: Plan, publish: Callable[[Identified], None],
          turn: Lock | None = None) -> Run:
    """
    Subscribe in the name of a node, and identify.

    Parameters
    ----------
    node : Node
    plan : Plan
    publish : callable
        Given each result, in the thread of identification.
    turn : Lock, optional
        That of the node: what it began before may not have ended yet.

    Raises
    ------
    StorageError
        If the recording cannot be begun.
    """
    settings, log = plan.config.node, node.get_logger()
    clock = SimClock() if node.get_parameter('use_sim_time').value else None

    def publishers(topic: str) -> int:
        return int(node.count_publishers(node.resolve_topic_name(topic)))

    with ExitStack() as undo:  # what has begun, if the rest cannot
        recorder = None
        if settings.ingest_record:
            recorder = _recorder(settings.ingest_record, plan.types)
            undo.callback(recorder.close)
            log.info(f'recording the messages to {recorder.path}')
        feed = Feed(plan.config, plan.types, publishers, recorder, clock)
        session = Session(plan.config.settings, publish, log.error, turn)
        undo.callback(session.stop, _STOP)
        intake = Intake(node, feed, plan.classes, settings,
                        lambda record: _submit(record, session, feed), clock)
        undo.pop_all()
    log.info(_opening(plan.config, node.resolve_topic_name))
    return Run(node.get_fully_qualified_name(), feed, intake, session,
               IngestDiagnosis(plan.config, time.time_ns()), recorder)


def _opening(config: Config, resolved: Callable[[str], str]) -> str:
    """Return what the node listens to, and when the first model is due."""
    topics: dict[str, list[str]] = {}
    for channel in config.channels:
        topics.setdefault(f'{resolved(channel.topic)} ({channel.type})', []).append(
            f'{channel.role} {channel.name} = {channel.field}')
    settings = config.settings
    first = settings.window_length + settings.window_max_delay
    return (f'listening to {"; ".join(f"{t}: {join(c)}" for t, c in topics.items())}. The first '
            f'model is due {first:g} s after the first samples of all of them (`window.length` '
            f'and `window.max_delay`), the next ones every {settings.window_stride:g} s')


def _recorder(path: str, types: Mapping[str, MessageType]) -> BagWriter:
    try:
        from ctsid_ros.recordings.writer import BagWriter
    except ImportError as error:
        missing = lacks_bag_package(error, '`ingest.record`')
        if not missing:
            raise
        raise StorageError(f'{missing}; or leave it empty') from error
    return BagWriter(path, types)


def _submit(record: Record, session: Session, feed: Feed, *, requested: bool = False) -> None:
    end_ns = record.epoch_ns + round(record.end * 1e9)
    session.submit(record, feed.arrival_ns(end_ns), requested=requested)
