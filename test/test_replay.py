# SPDX-License-Identifier: Apache-2.0
"""From bags to records and estimates: the same data and numbers as by any other way."""

from __future__ import annotations

from dataclasses import replace
import math
from pathlib import Path

from bag_fixtures import IMU, START, Sent, imu, joints, vector, write_mcap, write_rosbag2
from flights import PARAMS, TRUTH, S, at, flight, spoilt, stamp_of, write_flight
from marks import slow
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
import yaml

from ctsid_core.model.estimate import Estimate, Status
from ctsid_core.model.storage import to_json
from ctsid_core.model.validation import simulation
from ctsid_core.model.verdict import Grade
from ctsid_core.sequence.tracking import Tracked, Tracker
from ctsid_core.settings import Settings
from ctsid_core.signals.record import Signal
from ctsid_ros.config.channels import Channel, Config
from ctsid_ros.config.parameter_file import parse_config
from ctsid_ros.errors import BagError
from ctsid_ros.ingest.ingest import Ingest
from ctsid_ros.recordings import chunks
from ctsid_ros.recordings.bag import open_bag
from ctsid_ros.recordings.playback import Interval, fit_config, read_record
from ctsid_ros.replay.replay import Replay, Result, best_of, last_change

CONFIG = parse_config(yaml.safe_load(PARAMS))


@pytest.fixture(scope='module')
def path(tmp_path_factory) -> str:
    return write_flight(tmp_path_factory.mktemp('flight') / 'bag')


@pytest.fixture
def bag(path):
    with open_bag(path) as opened:
        yield opened


def windows_of_rosbags(path: str, config: Config):
    """The windows, from the messages as another library reads and decodes them."""
    ingest = Ingest(config)
    with AnyReader([Path(path)]) as reader:
        for connection, log_ns, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            if connection.topic == '/imu':
                stamp = message.header.stamp
                values, header_ns = (message.angular_velocity.x,), stamp.sec * S + stamp.nanosec
            else:
                values, header_ns = (message.data[0],), None
            ingest.push(connection.topic, log_ns, log_ns, header_ns, values)
            yield from ingest.due()
        yield from ingest.flush()


def same(a, b) -> bool:
    return (a.start, a.end, a.epoch_ns) == (b.start, b.end, b.epoch_ns) and all(
        np.array_equal(s.time, t.time) and np.array_equal(s.values, t.values)
        for s, t in zip((*a.inputs, *a.outputs), (*b.inputs, *b.outputs), strict=True))


@pytest.fixture(scope='module')
def ran(path):
    with open_bag(path) as opened:
        run = Replay(opened, CONFIG)
        run.run()
        yield run


def test_replay_gives_the_estimates_of_all_windows_to_the_last_bit(ran, path):
    records = list(windows_of_rosbags(path, CONFIG))
    assert len(records) == len(ran.results) == 6
    tracker = Tracker(CONFIG.settings.for_windows())
    for number, (record, result) in enumerate(zip(records, ran.results, strict=True)):
        expected = tracker.take(record)
        assert to_json(result.estimate) == to_json(expected.estimate)
        assert result.estimate.model == expected.estimate.model
        assert (result.tracked.realisation, result.tracked.modes) == (1, (1, 2))
        for name in ('eigenvalues', 'eigenvalue_std', 'fresh_fit'):
            np.testing.assert_array_equal(getattr(result.tracked, name), getattr(expected, name))
        assert same(ran.record(number), record)


def test_models_are_tested_on_what_is_new_before_it_is_used(ran):
    fits = np.array([result.tracked.fresh_fit[0] for result in ran.results])
    assert np.isnan(fits[0])
    assert (fits[1:] > 85).all()
    for before, result in zip(ran.results[:-1], ran.results[1:], strict=True):
        assert result.tracked.fresh_start_ns == before.estimate.end_ns
        assert result.tracked.fresh_end_ns == result.estimate.end_ns


def test_models_are_tested_on_the_first_window_that_shares_nothing(ran, path):
    records = list(windows_of_rosbags(path, CONFIG))
    for number, result in enumerate(ran.results):
        if number + 2 < len(records):  # 5 s long, one each 2.5 s
            found = simulation(result.estimate.model, records[number + 2])
            np.testing.assert_array_equal(result.next_fit, found.fit)
            assert result.next_fit[0] > 90
        else:
            assert not result.tested


@pytest.mark.slow
def test_the_last_window_that_the_data_fill_is_not_forgotten(path):
    config = replace(CONFIG, settings=CONFIG.settings.replace(window_length=4.9))
    with open_bag(path) as opened:
        run = Replay(opened, config)
        run.run()
    assert len(run.results) == 7  # to 15 + 4.9 s; the bag ends at 20 s
    assert [r.estimate.start_ns for r in run.results] == [
        record.epoch_ns for record in windows_of_rosbags(path, config)]


def test_progress_goes_from_nothing_to_all(path):
    told = []
    with open_bag(path) as opened:
        Replay(opened, CONFIG).run(lambda fraction, text: told.append((fraction, text)))
    fractions = [fraction for fraction, _ in told]
    assert fractions == sorted(fractions)
    assert fractions[0] < 0.01
    assert fractions[-1] == 1.0
    assert told[0][1] == 'no window yet'
    assert told[-1][1].startswith('6 of 6 windows, fit 9')


def test_whole_record_is_all_of_the_bag(bag):
    data = read_record(bag, CONFIG)
    sent = flight()
    u, y = data.record.inputs[0], data.record.outputs[0]
    assert (len(u.time), len(y.time)) == (400, 2000)
    rates = [s.message.angular_velocity.x for s in sent if s.topic == '/imu']
    np.testing.assert_array_equal(y.values[:, 0], rates)
    np.testing.assert_array_equal(u.values[:, 0],
                                  [s.message.data[0] for s in sent if s.topic == '/cmd'])
    epoch = data.record.epoch_ns
    np.testing.assert_allclose(u.time, [(s.log_ns - epoch) * 1e-9 for s in sent
                                        if s.topic == '/cmd'], atol=1e-9)
    np.testing.assert_allclose(y.time, [(stamp_of(s) - epoch) * 1e-9 for s in sent
                                        if s.topic == '/imu'], atol=1e-9)
    assert math.isnan(data.split)
    assert data.complaints == ()
    assert [data.counts.channels[n].source for n in ('torque', 'rate')] == ['log', 'header']
    assert data.config.settings == CONFIG.settings  # not the endless window of the reading


def test_split_is_counted_from_the_start_of_the_bag_whatever_clock_the_stamps_are_of(tmp_path):
    late = write_flight(tmp_path / 'late', spoilt(
        '/imu', lambda _, s: at(s, stamp_of(s) - 10**6 * S)))
    config = replace(CONFIG, channels=tuple(
        replace(c, topic='/imu', type=IMU, field=field) for c, field in zip(
            CONFIG.channels, ('linear_acceleration.x', 'angular_velocity.x'), strict=True)))
    with open_bag(late) as opened:
        data = read_record(opened, config, split=8.0)
    assert data.record.epoch_ns < START - 10**5 * S
    assert data.split == pytest.approx(8.0, abs=0.02)


def test_an_interval_takes_what_was_recorded_in_it_and_the_inputs_that_act_in_it(bag):
    found = {}
    for delay, first in (('auto', 4.0), (0.5, 4.5), (0.0, 5.0)):
        config = replace(CONFIG, channels=(
            replace(CONFIG.inputs[0], delay=delay), *CONFIG.outputs),
                         settings=CONFIG.settings.replace(delay='auto'))
        data = found[delay] = read_record(bag, config, Interval(5.0, 4.0))
        for signal, begin in ((data.record.inputs[0], first), (data.record.outputs[0], 5.0)):
            absolute = data.record.epoch_ns + signal.time * 1e9 - START
            before = absolute[absolute < begin * S]     # three samples of context
            assert len(before) in (2, 3, 4)
            assert before[0] > (begin - 0.22) * S
            assert 8.94 * S < absolute.max() < 9.01 * S
    plain = found.pop(0.0)
    for data in found.values():     # nothing else is another one
        assert (data.counts, data.complaints) == (plain.counts, plain.complaints)
        assert (data.record.start, data.record.end, data.record.epoch_ns) == (
            plain.record.start, plain.record.end, plain.record.epoch_ns)
        assert [data.samples(c) for c in CONFIG.channels] == [
            plain.samples(c) for c in CONFIG.channels]
        np.testing.assert_array_equal(
            *(d.record.outputs[0].between(0.0, 4.0, context=0).values for d in (data, plain)))


def test_keys_pressed_before_an_interval_are_known_in_it(tmp_path):
    """Of keys that are sent when they change only: nothing of the interval waits for the next."""
    keys = {1: 0.4, 14: -0.2, 16: 0.0}
    sent = [*(Sent('/cmd', 'geometry_msgs/msg/Vector3', START + k * S, vector(v))
              for k, v in keys.items()),
            *(Sent('/imu', IMU, t, imu(t, 0.0)) for t in range(START, START + 20 * S, S // 100))]
    config = Config((Channel('u', 'input', '/cmd', '', 'x'),
                     Channel('rate', 'output', '/imu', '', 'angular_velocity.x')))
    with open_bag(write_mcap(tmp_path / 'keys.mcap', sorted(
            sent, key=lambda s: s.log_ns))) as opened:
        record = read_record(opened, config, Interval(5.0)).record
    assert (record.epoch_ns - START) * 1e-9 == pytest.approx(5.0, abs=0.011)
    assert record.end == pytest.approx(15.0, abs=0.03)
    held = record.inputs[0]
    assert (held.time[0], *held.values[:, 0]) == (pytest.approx(-4.0, abs=0.02), *keys.values())


@pytest.mark.parametrize(('start', 'duration', 'fits'), [
    (0.0, math.inf, True), (19.9, 1.0, True), (21.0, 1.0, False)])
def test_interval_has_to_lie_in_the_bag(bag, start, duration, fits):
    if fits:
        first, last = Interval(start, duration).span_ns(bag)
        assert bag.start_ns <= first < last <= bag.end_ns
    else:
        with pytest.raises(BagError, match=r'the bag is 20\.0 s long'):
            Interval(start, duration).span_ns(bag)


def test_config_is_completed_from_the_bag(tmp_path):
    path = write_mcap(tmp_path / 'bag.mcap', [
        Sent('/joints', 'sensor_msgs/msg/JointState', START + k * S // 50,
             joints(START + k * S // 50, [k, 2 * k, 3 * k])) for k in range(10)])
    config = Config((Channel('effort', 'input', '/joints', '', 'effort[:]'),
                     Channel('angle', 'output', '/joints', 'sensor_msgs/JointState',
                             'position[1:]')))
    with open_bag(path) as opened:
        found = fit_config(opened, config)
        record = read_record(opened, config).record
    assert [(c.type, c.field) for c in found.channels] == [
        ('sensor_msgs/msg/JointState', 'effort[0:3]'),
        ('sensor_msgs/msg/JointState', 'position[1:3]')]
    assert (record.nu, record.ny) == (3, 2)


def test_what_comes_before_stamps_jump_back_is_said_not_to_be_used(tmp_path):
    """A driver was started again after 12 s: the record has only what follows."""
    path = write_mcap(tmp_path / 'bag.mcap', [
        Sent('/imu', 'sensor_msgs/msg/Imu', START + k * S // 100, imu(
            S + (k if k < 1200 else k - 1200) * S // 100, float(k))) for k in range(2000)])
    config = Config((Channel('u', 'input', '/imu', '', 'angular_velocity.y'),
                     Channel('y', 'output', '/imu', '', 'angular_velocity.x')))
    with open_bag(path) as opened:
        found = read_record(opened, config)
        said = found.complaints[-1]
        assert 'only what comes after the last jump back is used, 8.0 s of data' in said
        assert '`--start 0 --duration 11.9`' in said
        assert found.samples(config.outputs[0]) == 800
        first = read_record(opened, config, Interval(0.0, 11.9))
        assert (first.complaints, first.record.outputs[0].values[0, 0]) == ((), 0.0)


def test_delays_of_channels_survive_the_completion(bag):
    config = replace(CONFIG, channels=(replace(CONFIG.inputs[0], delay=0.25), *CONFIG.outputs),
                     settings=CONFIG.settings.replace(delay='auto'))
    data = read_record(bag, config)
    assert data.config.settings.delay == 0.25
    later = read_record(bag, config, Interval(5.0)).record
    assert later.inputs[0].time[2] == pytest.approx(-0.25, abs=0.06)    # three of context


def test_messages_that_cannot_be_decoded_do_not_settle_the_source_of_stamps(tmp_path):
    sent = flight(6.0)
    first = next(i for i, s in enumerate(sent) if s.topic == '/imu')
    sent[first] = replace(sent[first], message=b'\0\1\0\0\0\0')  # too short for an Imu
    with open_bag(write_mcap(tmp_path / 'bag.mcap', sent)) as opened:
        data = read_record(opened, CONFIG)
    assert data.counts.channels['rate'].source == 'header'
    assert data.counts.channels['rate'].samples.wrong_width == 1
    assert 'could not be decoded' in ' '.join(data.complaints)


def test_publish_times_are_used_where_wanted(tmp_path):
    sent = [replace(s, publish_ns=s.log_ns - 50_000_000) for s in flight(4.0)]
    config = replace(CONFIG, channels=tuple(replace(c, stamp='publish') for c in CONFIG.channels),
                     settings=CONFIG.settings.replace(delay='auto'))
    with open_bag(write_mcap(tmp_path / 'bag.mcap', sent)) as opened:
        record = read_record(opened, config).record
    first = next(s.log_ns for s in sent if s.topic == '/imu')
    assert record.epoch_ns + round(record.outputs[0].time[0] * 1e9) == first - 50_000_000


def test_gaps_do_not_skip_windows(tmp_path):
    path = write_rosbag2(tmp_path / 'bag', [
        s for s in flight() if s.topic == '/cmd' or not 8 * S < s.log_ns - START < 11 * S])
    with open_bag(path) as opened:
        run = Replay(opened, CONFIG)
        run.run()
    starts = [(r.estimate.start_ns - run.results[0].estimate.start_ns) / S for r in run.results]
    assert starts == [0.0, 2.5, 5.0, 7.5, 10.0, 12.5]
    statuses = [r.estimate.status for r in run.results]
    assert set(statuses) == {Status.OK}
    assert [r.estimate.notes for r in run.results] == [(), (), *(
        (f'{share} % of the window has no samples of rate',) for share in (40, 60, 20)), ()]


def result(fit: float, n: int = 2, *, ok: bool = True, tested: bool = True) -> Result:
    model = TRUTH if n == 2 else replace(TRUTH, A=np.diag(-np.arange(1.0, n + 1)),
                                         B=np.ones((n, 1)), C=np.ones((1, n)),
                                         K=np.empty(0), x_trim=np.zeros(n))
    estimate = Estimate(status=Status.OK if ok else Status.UNEXPLAINED, settings=Settings(),
                        model=model if ok else None, fit=np.array([99.0]),
                        held_out_fit=np.array([fit]))
    return Result(Tracked(estimate), np.array([fit if tested else math.nan]))


@pytest.mark.parametrize(('results', 'number'), [
    ([], None),
    ([result(95, ok=False)], None),
    ([result(80), result(95), result(90)], 1),
    ([result(95.0, n=6), result(94.5, n=3), result(94.4, n=3), result(90, n=2)], 1),
    ([result(80), result(99, tested=False)], 0),  # nothing is known of unseen data
    ([result(80, tested=False), result(85, tested=False)], 1),
    ([result(-math.inf), result(-50)], 1)])
def test_best_explains_unseen_data_with_few_states(results, number):
    assert best_of(results) == number


def test_best_is_of_the_plant_after_its_last_change():
    """That of before was kept, GOOD and without a word in its file."""
    def window(start, fit, status=Status.OK, grade=Grade.GOOD, share=0.5):
        found = result(fit, ok=status is Status.OK)
        estimate = replace(
            found.estimate, start_ns=start * S, end_ns=(start + 20) * S, status=status,
            statistics={'change_share': share},
            verdict=replace(found.estimate.verdict, grade=grade))
        return replace(found, tracked=replace(found.tracked, estimate=estimate))
    before = [window(0, 99), window(10, 98), window(50, 0, Status.CHANGED)]
    # Rejected for what an earlier window has shown: it tells no change of its own.
    before.append(window(55, 0, Status.CHANGED, share=math.nan))
    after = [window(60, 70, grade=Grade.WEAK), window(70, 95), window(80, 96)]
    assert last_change(before) == 60 * S
    for results, number in ((before, 0), (before + after[:1], 0), (before + after, 6)):
        assert best_of(results, last_change(results)) == number


def test_nothing_is_kept_of_windows_but_their_estimates(ran):
    assert {type(v).__name__ for r in ran.results for v in vars(r).values()} == {
        'Tracked', 'ndarray'}
    assert {type(v).__name__ for r in ran.results for v in vars(r.tracked).values()} == {
        'Estimate', 'ndarray', 'int', 'tuple'}


def test_a_bag_that_cannot_be_read_on_keeps_its_windows(tmp_path, monkeypatch):
    path = write_mcap(tmp_path / 'b.mcap', flight(13.0), chunk_size=4096)
    monkeypatch.setattr(chunks, 'BATCH', 1)
    with open_bag(path) as bag:
        whole = Replay(bag, CONFIG)
        whole.run()
        blocks = bag.blocks

        def torn(fields):
            for count, block in enumerate(blocks(fields)):
                if count == limit:
                    raise BagError('reading stopped: input/output error')
                yield block

        monkeypatch.setattr(bag, 'blocks', torn)
        limit = len(list(blocks({'/imu': []}))) // 2
        part = Replay(bag, CONFIG)
        part.run()
        assert 0 < len(part.results) < len(whole.results)
        for one, other in zip(part.results, whole.results, strict=False):
            assert one.estimate.start_ns == other.estimate.start_ns
            assert one.estimate.fit.tolist() == other.estimate.fit.tolist()
        assert 'input/output error' in part.played.complaints[0]
        limit = 0
        with pytest.raises(BagError, match='input/output error'):
            Replay(bag, CONFIG).run()


@pytest.mark.parametrize('delay', [0.5, *slow('auto')])
def test_an_interval_has_the_windows_that_all_of_the_bag_has_there(tmp_path, delay):
    rng, t = np.random.default_rng(0), np.arange(1301) / 100.0
    u = np.repeat(rng.uniform(-1.0, 1.0, 67), 30)[:len(t)]
    late = np.concatenate([np.zeros(50), u])[:len(t)]
    y = TRUTH.simulate((Signal(t, late[:, np.newaxis], 'zoh'),), t)[:, 0]
    np.savetxt(tmp_path / 'robot.csv', np.column_stack([t, u, y]), delimiter=',', comments='',
               header='t,torque,rate')
    config = parse_config(yaml.safe_load(f"""
/**:
  ros__parameters:
    inputs: [torque]
    outputs: [rate]
    torque: {{topic: robot, field: torque, delay: {delay}}}
    rate: {{topic: robot, field: rate}}
    order: 2
    window: {{length: 5.0, stride: 2.5}}
"""))
    with open_bag(str(tmp_path / 'robot.csv')) as bag:
        whole, part = Replay(bag, config), Replay(bag, config, Interval(start=5.0))
        whole.run()
        part.run()
        assert len(part.results) == len(whole.results) - 2 == 2
        for number, result in enumerate(part.results):
            assert same(part.record(number), whole.record(number + 2))
            np.testing.assert_array_equal(result.estimate.fit,
                                          whole.results[number + 2].estimate.fit)
        first = part.results[0].estimate.model
        assert first.delay[0] == pytest.approx(0.5, abs=0.01)
        np.testing.assert_allclose(first.poles, TRUTH.poles, rtol=0.02)
