# SPDX-License-Identifier: Apache-2.0
"""Tables (CSV, Parquet): times, units, names of columns; what is odd or damaged is said."""

from __future__ import annotations

import sys

from bag_fixtures import flight, notes, numbers, refused, write_mcap
import numpy as np
import pytest
from recording_files import samples_read, write_csv

from ctsid_ros.errors import BagError
from ctsid_ros.recordings.bag import open_bag
from ctsid_ros.recordings.table_times import Column, read_times

BOOT = 10**15  # times that count from zero are shifted: a stamp of zero means that there is none
T = np.arange(20) * 0.01


def stamps(path, topic=None, time=()):
    """Log times [ns] of a topic, after the start of clocks of their own."""
    with open_bag(path, time) as bag:
        (name,) = [topic] if topic else bag.topics
        log_ns = np.concatenate([b.columns[0].log_ns for b in bag.blocks({name: []})])
    return log_ns - BOOT * (log_ns[0] < 10**17)


def text_file(tmp_path, text, name='a.csv', encoding='utf-8'):
    (tmp_path / name).write_bytes(text.encode(encoding))
    return tmp_path / name


def test_a_plain_table(tmp_path):
    path = write_csv(tmp_path / 'my flight (1).csv', {'t': T, 'u': 2 * T, 'rate.x': 3 * T})
    with open_bag(path) as bag:
        assert [(name, info.type, info.count) for name, info in bag.topics.items()] == [
            ('my_flight_1', 'table/msg/Row', 20)]
        assert [str(field) for field in bag.scalar_fields('my_flight_1')] == ['u', 'rate.x']
        assert bag.notes == ()
    np.testing.assert_array_equal(stamps(path), np.round(T * 1e9).astype(int))
    np.testing.assert_array_equal(numbers(path, 'my_flight_1', 'rate.x', 'u'),
                                  np.column_stack([3 * T, 2 * T]))


@pytest.mark.parametrize(('title', 'scale'), [
    ('t [s]', 1), ('time(ms)', 1e-3), ('t_us', 1e-6), ('timestamp [ns]', 1e-9),
    ('Time / ms', 1e-3), ('TimeUS', 1e-6), ('elapsed_time', 1), ('secs', 1), ('% time <ms>', 1e-3),
    ('time_nsec', 1e-9), ('t', 1), ('time [min]', 60), ('t_min', 60), ('Time (hours)', 3600)])
def test_the_unit_of_a_time_is_in_its_name(tmp_path, title, scale):
    times = [f'{value:.12g}' for value in T / scale]
    path = write_csv(tmp_path / 'a.csv', {title: times, 'u': T})
    np.testing.assert_allclose(stamps(path), T * 1e9, atol=1)
    assert notes(path) == ''


@pytest.mark.parametrize(('start', 'scale', 'said'), [
    (1.7e9, 1, ''), (1.7e9, 1e-3, ''), (1.7e9, 1e-6, ''), (1.7e9, 1e-9, ''),  # dates
    (5.0, 1, ''), (5.0, 1e-3, 'taken as ms, for they step by 10'),
    (5.0, 1e-6, 'taken as us'),
    (5.0, 1e-9, 'taken as ns, for they step by 1e+07: 0.19 s in all; if that is wrong, say --time '
     'timestamp:s')])
def test_or_the_values_tell_it(tmp_path, start, scale, said):
    whole = round(start) * round(1 / scale)
    times = [f'{start + t:.2f}' for t in T] if scale == 1 else [
        str(whole + round(t / scale)) for t in T]
    path = write_csv(tmp_path / 'a.csv', {'timestamp': times, 'u': T})
    found = stamps(path)
    np.testing.assert_allclose(found - found[0], T * 1e9, atol=300)
    assert found[0] == start * 1e9
    assert said in notes(path)
    assert bool(notes(path)) == bool(said)


@pytest.mark.parametrize(('step', 'told'), [(0.1, False), (0.5, True), (1.003, True)])
def test_steps_that_could_be_milliseconds_are_told(tmp_path, step, told):
    path = write_csv(tmp_path / 'a.csv', {'t': step * np.arange(20), 'u': T})
    np.testing.assert_allclose(stamps(path), step * 1e9 * np.arange(20), atol=1)
    assert ('taken as s' in notes(path)) == told


def test_a_unit_that_is_not_known_is_told(tmp_path):
    path = write_csv(tmp_path / 'a.csv', {'time [frames]': T, 'u': T})
    np.testing.assert_allclose(stamps(path), T * 1e9, atol=1)
    assert "time have the unit 'frames', which is not known, and are taken as s" in notes(path)


def test_steps_are_those_of_rows_in_order(tmp_path):
    times = np.random.default_rng(0).permutation(0.01 * np.arange(2000))
    path = write_csv(tmp_path / 'a.csv', {'t': times, 'u': times})
    np.testing.assert_allclose(np.sort(stamps(path, time=['t'])), np.sort(times) * 1e9, atol=1)
    one = write_csv(tmp_path / 'b.csv', {'t': [0.5], 'u': [1.0]})
    assert 'column t has no two times' in refused(one)


def test_nanoseconds_are_exact(tmp_path):
    times = 1_700_000_000_123_456_789 + np.arange(20) * 10_000_001
    path = write_csv(tmp_path / 'a.csv', {'stamp': times, 'u': T})
    np.testing.assert_array_equal(stamps(path), times)


def test_seconds_and_nanoseconds_side_by_side(tmp_path):
    times = 1_700_000_000_900_000_001 + np.arange(20) * 10_000_000
    path = write_csv(tmp_path / 'a.csv', {
        'seq': range(20), 'header.stamp.secs': times // 10**9, 'header.stamp.nsecs': times % 10**9,
        'u': T})
    np.testing.assert_array_equal(stamps(path), times)
    bare = write_csv(tmp_path / 'b.csv', {'sec': times // 10**9, 'nanosec': times % 10**9, 'u': T})
    np.testing.assert_array_equal(stamps(bare), times)
    with open_bag(bare) as bag:
        assert [str(field) for field in bag.scalar_fields('b')] == ['u']


def test_dates(tmp_path):
    rows = [f'2024-05-01 10:00:00.{i:02d}' for i in range(20)]
    path = write_csv(tmp_path / 'a.csv', {'when': rows, 'u': T})
    assert stamps(path)[0] == 1_714_557_600 * 10**9
    np.testing.assert_array_equal(np.diff(stamps(path)), 10_000_000)
    zoned = write_csv(tmp_path / 'b.csv', {'when': [f'{r}+02:00' for r in rows], 'u': T})
    assert stamps(zoned)[0] == (1_714_557_600 - 7200) * 10**9


def test_the_user_says_which_column_is_the_time(tmp_path):
    path = write_csv(tmp_path / 'a.csv', {'frame': T * 1000, 't': T, 'u': T})
    np.testing.assert_allclose(stamps(path, time=['frame:ms']), T * 1e9, atol=1)
    np.testing.assert_allclose(stamps(path, time=['frame:us']), T * 1e6, atol=1)
    with pytest.raises(BagError, match='no column is called frames; nearest: frame'):
        open_bag(path, ['frames'])
    write_mcap(tmp_path / 'a.mcap', flight(2))
    with pytest.raises(BagError, match='t would be the time of a table .*leave --time out'):
        open_bag(tmp_path / 'a.mcap', ['t'])
    bare = write_csv(tmp_path / 'b.csv', {'u': [1, 3, 2], 'y': [2, 5, 1]})
    assert 'no column is known to be the time' in refused(bare)
    assert '--time COLUMN; there are: u, y' in refused(bare)


def test_several_times_are_topics_of_their_own(tmp_path):
    path = write_csv(tmp_path / 'a.csv', {'t_u': T[:7] * 2, 'u': T[:7], 't_y': T, 'y': 2 * T})
    with open_bag(path) as bag:
        assert {n: info.count for n, info in bag.topics.items()} == {'a/t_u': 7, 'a/t_y': 20}
    np.testing.assert_array_equal(stamps(path, 'a/t_u'), np.round(T[:7] * 2e9))
    np.testing.assert_array_equal(numbers(path, 'a/t_y', 'y')[-1], 2 * T[-1])
    assert notes(path) == ''
    # Not where a second one counts something else: it is a column as others.
    other = write_csv(tmp_path / 'b.csv', {'stamp': T + 1.7e9, 'u': T, 'time': T, 'y': T})
    with open_bag(other) as bag:
        assert list(bag.topics) == ['b']
    with open_bag(other, ['stamp', 'time']) as bag:
        assert list(bag.topics) == ['b/stamp', 'b/time']


def test_titles_without_rows_are_told(tmp_path):
    (tmp_path / 'a.csv').write_text('time,u,y\n')
    assert "titles ('time,u,y') without rows of numbers below" in refused(tmp_path / 'a.csv')


def test_a_name_with_a_dot_is_kept(tmp_path):
    for name, topic in (
            ('run1.2.csv', 'run1_2'), ('run.csv', 'run'), ('drive.left.csv', 'drive_left')):
        with open_bag(write_csv(tmp_path / name, {'t': T, 'u': T})) as bag:
            assert list(bag.topics) == [topic]


def test_times_of_one_table_that_name_no_unit_have_one(tmp_path):
    """A command every second, and samples at 0.5 Hz by a clock of their own: hours, not ms."""
    path = write_csv(tmp_path / 'a.csv', {
        't_cmd': np.arange(100.0), 'u': T[:1].repeat(100),
        't_meas': [*(2.0005 * np.arange(50.0)), *[''] * 50], 'y': [*np.arange(50.0), *[''] * 50]})
    assert np.ptp(stamps(path, 'a/t_cmd')) == 99e9
    assert np.ptp(stamps(path, 'a/t_meas')) == pytest.approx(49 * 2.0005e9)
    assert 'column t_meas name no unit and are taken as s' in notes(path)
    # Dates tell their own.
    dated = write_csv(tmp_path / 'b.csv', {
        't_cmd': 1.7e9 + T, 'u': T, 't_meas': 1.7e12 + 1e3 * T, 'y': T})
    with open_bag(dated) as bag:
        assert list(bag.topics) == ['b/t_cmd', 'b/t_meas']
    assert np.ptp(stamps(dated, 'b/t_meas')) == pytest.approx(np.ptp(T) * 1e9, abs=1e6)
    # One event has no steps.
    rows, event = read_times([Column('t', '', 10.0 * np.arange(200.0)),
                              Column('t_event', '', np.array([50.0, *[np.nan] * 199]))], {})
    assert np.ptp(rows.log_ns) == 1.99e9
    assert event.log_ns[0] - rows.log_ns[0] == 50e6


def test_columns_that_are_filled_in_other_rows_are_sampled_at_other_times(tmp_path):
    """As PlotJuggler and others write signals of different rates into one table."""
    often = [f'{i}' if i % 2 else '' for i in range(20)]
    seldom = ['' if i % 5 else f'{i}' for i in range(20)]
    path = write_csv(tmp_path / 'a.csv', {
        '__time': T, '/imu/rate/x': often, '/imu/rate/y': often, '/gps/x': seldom, 'mode': T})
    with open_bag(path) as bag:
        assert {n: info.count for n, info in bag.topics.items()} == {
            'a': 20, 'a/imu.rate': 10, 'a/gps': 4}
    assert numbers(path, 'a/imu.rate', 'imu.rate.x', 'imu.rate.y')[1] == (3.0, 3.0)
    # A few cells that are missing do not make a topic.
    few = write_csv(tmp_path / 'b.csv', {'t': T, 'u': T, 'y': [*T[:19], '']})
    with open_bag(few) as bag:
        assert {n: info.count for n, info in bag.topics.items()} == {'b': 20}
    assert np.isnan(numbers(few, 'b', 'y')[-1][0])


@pytest.mark.parametrize('text', [
    '\ufefft,u\n0,1\n0.1,2\n', '"t","u"\r\n"0","1"\r\n"0.1","2"\r\n', 't;u\n0;1\n0,1;2\n',
    't\tu\n0\t1\n0.1\t2\n', '# made by hand\n\nt, u\n0, 1\n0.1, 2\n', 't,u,\n0,1,\n0.1,2,\n',
    '# t,u\n0,1\n0.1,2\n', 't [s],u [N m]\n0,1\n0.1,2', 't,u\n0,1,\n0.1,2,\n',
    't;u\n"0";"1,0"\n"0,1";"2,0"\n', '\n\nt,u\n0,1\n0.1,2\n',
    'sep=;\nt;u\n0,0;1\n0,1;2\n', '  t   u\n0.0 1\n  0.1   2 \n', '# t u\n0e0 1e0\n1e-1 2e0\n'],
    ids=['bom', 'quoted', 'decimal comma', 'tab', 'comment', 'trailing', 'comment header',
         'units', 'trailing in rows', 'all quoted', 'blank lines', 'excel', 'spaces', 'NumPy'])
@pytest.mark.parametrize('encoding', ['utf-8', 'utf-16'])
def test_ways_to_write_a_table(tmp_path, text, encoding):
    path = text_file(tmp_path, text.lstrip('\ufeff') if encoding == 'utf-16' else text,
                     encoding=encoding)
    assert numbers(path, 'a', 'u') == [(1.0,), (2.0,)]
    np.testing.assert_array_equal(stamps(path), [0, 100_000_000])
    assert notes(path) == ''


def test_western_windows(tmp_path):
    path = text_file(tmp_path, 't;Geschwindigkeit größer [m/s]\n0,0;1,5\n0,1;2,5\n',
                     encoding='cp1252')
    assert numbers(path, 'a', 'Geschwindigkeit_gr_er') == [(1.5,), (2.5,)]


def test_a_table_without_a_header(tmp_path):
    path = text_file(tmp_path, '0.0,5\n0.1,3\n0.2,4\n')
    assert numbers(path, 'a', 'column_2') == [(5.0,), (3.0,), (4.0,)]
    assert 'it has no header: its columns are called column_1' in notes(path)


def test_spaces_make_a_table_of_numbers_only(tmp_path):
    titles = text_file(tmp_path, 'elapsed time [s] u\n0.0 1\n0.1 2\n')
    assert numbers(titles, 'a', 'column_2') == [(1.0,), (2.0,)]
    prose = text_file(tmp_path, 'flown on day 1\nlanded on day 2\nbroken on day 3\n', 'b.txt')
    assert 'looks like text' in refused(prose)


def test_rows_without_times_have_a_rate(tmp_path):
    bare = write_csv(tmp_path / 'b.csv', {'u': [1, 3, 2], 'y': [2, 5, 1]})
    assert 'such as --time 100Hz' in refused(bare)
    np.testing.assert_array_equal(stamps(bare, time=['12.5Hz']), [0, 80_000_000, 160_000_000])
    with open_bag(bare, ['12.5Hz']) as bag:
        assert [str(field) for field in bag.scalar_fields('b')] == ['u', 'y']
    for text in ('-5Hz', '0Hz', 'fastHz'):
        with pytest.raises(BagError, match=f'no column is called {text}'):
            open_bag(bare, [text])
    named = write_csv(tmp_path / 'a.csv', {'u': T, '1Hz': 2 * T, 'y': T})
    np.testing.assert_allclose(stamps(named, time=['1Hz']), 2e9 * T, atol=1)


def test_rows_and_cells_that_are_no_numbers(tmp_path):
    path = text_file(tmp_path, 't,u,y,mode\n0,1,2,A\n0.1,bad,3,B\n0.2,4\n0.3,5,6,C\n0.4,1,2,3,4\n'
                     '0.5,nan,7,D\n0.6,8,9,\n,1,1,E\n"0.7,1,1,F\n'
                     + '0.8,1,1,G\n' * 20 + '0.9,3')
    said = notes(path)
    assert 'a.csv: 3 rows left out (the first is line 4: 2 cells instead of 4)' in said
    assert "cells that are no numbers were left out: 1 in u ('bad')" in said
    assert 'a.csv: left out, for they hold text: mode' in said
    assert 'a.csv: rows left out, for their time (t) is empty: 1' in said
    assert len(said.splitlines()) == 4
    np.testing.assert_array_equal(
        numbers(path, 'a', 'u', 'y'),
        [(1, 2), (np.nan, 3), (5, 6), (np.nan, 7), (8, 9)] + 21 * [(1, 1)])


def test_times_that_go_back_are_put_in_order(tmp_path):
    times = [0.0, 0.1, 0.3, 0.2, *(0.4 + 0.1 * i for i in range(100))]
    path = write_csv(tmp_path / 'a.csv', {'t': times, 'u': range(104)})
    assert [int(u) for (u,) in numbers(path, 'a', 'u')][:5] == [0, 1, 3, 2, 4]
    assert 'places where t goes back: 1; the rows were put in the order of time' in notes(path)


def test_runs_behind_each_other_in_one_table_are_not_mixed(tmp_path):
    path, first = tmp_path / 'a.csv', np.arange(60) * 0.01
    write_csv(path, {'t': [*first + 0.003, *first, *T + 5.0], 'u': range(140)})
    assert ('time starts again after 60 rows of a: these are several runs; put each into a file'
            in refused(path))


@pytest.mark.parametrize('times', [
    [*T[:10] + 0.2, *T[10:] - 0.05, *T + 5.0],           # packets that a network has swapped
    [0.0, 99.0, *T[1:] + 5.0],                           # one time is false
    np.random.default_rng(0).permutation(400) * 0.01])
def test_rows_in_disorder_are_one_run(tmp_path, times):
    path = write_csv(tmp_path / 'a.csv', {'t': times, 'u': range(len(times))})
    with open_bag(path, ['t']) as bag:
        assert bag.topics['a'].count == len(times)


def test_signals_whose_rows_stand_behind_each_other_are_one_run(tmp_path):
    """As `pandas.concat` writes those of two rates."""
    t = np.arange(60) * 0.01
    path = write_csv(tmp_path / 'a.csv', {
        't': [*t, *t + 0.002], 'u': [*t, *[''] * 60], 'y': [*[''] * 60, *t]})
    with open_bag(path) as bag:
        assert {name: topic.count for name, topic in bag.topics.items()} == {'a/u': 60, 'a/y': 60}


@pytest.mark.parametrize(('title', 'times', 'said'), [
    ('Time', [f'00:00:{i:02}' for i in range(20)], "column Time holds '00:00:00', which is read "
     'neither as a number nor as a date (2024-05-01 10:00:00.25); say which one by --time'),
    ('Date', ['01/05/2024 22:00:10'] * 20, "column Date holds '01/05/2024 22:00:10', which"),
    ('time', [1.7e9] * 20, 'time: column time goes back or stands still too often; say')])
def test_a_time_that_cannot_be_read_is_named(tmp_path, title, times, said):
    path = write_csv(tmp_path / 'a.csv', {title: times, 'u': 1 - T})
    assert said in refused(path)
    if isinstance(times[0], str):
        with pytest.raises(BagError, match=f'a.csv: column {title} holds'):
            open_bag(path, [title])


@pytest.mark.parametrize(('title', 'scale'), [('ms', 1e-3), ('millis', 1e-3), ('us', 1e-6)])
def test_a_time_may_be_called_by_its_unit(tmp_path, title, scale):
    path = write_csv(tmp_path / 'a.csv', {'u': 1 - T, 's': T, title: np.round(T / scale)})
    np.testing.assert_allclose(stamps(path), T * 1e9, atol=1)


@pytest.mark.parametrize('above', [['Operator,Bob', 'Date,2024-05-01', ''], ['Run 3'], []])
def test_titles_may_stand_below_lines_on_the_recording(tmp_path, above):
    path = text_file(tmp_path, '\n'.join([*above, 'Time [s],Speed [m/s],Mode', *(
        f'{t:.2f},{2 * t:.2f},A' for t in T)]) + '\n')
    np.testing.assert_allclose(np.ravel(numbers(path, 'a', 'Speed')), 2 * T)
    lines = sum(map(bool, above))
    assert (f'lines above its titles were left out: {lines}' in notes(path)) is bool(above)


def test_a_row_of_data_with_text_and_a_comma_too_many_is_no_title(tmp_path):
    path = text_file(tmp_path, '\n'.join(['t,u,mode', *(
        f'{t:.2f},{2 * t:.2f},AUTO,' for t in T)]) + '\n')
    np.testing.assert_allclose(np.ravel(numbers(path, 'a', 'u')), 2 * T, atol=0.01)


def test_names_that_are_no_fields(tmp_path):
    path = write_csv(tmp_path / 'a.csv', {
        't': T, 'motor 1 [rpm]': T, '2nd': T, 'a': T, 'a.b': T, 'q[0]': T, 'q[1]': T, 'p[3]': T,
        'u': T, 'u ': T, '/j/0': T, '/j/1': T, 'x-y': T})
    with open_bag(path) as bag:
        assert [str(field) for field in bag.scalar_fields('a')] == [
            'motor_1', '_2nd', 'a', 'a_b', 'q[0]', 'q[1]', 'p_3', 'u', 'u_2', 'j[0]', 'j[1]',
            'x_y']


def test_a_quaternion_can_be_angles(tmp_path):
    path = write_csv(tmp_path / 'a.csv', {
        't': T, '/att/x': np.sin(T / 2), '/att/y': 0 * T, '/att/z': 0 * T,
        '/att/w': np.cos(T / 2)})
    with open_bag(path) as bag:
        assert 'euler(att).roll' in [str(field) for field in bag.scalar_fields('a')]
    np.testing.assert_allclose(numbers(path, 'a', 'euler(att).roll'), T[:, None], atol=1e-12)


def test_a_table_alone_answers_to_other_names(tmp_path):
    """So that one parameter file serves all of its kind."""
    path = write_csv(tmp_path / 'tuesday.csv', {'t': T, 'u': T})
    with open_bag(path) as bag:
        assert bag.topic('monday').count == 20
        assert bag.notes == ('topic monday is read from tuesday, the only table',)
    write_csv(tmp_path / 'other.csv', {'t': T, 'y': T})
    with open_bag(tmp_path) as bag, pytest.raises(BagError, match='there are: other, tuesday'):
        bag.topic('monday')


@pytest.fixture(scope='module')
def arrow():
    return pytest.importorskip('pyarrow')


def write_parquet(path, columns, **more):
    import pyarrow
    from pyarrow import parquet

    parquet.write_table(pyarrow.table(columns), path, **more)
    return path


def test_parquet(tmp_path, arrow):
    dates = arrow.array([1_700_000_000_000_000 + 10_000 * i for i in range(20)],
                        arrow.timestamp('us', tz='UTC'))
    path = write_parquet(tmp_path / 'a.parquet', {
        'when': dates, 'u': T.astype(np.float32), 'n': arrow.array([None, *range(19)]),
        'on': [True, False] * 10, 'rate': [{'x': i, 'y': 2.5} for i in range(20)],
        'q': [[0.0, float(i)] for i in range(20)], 'word': ['a'] * 20})
    with open_bag(path) as bag:
        assert [str(f) for f in bag.scalar_fields('a')] == [
            'u', 'n', 'on', 'rate.x', 'rate.y', 'q[0]', 'q[1]']
        assert bag.notes == ('a.parquet: left out, for they are no numbers: word',)
    assert numbers(path, 'a', 'n', 'on', 'rate.x', 'q[1]', 'u')[3] == (
        2.0, 0.0, 3.0, 3.0, float(np.float32(0.03)))
    np.testing.assert_array_equal(stamps(path),
                                  1_700_000_000 * 10**9 + np.arange(20) * 10_000_000)


def test_parquet_with_times_of_its_own(tmp_path, arrow):
    path = write_parquet(tmp_path / 'a.parquet', {
        't_u': arrow.array([0.0, 0.1, 0.15, None]), 'u': arrow.array([1.0, 2.0, 3.0, None]),
        't_y': [0.0, 0.05, 0.1, 0.15], 'y': [4.0, 3.0, 2.0, 1.0]})
    assert numbers(path, 'a/t_u', 'u') == [(1.0,), (2.0,), (3.0,)]
    assert stamps(path, 'a/t_y')[-1] == 150_000_000


@pytest.mark.usefixtures('arrow')
def test_damaged_parquet(tmp_path):
    table = {'t': np.arange(4000) * 0.01, 'u': np.random.default_rng(0).normal(size=4000)}
    path = write_parquet(tmp_path / 'a.parquet', table, row_group_size=1000,
                         write_page_checksum=True)
    content = bytearray(path.read_bytes())
    cut = tmp_path / 'cut.parquet'
    cut.write_bytes(content[:-200])
    assert 'its end, so nothing can be recovered' in refused(cut)
    middle = len(content) // 2
    content[middle:middle + 400] = bytes(400)
    hole = tmp_path / 'hole.parquet'
    hole.write_bytes(content)
    assert 'hole.parquet: damaged: ' in notes(hole)
    with open_bag(hole) as bag:
        assert bag.topics['hole'].count in (2000, 3000)


@pytest.mark.usefixtures('arrow')
def test_parquet_without_its_library(tmp_path, monkeypatch):
    path = write_parquet(tmp_path / 'a.parquet', {'t': T, 'u': T})
    monkeypatch.setitem(sys.modules, 'pyarrow', None)
    assert 'pip install pyarrow (it is the extra `parquet` of ctsid)' in refused(path)


def test_damage_anywhere_in_a_table_does_not_crash(tmp_path):
    content = write_csv(tmp_path / 'a.csv', {'t': T, 'u': 2 * T, 'y': T}).read_bytes()
    rng, read = np.random.default_rng(0), 0
    path = tmp_path / 'd.csv'
    for _ in range(60):
        damaged = bytearray(content)
        for at in rng.integers(0, len(content), 4):
            damaged[at] = rng.integers(256)
        path.write_bytes(damaged)
        read += samples_read(path)
    assert read > 40 * len(T)
