# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
import math

import numpy as np
import pytest

from ctsid_core.errors import DataError, SettingsError
from ctsid_core.settings import Settings
from ctsid_ros.config.channels import Channel, Config
from ctsid_ros.decoding.field_path import parse_field
from ctsid_ros.ingest.header_clock import HeaderClock
from ctsid_ros.ingest.ingest import Ingest

S = 10**9
EPOCH = 1_700_000_000 * S
U = Channel('u', 'input', '/cmd', '', 'data[0]', 'N m')
P = Channel('p', 'output', '/imu', '', 'angular_velocity.x', 'rad/s')
Q = replace(P, name='q', field='angular_velocity.y')
SETTINGS = Settings(window_length=2.0, window_stride=1.0, window_max_delay=0.1)


def make(*channels: Channel, **settings: float) -> Ingest:
    return Ingest(Config(channels, SETTINGS.replace(**settings)))


def play(ingest: Ingest, *, seconds: float = 6.0, offset_ns: int = 0, header_u=None):
    """u at 25 Hz without header, p at 100 Hz with one; logged 3 ms later than stamped."""
    records = []
    for k in range(int(seconds * 100)):
        stamp = EPOCH + offset_ns + k * S // 100
        ingest.push('/imu', stamp + 3_000_000, stamp + 1_000_000, stamp,
                    (math.sin(0.05 * k),) * sum(f.width for f in ingest.fields['/imu']))
        if k % 4 == 0 and '/cmd' in ingest.fields:
            ingest.push('/cmd', stamp + 3_000_000, stamp + 1_000_000, header_u, (float(k),))
        records += ingest.due()
    return records + list(ingest.flush())


def test_messages_become_windows_with_names_units_holds_and_stamps():
    records = play(make(U, P))
    assert len(records) == 4
    for number, record in enumerate(records):
        # u starts last; it has no header, so its time is that of recording
        assert record.epoch_ns == EPOCH + 3_000_000 + number * S
        u, p = record.inputs[0], record.outputs[0]
        assert (record.input_names, record.output_names) == (('u',), ('p',))
        assert (record.input_units, record.output_units) == (('N m',), ('rad/s',))
        assert (u.hold, p.hold) == ('zoh', 'smooth')
        k = np.round((p.time + 0.003 + number) * 100)
        np.testing.assert_allclose(p.time + 0.003 + number, k / 100, atol=1e-9)
        np.testing.assert_allclose(p.values[:, 0], np.sin(0.05 * k))
        np.testing.assert_allclose(u.values[:, 0], np.round((u.time + number) * 100))


def test_sources_are_named_with_their_reason():
    ingest = make(U, P, replace(Q, stamp='publish'))
    play(ingest, seconds=1.0)
    channels = ingest.counts().channels
    assert [channels[c].source for c in 'upq'] == ['log', 'header', 'publish']
    record = ingest.whole()
    assert [s.names for s in record.outputs] == [('p',), ('q',)]
    assert record.outputs[1].time[0] - record.outputs[0].time[0] == pytest.approx(0.001)
    assert channels['u'].why == 'its messages have no header'
    assert channels['q'].why == 'it is set so'
    assert make(U, P).counts().channels['u'].source == ''


@pytest.mark.parametrize(('stamp', 'first'), [
    ('log', 3_000_000), ('publish', 1_000_000), ('header', 0), ('auto', 0)])
def test_the_source_of_stamps_can_be_chosen(stamp, first):
    ingest = make(replace(U, stamp='header'), replace(P, stamp=stamp))
    ingest.push('/cmd', 1, 1, EPOCH, (0.0,))
    for k in range(100):
        stamp = EPOCH + k * S // 100
        ingest.push('/imu', stamp + 3_000_000, stamp + 1_000_000, stamp, (1.0,))
    ingest.push('/cmd', 1, 1, EPOCH + S, (0.0,))
    record = ingest.whole()
    assert record.epoch_ns == EPOCH + first


def test_channels_of_one_message_share_their_stamps_and_keep_the_order_of_the_file():
    ingest = make(U, P, Q)
    assert ingest.fields == {'/cmd': (parse_field('data[0]'),),
                             '/imu': (P.path, Q.path)}
    record = play(ingest)[0]
    assert record.output_names == ('p', 'q')
    assert len(record.outputs) == 1
    other = Channel('o', 'output', '/odom', '', 'x')
    ingest = make(U, P, other, Q)
    for k in range(300):
        ingest.push('/imu', EPOCH + k * S // 100, 0, None, (1.0, 2.0))
        ingest.push('/odom', EPOCH + k * S // 100 + 5, 0, None, (3.0,))
        ingest.push('/cmd', EPOCH + k * S // 100, 0, None, (0.0,))
    record = next(ingest.flush())
    assert record.output_names == ('p', 'o', 'q')
    assert [s.values[0, 0] for s in record.outputs] == [1.0, 3.0, 2.0]
    assert record.outputs[0].values.shape[1] == 1


def test_input_and_output_of_one_message():
    effort = Channel('effort', 'input', '/joints', '', 'effort[0:2]', hold='smooth')
    speed = Channel('speed', 'output', '/joints', '', 'velocity[0:2]')
    ingest = make(effort, speed)
    assert ingest.fields['/joints'] == (effort.path, speed.path)
    for k in range(300):
        ingest.push('/joints', 0, 0, EPOCH + k * S // 100, (1.0, 2.0, 3.0, 4.0))
    record = next(ingest.flush())
    assert record.input_names == ('effort[0]', 'effort[1]')
    assert record.output_names == ('speed[0]', 'speed[1]')
    np.testing.assert_array_equal(record.inputs[0].values[0], [1.0, 2.0])
    np.testing.assert_array_equal(record.outputs[0].values[0], [3.0, 4.0])
    ingest.push('/joints', 0, 0, EPOCH + 4 * S, (1.0, 2.0, 3.0, 4.0, 5.0))
    ingest.push('/joints', 0, 0, EPOCH + 4 * S, (1.0, math.nan, math.nan, 4.0))
    ingest.push('/joints', 0, 0, EPOCH + 4 * S, (1.0, 2.0, 3.0, math.nan))
    samples = [ingest.counts().channels[name].samples for name in ('effort', 'speed')]
    assert [(s.wrong_width, s.non_finite, s.accepted) for s in samples] == [
        (1, 1, 301), (1, 2, 300)]


def test_a_stream_of_zero_header_stamps_uses_the_log_and_says_so():
    ingest, plain = make(U, P), make(U, P)
    records, wanted = play(ingest, header_u=0), play(plain, header_u=None)
    assert [r.epoch_ns for r in records] == [r.epoch_ns for r in wanted]
    for a, b in zip(records, wanted, strict=True):
        np.testing.assert_array_equal(a.inputs[0].values, b.inputs[0].values)
    counts = ingest.counts().channels['u']
    assert (counts.source, counts.samples.accepted) == ('log', 150)
    assert any('zero' in line and '`u`' in line for line in ingest.report())
    assert plain.report() == []


def test_messages_before_the_beginning_that_wait_for_their_source_are_not_of_it():
    ingest, plain = make(U, P, window_length=5.0), make(U, P, window_length=5.0)
    for k in range(2):          # of stamps that are zero it takes three to know
        ingest.push('/cmd', EPOCH - S + k * S // 25, 0, 0, (9.0,))
    ingest.begin()
    for one in (ingest, plain):
        play(one, header_u=0)
    assert ingest.counts() == plain.counts()


@pytest.mark.parametrize('header', [lambda _: EPOCH + 5, lambda stamp: stamp // S * S])
def test_a_header_that_stands_still_is_left_for_the_log(header):
    """Nobody fills it, or its nanoseconds: of 300 samples 1, or 3, would be left."""
    ingest = make(U, P)
    for k in range(300):
        stamp = EPOCH + k * S // 100
        ingest.push('/cmd', stamp, 0, stamp, (float(k),))
        ingest.push('/imu', stamp + 3_000_000, 0, header(stamp), (0.0,))
    counts = ingest.counts().channels['p']
    assert (counts.source, counts.samples.accepted) == ('log', 300)
    assert any('`p`: the stamps in its headers stand still' in line for line in ingest.report())


def test_many_samples_under_the_stamp_of_another_are_a_fault_of_the_window():
    def said(header, value, stamp='auto') -> tuple[str, ...]:
        ingest = make(U, replace(P, stamp=stamp), window_length=1.0)
        records = []
        for k in range(600):
            time = EPOCH + k * S // 100
            ingest.push('/cmd', time, 0, time, (float(k),))
            ingest.push('/imu', time, 0, header(time), (value(k),))
            records += ingest.due()
        assert len({record.faults for record in records}) == 1
        assert ingest.whole().faults == records[0].faults
        return records[0].faults

    def tenths(time: int) -> int:
        return time // (S // 10) * (S // 10)

    fault, = said(tenths, float)
    assert fault == ('90 % of the samples of p are not used, for they have the stamp of another '
                     'one, but other values; set `stamp` to log, or correct the clock.')
    assert said(tenths, lambda k: k // 10) == ()        # the same message again and again
    assert said(lambda time: time // S * S + time % S // (S // 8) * (S // 8), float, 'log') == ()
    assert said(lambda time: time - S // 100 * (time // (S // 100) % 6 == 5), float) == ()


@pytest.mark.parametrize('alike', [2, 9])
def test_a_driver_that_stamps_a_few_messages_alike_keeps_its_header(alike):
    ingest = make(U, P)
    for k in range(900):
        stamp = EPOCH + k * S // 100
        ingest.push('/cmd', stamp, 0, stamp, (float(k),))
        ingest.push('/imu', stamp, 0, EPOCH + k // alike * alike * S // 100, (0.0,))
    counts = ingest.counts().channels['p']
    assert (counts.source, counts.samples.accepted) == ('header', 900 // alike)


def test_a_header_that_comes_once_is_not_waited_for():
    """As of a command that is sent when it changes: held back, it would be late."""
    ingest = make(replace(U, hold='linear'), P)
    for k in range(600):
        stamp = EPOCH + k * S // 100
        if k in (0, 400):
            ingest.push('/cmd', stamp, 0, stamp, (1.0,))
        ingest.push('/imu', stamp, 0, stamp, (0.0,))
    assert ingest.counts().channels['u'].samples.accepted == 2


@pytest.mark.parametrize('at', [0, 1, 2, 50])
def test_zero_stamps_in_a_good_stream_are_dropped_not_mixed_in(at):
    ingest = make(U, P)
    for k in range(300):
        stamp = EPOCH + k * S // 100
        ingest.push('/cmd', stamp + 7, 0, 0 if k in (at, at + 1) else stamp, (float(k),))
        ingest.push('/imu', stamp, 0, stamp, (0.0,))
    counts = ingest.counts().channels['u']
    assert (counts.source, counts.samples.bad_stamp, counts.samples.accepted) == ('header', 2, 298)
    record = ingest.whole()
    u = record.inputs[0]
    stamps = record.epoch_ns + np.round(u.time * 1e9).astype(np.int64)
    np.testing.assert_array_equal((stamps - EPOCH) // (S // 100), u.values[:, 0])
    assert any('2 of 300 samples have a stamp of zero' in line for line in ingest.report())


def test_a_short_stream_of_zero_stamps_is_not_lost_at_its_end():
    ingest = make(replace(U, hold='linear'), P)
    for k in range(2):
        ingest.push('/cmd', EPOCH + 2 * k * S, 0, 0, (1.0,))
    for k in range(201):
        ingest.push('/imu', 0, 0, EPOCH + k * S // 100, (1.0,))
    assert ingest.counts().channels['u'].samples.accepted == 0
    record = ingest.whole()
    assert ingest.counts().channels['u'].source == 'log'
    assert ingest.counts().channels['u'].samples.late == 1  # it came before the others
    assert record is None


def test_a_short_stream_of_zero_stamps_has_its_windows():
    ingest = make(U, P, window_length=0.5)
    ingest.push('/cmd', EPOCH, 0, 0, (1.0,))
    for k in range(101):
        ingest.push('/imu', 0, 0, EPOCH + k * S // 1000, (1.0,))
    ingest.push('/cmd', EPOCH + S // 2 + 1, 0, 0, (1.0,))
    assert len(list(ingest.flush())) == 1


def test_header_wanted_but_there_is_none():
    ingest = make(replace(U, stamp='header'), P)
    assert play(ingest) == []
    samples = ingest.counts().channels['u'].samples
    assert (samples.accepted, samples.bad_stamp) == (0, 150)
    assert any('set `u.stamp` to auto or log' in line for line in ingest.report())


def test_everything_is_counted_per_channel_and_reported():
    ingest = make(U, P, Q)
    play(ingest, seconds=3.0)
    end = EPOCH + 3 * S
    ingest.push('/imu', 0, 0, end, (math.nan, 1.0))
    ingest.push('/imu', 0, 0, end, (math.nan, math.inf))
    ingest.push('/imu', 0, 0, end, (1.0, 1.0))
    ingest.push('/imu', 0, 0, end, (1.0, 1.0))
    ingest.push('/imu', 0, 0, end, (1.0,))
    ingest.push('/imu', 0, 0, end, ())
    ingest.push('/imu', 0, 0, end - S // 2, (1.0, 1.0))
    ingest.push('/imu', 0, 0, end + 10**16, (1.0, 1.0))
    ingest.push('/imu', 0, 0, end + 1, (1.0, 1.0))
    p, q, u = (ingest.counts().channels[name].samples for name in 'pqu')
    assert (p.non_finite, q.non_finite, u.non_finite) == (2, 1, 0)
    assert (p.duplicate, p.wrong_width, p.late, p.astray, p.accepted) == (1, 2, 1, 1, 302)
    assert replace(p, non_finite=1) == q
    assert (u.accepted, u.late) == (75, 0)
    text = '\n'.join(ingest.report())
    for part in ('`p`: 2 of', 'not finite', '`q`: 1 of', 'came too late, up to 0.5 s',
                 '`window.max_delay` (0.1 s)', 'stamp of another', 'could not be decoded',
                 'far from all others, up to 1e+07 s ahead'):
        assert part in text
    assert '`u`' not in text


def test_a_silent_channel_and_a_restart_and_empty_windows_are_reported():
    ingest = make(U, P)
    for k in range(100):
        ingest.push('/imu', 0, 0, EPOCH + k * S // 100, (1.0,))
    assert ingest.report() == ['`u`: no message has come on /cmd']
    ingest = make(U, P)
    for offset in (0, 20 * S, 0):
        play(ingest, offset_ns=offset)
    counts = ingest.counts()
    assert (counts.resets, counts.empty) == (1, 12)
    # four; two that reach into the gap, and six with the samples after it; four once more
    assert counts.windows == 4 + 2 + 6 + 4
    assert [line.split()[0] for line in ingest.report()] == ['the', 'the']
    assert 'jumped ahead over 12 windows' in ingest.report()[1]


def test_angles_are_unwrapped_in_the_order_of_stamps():
    yaw = Channel('yaw', 'output', '/odom', '', 'euler(pose.orientation).yaw')
    channels = U, yaw, replace(P, topic='/odom'), replace(Q, topic='/odom', stamp='header')
    rng = np.random.default_rng(1)
    true = 2.4 * np.arange(300)  # nearly half a turn from one to the next
    wrapped = (true + np.pi) % (2 * np.pi) - np.pi
    order = np.argsort(np.arange(300) + rng.uniform(0, 9, 300))
    ingest = make(*channels)
    for k in order:
        ingest.push('/odom', 0, 0, EPOCH + int(k) * S // 100, (wrapped[k],) * 3)
        ingest.push('/cmd', EPOCH + int(k) * S // 100, 0, None, (0.0,))
    for record in ingest.flush():
        signal = record.outputs[0]
        np.testing.assert_allclose(np.diff(signal.values[:, 0]), 2.4)
        for numbers in (signal.values[:, 1], record.outputs[1].values):  # left alone
            assert np.abs(numbers).max() <= np.pi
        assert abs(signal.values[0, 0]) <= np.pi
    assert ingest.counts().windows == 1


@pytest.mark.parametrize('turn', [360.0, 2.0 * np.pi, 4096.0])
def test_plain_angles_are_unwrapped_where_a_turn_is_given(turn):
    """Windows that begin later agree but for full turns."""
    heading = Channel('heading', 'output', '/compass', '', 'data', turn=turn)
    ingest = make(U, heading, replace(P, topic='/compass'))
    true = turn * (0.3 + 0.9 * np.sin(0.01 * np.arange(600)))
    for k, angle in enumerate(true % turn):
        ingest.push('/compass', EPOCH + k * S // 100, 0, None, (angle, angle))
        ingest.push('/cmd', EPOCH + k * S // 100, 0, None, (0.0,))
    records = list(ingest.flush())
    assert len(records) > 3
    for record in records:
        signal = record.outputs[0]
        rows = np.round((record.epoch_ns - EPOCH) / S * 100 + 100 * signal.time).astype(int)
        turns = (signal.values[:, 0] - true[rows]) / turn
        np.testing.assert_allclose(turns, round(turns[0]), atol=1e-9)
        assert (signal.values[:, 1] == true[rows] % turn).all()      # left alone


def test_dead_time_gives_inputs_their_history():
    first, second = play(make(replace(U, delay=0.5), P))[:2]
    assert first.epoch_ns == EPOCH + 3_000_000
    assert first.inputs[0].time[0] == 0.0
    assert -0.65 < second.inputs[0].time[0] <= -0.5


def test_two_doors_give_the_same_records():
    """What arrives in bursts live is the same as what a bag has in order."""
    live, replay = make(U, P), make(U, P)
    messages = []
    for k in range(900):
        stamp = EPOCH + k * S // 100
        messages.append((stamp, ('/imu', stamp + 5, 0, stamp, (math.sin(k),))))
        messages.append((stamp + 7, ('/cmd', stamp + 7, 0, None, (math.cos(k),))))
    got = []
    for burst in range(0, len(messages), 14):
        part = messages[burst:burst + 14]
        for _, message in sorted(part, key=lambda m: m[1][0]):
            live.push(*message)
        got += live.due()
    got += live.flush()
    wanted = []
    for _, message in messages:
        replay.push(*message)
        wanted += replay.due()
    wanted += replay.flush()
    assert len(got) == len(wanted) == 7
    for a, b in zip(got, wanted, strict=True):
        assert a.epoch_ns == b.epoch_ns
        for x, z in zip(a.inputs + a.outputs, b.inputs + b.outputs, strict=True):
            assert x.time.tobytes() == z.time.tobytes()
            assert x.values.tobytes() == z.values.tobytes()
    assert live.counts() == replay.counts()


@pytest.mark.parametrize(('rate', 'jitter_ms', 'whole', 'stamp', 'told'), [
    (0.5, 5.0, 1, 'log', True), (1.01, 1.0, 1, 'auto', True), (0.5, 5.0, 1, 'header', False),
    (1.01, 1.0, 1, 'log', False),               # a sensor's own clock, and it is not used
    (1.0, 20.0, 1, 'log', False), (1.0003, 1.0, 1, 'log', False),
    (1.0, 1.0, S // 128, 'log', False), (1.0, 1.0, S, 'log', False)])     # rounded headers
def test_headers_of_a_clock_at_another_rate_are_a_fault(rate, jitter_ms, whole, stamp, told):
    """A simulation at half the speed is no plant of twice the time constant."""
    rng = np.random.default_rng(1)
    ingest = make(replace(U, stamp=stamp), replace(P, stamp=stamp), window_length=10.0)
    late = np.sort(np.arange(3000) * S // 100 + rng.exponential(jitter_ms * 1e6, 3000).astype(int))
    records = []
    for k, log in enumerate((EPOCH + late).tolist()):
        begun = EPOCH if stamp == 'auto' else 10 * S
        header = (begun + round(k * S // 100 * rate)) // whole * whole
        ingest.push('/imu', log, 0, header, (math.sin(k),))
        ingest.push('/cmd', log, 0, header if stamp == 'header' else None, (math.cos(k),))
        records += ingest.due()
    assert len(records) > 3
    for record in records:
        assert bool(record.faults) is told
    if told:
        assert record.faults[0].startswith('Headers of /imu run ')
        assert f'as fast as the clock of u{", p" if stamp == "log" else ""}, ' in record.faults[0]
        assert ('not in real time' in record.faults[0]) is (rate == 0.5)
        assert ('set `stamp: log`' in record.faults[0]) is (rate == 1.01)
        assert float(record.faults[0].split()[4]) == pytest.approx(rate, rel=0.01)


@pytest.mark.parametrize('length', [10.0, 0.8])
@pytest.mark.parametrize(('imu', 'cmd', 'told'), [
    (0.3, None, True),          # from the future, beside a topic without headers
    (5.0, -0.003, True),        # or beside one whose messages come 3 ms after they are stamped
    (5.0, 4.99, False),         # one clock that is 5 s ahead of the recorder's
    (0.05, 0.01, False), (0.05, -0.05, False),      # or 50 ms; others take 40 and 100 ms to come
    (0.015, None, False), (-0.1, None, False), (-0.1, -0.002, False)])      # what takes its time
def test_headers_from_the_future_are_of_another_clock(imu, cmd, told, length):
    ingest, records = make(U, P, window_length=length, window_stride=length / 16.0,
                           window_max_delay=6.0), []
    for k in range(3000):
        log = EPOCH + k * S // 100
        for topic, ahead, x in (('/imu', imu, math.sin(k)), ('/cmd', cmd, math.cos(k))):
            header = None if ahead is None else log + round(ahead * S)
            ingest.push(topic, log, 0, header, (x,))
        records += ingest.due()
    assert records
    for record in records:
        assert bool(record.faults) is told
    if told:
        assert record.faults[0].startswith(f'Headers of /imu are {imu:g} s ahead of when its ')
        assert 'those of u are not: their clocks differ' in record.faults[0]


def test_headers_are_not_compared_with_the_clock_of_a_publisher():
    """It may be that of the headers: here both are 0.5 s ahead of the recorder's."""
    ingest, records = make(replace(U, stamp='publish'), P, window_length=10.0), []
    for k in range(2000):
        log = EPOCH + k * S // 100
        ingest.push('/imu', log, 0, log + S // 2, (math.sin(k),))
        ingest.push('/cmd', log, log + S // 2, None, (math.cos(k),))
        records += ingest.due()
    assert records
    assert not any(record.faults for record in records)


def test_the_clock_of_headers_is_the_same_from_rows():
    rng = np.random.default_rng(2)
    log = np.cumsum(rng.exponential(0.3e9, 200)).astype(np.int64)
    header = np.where(rng.uniform(size=200) < 0.1, 0, log // 2 + 1)
    one, other = HeaderClock(), HeaderClock()
    for times in zip(log.tolist(), header.tolist(), strict=True):
        one.take(*times)
    for rows in np.split(np.arange(200), [3, 50, 51, 120]):
        other.take_rows(log[rows], header[rows])
    assert vars(one) == vars(other)
    one.take(5, 7)      # played again
    assert vars(one) == {'_pairs': [(5, 7)]}


def test_misuse_raises():
    with pytest.raises(DataError, match="no channel is of topic '/imus'; nearest: /imu"):
        make(U, P).push('/imus', 1, 1, 1, (1.0,))
    with pytest.raises(DataError, match='int nanoseconds'):
        make(U, P).push('/imu', 1, 1, 1.7e18, (1.0,))
    with pytest.raises(SettingsError, match='give the end of the range'):
        make(replace(U, field='data[:]'), P)


def test_real_recording_agrees_with_reading_it_by_hand(data_folder):
    """Stamps of the aircraft: aileron stick without header, pose with one."""
    highlevel = pytest.importorskip('rosbags.highlevel')
    path = data_folder / 'cubs2' / 'cub_stabilize_2025_11_13.mcap'
    stick = Channel('stick', 'input', '/cub1/joy_serial_status', '', 'data[0]')
    x = Channel('x', 'output', '/cub1/pose', '', 'pose.position.x')
    ingest, by_hand, windows = make(stick, x, window_length=20.0, window_stride=5.0), {}, []
    with highlevel.AnyReader([path]) as reader:
        for connection, log_ns, raw in reader.messages(
                [c for c in reader.connections if c.topic in ingest.fields]):
            if len(by_hand.get('/cub1/pose', [])) > 6000:
                break
            message = reader.deserialize(raw, connection.msgtype)
            stamp = getattr(getattr(message, 'header', None), 'stamp', None)
            header = None if stamp is None else stamp.sec * S + stamp.nanosec
            values = ingest.fields[connection.topic][0].get(message)
            ingest.push(connection.topic, log_ns, log_ns, header, values)
            windows += ingest.due()
            by_hand.setdefault(connection.topic, []).append((header or log_ns, values[0]))
    assert len(windows) > 5
    for record in windows:
        for topic, signal in (('/cub1/joy_serial_status', record.inputs[0]),
                              ('/cub1/pose', record.outputs[0])):
            stamps = record.epoch_ns + np.round(signal.time * 1e9).astype(np.int64)
            wanted = [v for v in by_hand[topic] if stamps[0] <= v[0] <= stamps[-1]]
            np.testing.assert_array_equal(stamps, [t for t, _ in wanted])
            np.testing.assert_array_equal(signal.values[:, 0], [v for _, v in wanted])
    counts = ingest.counts().channels
    assert (counts['stick'].source, counts['x'].source) == ('log', 'header')
    assert counts['x'].samples.accepted == len(by_hand['/cub1/pose'])


def pushed(stamps, values=(1.0,), clock=None, **changes):
    """Return what is said of 'u' if its stamps are so, beside a good output at 100 Hz."""
    ingest = make(replace(U, **changes), P)
    for k in range(300):
        ingest.push('/imu', 0, 0, EPOCH + k * S // 100, (float(k),))
        if k % 10 == 5:
            ingest.push('/cmd', 0 if clock is None else clock, 0, stamps(k), values)
    return [line for line in ingest.report() if line.startswith('`u`')]


@pytest.mark.parametrize(('stamps', 'values', 'words'), [
    (lambda k: EPOCH + k * S // 100, (math.nan,),
     ['not one of 30 samples is a finite number in', 'of /cmd; check the sensor, or choose']),
    (lambda k: EPOCH + 3600 * S + k * S // 100, (1.0,),
     ['their stamps are 3.6e+03 s ahead of all others', 'clocks are not one; set `stamp` to log']),
    (lambda k: EPOCH - 3600 * S + k * S // 100, (1.0,),
     ['their stamps are 3.6e+03 s behind those of other channels', 'clocks are not one']),
    (lambda k: EPOCH - S + k * S // 100, (1.0,),
     ['comes in time: they are up to 1 s behind', 'set `stamp` to log for all channels if clocks '
      'differ, else raise `window.max_delay` (0.1 s)']),
    (lambda k: EPOCH + S // 2, (1.0,), ['stand still, so the time of recording is used']),
    (lambda k: EPOCH + k * S // 100, (), ['not one of 30 samples could be decoded']),
])
def test_a_channel_without_one_good_sample_gets_the_right_advice(stamps, values, words):
    text = ' '.join(pushed(stamps, values))
    assert all(word in text for word in words), text


def test_stamps_that_are_all_zero_get_the_right_advice():
    line, = pushed(lambda k: 0, stamp='header')
    assert 'not one of 30 samples has a stamp in its header; set `u.stamp` to auto or log' in line
    line, = pushed(lambda k: 0, stamp='log')
    assert 'simulated time is not known; check that /clock is published' in line
    line, = pushed(lambda k: 0, stamp='publish')
    assert 'set `u.stamp` to log' in line


def test_one_stamp_an_hour_ahead_does_not_colour_what_is_late():
    ingest = make(U, P)
    play(ingest, seconds=3.0)
    end = EPOCH + 3 * S
    ingest.push('/imu', 0, 0, end + 3600 * S, (1.0,))
    ingest.push('/imu', 0, 0, end + 1, (1.0,))
    ingest.push('/imu', 0, 0, end - S // 2, (1.0,))
    samples = ingest.counts().channels['p'].samples
    assert samples.worst_late == pytest.approx(-0.5)
    assert samples.worst_astray == pytest.approx(3600.0, abs=0.1)
    ingest.forget_worst()
    samples = ingest.counts().channels['p'].samples
    assert (samples.late, samples.worst_late, samples.worst_astray) == (1, 0.0, 0.0)


def test_a_channel_that_another_of_its_topic_drops_is_not_said_to_be_silent():
    ingest = make(U, P, Q)
    for k in range(100):
        ingest.push('/cmd', 0, 0, EPOCH + k * S // 100, (1.0,))
        ingest.push('/imu', 0, 0, EPOCH + k * S // 100, (math.nan, 1.0))
    line, = ingest.report()
    assert line.startswith('`p`: not one of 100 samples is a finite number in ')


def test_a_clock_of_headers_is_bounded_whatever_is_forgotten():
    """In simulated time the log is of another clock than the windows: nothing is old enough."""
    clock = HeaderClock()
    for second in range(5000):
        clock.take((second + 1) * S, second + 1)
    clock.forget(0)
    assert len(vars(clock)['_pairs']) < 5000
