# SPDX-License-Identifier: Apache-2.0
from collections.abc import Iterator

import numpy as np
import pytest

from ctsid_core.errors import DataError
from ctsid_core.signals.record import Record
from ctsid_core.signals.samples import Group
from ctsid_core.signals.windows import SlidingWindow

S = 10**9
EPOCH = 1_700_000_000 * S + 123_456_789
GROUPS = (Group('u', 1, 'input', 'zoh', ('torque',), ('N m',)),
          Group('y', 2, 'output', 'smooth', ('rate', 'angle')))
Sample = tuple[str, int, tuple[float, ...]]


def stream(seconds: float = 12.0, *, start_u: float = 0.0, start_y: float = 0.0,
           rate_u: float = 17.0, rate_y: float = 60.0, seed: int = 0) -> list[Sample]:
    """Two groups of different rates, jittered, in the order of their stamps."""
    rng = np.random.default_rng(seed)
    samples: list[Sample] = []
    for name, width, start, rate in (('u', 1, start_u, rate_u), ('y', 2, start_y, rate_y)):
        count = int((seconds - start) * rate)
        at = start + (np.arange(count) + 0.8 * rng.random(count)) / rate
        stamps = EPOCH + np.unique(np.round(at * 1e9).astype(np.int64))
        samples += [(name, int(t), tuple(rng.standard_normal(width))) for t in stamps]
    return sorted(samples, key=lambda sample: sample[1])


def window(**changes: float) -> SlidingWindow:
    return SlidingWindow(GROUPS, **{'length': 4.0, 'stride': 1.0, 'max_delay': 0.3} | changes)


def run(samples: list[Sample], slider: SlidingWindow, every: int = 1,
        flush: bool = True) -> list[Record]:
    records = []
    for count, sample in enumerate(samples):
        slider.push(*sample)
        if every and count % every == 0:
            records += slider.due()
    return records + list(slider.flush() if flush else slider.due())


def assert_same(got: list[Record], wanted: list[Record], shift_ns: int = 0) -> None:
    assert [r.epoch_ns for r in got] == [r.epoch_ns + shift_ns for r in wanted]
    for a, b in zip(got, wanted, strict=True):
        assert (a.start, a.end) == (b.start, b.end)
        for x, z in zip(a.inputs + a.outputs, b.inputs + b.outputs, strict=True):
            np.testing.assert_array_equal(x.time, z.time)
            np.testing.assert_array_equal(x.values, z.values)
            assert (x.hold, x.names, x.units) == (z.hold, z.names, z.units)


def cut_by_hand(samples: list[Sample], length: float, stride: float, lead: float,
                ) -> Iterator[tuple[int, list[tuple[np.ndarray, np.ndarray]]]]:
    """Yield (epoch, [(time, values) of u, of y]) of every window the samples reach the end of."""
    groups = []
    for name in ('u', 'y'):
        mine = [s for s in samples if s[0] == name]
        groups.append((np.array([s[1] for s in mine]), np.array([s[2] for s in mine])))
    start = max(groups[0][0][0], groups[1][0][0])
    while start + round(length * 1e9) <= max(stamps[-1] for stamps, _ in groups):
        end, parts = start + round(length * 1e9), []
        for (stamps, values), history, after in zip(groups, (lead, 0.0), (0, 3), strict=True):
            first = np.searchsorted(stamps, start - round(history * 1e9)) - 3
            last = np.searchsorted(stamps, end, side='right') + after
            part = slice(max(first, 0), last)
            parts.append(((stamps[part] - start) / 1e9, values[part]))
        yield int(start), parts
        start += round(stride * 1e9)


@pytest.mark.parametrize(('length', 'stride', 'lead'),
                         [(4.0, 1.0, 0.0), (4.0, 0.37, 0.25), (2.0, 3.0, 0.1)])
def test_a_record_equals_cutting_the_whole_stream_by_hand(length, stride, lead):
    samples = stream(start_u=0.5)
    records = run(samples, window(length=length, stride=stride, lead=lead))
    wanted = list(cut_by_hand(samples, length, stride, lead))
    assert len(records) == len(wanted) >= 3
    for record, (epoch, (u, y)) in zip(records, wanted, strict=True):
        assert (record.epoch_ns, record.start, record.end) == (epoch, 0.0, length)
        for signal, (time, values) in zip(record.inputs + record.outputs, (u, y), strict=True):
            np.testing.assert_array_equal(signal.time, time)
            np.testing.assert_array_equal(signal.values, values)
    assert records[0].input_names == ('torque',)
    assert records[0].input_units == ('N m',)
    assert (records[0].inputs[0].hold, records[0].outputs[0].hold) == ('zoh', 'smooth')


def test_a_record_agrees_with_the_record_of_the_whole_stream():
    samples = stream()
    whole = window(length=1e5)
    run(samples, whole, flush=False)
    record = whole.whole()
    for part in run(samples, window(lead=0.2)):
        offset = (part.epoch_ns - record.epoch_ns) / 1e9
        wanted = record.between(offset, offset + 4.0, lead=0.2)
        y = wanted.outputs[0]
        np.testing.assert_allclose(part.outputs[0].time, y.time - offset, atol=2e-15 * 1e3)
        np.testing.assert_array_equal(part.outputs[0].values, y.values)
        u = part.inputs[0]  # held: what comes after the window says nothing about it
        np.testing.assert_array_equal(u.values, wanted.inputs[0].values[:len(u.values)])
        assert wanted.inputs[0].time[len(u.time)] - offset > 4.0


@pytest.mark.parametrize('seed', range(5))
def test_arrival_shuffled_within_max_delay_gives_identical_records(seed):
    samples = stream(start_u=0.4, seed=seed)
    wanted = run(samples, window())
    rng = np.random.default_rng(seed)
    arrival = [stamp + rng.uniform(0.0, 0.29e9) for _, stamp, _ in samples]
    shuffled = [samples[i] for i in np.argsort(arrival)]
    assert shuffled != samples
    slider = window()
    assert_same(run(shuffled, slider), wanted)
    assert len(wanted) > 5
    assert all(c.late == c.duplicate == 0 for c in slider.counts.groups.values())


@pytest.mark.parametrize('every', [0, 1, 7, 1000])
def test_windows_do_not_depend_on_when_they_are_asked_for(every):
    samples = stream(start_u=0.4) + [(n, t + 60 * S, v) for n, t, v in stream(seed=1)]
    samples += stream(seed=2)  # and back again: a restart in the middle
    sliders = window(), window()
    assert_same(run(samples, sliders[0], every), run(samples, sliders[1], 3))
    assert sliders[0].counts == sliders[1].counts
    assert sliders[0].counts.resets == 1


def test_a_window_is_due_once_its_context_has_its_final_order_and_not_before():
    slider, samples, due_at = window(), stream(), None
    for sample in samples:
        slider.push(*sample)
        if due_at is None and (records := list(slider.due())):
            due_at = sample[1]
    end = records[0].epoch_ns + 4 * S
    assert records[0].outputs[0].time[-1] > 4.0  # three samples after it: known to its very end
    last_ns = records[0].epoch_ns + round(records[0].outputs[0].time[-1] * 1e9)
    assert last_ns + 0.3e9 <= due_at < end + 0.3e9 + 0.15e9


def test_stamps_keep_their_nanoseconds():
    slider = SlidingWindow((Group('y', 1, 'output', 'linear'),), 1e-3, 1e-3, 0.0)
    stamps = [1_700_000_000_000_000_001 + 7_919 * k for k in range(400)]
    for stamp in stamps:
        slider.push('y', stamp, (1.0,))
    for record in slider.flush():
        back = np.round(record.outputs[0].time * 1e9).astype(np.int64) + record.epoch_ns
        assert set(back.tolist()) <= set(stamps)


def test_first_window_starts_where_all_is_known_and_inputs_have_the_history_there_is():
    samples = stream(start_u=3.0, start_y=1.0)
    first_u = next(t for name, t, _ in samples if name == 'u')
    first, second = run(samples, window(lead=0.5))[:2]
    assert first.epoch_ns == first_u
    assert first.inputs[0].time[0] == 0.0
    assert -0.8 < second.inputs[0].time[0] <= -0.5      # a held value is known from before
    samples = stream(start_u=1.0, start_y=3.0)
    first_y = next(t for name, t, _ in samples if name == 'y')
    first = run(samples, window(lead=0.5))[0]
    assert first.epoch_ns == first_y
    assert -0.8 < first.inputs[0].time[0] <= -0.5


def test_history_of_inputs_does_not_reach_over_a_gap():
    """What came in it is not known; only what is held when a window begins is, or is guessed."""
    early, late = stream(6.0, seed=1), stream(6.0, seed=2)
    samples = early + [(name, stamp + 60 * S, values) for name, stamp, values in late]
    back = next(stamp for name, stamp, _ in samples[len(early):] if name == 'u')
    for every in (1, 0):        # whenever windows are asked for
        records = [r for r in run(samples, window(lead=1.5, stride=0.25), every)
                   if r.epoch_ns > EPOCH + 50 * S]
        behind = [r for r in records if r.epoch_ns >= back + S // 4]
        assert len(behind) >= 5
        for record in behind:
            first, since = record.inputs[0].time[0], (back - record.epoch_ns) / 1e9
            assert max(since, -1.9) - 1e-9 <= first <= max(since, -1.5) + 1e-9
        ahead = next(r for r in records if r.epoch_ns < back)
        assert ahead.inputs[0].time[0] < -40.0


def test_history_of_inputs_does_not_reach_over_a_restart():
    samples = stream(9.0, seed=1) + stream(9.0, seed=2)
    slider = window(lead=1.5)
    first = run(samples[:-1], slider, flush=False)
    assert slider.counts.resets == 1
    again = [r for k, r in enumerate(first) if k and r.epoch_ns < first[k - 1].epoch_ns]
    assert again[0].inputs[0].time[0] >= -0.2


def test_what_came_before_the_beginning_is_history_and_counts_for_nothing():
    """Of samples with a straggler, duplicates, values that are no numbers, and a restart."""
    before = stream(6.0, seed=3)
    before += [before[-1], ('y', before[-1][1] - S // 2, (0.0, 0.0)), ('u', 10, (1.0,)),
               ('y', before[-1][1] + 1, (np.nan, 0.0))]
    slider, alone, later = *(window(length=1e5, lead=1.0) for _ in range(2)), stream(12.0)
    for sample in stream(9.0, seed=2) + before + [s for s in later if s[1] < EPOCH + 5 * S]:
        slider.push(*sample)
    assert slider.counts.resets == 2
    assert slider.counts.groups['y'].non_finite == 1
    slider.begin()
    for sample in (s for s in later if s[1] >= EPOCH + 5 * S):
        slider.push(*sample)
        alone.push(*sample)
    found, wanted = slider.whole(), alone.whole()
    assert slider.counts == alone.counts
    first, last = min(s[1] for s in later if s[0] == 'y' and s[1] >= EPOCH + 5 * S), 1e-9 * (
        wanted.epoch_ns - EPOCH) + wanted.end
    assert (found.epoch_ns, 1e-9 * (first - EPOCH) + found.end) == (first, pytest.approx(last))
    assert found.inputs[0].time[0] < -0.9 < wanted.inputs[0].time[0]


def test_no_window_of_what_came_before_the_beginning_is_handed_out():
    """A clock that restarts ends a stream, and its last windows become due."""
    slider = window(length=1.0, stride=1.0)
    for sample in stream(6.0, seed=2) + list(stream(3.0, seed=3)):
        slider.push(*sample)
    assert slider.counts.resets == 1
    slider.begin()
    assert slider.counts.windows == 0
    assert not list(slider.flush())


@pytest.mark.parametrize('hold', ['zoh', 'linear'])
def test_what_is_held_is_known_from_before_the_beginning(hold):
    """A key was pressed before it, and once more long after it: nothing is to be waited for."""
    slider = SlidingWindow((Group('u', 1, 'input', hold), Group('y', 1, 'output', 'linear')),
                           1e5, 1e5, 0.1)
    keys, outputs = {3: 1.0, 25: -1.0, 28: 0.0}, range(0, 3000)
    stamps = sorted([('u', EPOCH + k * S, (v,)) for k, v in keys.items()]
                    + [('y', EPOCH + k * S // 100, (0.01 * k,)) for k in outputs],
                    key=lambda s: s[1])
    for sample in stamps:
        if sample[1] == EPOCH + 5 * S and sample[0] == 'y':
            slider.begin()
        slider.push(*sample)
    record = slider.whole()
    since = 5 if hold == 'zoh' else 25
    assert record.epoch_ns == EPOCH + since * S
    assert [record.inputs[0].time[0], *record.inputs[0].values[:, 0]] == (
        [-2.0, 1.0, -1.0, 0.0] if hold == 'zoh' else [-22.0, 1.0, -1.0, 0.0])
    assert slider.counts.groups['u'].accepted == 2


def test_no_window_and_bounded_memory_while_a_group_is_missing():
    slider = window(lead=0.5)
    for k in range(100_000):
        slider.push('y', EPOCH + k * S // 200, (1.0, 2.0))
        assert not list(slider.due())
    assert len(slider._tracks['y'].stamps) < 2 * 200 * (0.3 + 0.5 + 0.1) + 10
    late = [('u', EPOCH + 500 * S + k * S // 20, (float(k),)) for k in range(200)]
    late += [('y', EPOCH + 500 * S + k * S // 200, (1.0, float(k))) for k in range(2000)]
    records = run(sorted(late, key=lambda s: s[1]), slider)
    assert records[0].epoch_ns == EPOCH + 500 * S
    assert records[0].outputs[0].time[0] == -0.015


def test_memory_is_bounded_in_a_long_stream():
    slider, most = window(length=1.0, stride=0.1, max_delay=0.1), 0
    for k in range(60_000):
        slider.push('u', EPOCH + k * 2_000_000, (1.0,))
        slider.push('y', EPOCH + k * 2_000_000, (1.0, 2.0))
        for _ in slider.due():
            pass
        most = max(most, len(slider._tracks['y'].stamps))
    assert most < 2 * 500 * 1.4
    assert slider.counts.windows == pytest.approx(1190, abs=5)
    assert slider.counts.groups['y'].accepted == 60_000


@pytest.mark.parametrize('silent', ['u', 'y'])
def test_a_group_that_stops_does_not_stall_the_others(silent):
    samples = [s for s in stream() if s[0] != silent or s[1] < EPOCH + 6 * S]
    slider = window()
    records = run(samples, slider, flush=False)
    last = records[-1]
    assert last.epoch_ns + 4 * S > EPOCH + 10 * S
    signal = (last.inputs if silent == 'u' else last.outputs)[0]
    assert signal.time[-1] < 0.0  # only context: the last values, held
    assert len(signal.time) == 3
    assert slider.counts.empty == 0


def test_late_duplicate_and_bad_samples_are_dropped_and_counted():
    samples, slider = stream(), window()
    wanted = run(samples, window())
    at = samples[300][1]
    bad = [('u', at - S // 2, (1.0,)), ('u', samples[299][1] + 1, (np.nan,)),
           ('y', at + 1, (np.inf, -np.inf)), ('y', at + 1, (1.0,)), ('u', at + 1, (1.0, 2.0)),
           ('u', 0, (1.0,)), ('y', -5, (1.0, 1.0)), ('y', 2**63, (1.0, 1.0))]
    y = next(s for s in reversed(samples[:300]) if s[0] == 'y')
    bad += [(*y[:2], (99.0, 99.0)), (*y[:2], (99.0, 99.0))]
    assert_same(run(samples[:300], slider, flush=False), [])
    assert not any(slider.push(*sample) for sample in bad)
    assert_same(run(samples[300:], slider), wanted)
    u, y = slider.counts.groups['u'], slider.counts.groups['y']
    assert (u.late, u.non_finite, u.wrong_width, u.bad_stamp, u.duplicate) == (1, 1, 1, 1, 0)
    assert (y.late, y.non_finite, y.wrong_width, y.bad_stamp, y.duplicate) == (0, 1, 1, 2, 2)
    assert u.worst_late == pytest.approx(-0.5, abs=0.02)
    assert u.accepted + y.accepted == len(samples)
    assert slider.counts.windows == len(wanted)


def test_huge_but_finite_values_are_not_taken_for_infinite():
    slider = SlidingWindow((Group('y', 2, 'output', 'linear'),), 1.0, 1.0, 0.0)
    assert slider.push('y', EPOCH, (1.7e308, 1.7e308))
    assert slider.counts.groups['y'].non_finite == 0


@pytest.mark.parametrize('back', [2.0, 5.0, 100.0])
def test_one_or_two_stragglers_are_no_restart(back):
    samples, slider = stream(), window()
    wanted = run(samples, window())
    records = run(samples[:400], slider, flush=False)
    for k in range(2):
        slider.push('y', samples[399][1] - round(back * 1e9) + k, (0.0, 0.0))
    records += run(samples[400:], slider)
    assert_same(records, wanted)
    assert slider.counts.resets == 0
    assert slider.counts.groups['y'].astray == 2


def test_stragglers_and_samples_from_the_future_do_not_confirm_each_other():
    samples, slider = stream(), window()
    wanted = run(samples, window())
    records = run(samples[:400], slider, flush=False)
    for offset in (-50, 50, 50, -50, -50, 50, 50):
        slider.push('y', samples[399][1] + offset * S, (0.0, 0.0))
    assert_same(records + run(samples[400:], slider), wanted)
    assert slider.counts.groups['y'].astray == 7


def test_a_group_that_is_always_late_is_no_restart():
    slider = window()
    for k in range(3000):
        slider.push('u', EPOCH + k * S // 1000 - S, (1.0,))
        if k % 100 == 0:
            slider.push('y', EPOCH + k * S // 1000, (1.0, 1.0))
    counts = slider.counts
    assert counts.resets == 0
    assert counts.groups['u'].late == 2999  # the first came before all others
    assert counts.groups['u'].worst_late == pytest.approx(-0.999, abs=0.001)
    assert counts.groups['y'].accepted == 30


def test_a_looped_bag_gives_the_same_windows_each_time():
    samples, slider = stream(), window()
    once = run(samples, window())
    thrice = run(samples * 3, slider)
    assert_same(thrice, once * 3)
    assert slider.counts.resets == 2
    assert all(c.late == c.astray == 0 for c in slider.counts.groups.values())


def test_a_clock_set_back_within_the_window_starts_anew_without_losing_samples():
    first, second = stream(8.0), [(n, t + 5 * S, v) for n, t, v in stream(7.0, seed=3)]
    slider = window()
    assert_same(run(first + second, slider), run(first, window()) + run(second, window()))
    assert slider.counts.resets == 1


def test_samples_from_the_far_future_do_no_harm():
    samples = stream()
    wanted, slider = run(samples, window()), window()
    records = []
    for k, sample in enumerate(samples):
        slider.push(*sample)
        if k % 50 < 2:
            slider.push('u', sample[1] + 10**17, (9.0,))
        records += slider.due()
    assert_same(records + list(slider.flush()), wanted)
    astray = slider.counts.groups['u'].astray
    assert astray == 2 * -(-len(samples) // 50)
    assert slider.counts.groups['u'].worst_astray == pytest.approx(1e8)


def test_a_gap_of_decades_costs_no_time_nor_memory():
    samples = stream()
    after = [(n, t + 10**18, v) for n, t, v in stream(seed=5)]
    slider = window(stride=0.004, length=3.0)
    records = run(samples + after, slider, every=50)
    assert all(s.time[-1] - s.time[0] < 1.1e9 for r in records for s in r.outputs)
    assert slider.counts.empty > 10**11
    assert slider.counts.resets == 0
    grid = {(r.epoch_ns - records[0].epoch_ns) % 4_000_000 for r in records}
    assert grid == {0}
    holding = [r for r in records if any(((0 <= s.time) & (s.time <= 3.0)).any()
                                         for s in r.inputs + r.outputs)]
    assert len(holding) == len(records) == slider.counts.windows
    assert len(slider._tracks['y'].stamps) < 1000


def test_empty_windows_are_counted_one_by_one():
    slider = SlidingWindow((Group('y', 1, 'output', 'linear'),), 2.0, 1.0, 0.0)
    for second in (0, 1, 2, 3, 4, 30, 31, 32, 33, 34, 35):
        slider.push('y', EPOCH + second * S, (1.0,))
    starts = [(r.epoch_ns - EPOCH) // S for r in slider.flush()]
    assert starts == [0, 1, 2, 3, 4, 28, 29, 30, 31, 32, 33]
    assert slider.counts.empty == 23


def test_sparse_samples_further_apart_than_a_window_are_not_lost():
    slider = SlidingWindow((Group('y', 1, 'output', 'linear'),), 2.0, 1.0, 0.0)
    for k in range(40):
        slider.push('y', EPOCH + k * 15 * S, (float(k),))
    assert slider.counts.groups['y'].accepted == 38  # the last two wait for confirmation


def test_nanoseconds_that_coincide_decades_before_a_window_do_not_raise():
    slider = SlidingWindow((Group('y', 1, 'output', 'linear'),), 2.0, 1.0, 0.0)
    for k in range(5):
        slider.push('y', 2 * S + k, (float(k),))
    for k in range(50):
        slider.push('y', EPOCH + k * S // 10, (float(k),))
    records = list(slider.flush())
    assert records
    assert all(r.outputs[0].time[0] > -2e9 for r in records)


def test_the_whole_stream_as_one_record():
    samples, slider = stream(start_u=1.0, start_y=1.5), window(length=1e5, lead=0.2)
    assert slider.whole() is None
    assert run(samples, slider) == []
    record, first = slider.whole(), next(s for s in samples if s[0] == 'y')
    assert record.epoch_ns == first[1]
    assert record.end == pytest.approx(12.0 - 1.5, abs=0.1)
    assert -0.5 < record.inputs[0].time[0] < -0.2
    assert len(record.outputs[0].time) == sum(s[0] == 'y' for s in samples)


def test_the_whole_stream_is_none_where_groups_do_not_overlap():
    slider = window(length=1e5)
    for k in range(5):
        slider.push('u', EPOCH + k, (1.0,))
        slider.push('y', EPOCH + S * 60 + k, (1.0, 1.0))
    assert slider.whole() is None


@pytest.mark.parametrize(('changes', 'message'), [
    ({'length': 0.0}, 'length'), ({'stride': -1.0}, 'stride'), ({'max_delay': -0.1}, 'max_delay'),
    ({'length': float('nan')}, 'length'), ({'lead': float('inf')}, 'lead')])
def test_impossible_times_are_refused(changes, message):
    with pytest.raises(DataError, match=message):
        window(**changes)


@pytest.mark.parametrize(('sample', 'message'), [
    (('v', EPOCH, (1.0,)), "'v'.*'u', 'y'"), (('u', 1.7e18, (1.0,)), 'int nanoseconds'),
    (('u', EPOCH, (None,)), 'floats'), (('u', EPOCH, 3.0), 'sequence'),
    (('u', 9e18, (1.0,)), 'int nanoseconds')])
def test_misuse_of_push_raises(sample, message):
    slider = window()
    with pytest.raises(DataError, match=message):
        slider.push(*sample)
    assert slider.counts.groups['u'].accepted == 0


@pytest.mark.parametrize(('groups', 'message'), [
    ((), 'output'), ((GROUPS[0],), 'output'), ((GROUPS[1], GROUPS[1]), 'twice')])
def test_impossible_groups_are_refused(groups, message):
    with pytest.raises(DataError, match=message):
        SlidingWindow(groups, 1.0, 1.0, 0.0)


@pytest.mark.parametrize(('arguments', 'message'), [
    (('g', 0, 'input', 'zoh'), 'width'), (('g', 1, 'state', 'zoh'), 'role'),
    (('g', 1, 'input', 'foh'), 'hold'), (('g', 2, 'input', 'zoh', ('a',)), '1 names')])
def test_impossible_group_is_refused(arguments, message):
    with pytest.raises(DataError, match=message):
        Group(*arguments)
