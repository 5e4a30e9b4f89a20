# SPDX-License-Identifier: Apache-2.0
"""
The health of ingest and identification: sentences on what is wrong now, and numbers.

Now is the last `window.length` of the computer's clock, which the next model is made of; totals
since the activation are among the numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

from ctsid_core.linear.types import Array
from ctsid_core.model.estimate import Estimate
from ctsid_core.model.verdict import Verdict
from ctsid_ros.config.channels import Config
from ctsid_ros.ingest.feed import Feed
from ctsid_ros.ingest.recent import Recent, Totals
from ctsid_ros.messages.health import Health, Level
from ctsid_ros.node.session import Progress, UnderWay

INGEST, IDENTIFICATION = 'ingest', 'identification'
_FULL = 0.99  # of a window that waits for the samples after its end
_KINDS = ('late', 'astray', 'bad_stamp', 'duplicate', 'non_finite', 'wrong_width')


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
    causes : list of str
        These, and the silences of commands, which may be behind a verdict that is not GOOD.
    """

    def __init__(self, config: Config, start_ns: int) -> None:
        self._config, self._start_ns = config, start_ns
        self._past: dict[str, _Past] = {}
        self._length = config.settings.window_length
        # For so long a verdict stands that silence has a part in
        self._told = self._length + config.settings.window_stride \
            + config.settings.window_max_delay
        self._recent = Recent(self._length)
        self._silences: dict[str, tuple[int, float]] = {}  # the last of each: when, how long
        self.troubles: list[str] = []
        self.causes: list[str] = []
        # Their commands may be sent when they change, or while a key is pressed.
        self._held = {c.topic for c in config.channels if all(
            other.hold == 'zoh' and other.role == 'input' for other in config.channels
            if other.topic == c.topic)}

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
        silent: dict[str, str] = {}
        ended: dict[str, str] = {}
        values: dict[str, object] = {}
        for topic, state in feed.topics.items():
            age = (now_ns - (state.last_ns or self._start_ns)) * 1e-9
            if age > timeout:
                silent[topic] = (
                    f'{topic} has been silent for {age:.1f} s; check its publisher'
                    if state.messages else
                    f'no message has come on {topic}; check its name, and that its publisher runs')
                if state.messages:
                    self._silences[topic] = now_ns, age
            elif topic in self._silences and 0.0 <= (
                    since := (now_ns - self._silences[topic][0]) * 1e-9) < self._told:
                ended[topic] = (f'{topic} was silent for {self._silences[topic][1]:.1f} s until '
                                f'{since:.0f} s ago, within the last windows')
            values |= {f'{topic} messages': state.messages,
                       f'{topic} rate [1/s]': self._rate(topic, state.messages, now_ns * 1e-9),
                       f'{topic} age [s]': age if state.messages else math.nan,
                       f'{topic} lost': state.numbers.lost}
        totals = feed.totals()
        recent = self._recent.added(now_ns, totals)
        values |= {'window filled [%]': 100.0 * feed.filled, 'largest batch': feed.largest_batch,
                   **_sample_values(totals, recent, self._config)}
        own = [f'a fault of ctsid, please report it: {failure}'] if failure else []
        stale = len(silent) == len(feed.topics)
        told = silent | ended
        normal = [topic for topic in told
                  if topic in self._held and feed.topics[topic].messages and not stale]
        troubles = [*own, *faults, *(told[topic] for topic in told if topic not in normal)]
        # What never came is reported as silent already.
        troubles += [line for line in feed.report(recent, f' of the last {self._length:g} s')
                     if 'no message has come' not in line]
        self.troubles, self.causes = troubles, [*troubles, *(told[topic] for topic in normal)]
        heard = any(state.messages for state in feed.topics.values())
        level = (Level.ERROR if failure else
                 Level.STALE if stale else
                 Level.WARN if troubles else Level.OK if heard else Level.STALE)
        return Health(INGEST, level, '; '.join(troubles) or (
            'messages come in' if heard else 'no message has come yet'), values)

    def _rate(self, topic: str, messages: int, now: float) -> float:
        past = self._past.setdefault(topic, _Past(now, messages))
        if now - past.time > 0.5:
            rate = max(messages - past.messages, 0) / (now - past.time)
            self._past[topic] = past = _Past(now, messages, rate)
        return past.rate


def _sample_values(totals: Totals, recent: Totals, config: Config) -> dict[str, object]:
    """Return the counts of each channel since the activation, and in the last window."""
    if totals.counts is None or recent.counts is None:
        return {}
    values: dict[str, object] = {}
    for channel in config.channels:
        own, now = (t.counts.channels[channel.name] for t in (totals, recent) if t.counts)
        values[f'{channel.name} samples'] = own.samples.accepted
        values[f'{channel.name} samples in the last window'] = now.samples.accepted
        values[f'{channel.name} stamps from'] = own.source or 'not known yet'
        for key in _KINDS:
            if count := getattr(own.samples, key):
                values[f'{channel.name} {key}'] = count
                values[f'{channel.name} {key} in the last window'] = getattr(now.samples, key)
    return values | {'windows': totals.counts.windows, 'empty windows': totals.counts.empty,
                     'resets': totals.counts.resets}


def no_window(progress: Progress, timeout: float, filled: float) -> str:
    """Return that no window comes, if it should have [s]; and how full the next one is."""
    fills = f', the next one is filled to {100.0 * filled:.0f} %' if filled < _FULL else ''
    return f'no window has come for {progress.idle:.1f} s{fills}' \
        if progress.overdue > timeout else ''


def diagnose_identification(progress: Progress) -> Health:
    """Return how the identification is."""
    values: dict[str, object] = {
        'windows': progress.windows, 'skipped windows': progress.skipped,
        'faults': progress.failures, 'budget [s]': progress.budget,
        **_under_way_values(progress.under_way)}
    last, slow = progress.last, _slow(progress)
    if last is None:
        return _without_result(progress, slow, values)
    estimate = last.tracked.estimate
    values |= {'window': last.window.number, 'computing time [s]': last.computing,
               'latency [s]': last.latency, **_estimate_values(estimate),
               'fresh fit [%]': _numbers(last.tracked.fresh_fit)}
    verdict = estimate.verdict
    troubles = [] if estimate.good else [f'{verdict.grade.name}: {verdict.reason}']
    if progress.failure:
        troubles.append('the last window failed by a fault of ctsid, please report it: '
                        f'{progress.failure}')
    troubles += [slow] if slow else []
    level = Level.OK if not troubles else Level.WARN if estimate.ok else Level.ERROR
    return Health(IDENTIFICATION, level, '; '.join(troubles) or verdict.reason, values)


def with_cause(identification: Health, gone: str, troubles: Sequence[str]) -> Health:
    """
    Return how the identification is now, with what the ingest says of it.

    Parameters
    ----------
    identification : Health
        As the last window has left it.
    gone : str
        Why there is nothing to identify now; '' if there is.
    troubles : sequence of str
        See `IngestDiagnosis`.
    """
    if gone and identification.level is not Level.STALE:
        return replace(identification, level=Level.STALE, message=(
            f'{gone}, see ingest; of the last window: {identification.message}'))
    if identification.level is Level.OK or not troubles:
        return identification
    return replace(identification, message=(
        f'{identification.message.rstrip(".")}; the ingest may know why: {troubles[0]}'))


def _without_result(progress: Progress, slow: str, values: dict[str, object]) -> Health:
    """Return how the identification is before its first result."""
    if progress.failure:
        return Health(IDENTIFICATION, Level.ERROR, progress.failure, values)
    words, now = slow, progress.under_way
    if now is not None and not slow:
        words = f'window {now.number} is being identified, for {now.seconds:.1f} s so far'
    elif progress.waiting and not slow:
        words = 'a window is about to be identified'
    return Health(IDENTIFICATION, Level.WARN if slow else Level.STALE,
                  f'{words}; there is no result yet' if words else 'no window is full yet', values)


def _slow(progress: Progress) -> str:
    """Return a sentence if identification does not keep up with the windows; else ''."""
    now, last = progress.under_way, progress.last
    cure = 'raise `window.stride`, or set `order`'
    if now is not None and now.skipped:
        return (f'window {now.number} has been under way for {now.seconds:.1f} s, and '
                f'{now.skipped} newer windows were skipped meanwhile; {cure}')
    if last is not None and last.skipped:
        return (f'{last.skipped} windows were skipped while window {last.window.number} was '
                f'identified, which took longer than `window.stride`; {cure}')
    return ''


def _under_way_values(now: UnderWay | None) -> dict[str, object]:
    return {} if now is None else {
        'window under way': now.number, 'under way for [s]': now.seconds,
        'skipped meanwhile': now.skipped}


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
                   'error that is not white [%]': _numbers(100 * verdict.coloured_error)}
    if verdict.agreement is not None:
        values['cross-check'] = verdict.agreement.words
    return values


def _numbers(values: Array) -> str:
    return ', '.join(f'{value:.1f}' for value in values)
