# SPDX-License-Identifier: Apache-2.0
"""What came of the messages of the last seconds, beside what came of all."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace

from ctsid_core.signals.samples import GroupCounts
from ctsid_ros.decoding.field_path import Leaf
from ctsid_ros.decoding.names import join_called
from ctsid_ros.ingest.counts import IngestCounts

Called = Mapping[str, Mapping[Leaf, Sequence[Leaf]]]
_WORST = ('worst_late', 'worst_astray')
_COUNTED = tuple(f.name for f in fields(GroupCounts) if f.name not in _WORST)


@dataclass(frozen=True)
class Totals:
    """
    Counts since the beginning; the worst offsets are those since the counts before.

    Parameters
    ----------
    counts : IngestCounts or None
        None while the lengths of arrays are awaited.
    lost : mapping of str to int
        Messages lost on the way, by topic.
    called : mapping
        `Extractor.called` by topic, since the totals before.
    """

    counts: IngestCounts | None = None
    lost: Mapping[str, int] = field(default_factory=dict)
    called: Called = field(default_factory=dict)


class Recent:
    """
    Remember totals for some seconds, to tell what has been added to them.

    Parameters
    ----------
    seconds : float
        How long [s].
    """

    def __init__(self, seconds: float) -> None:
        self._ns = round(seconds * 1e9)
        self._past: deque[tuple[int, Totals]] = deque()

    def added(self, now_ns: int, now: Totals) -> Totals:
        """Return what the last seconds have added, and remember the totals of now [ns]."""
        if self._past and _restarted(self._past[-1][1], now):
            self._past.clear()
        if self._past and now_ns < self._past[-1][0]:  # the clock was set back
            self._past = deque([(now_ns, self._past[-1][1])])
        since_ns = now_ns - self._ns
        while len(self._past) > 1 and self._past[1][0] - since_ns <= since_ns - self._past[0][0]:
            self._past.popleft()        # the next one is as near
        before = self._past[0][1] if self._past else Totals()
        since = [totals for _, totals in self._past][1:] + [now]
        self._past.append((now_ns, now))
        lost = {topic: n - before.lost.get(topic, 0) for topic, n in now.lost.items()}
        return Totals(_added(before.counts, now.counts, [t.counts for t in since]), lost,
                      _called(since))


def _restarted(before: Totals, now: Totals) -> bool:
    """Whether the counts began anew."""
    if before.counts is None or now.counts is None:
        return before.counts is not None
    return now.counts.windows < before.counts.windows or any(
        getattr(own.samples, name) < getattr(before.counts.channels[key].samples, name)
        for key, own in now.counts.channels.items() for name in _COUNTED)


def _called(since: list[Totals]) -> Called:
    found: dict[str, dict[Leaf, Sequence[Leaf]]] = {}
    for totals in since:
        for topic, called in totals.called.items():
            own = found.setdefault(topic, {})
            own |= {leaf: join_called(own.get(leaf, ()), names) for leaf, names in called.items()}
    return found


def _added(before: IngestCounts | None, now: IngestCounts | None,
           since: list[IngestCounts | None]) -> IngestCounts | None:
    if before is None or now is None:
        return now
    channels = {}
    for name, own in now.channels.items():
        old = before.channels[name].samples
        changes = {key: getattr(own.samples, key) - getattr(old, key) for key in _COUNTED}
        worst = {key: max((getattr(c.channels[name].samples, key) for c in since if c), key=abs)
                 for key in _WORST}
        channels[name] = replace(own, samples=GroupCounts(**changes, **worst),
                                 absent=own.absent - before.channels[name].absent)
    return IngestCounts(channels, now.windows - before.windows, now.empty - before.empty,
                        now.resets - before.resets)
