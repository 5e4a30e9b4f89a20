# SPDX-License-Identifier: Apache-2.0
"""Messages as they arrive on a robot, against the same messages played from a recording."""

from collections import Counter
from dataclasses import replace
import math

from marks import slow
import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from ctsid_core.errors import SettingsError, StorageError
from ctsid_core.settings import Settings
from ctsid_ros.config.channels import Channel, Config
from ctsid_ros.decoding.message_types import FieldType, MessageType
from ctsid_ros.ingest.feed import Feed, Taken
from ctsid_ros.ingest.ingest import Ingest
from ctsid_ros.ingest.sim_clock import SimClock
from ctsid_ros.recordings.bag import open_bag
from ctsid_ros.recordings.playback import Interval, fit_config, play
from ctsid_ros.recordings.writer import BagWriter

S, MS = 10**9, 10**6
EPOCH = 1_700_000_000 * S
STORE = get_typestore(Stores.ROS2_JAZZY)
VECTOR = {'x': FieldType('float64'), 'y': FieldType('float64'), 'z': FieldType('float64')}
TIME = {'sec': FieldType('int32'), 'nanosec': FieldType('uint32')}
HEADER = {'stamp': FieldType('builtin_interfaces/msg/Time'), 'frame_id': FieldType('string')}
TYPES = {
    '/rate': MessageType('geometry_msgs/msg/Vector3Stamped', {
        'geometry_msgs/msg/Vector3Stamped': {
            'header': FieldType('std_msgs/msg/Header'),
            'vector': FieldType('geometry_msgs/msg/Vector3')},
        'std_msgs/msg/Header': HEADER, 'builtin_interfaces/msg/Time': TIME,
        'geometry_msgs/msg/Vector3': VECTOR}),
    '/cmd': MessageType('std_msgs/msg/Float64MultiArray', {
        'std_msgs/msg/Float64MultiArray': {
            'layout': FieldType('std_msgs/msg/MultiArrayLayout'),
            'data': FieldType('float64', 'sequence')},
        'std_msgs/msg/MultiArrayLayout': {
            'dim': FieldType('std_msgs/msg/MultiArrayDimension', 'sequence'),
            'data_offset': FieldType('uint32')},
        'std_msgs/msg/MultiArrayDimension': {
            'label': FieldType('string'), 'size': FieldType('uint32'),
            'stride': FieldType('uint32')}})}
CONFIG = Config((Channel('u', 'input', '/cmd', '', 'data[0:2]', 'V'),
                 Channel('y', 'output', '/rate', '', 'vector.x', 'rad/s')),
                Settings(window_length=1.0, window_stride=0.5, window_max_delay=0.05))


def rate(stamp_ns, value):
    make = STORE.types
    stamp = make['builtin_interfaces/msg/Time'](stamp_ns // S, stamp_ns % S)
    return bytes(STORE.serialize_cdr(make['geometry_msgs/msg/Vector3Stamped'](
        make['std_msgs/msg/Header'](stamp, 'body'),
        make['geometry_msgs/msg/Vector3'](value, 0.0, 0.0)), 'geometry_msgs/msg/Vector3Stamped'))


def command(values):
    make = STORE.types
    return bytes(STORE.serialize_cdr(make['std_msgs/msg/Float64MultiArray'](
        make['std_msgs/msg/MultiArrayLayout']([], 0), np.array(values, dtype=float)),
        'std_msgs/msg/Float64MultiArray'))


def arriving(seconds=4.0, seed=0):
    """Taken messages in the order of arrival: /rate at 200 Hz with header, /cmd at 50 Hz."""
    rng = np.random.default_rng(seed)
    taken, number = [], {'/rate': 0, '/cmd': 0}
    for k in range(int(200 * seconds)):
        stamp = EPOCH + k * 5 * MS + int(rng.integers(0, MS))
        taken.append((stamp + int(rng.integers(MS, 4 * MS)), '/rate',
                      rate(stamp, math.sin(0.02 * k)), stamp + MS))
        if k % 4 == 0:
            taken.append((stamp + int(rng.integers(MS, 2 * MS)), '/cmd', command([k, -k]),
                          stamp))
    messages = []
    for arrival, topic, raw, source in sorted(taken):
        number[topic] += 1
        messages.append(Taken(arrival, topic, raw, source, number[topic]))
    return messages


def batches(messages, seed=1):
    """Split as a drain does: by topic, and what arrives meanwhile comes with the later topic."""
    rng = np.random.default_rng(seed)
    now, rest = messages[0].arrival_ns, list(messages)
    while rest:
        now += int(rng.integers(MS, 30 * MS))
        seen = {'/rate': now, '/cmd': now + int(rng.integers(0, MS))}
        batch = [t for topic in seen for t in rest
                 if t.topic == topic and t.arrival_ns <= seen[topic]]
        rest = [t for t in rest if t.arrival_ns > seen[t.topic]]
        yield batch, now - MS // 2
    yield [], now + S


def run(feed, messages, seed=1):
    return [record for batch, until in batches(messages, seed)
            for record in feed.take(batch, until)]


def bits(records):
    return [(r.epoch_ns, r.start, r.end, [(s.time.tobytes(), s.values.tobytes(), s.hold, s.names)
                                          for s in (*r.inputs, *r.outputs)]) for r in records]


def replayed(path, config=CONFIG):
    with open_bag(path) as bag:
        fitted = fit_config(bag, config)
        ingest = Ingest(fitted)
        return [record for _ in play(bag, ingest, Interval()) for record in ingest.due()]


@pytest.mark.parametrize('seed', [0, *slow(1, 2)])
def test_a_recording_gives_the_same_windows_however_the_messages_were_drained(tmp_path, seed):
    writer = BagWriter(tmp_path / 'flight.mcap', TYPES)
    feed = Feed(CONFIG, TYPES, lambda _: 1, writer)
    records = run(feed, arriving(), seed)
    writer.close()
    assert len(records) == 6
    assert bits(replayed(writer.path)) == bits(records)
    other = run(Feed(CONFIG, TYPES, lambda _: 1), arriving(), seed + 10)
    assert bits(other) == bits(records)


def numbered(publishers):
    """Return publishers and what `arriving` gives; those of /cmd count their own messages."""
    counts, messages = Counter(), []
    for taken in arriving():
        who = publishers((taken.arrival_ns - EPOCH) / S, taken.sequence) \
            if taken.topic == '/cmd' else 0
        counts[who] += 1
        messages.append((who, taken._replace(sequence=counts[who])))
    return messages


def between(second, every):
    """A second publisher sends one of so many messages from 1.8 to 2.2 s."""
    return lambda t, k: second if 1.8 < t < 2.2 and k % every == 0 else 1


@pytest.mark.parametrize(('publishers', 'mixed'), [
    (lambda t, k: 1, []), (lambda t, k: 1 if t < 2.0 else 2, []),  # one takes over
    (between(2, 2), [1.0, 1.5, 2.0]), (between(2, 19), [1.0, 1.5])])
def test_windows_of_two_publishers_are_told_live_and_of_a_recording(tmp_path, publishers, mixed):
    writer = BagWriter(tmp_path / 'flight.mcap', TYPES)
    records = run(Feed(CONFIG, TYPES, lambda _: 2, writer),
                  [taken for _, taken in numbered(publishers)])
    writer.close()
    starts = [round((r.epoch_ns - EPOCH) / S, 1) for r in records if r.faults]
    assert starts == mixed
    again = replayed(writer.path)
    assert bits(again) == bits(records)
    assert [r.faults for r in again] == [r.faults for r in records]
    for record in records:
        assert not record.faults or record.faults == (
            'Samples of several publishers are mixed in u, of /cmd; stop all but one of them, or '
            'give them topics of their own.',)


def test_publishers_mix_while_windows_have_samples_of_both_in_turns():
    def seen(publishers, known=True):
        feed = Feed(CONFIG, TYPES, lambda _: 2)
        assert feed.mixes('/cmd')                   # nobody knows yet
        found = []
        for _, taken in numbered(publishers):
            feed.take([taken if known else taken._replace(sequence=None)], taken.arrival_ns)
            if taken.topic == '/cmd':
                found.append(feed.mixes('/cmd'))
        return found

    taking_turns = seen(between(2, 2))
    assert not any(taking_turns[:85])
    assert all(taking_turns[95:110])
    assert not any(taking_turns[-15:])
    assert not any(seen(lambda t, k: 1 if t < 2.0 else 2))      # one takes over,
    assert sum(seen(lambda t, k: 2 if 1.5 < t < 3.1 else 1)) < 5    # for longer than a window
    assert all(seen(lambda t, k: 1, known=False))


@pytest.mark.parametrize('spoilt', [[2], [1, 2]])
@pytest.mark.parametrize('values', [[], [math.nan, 0.0]])
def test_a_publisher_of_which_no_sample_is_kept_mixes_nothing(tmp_path, values, spoilt):
    writer = BagWriter(tmp_path / 'flight.mcap', TYPES)
    records = run(Feed(CONFIG, TYPES, lambda _: 2, writer), [
        taken._replace(raw=command(values)) if who in spoilt else taken
        for who, taken in numbered(between(2, 2))])
    writer.close()
    again = replayed(writer.path)
    assert bits(again) == bits(records)
    assert not any(r.faults for r in (*records, *again))


def test_losses_beside_a_silent_publisher_mix_nothing():
    messages = [t for t in arriving() if t.sequence % 7 or t.sequence % 11 == 0]
    assert not any(r.faults for r in run(Feed(CONFIG, TYPES, lambda _: 2), messages))


def test_windows_are_those_of_the_ingest_by_itself():
    ingest = Ingest(CONFIG)
    expected = []
    for taken in arriving():
        k = taken.sequence - 1
        header, values = ((None, (4.0 * k, -4.0 * k)) if taken.topic == '/cmd' else
                          (taken.source_ns - MS, (math.sin(0.02 * k),)))
        ingest.push(taken.topic, taken.arrival_ns, taken.source_ns, header, values)
        expected += ingest.due()
    # Samples of /rate may overtake each other on the way: their number is that of arrival.
    found = run(Feed(CONFIG, TYPES, lambda _: 1), arriving())
    assert [r.epoch_ns for r in found] == [r.epoch_ns for r in expected]
    np.testing.assert_array_equal(found[2].inputs[0].values, expected[2].inputs[0].values)


def test_what_arrived_after_now_waits_for_what_may_still_come_from_before():
    config = replace(CONFIG, settings=CONFIG.settings.replace(window_max_delay=0.0))
    early, late = Taken(EPOCH + 10 * MS, '/cmd', command([1, 2])), None
    late = Taken(EPOCH + 12 * MS, '/rate', rate(EPOCH + 11 * MS, 0.5))
    feed = Feed(config, TYPES, lambda _: 1)
    feed.take([late], EPOCH + 9 * MS)
    assert feed.topics['/rate'].messages == 0
    feed.take([early], EPOCH + 11 * MS)
    feed.take([], EPOCH + 13 * MS)
    samples = feed.counts().channels
    assert (samples['u'].samples.accepted, samples['y'].samples.accepted) == (1, 1)
    assert samples['u'].samples.late == 0


def test_a_computer_that_stalls_while_messages_are_handed_out_mixes_nothing_up():
    config = replace(CONFIG, settings=CONFIG.settings.replace(window_max_delay=0.0))
    messages = [Taken(EPOCH + k * 100 * MS, '/rate', rate(EPOCH + k * 100 * MS, 0.5))
                for k in range(1, 50)]
    feed = Feed(config, TYPES, lambda _: 1)
    feed.take(messages, EPOCH, EPOCH + 5 * S)  # 5 s between the first and the last
    feed.take([Taken(EPOCH + 50 * MS, '/cmd', command([1, 2]))], EPOCH + 6 * S)
    samples = feed.counts().channels
    assert (samples['u'].samples.accepted, samples['y'].samples.accepted) == (1, 49)


def test_a_clock_set_back_holds_nothing_up():
    messages = arriving(2.0)
    back = [taken._replace(arrival_ns=taken.arrival_ns - 3600 * S) for taken in arriving(2.0, 3)]
    feed = Feed(CONFIG, TYPES, lambda _: 1)
    feed.take(messages, messages[-1].arrival_ns - 3600 * S)
    assert feed.topics['/rate'].messages == 400
    feed.take(back, back[-1].arrival_ns)
    assert feed.topics['/rate'].messages == 800


def test_lost_messages_are_counted_and_told():
    messages = [t for t in arriving() if not (t.topic == '/rate' and 100 <= t.sequence < 107)]
    feed = Feed(CONFIG, TYPES, lambda _: 1)
    run(feed, messages)
    assert feed.topics['/rate'].numbers.lost == 7
    assert feed.topics['/cmd'].numbers.lost == 0
    assert any('/rate: 7 messages were lost' in line for line in feed.report())


def test_what_cannot_be_decoded_is_counted_and_the_rest_goes_on(tmp_path):
    good = arriving()
    bad = [Taken(good[100].arrival_ns + 1, '/rate', b'\0\1\0\0'),
           Taken(good[200].arrival_ns + 1, '/cmd', command([1.0])),
           Taken(good[300].arrival_ns + 1, '/cmd', b''),
           Taken(good[400].arrival_ns + 1, '/rate', rate(EPOCH + 2 * S + 77, math.nan))]
    writer = BagWriter(tmp_path / 'flight.mcap', TYPES)
    feed = Feed(CONFIG, TYPES, lambda _: 1, writer)
    records = run(feed, sorted([*good, *bad], key=lambda t: t.arrival_ns))
    writer.close()
    counts = feed.counts().channels
    assert counts['u'].samples.wrong_width == 2
    assert counts['y'].samples.wrong_width == 1
    assert counts['y'].samples.non_finite == 1
    assert len(records) == 6
    assert bits(replayed(writer.path)) == bits(records)


def test_open_ranges_wait_for_the_first_message_and_lose_nothing(tmp_path):
    config = CONFIG.with_fields({'u': 'data[:]'})
    messages = arriving()
    first = next(i for i, t in enumerate(messages) if t.topic == '/cmd')
    empty = Taken(messages[0].arrival_ns - 1, '/cmd', command([]))
    messages = [empty, *messages]
    feed = Feed(config, TYPES, lambda _: 1)
    assert first < 3
    for taken in messages[:first + 1]:
        assert feed.take([taken], taken.arrival_ns) == []
    assert feed.counts() is None
    assert any('`u`: waiting for a message on /cmd' in line for line in feed.report())
    records = run(feed, messages[first + 1:])
    assert feed.config.inputs[0].field == 'data[0:2]'
    plain = Feed(CONFIG, TYPES, lambda _: 1)
    assert bits(records) == bits(run(plain, messages))


def test_a_reset_begins_anew():
    feed = Feed(CONFIG.with_fields({'u': 'data[:]'}), TYPES, lambda _: 1)
    first = run(feed, arriving())
    feed.reset()
    assert (feed.counts(), feed.newest_ns, feed.largest_batch) == (None, 0, 0)
    assert bits(run(feed, arriving())) == bits(first)


def test_the_arrival_of_a_stamp_is_known():
    feed = Feed(CONFIG, TYPES, lambda _: 1)
    for taken in arriving():
        feed.take([taken], taken.arrival_ns)
    stamp = EPOCH + 3 * S
    arrival = feed.arrival_ns(stamp)
    assert 0 <= arrival - stamp < 15 * MS
    assert feed.arrival_ns(EPOCH + 100 * S) is None


def test_the_last_window_may_be_had_at_any_time():
    feed = Feed(CONFIG, TYPES, lambda _: 1)
    messages = arriving()
    half = next(i for i, t in enumerate(messages) if t.arrival_ns > EPOCH + S // 2)
    feed.take(messages[:half], messages[half].arrival_ns)
    assert feed.latest() is None
    rest = run(feed, messages[half:])
    record = feed.latest()
    assert record.duration == pytest.approx(1.0)
    assert record.epoch_ns + S == feed.newest_ns - 50 * MS
    assert record.epoch_ns > rest[-1].epoch_ns


def test_fields_that_do_not_fit_are_faults_all_at_once():
    config = CONFIG.with_fields({'u': 'dat[0]', 'y': 'vector'})
    with pytest.raises(SettingsError) as error:
        Feed(config, TYPES, lambda _: 1)
    assert len(error.value.faults) == 2
    assert 'data' in error.value.faults[0]
    assert 'vector.x' in error.value.faults[1]


class FullDisk:
    def write(self, *_):
        raise StorageError('flight.mcap cannot be written on (No space left on device)')


def test_a_full_disk_ends_the_recording_only():
    feed = Feed(CONFIG, TYPES, lambda _: 1, FullDisk())
    assert len(run(feed, arriving())) == 6
    assert sum('No space left' in line for line in feed.report()) == 1


def test_a_recording_never_replaces_another(tmp_path):
    paths = []
    for _ in range(3):
        writer = BagWriter(tmp_path / 'logs' / 'flight.mcap', TYPES)
        writer.close()
        paths.append(writer.path.name)
    assert paths == ['flight.mcap', 'flight-2.mcap', 'flight-3.mcap']
    (tmp_path / 'file').write_text('')
    with pytest.raises(StorageError, match='choose another'):
        BagWriter(tmp_path / 'file' / 'flight.mcap', TYPES)


def test_header_less_messages_have_simulated_stamps_and_replay_alike(tmp_path):
    clock = SimClock()
    writer = BagWriter(tmp_path / 'sim.mcap', TYPES)
    config = replace(CONFIG, channels=(
        *CONFIG.inputs, replace(CONFIG.outputs[0], stamp='log')))
    feed = Feed(config, TYPES, lambda _: 1, writer, clock)
    messages, records = arriving(), []
    ticks = [(EPOCH + k * 25 * MS, k * 25 * MS + S) for k in range(-1, 200)]
    for batch, until in batches(messages):
        while ticks and ticks[0][0] <= until:
            clock.tick(*ticks.pop(0))
        records += feed.take(batch, until)
    writer.close()
    assert 0 < records[0].epoch_ns < 2 * S
    assert [r.epoch_ns - records[0].epoch_ns for r in records] == [
        k * S // 2 for k in range(len(records))]
    assert bits(replayed(writer.path, config)) == bits(records)


def test_what_comes_before_simulated_time_has_no_stamp(tmp_path):
    clock = SimClock()
    writer = BagWriter(tmp_path / 'sim.mcap', TYPES)
    config = replace(CONFIG, channels=(
        *CONFIG.inputs, replace(CONFIG.outputs[0], stamp='log')))
    feed = Feed(config, TYPES, lambda _: 1, writer, clock)
    messages = arriving()
    before, later = messages[:100], messages[100:]
    assert feed.take(before, before[-1].arrival_ns) == []
    counts = feed.counts().channels
    assert (counts['u'].samples.accepted, counts['y'].samples.accepted) == (0, 0)
    assert sum(own.samples.bad_stamp for own in counts.values()) == 100
    start = later[0].arrival_ns
    clock.tick(start - 20 * MS, 100 * S)
    clock.tick(start - 10 * MS, 100 * S + 10 * MS)
    records = []
    for taken in later:
        clock.tick(taken.arrival_ns, 100 * S + taken.arrival_ns - start + 20 * MS)
        records += feed.take([taken], taken.arrival_ns)
    writer.close()
    assert 100 * S <= records[0].epoch_ns < 101 * S
    assert bits(replayed(writer.path, config)) == bits(records)


@pytest.mark.parametrize('simulated', [False, True])
def test_a_clock_that_jumps_back_begins_another_recording(tmp_path, simulated):
    clock = SimClock() if simulated else None
    writer = BagWriter(tmp_path / 'flight.mcap', TYPES)
    config = replace(CONFIG, channels=(
        *CONFIG.inputs, replace(CONFIG.outputs[0], stamp='log')))
    feed = Feed(config, TYPES, lambda _: 1, writer, clock)
    again = [t._replace(arrival_ns=t.arrival_ns + (5 if simulated else -2) * S)
             for t in arriving(seed=2)]
    records = []
    for messages in (arriving(), again):
        for taken in messages:
            if clock:
                clock.tick(taken.arrival_ns, S + taken.arrival_ns - messages[0].arrival_ns)
            records += feed.take([taken], taken.arrival_ns)
    writer.close()
    assert writer.path.name == 'flight-2.mcap'
    assert feed.counts().resets == 1
    alone = []
    for name in ('flight.mcap', 'flight-2.mcap'):
        with open_bag(tmp_path / name) as bag:
            ingest = Ingest(fit_config(bag, config))
            alone += [r for _ in play(bag, ingest, Interval()) for r in ingest.due()]
            alone += ingest.flush() if name == 'flight.mcap' else ()
    assert bits(alone) == bits(records)
