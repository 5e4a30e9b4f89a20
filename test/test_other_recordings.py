# SPDX-License-Identifier: Apache-2.0
"""From recordings that are no bags to records and models, by the same verbs."""

from __future__ import annotations

import json
from pathlib import Path
import shlex

from bag_fixtures import START, refused, write_mcap
from bag_fixtures import flight as messages
from marks import slow
import numpy as np
import pytest
from recording_files import flight, write_ardupilot, write_csv, write_ulog

from ctsid_core.model.storage import load_estimate
from ctsid_core.settings import Settings
from ctsid_ros.cli import main
from ctsid_ros.config.channels import Channel, Config
from ctsid_ros.config.parameter_file import read_config
from ctsid_ros.decoding.field_path import parse_field
from ctsid_ros.recordings.bag import open_bag
from ctsid_ros.recordings.grouping import recordings
from ctsid_ros.recordings.playback import read_record
from ctsid_ros.recordings.recording import Times, successors

SECONDS = 6.0


def write(path: Path, seed: int = 0) -> Path:
    """The same experiment in each format, by its suffix."""
    t_u, u, t_y, y = data = flight(SECONDS, seed=seed)
    if path.suffix in LIBRARIES:
        pytest.importorskip(LIBRARIES[path.suffix])
    if path.suffix == '.ulg':
        return write_ulog(path, *data)
    if path.suffix == '.bin':
        return write_ardupilot(path, *data)
    if path.suffix == '.csv':
        return write_csv(path, {'tick_u': t_u * 1e3, 'cmd [N m]': u, 'tick_y': t_y * 1e3,
                                'rate.x': y})
    pyarrow = pytest.importorskip('pyarrow')
    parquet = pytest.importorskip('pyarrow.parquet')
    fill = [None] * (len(t_y) - len(t_u))
    parquet.write_table(pyarrow.table({
        't_cmd': [*t_u, *fill], 'cmd': [*u, *fill], 't_y': t_y, 'rate': [{'x': v} for v in y]}),
        path)
    return path


LIBRARIES = {'.ulg': 'pyulog', '.bin': 'pymavlink'}
CHANNELS = {  # topic and field of the command and of what it does
    '.ulg': ('vehicle_torque_setpoint', 'xyz[0]', 'vehicle_angular_velocity', 'xyz[0]'),
    '.bin': ('RCOU', 'C1', 'IMU', 'GyrX'), '.csv': ('a/tick_u', 'cmd', 'a/tick_y', 'rate.x'),
    '.parquet': ('a/t_cmd', 'cmd', 'a/t_y', 'rate.x')}

TIME = {'.csv': ['tick_u:ms', 'tick_y:ms']}  # of which neither name nor unit tells


@pytest.mark.parametrize('suffix', CHANNELS)
def test_a_record_has_the_samples_of_the_file(tmp_path, suffix):
    t_u, u, t_y, y = flight(SECONDS)
    act, acting, measure, measured = CHANNELS[suffix]
    config = Config((Channel('u', 'input', act, '', acting),
                     Channel('y', 'output', measure, '', measured)))
    with open_bag(write(tmp_path / f'a{suffix}'), TIME.get(suffix, ())) as bag:
        assert bag.notes == ()
        read = read_record(bag, config)
    assert read.complaints == ()
    shift = (read.record.epoch_ns - 10**15 * (read.record.epoch_ns > 10**14)) * 1e-9
    for signal, times, values in ((read.record.inputs[0], t_u, u),
                                  (read.record.outputs[0], t_y, y)):
        rows = np.searchsorted(times, signal.time + shift - 1e-5)
        np.testing.assert_allclose(signal.time + shift, times[rows], atol=1e-6)
        np.testing.assert_allclose(signal.values[:, 0], values[rows], rtol=1e-6)
        assert len(rows) > 0.98 * len(times)


@pytest.fixture
def ctsid(capsys, monkeypatch, tmp_path):
    """Run a command line in an empty folder; return what it prints."""
    monkeypatch.chdir(tmp_path)

    def run(*words: object) -> str:
        code = main([str(word) for word in words])
        out, err = capsys.readouterr()
        assert code == 0, err
        return out

    return run


@pytest.mark.parametrize('suffix', ['.csv', *slow('.ulg', '.bin', '.parquet')])
def test_from_file_to_report(ctsid, tmp_path, suffix):
    """As a new user does, by the lines of README.md, nothing set by hand."""
    first, second = write(tmp_path / f'a{suffix}'), write(tmp_path / f'b{suffix}', seed=1)
    time = [word for name in TIME.get(suffix, ()) for word in ('--time', name)]
    topics = {t['name'] for t in json.loads(ctsid('info', first, '--json', *time))['topics']}
    assert {CHANNELS[suffix][0], CHANNELS[suffix][2]} <= topics
    ctsid('init', first, '-o', 'params.yaml', *time)
    again = shlex.join(['ctsid', 'identify', str(first), *time, '--params', 'params.yaml'])
    assert f'#   {again}\n' in Path('params.yaml').read_text()
    params = ('--params', 'params.yaml', *time)
    assert 'Results: one/' in ctsid('identify', first, *params, '--out', 'one')
    estimate = load_estimate('one/model.json')
    assert abs(estimate.model.poles[0] + 3.0) < 5 * estimate.pole_std[0]
    assert Path('one/report.html').exists()
    # The other file is another recording of the same columns: with the same channels and model.
    both = json.loads(ctsid('identify', first, second, *params, '--out', 'two', '--json'))
    assert len(both['records']) == 2
    assert abs(load_estimate('two/model.json').model.poles[0] + 3.0) < 0.05
    assert 'b' + suffix in ctsid('simulate', 'one/model.json', second, *time)


@pytest.mark.parametrize('seed', slow(0, 1, 2, 3))
def test_a_stepped_command_of_a_table_is_held(ctsid, tmp_path, seed):
    """A motor logged row by row: taken as measured, its command came half a sample early."""
    rng, step, tau = np.random.default_rng(seed), 0.02, 0.15
    voltage = np.repeat(rng.uniform(-6, 6, 40), 40)
    speed, kept = np.zeros(len(voltage)), np.exp(-step / tau)
    for k in range(1, len(voltage)):
        speed[k] = kept * speed[k - 1] + (1 - kept) * 8 * voltage[k - 1]
    table = write_csv(tmp_path / 'motor.csv', {
        'time': step * np.arange(len(voltage)), 'voltage': voltage,
        'speed': speed + 0.05 * rng.standard_normal(len(speed))})
    ctsid('init', table, '-o', 'params.yaml')
    assert {c.name: c.hold for c in read_config(Path('params.yaml')).channels} == {
        'voltage': 'zoh', 'speed': 'smooth'}
    ctsid('identify', table, '--params', 'params.yaml', '--out', 'res')
    found = load_estimate('res/model.json')
    assert found.model.delay == (0.0,)
    assert found.model.n == 1
    assert abs(found.model.poles[0] + 1 / tau) < 3.5 * found.pole_std[0]


def test_files_with_clocks_of_their_own_are_recordings_by_their_columns(tmp_path):
    ulogs = [str(write(tmp_path / name)) for name in ('1.ulg', '2.ulg')]
    assert recordings(ulogs) == [(ulogs[0],), (ulogs[1],)]
    assert recordings(ulogs, ['vehicle_torque_setpoint']) == [(ulogs[0],), (ulogs[1],)]
    t = np.arange(10) * 0.1
    run = tmp_path / 'run'
    run.mkdir()
    write_csv(run / 'cmd.csv', {'t': t, 'u': t})
    write_csv(run / 'imu.csv', {'t': t, 'x': t, 'y': t})
    assert recordings([str(run)]) == [(str(run),)]
    write_csv(run / 'gyro.csv', {'t': t, 'x': t, 'y': t})  # again, or of another sensor?
    files = [str(run / name) for name in ('cmd.csv', 'gyro.csv', 'imu.csv')]
    assert recordings([str(run)]) == [tuple(files[:2]), (files[2],)]
    assert recordings([str(run)], ['gyro', 'imu', 'cmd']) == [(str(run),)]
    dated = [str(write_csv(tmp_path / f'{day}.csv', {'time': t + 1.7e9 + 86_400 * day, 'u': t}))
             for day in range(2)]
    assert recordings(dated) == [(dated[0],), (dated[1],)]


def test_a_folder_of_bags_has_no_tables(tmp_path):
    """Those beside bags are results of them, such as estimates.csv."""
    (tmp_path / 'monday').mkdir()
    write_mcap(tmp_path / 'monday' / 'a.mcap', messages())
    for folder in (tmp_path, tmp_path / 'monday'):
        write_csv(folder / 'estimates.csv', {'t': [0, 1], 'u': [0, 1]})
    assert 'there are bags in its subfolders monday' in refused(tmp_path)
    with open_bag(tmp_path / 'monday') as bag:
        assert 'estimates' not in bag.topics
        assert bag.notes == ()


def test_a_table_beside_a_bag(tmp_path):
    """Given by name it is read with it, by its dates."""
    bag_file = write_mcap(tmp_path / 'a.mcap', messages())
    table = write_csv(tmp_path / 'load.csv', {'stamp': START + np.arange(20) * 10**7,
                                              'force': np.arange(20)})
    with open_bag([bag_file, table]) as bag:
        assert {'load', '/imu'} <= set(bag.topics)
        times = np.concatenate([block.log_ns for block in bag.blocks({'load': [], '/imu': []})])
    assert (np.diff(times) >= 0).all()
    assert len(times) == 20 + 40


def parts_of_a_table(tmp_path: Path, count: int = 11) -> list[str]:
    """A flight that its logger has split into tables, part1.csv to part11.csv."""
    t_u, u, t_y, y = flight(SECONDS)
    edges = np.linspace(t_u[0], t_y[-1] + 0.01, count + 1)
    files = []
    for i, (start, end) in enumerate(zip(edges[:-1], edges[1:], strict=True), 1):
        a, b = ((t >= start) & (t < end) for t in (t_u, t_y))
        files.append(write_csv(tmp_path / f'part{i}.csv', {
            't_cmd': t_u[a], 'cmd': u[a], 't_imu': t_y[b], 'rate.x': y[b]}))
    return [str(file) for file in files]


def test_parts_of_a_table_are_one_recording(ctsid, tmp_path):
    """Each continues the times of the one before, in whatever order they are given."""
    t_u, u, t_y, y = flight(SECONDS)
    files = sorted(parts_of_a_table(tmp_path))
    assert files[1].endswith('part10.csv')
    (group,) = recordings(files)
    assert sorted(group) == files
    with open_bag(files) as bag:
        assert {n: t.count for n, t in bag.topics.items()} == {
            'part1/t_cmd': len(u), 'part1/t_imu': len(y)}
        found = np.concatenate([block.columns[0].values[:, 0] for block in bag.blocks(
            {'part1/t_imu': [parse_field('rate.x')]})])
    np.testing.assert_allclose(found, y)
    ctsid('init', *files, '-o', 'p.yaml')
    said = json.loads(ctsid('identify', *files, '--params', 'p.yaml', '--out', 'one', '--json'))
    assert 'records' not in said
    assert abs(load_estimate('one/model.json').model.poles[0] + 3.0) < 0.1
    # Those that begin anew are others.
    again = [str(write_csv(tmp_path / f'{name}.csv', {'t': np.arange(50) * 0.1, 'u': np.ones(50)}))
             for name in 'ab']
    assert recordings(again) == [(again[0],), (again[1],)]


def run_in_parts(tmp_path: Path, name: str, edges: tuple[float, ...]) -> list[str]:
    """A run of one clock, split at these times; between parts is one interval."""
    files = []
    for i, (start, end) in enumerate(zip(edges[:-1], edges[1:], strict=True), 1):
        t = np.arange(start, end, 0.1)
        files.append(str(write_csv(tmp_path / f'{name}_part{i}.csv', {'t': t, 'u': np.sin(t)})))
    return files


def test_parts_of_two_runs_are_not_mixed_up(tmp_path):
    """Two runs split at the same time: no time tells which part continues which."""
    one, two = (run_in_parts(tmp_path, name, (0.0, 10.0, 20.0)) for name in ('one', 'two'))
    said = []
    assert recordings([*one, *two], note=said.append) == [(file,) for file in (*one, *two)]
    assert len(said) == 1
    assert all(file in said[0] for file in (*one, *two))
    with open_bag([*one, *two]) as bag:
        assert sorted(bag.topics) == ['one_part1', 'one_part2', 'two_part1', 'two_part2']
    # Where times differ by more than a logger's gap, they tell.
    late = run_in_parts(tmp_path, 'late', (0.0, 14.0, 28.0))
    assert recordings([*one, *late]) == [tuple(one), tuple(late)]


@pytest.mark.parametrize('edges', [(0.0, 10.0), (10.0, 20.0)])
def test_no_file_is_in_two_recordings(tmp_path, edges):
    """A run in two parts, and another file that ends, or begins, where they meet."""
    one = run_in_parts(tmp_path, 'one', (0.0, 10.0, 20.0))
    (other,) = run_in_parts(tmp_path, 'other', edges)
    given = [one[1], one[0], other]
    found = [file for group in recordings(given) for file in group]
    assert sorted(found) == sorted(given)


def test_a_table_with_one_more_column_or_another_unit_is_a_recording_of_its_own(tmp_path):
    """Beside `mon.csv` it was not read, without a word."""
    t = np.arange(50) * 0.01
    own = {'mon': {'volt [V]': t, 'speed [rad/s]': t}, 'tue': {'volt [V]': t, 'speed [rpm]': t},
           'wed': {'volt [V]': t, 'speed [rad/s]': t, 'battery': t},
           'gps': {'speed': t, 'east': t}}
    files = [str(write_csv(tmp_path / f'{name}.csv', {'t': t, **columns}))
             for name, columns in own.items()]
    assert recordings(files[:3]) == [(file,) for file in files[:3]]
    assert recordings([files[0], files[3]]) == [(files[0], files[3])]
    config = Config((Channel('u', 'input', 'mon', '', 'volt'),
                     Channel('y', 'output', 'mon', '', 'speed')), Settings())
    with open_bag([files[0], files[3]]) as bag:
        read_record(bag, config)
        assert bag.notes == ('table gps is not used, for no channel is of it',)


def test_only_tables_are_split(tmp_path):
    """A logger of an autopilot that begins again has begun another recording."""
    pytest.importorskip('pyulog')
    t_u, u, t_y, y = flight(SECONDS)
    given = [str(write_ulog(tmp_path / f'{k}.ulg', t_u + k * SECONDS, u, t_y + k * SECONDS, y))
             for k in range(2)]
    spans = []
    for file in given:
        with open_bag([file]) as bag:
            spans.append((bag.start_ns, bag.end_ns))
    assert 0 < spans[1][0] - spans[0][1] < 10**9
    assert recordings(given) == [(given[0],), (given[1],)]


def test_tables_continue_each_other_only_where_no_other_could():
    a, b, c = (Times(columns, k * 10**10, (k + 1) * 10**10 - 1)
               for k, columns in enumerate(('u', 'u', 'u')))
    assert successors([c, a, b]) == ({1: 2, 2: 0}, ())
    assert successors([a, b, a]) == ({}, (0, 1, 2))
    assert successors([a, b, b, c]) == ({}, (0, 1, 2, 3))
    other = b._replace(columns='v')
    assert successors([a, b, other]) == ({0: 1}, ())
    none = Times((), 0, 10**10)
    assert successors([none, none._replace(start_ns=10**10, end_ns=2 * 10**10)]) == ({}, ())
    short = [Times('u', k * 10**8, (k + 1) * 10**8 - 1) for k in range(5)]     # all are near
    assert successors(short) == ({0: 1, 1: 2, 2: 3, 3: 4}, ())
    instant = Times('u', 5, 5)
    assert successors([instant, instant]) == ({}, ())       # neither is behind the other


def test_a_folder_whose_only_bag_is_in_a_subfolder(ctsid, tmp_path):
    outer = tmp_path / 'monday'
    (outer / 'flight').mkdir(parents=True)
    (outer / 'notes').mkdir()
    write(outer / 'flight' / 'a.csv')
    named = str(outer / 'flight' / 'a.csv')
    time = [word for name in TIME['.csv'] for word in ('--time', name)]
    ctsid('init', named, '-o', 'p.yaml', *time)
    assert 'a/tick_u' in ctsid('info', outer, *time)
    assert 'Results: one/' in ctsid('identify', outer, '--params', 'p.yaml', '--out', 'one', *time)
