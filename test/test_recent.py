# SPDX-License-Identifier: Apache-2.0
"""What the last seconds have added to the counts."""

import numpy as np

from ctsid_core.signals.samples import GroupCounts
from ctsid_ros.ingest.counts import ChannelCounts, IngestCounts
from ctsid_ros.ingest.recent import Recent, Totals

S = 10**9


def totals(windows=0, resets=0, lost=0, **samples) -> Totals:
    own = ChannelCounts('header', '', GroupCounts(**samples))
    return Totals(IngestCounts({'u': own}, windows, 0, resets), {'/u': lost})


def test_the_first_totals_are_all_new():
    first = totals(accepted=5, late=1, worst_late=-0.5, lost=2)
    assert Recent(3.0).added(0, first) == first


def test_what_is_older_than_the_time_does_not_count():
    recent, found = Recent(3.0), []
    for second in range(8):
        late = min(second, 2)  # two, in the first two seconds
        found.append(recent.added(second * S, totals(
            accepted=10 * second, late=late, lost=late, worst_late=-late if second < 3 else 0.0)))
    own = [f.counts.channels['u'].samples for f in found]
    assert [one.late for one in own] == [0, 1, 2, 2, 1, 0, 0, 0]
    assert [f.lost['/u'] for f in found] == [0, 1, 2, 2, 1, 0, 0, 0]
    assert [one.worst_late for one in own] == [0.0, -1.0, -2.0, -2.0, -2.0, 0.0, 0.0, 0.0]
    assert own[-1].accepted == 30


def test_looks_that_come_a_little_early_or_late_count_the_same_time():
    recent, rng, found = Recent(10.0), np.random.default_rng(0), []
    for second in range(40):
        at = second + rng.uniform(-0.02, 0.02)
        found.append(recent.added(round(at * S), totals(accepted=round(50 * at + 10))))
    assert all(abs(f.counts.channels['u'].samples.accepted - 500) <= 3 for f in found[12:])


def test_counts_that_begin_anew_are_all_new():
    recent = Recent(3.0)
    recent.added(0, totals(accepted=50, resets=2))
    again = totals(accepted=10, resets=1)
    assert recent.added(S, again) == again
    assert recent.added(2 * S, Totals(None, {})).counts is None
    assert recent.added(3 * S, again) == again


def test_a_clock_that_is_set_back_does_not_keep_what_is_old():
    recent = Recent(3.0)
    for second in (100, 101, 102):
        recent.added(second * S, totals(accepted=second, late=second - 100))
    found = [recent.added(second * S, totals(accepted=103 + second, late=2)) for second in (1, 2)]
    assert [f.counts.channels['u'].samples.late for f in found] == [0, 0]
