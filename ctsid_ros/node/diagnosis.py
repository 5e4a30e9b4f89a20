# SPDX-License-Identifier: Apache-2.0
"""The health of ingest and identification: sentences on what is wrong, and numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

from ctsid_core.linear.types import Array
from ctsid_core.model.estimate import Estimate
from ctsid_core.model.verdict import Verdict
from ctsid_ros.config.channels import Config
from ctsid_ros.ingest.feed import Feed
from ctsid_ros.messages.health import Health, Level
from ctsid_ros.node.session import Progress

INGEST, IDENTIFICATION = 'ingest', 'identification'


@dataclass
class _Past:
    """What was known of a topic when its rate was looked at last."""

    time: float
    messages: int
    rate: float = 0.0


class IngestDiagnosis:
    """
    Judge the ingest; remembers the last look, for the rates.

    Parameters
    ----------
    config : Config
    start_ns : int
        When the node began to listen, by the computer's clock [ns].

    Attributes
    ----------
    troubles : list of str
        What was wrong at the last look: a sentence on each fault.
    """

    def __init__(self, config: Config, start_ns: int) -> None:
        self._config, self._start_ns = config, start_ns
        self._past: dict[str, _Past] = {}
        self.troubles: list[str] = []

    def look(self, feed: Feed, now_ns: int, timeout: float, faults: Sequence[str],
             failure: str) -> Health:
        """
        Return how the ingest is.

        Parameters
        ----------
        feed : Feed
        now_ns : int
            The computer's clock [ns].
        timeout : float
            A topic without messages for so long is silent [s].
        faults : sequence of str
            Sentences on publishers that cannot be heard.
        failure : str
            The last fault of the ingest itself, if any.
        """
        silent: list[str] = []
        values: dict[str, object] = {}
        for topic, state in feed.topics.items():
            age = (now_ns - (state.last_ns or self._start_ns)) * 1e-9
            if age > timeout:
                silent.append(f'{topic} has been silent for {age:.1f} s; check its '
                              'publisher' if state.messages
                              else f'no message has come on {topic}; check its name, and that '
                              'its publisher runs')
            values |= {f'{topic} messages': state.messages,
                       f'{topic} rate [1/s]': self._rate(topic, state.messages, now_ns * 1e-9),
                       f'{topic} age [s]': age if state.messages else math.nan,
                       f'{topic} lost': state.numbers.lost}
        values |= {'largest batch': feed.largest_batch, **_sample_values(feed, self._config)}
        own = [f'a fault of ctsid, please report it: {failure}'] if failure else []
        troubles = [*own, *faults, *silent]
        # What never came is reported as silent already.
        troubles += [line for line in feed.report() if 'no message has come' not in line]
        self.troubles = troubles
        level = (Level.ERROR if failure else Level.STALE if len(silent) == len(feed.topics)
                 else Level.WARN if troubles else Level.OK)
        return Health(INGEST, level, '; '.join(troubles) or 'messages come in', values)

    def _rate(self, topic: str, messages: int, now: float) -> float:
        past = self._past.setdefault(topic, _Past(now, messages))
        if now - past.time > 0.5:
            rate = max(messages - past.messages, 0) / (now - past.time)
            self._past[topic] = past = _Past(now, messages, rate)
        return past.rate


def _sample_values(feed: Feed, config: Config) -> dict[str, object]:
    counts = feed.counts()
    if counts is None:
        return {}
    values: dict[str, object] = {}
    for channel in config.channels:
        own = counts.channels[channel.name]
        values[f'{channel.name} samples'] = own.samples.accepted
        values[f'{channel.name} stamps from'] = own.source or 'not known yet'
        for key in ('late', 'astray', 'bad_stamp', 'duplicate', 'non_finite', 'wrong_width'):
            if count := getattr(own.samples, key):
                values[f'{channel.name} {key}'] = count
    return values | {'windows': counts.windows, 'empty windows': counts.empty,
                     'resets': counts.resets}


def diagnose_identification(progress: Progress) -> Health:
    """Return how the identification is."""
    values: dict[str, object] = {
        'windows': progress.windows, 'skipped windows': progress.skipped,
        'faults': progress.failures}
    last = progress.last
    if last is None:
        return Health(IDENTIFICATION, Level.ERROR if progress.failures else Level.STALE,
                      progress.failure or (
                          'the first window is being identified' if progress.windows
                          else 'no window is full yet'), values)
    estimate = last.tracked.estimate
    values |= {'window': last.window.number, 'computing time [s]': last.computing,
               'latency [s]': last.latency, **_estimate_values(estimate),
               'fresh fit [%]': _numbers(last.tracked.fresh_fit)}
    verdict = estimate.verdict
    troubles = [] if estimate.good else [f'{verdict.grade.name}: {verdict.reason}']
    if progress.failures:
        troubles.append(f'{progress.failures} windows failed by a fault of ctsid, please report '
                        f'it: {progress.failure}')
    if progress.skipped:
        troubles.append(f'{progress.skipped} windows were skipped because identification takes '
                        'longer than `window.stride`; raise it, or set `order`')
    level = Level.OK if not troubles else Level.WARN if estimate.ok else Level.ERROR
    return Health(IDENTIFICATION, level, '; '.join(troubles) or verdict.reason, values)


def _estimate_values(estimate: Estimate) -> dict[str, object]:
    values: dict[str, object] = {
        'verdict': estimate.verdict.grade.name, 'reason': estimate.verdict.reason,
        'status': estimate.status.name, 'window start [ns]': estimate.start_ns,
        'window end [ns]': estimate.end_ns}
    if estimate.model is not None:
        values |= {'order': estimate.model.n, 'fit [%]': _numbers(estimate.fit),
                   'held-out fit [%]': _numbers(estimate.held_out_fit)}
    return values | _verdict_values(estimate.verdict)


def _verdict_values(verdict: Verdict) -> dict[str, object]:
    values: dict[str, object] = {}
    for one in verdict.excitation:
        values |= {f'{one.name} excited band [rad/s]': f'{one.low:.3g} to {one.high:.3g}',
                   f'{one.name} response std [%]': 100 * one.uncertainty}
    if verdict.excitation:
        values |= {'largest pole std [%]': 100 * verdict.pole_uncertainty,
                   'unmodelled response [%]': _numbers(100 * verdict.missing)}
    if verdict.agreement is not None:
        values['cross-check'] = verdict.agreement.words
    return values


def _numbers(values: Array) -> str:
    return ', '.join(f'{value:.1f}' for value in values)
