# SPDX-License-Identifier: Apache-2.0
"""Many bags on a cluster: every bag has its rows once, whatever becomes of processes and disk."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
import csv
from dataclasses import replace
import json
import logging
import math
import os
from pathlib import Path
import re
import resource
import shutil
import signal
import subprocess
import sys
import time

from bag_fixtures import write_mcap
from flights import PARAMS, TRUTH, flight, write_flight, write_params
import numpy as np
import pytest
from test_page import Tags
from test_window_headline import STUCK, hung
import yaml

from ctsid_ros.batch.bags import find_bags, vehicle
from ctsid_ros.batch.outliers import Numbers, outliers
from ctsid_ros.batch.store import ROWS, Store
from ctsid_ros.batch.summary import GRADES, Flight, batch_headline, sections
from ctsid_ros.batch.task import Recipe, Task, perform
from ctsid_ros.batch.task import _rows as task_rows
from ctsid_ros.cli import main
from ctsid_ros.config.parameter_file import parse_config
from ctsid_ros.errors import BagError
from ctsid_ros.recordings.bag import open_bag
from ctsid_ros.replay.replay import Replay
from ctsid_ros.report import interactive, static
from ctsid_ros.report.document import Headline
from ctsid_ros.report.tables import percent

dask = pytest.importorskip('dask')
distributed = pytest.importorskip('distributed')
pq = pytest.importorskip('pyarrow.parquet')

ROOT = Path(__file__).resolve().parent.parent
PATIENCE = 600.0  # [s] for a process, on a machine that has much else to do
CONFIG = parse_config(yaml.safe_load(PARAMS))
LENGTH = 6.0      # [s] of a flight: one window, and a bit


@pytest.fixture(scope='module')
def fleet(tmp_path_factory) -> Path:
    """Three flights of two vehicles, and what is no bag; nobody writes to it."""
    folder = tmp_path_factory.mktemp('fleet')
    for vehicle_, number in (('alpha', 1), ('alpha', 2), ('beta', 3)):
        (folder / vehicle_).mkdir(exist_ok=True)
        write_flight(folder / vehicle_ / f'flight{number}', flight(LENGTH, seed=number))
    (folder / 'beta/broken.mcap').write_bytes(b'no bag')
    write_params(folder / 'params.yaml')
    return folder


@pytest.fixture(scope='module')
def alone(fleet, tmp_path_factory) -> dict[str, object]:
    """What one process makes of the fleet, one bag after the other: rows by file."""
    folder = tmp_path_factory.mktemp('alone') / ROWS
    recipe = Recipe.of(CONFIG)
    for bag in find_bags([str(fleet)]):
        perform(Task(bag, str(folder), recipe))
    return tables(folder.parent)


@pytest.fixture(scope='module')
def address() -> Iterator[str]:
    """A cluster of threads of this process: no more than the tests need of one."""
    with distributed.LocalCluster(
            n_workers=1, threads_per_worker=2, processes=False, dashboard_address='127.0.0.1:0',
            silence_logs=logging.CRITICAL) as cluster:
        yield cluster.scheduler_address


@pytest.fixture
def batch(capsys, fleet, address, tmp_path):
    """Run the verb on the fleet; return code, stdout, stderr."""
    def run(*words: object, bags: object = fleet, out: Path | None = None) -> tuple[int, str, str]:
        capsys.readouterr()
        code = main([str(word) for word in (
            'batch', bags, '--params', fleet / 'params.yaml', '--out', out or tmp_path / 'out',
            '--scheduler', address, *words)])
        out_, err = capsys.readouterr()
        assert 'Traceback' not in out_ + err
        return code, out_, err

    return run


def tables(out: Path) -> dict[str, object]:
    """The rows of each file, with the metadata."""
    return {path.name: pq.read_table(path) for path in sorted((out / ROWS).glob('*.parquet'))}


def same(some: dict[str, object], others: dict[str, object]) -> None:
    assert list(some) == list(others)
    for name, table in some.items():
        assert table.equals(others[name], check_metadata=True), name


def written(out: Path) -> dict[str, int]:
    return {path.name: path.stat().st_mtime_ns for path in (out / ROWS).iterdir()}


# --- which bags


def test_bags_are_found_in_folders_patterns_and_lists(fleet, tmp_path):
    every = [str(fleet / name) for name in (
        'alpha/flight1', 'alpha/flight2', 'beta/broken.mcap', 'beta/flight3')]
    assert sorted(find_bags([str(fleet)])) == every
    assert find_bags([str(fleet / 'alpha/flight1')]) == every[:1]
    assert find_bags([str(fleet / 'alpha/*')]) == every[:2]
    assert sorted(find_bags([str(fleet / '**/*.mcap')])) == every
    listed = tmp_path / 'all.txt'
    listed.write_text(f'# two days\n{fleet}/alpha/*\n\n{fleet}/alpha\n/none.mcap\n')
    assert find_bags([str(listed)]) == [*every[:2], '/none.mcap']
    with pytest.raises(BagError, match='there is no bag'):
        find_bags([str(tmp_path / '*.mcap')])


def test_links_are_followed_and_may_lead_back(fleet, tmp_path):
    (tmp_path / 'one').symlink_to(fleet / 'alpha/flight1')
    (tmp_path / 'day').mkdir()
    (tmp_path / 'day/beta').symlink_to(fleet / 'beta')
    (tmp_path / 'day/round').symlink_to(tmp_path)
    assert sorted(find_bags([str(tmp_path)])) == [str(fleet / name) for name in (
        'alpha/flight1', 'beta/broken.mcap', 'beta/flight3')]


def test_logs_and_tables_are_found_where_there_is_no_bag(tmp_path):
    tables = [tmp_path / 'a.csv', tmp_path / 'b/c.ULG']
    for path in tables:
        path.parent.mkdir(exist_ok=True)
        path.write_text('0')
    assert find_bags([str(tmp_path)]) == [str(path) for path in tables]
    (tmp_path / 'b/d.mcap').write_text('0')
    assert find_bags([str(tmp_path)]) == [str(tmp_path / 'b/d.mcap')]


def test_the_vehicle_is_the_folder_or_what_a_pattern_finds():
    bag = '/data/uav-7/2026-03-01/a.mcap'
    assert vehicle(bag) == '2026-03-01'
    assert vehicle(bag, r'/(uav-\d+)/') == 'uav-7'
    assert vehicle(bag, 'uav-.') == 'uav-7'
    assert vehicle(bag, 'ugv') == ''


# --- what is written


def test_rows_are_those_of_a_replay(alone, fleet):
    bag = fleet / 'alpha/flight1'
    with open_bag(str(bag)) as opened:
        run = Replay(opened, CONFIG)
        run.run()
        start_ns = opened.start_ns
    (table,) = (t for name, t in alone.items() if name.startswith('flight1-'))
    times = {name: table[name].cast('int64').to_pylist() for name in ('recorded', 'start', 'end')}
    rows = table.drop_columns(['recorded', 'start', 'end']).to_pylist()
    assert len(rows) == len(run.results) >= 1
    assert times['recorded'] == [start_ns] * len(rows)
    for number, (row, result) in enumerate(zip(rows, run.results, strict=True)):
        estimate, model = result.estimate, result.estimate.model
        assert (times['start'][number], times['end'][number]) == (
            estimate.start_ns, estimate.end_ns)
        assert (row['bag'], row['window'], row['order']) == (str(bag), number + 1, 2)
        assert (row['verdict'], row['status']) == (
            estimate.verdict.grade.name, estimate.status.name)
        assert row['best'] == (number == run.best)
        assert [complex(p['re'], p['im']) for p in row['poles']] == model.poles.tolist()
        assert [p['std'] for p in row['poles']] == estimate.pole_std.tolist()
        assert [p['damping'] for p in row['poles']] == model.damping.tolist()
        assert row['gains'] == [{
            'input': 'torque', 'output': 'rate', 'gain': model.dc_gain[0, 0],
            'gain_std': estimate.dc_gain_std[0, 0], 'rate_gain': None, 'rate_gain_std': None}]
        assert [(f['output'], f['fit']) for f in row['fits']] == [('rate', estimate.fit[0])]
        assert [d['delay'] for d in row['delays']] == list(model.delay)
        assert row['failure'] is None


def test_failures_are_rows_too(alone, fleet):
    (table,) = (t for name, t in alone.items() if name.startswith('broken-'))
    (row,) = table.to_pylist()
    assert row['bag'] == str(fleet / 'beta/broken.mcap')
    assert 'is not a bag: it looks like text' in row['failure']
    assert {row[name] for name in ('window', 'verdict', 'poles', 'recorded')} == {None}


def test_a_batch_is_the_same_as_one_bag_after_the_other(batch, alone, tmp_path):
    code, out, err = batch()
    assert code == 0
    assert re.match(r'ctsid: 4 bags to identify at \w+://\S+\nctsid: flight\d begins\n', err), err
    same(tables(tmp_path / 'out'), alone)
    assert re.search(r'alpha +2 +\d{4}-\d\d-\d\d +2 +0 +0 +0', out)
    assert re.search(r'beta +2 +\d{4}-\d\d-\d\d +1 +0 +0 +1', out)
    assert 'broken.mcap, FAILED: ' in out
    with (tmp_path / 'out/bags.csv').open() as stream:
        rows = {Path(row['bag']).name: row for row in csv.DictReader(stream)}
    assert sorted(rows) == ['broken.mcap', 'flight1', 'flight2', 'flight3']
    assert float(rows['flight3']['pole1_re [rad/s]']) == pytest.approx(
        TRUTH.poles.real[0], abs=0.2)
    gain, std = (float(rows['flight3'][f'{word}_torque_to_rate']) for word in ('gain', 'gain_std'))
    assert abs(gain - TRUTH.dc_gain[0, 0]) < 4.0 * std
    assert rows['flight3']['rate_gain_torque_to_rate [1/s]'] == ''
    assert f'{gain:.3f} ± ' in out
    assert rows['broken.mcap']['failure'] != '' == rows['flight3']['failure']
    page = (tmp_path / 'out/report.html').read_text()
    assert 'Poles by vehicle and date' in page
    assert 'broken.mcap' in page
    assert 'alpha/flight1' in (tmp_path / 'out/report.md').read_text()


@pytest.mark.slow
def test_a_sensor_that_dies_is_told_first_and_not_counted_as_accepted(batch, fleet, tmp_path):
    """The model of the window before it died is GOOD; the bag is not, in the same words."""
    ours, out = tmp_path / 'bags', tmp_path / 'out'
    shutil.copytree(fleet / 'alpha', ours / 'alpha')
    (ours / 'beta').mkdir()
    write_flight(ours / 'beta/hung', hung(flight(13.0)))
    code, text, _ = batch('--json', bags=ours)
    told = json.loads(text)
    found = {Path(b['bag']).name: b for b in told['bags']}
    assert code == 0
    assert {name: b['verdict'] for name, b in found.items()} == {
        'flight1': 'GOOD', 'flight2': 'GOOD', 'hung': 'PARTLY'}
    assert found['hung']['good'] >= 1
    assert told['verdict'] == 'PARTLY'
    said = found['hung']['reason']
    assert 'NO_RESPONSE' in said
    since = float(re.search(r'same value from (\S+) to \S+ s after the start of the bag', said)[1])
    assert since == pytest.approx(STUCK, abs=0.1)
    with (out / 'bags.csv').open() as stream:
        rows = {Path(row['bag']).name: row for row in csv.DictReader(stream)}
    assert (rows['hung']['verdict'], rows['hung']['reason']) == ('PARTLY', said)
    assert rows['hung']['fit_rate [%]'] == repr(found['hung']['fits'][0]['fit'])
    page = (out / 'report.html').read_text(encoding='utf-8')
    shown = ' '.join(' '.join(Tags(page).words).split())
    first = (out / 'report.md').read_text(encoding='utf-8').splitlines()[2]
    assert '<header class="PARTLY">' in page
    assert first.startswith('**PARTLY.** 3 bags: 2 GOOD, 1 PARTLY. beta/hung, PARTLY: ')
    assert said in shown
    assert percent(found['hung']['fits'][0]['fit']) in shown
    assert f'ctsid replay {ours}/beta/hung --params' in shown
    # What its replay says is the same.
    assert main(['replay', str(ours / 'beta/hung'), '--params', str(fleet / 'params.yaml'),
                 '--out', str(tmp_path / 'alone'), '--quiet']) == 0
    alone = ' '.join(' '.join(Tags((tmp_path / 'alone/report.html').read_text()).words).split())
    assert 'PARTLY' in alone
    assert said in alone


def test_the_word_for_all_bags_and_the_command_go_to_the_worst():
    def bag(name: str, verdict: str) -> Flight:
        good = verdict in ('GOOD', 'CHANGED', 'PARTLY')
        return Flight(f'/d/{name}', 'v', 0, dict.fromkeys(GRADES, 1), {'order': 2} if good else {},
                      verdict, f'Because {name}.', 'no bag' * (verdict == 'FAILED'))

    def first(*verdicts: str, odd: tuple[str, ...] = ()) -> Headline:
        bags = [bag(f'b{k}', v) for k, v in enumerate(verdicts)]
        return batch_headline(bags, dict.fromkeys(odd, 'far'), 'p.yaml', ['all'])

    assert (first('GOOD', 'GOOD').grade, first('GOOD').command) == (
        'GOOD', 'ctsid identify all --params p.yaml')
    assert first('REJECT', 'FAILED').grade == 'REJECT'
    mixed = first('GOOD', 'FAILED', 'PARTLY', 'CHANGED')
    assert mixed.grade == 'PARTLY'
    assert mixed.sentence.startswith(
        '4 bags: 1 GOOD, 1 FAILED, 1 PARTLY, 1 CHANGED. b3, CHANGED: Because b3. b2 (PARTLY), b1 '
        '(FAILED): see below.')
    assert mixed.command == 'ctsid replay /d/b3 --params p.yaml'
    assert first('GOOD', 'FAILED').command == 'ctsid info /d/b1'
    assert first('GOOD', 'GOOD', odd=('/d/b1',)).command == 'ctsid replay /d/b1 --params p.yaml'
    assert first('GOOD', 'GOOD', odd=('/d/b1',)).sentence.endswith(
        'Other poles or gains than most: b1.')


def drawn(*recorded_s: float, poles: bool = True):
    """The drawing of poles along time, of bags that were recorded then; the last may have none."""
    pole = dict.fromkeys(('std', 'natural_frequency_std', 'damping_std'), 0.1) | {
        're': -1.0, 'im': 2.0, 'natural_frequency': 2.2, 'damping': 0.4}
    bags = [Flight(f'/d/b{k}', 'v', round(at * 1e9), dict.fromkeys(GRADES, 1),
                   {'order': 2, 'poles': [pole]} if poles or not k else {}, 'GOOD', '', '')
            for k, at in enumerate(recorded_s)]
    section = next(s for s in sections(bags, {}) if s.title == 'Poles by vehicle and date')
    return section.parts[0].drawing


@pytest.mark.parametrize(('apart_s', 'title', 'unit'), [
    (3 * 3600, 'hours after the first bag', 3600), (1800, 'minutes after the first bag', 60),
    (5, 'seconds after the first bag', 1)])
def test_bags_of_one_day_are_drawn_over_hours_or_less(apart_s, title, unit):
    last = drawn(1.6e9, 1.6e9 + apart_s).panels[-1]
    assert last.x_label == title
    assert last.curves[0].x.max() == pytest.approx(apart_s / unit)
    assert not last.x_dates


@pytest.mark.parametrize('poles', [True, False])
def test_bags_of_several_days_are_drawn_over_dates(tmp_path, poles):
    """Also where only one of them has a model."""
    found = drawn(1.6e9, 1.6e9 + 3 * 86400, poles=poles)
    assert {panel.x_dates for panel in found.panels} == {True}
    assert 'after' not in found.panels[-1].x_label
    figure = interactive.figure(found)
    dots = [t for t in figure['data'] if t.get('hoverinfo') == 'text']
    assert dots[-1]['x'] == ['2020-09-13T12:26:40', '2020-09-16T12:26:40'][:1 + poles]
    assert figure['layout']['xaxis']['type'] == figure['layout']['xaxis2']['type'] == 'date'
    static.write_drawings(tmp_path / 'a.svg', found.panels)
    assert '2020-Sep' in (tmp_path / 'a.svg').read_text()


def test_logs_without_dates_are_drawn_one_beside_the_other():
    """Their times count from when they were switched on, and tell no order."""
    last = drawn(60.0, 40.0, 1_000_000.0).panels[-1]
    assert last.x_label == 'number of the bag in the table (not all have dates)'
    assert last.curves[0].x.tolist() == [1.0, 2.0, 3.0]
    assert Flight('/d/b', 'v', 10**15, {}, {}, 'GOOD', '', '').date == ''


def test_what_is_done_is_not_done_again(batch, fleet, tmp_path, monkeypatch):
    ours, out = tmp_path / 'bags', tmp_path / 'out'
    shutil.copytree(fleet / 'alpha', ours)
    assert batch(bags=ours)[0] == 0
    before = written(out)

    def again(*_: object) -> None:
        raise AssertionError

    with monkeypatch.context() as patch:
        patch.setattr('ctsid_ros.batch.scheduling.cluster', again)   # not even a cluster
        assert batch(bags=ours)[0] == 0
    assert written(out) == before
    with monkeypatch.context() as patch:
        patch.setattr('ctsid_ros.replay.replay.Replay', again)
        (ours / 'flight1').rename(ours / 'moved')                    # the same content elsewhere
        shutil.copytree(ours / 'flight2', ours / 'copied')
        code, text, _ = batch('--json', bags=ours)
    assert code == 0
    found = {Path(b['bag']).name: b for b in json.loads(text)['bags']}
    assert sorted(found) == ['copied', 'flight2', 'moved']
    assert found['copied']['poles'] == found['flight2']['poles']
    bags = {row['bag'] for table in tables(out).values() for row in table.select(['bag'])
            .to_pylist()}
    assert bags == {b['bag'] for b in found.values()}                # nothing of flight1 is left


@pytest.mark.slow
def test_copies_are_identified_once_and_told(batch, fleet, tmp_path, monkeypatch):
    """The same flight under two names, and as of another robot; and one as large that differs."""
    ours = tmp_path / 'bags'
    for robot in ('alpha', 'beta'):
        (ours / robot).mkdir(parents=True)
    (original,) = (fleet / 'alpha/flight1').glob('*.mcap')
    for copy in ('alpha/one', 'alpha/again', 'beta/same'):
        shutil.copy(original, ours / f'{copy}{original.suffix}')
    other = bytearray(original.read_bytes())
    other[-1] ^= 1
    (ours / f'beta/other{original.suffix}').write_bytes(other)
    identified = []
    monkeypatch.setattr('ctsid_ros.batch.task._rows', lambda task, rows=task_rows: (
        identified.append(Path(task.bag).stem), rows(task))[1])
    code, out, _ = batch('--json', bags=ours)
    assert code == 0
    found = {Path(b['bag']).stem: b for b in json.loads(out)['bags']}
    assert sorted(identified) == ['again', 'other']
    first = ours.resolve() / f'alpha/again{original.suffix}'
    assert {name: b['copy_of'] for name, b in found.items()} == {
        'again': None, 'one': str(first), 'same': str(first), 'other': None}
    assert found['one']['poles'] == found['same']['poles'] == found['again']['poles']
    with (tmp_path / 'out/bags.csv').open() as file:
        assert {row['bag']: row['copy_of'] for row in csv.DictReader(file)} == {
            b['bag']: b['copy_of'] or '' for b in found.values()}
    page = (tmp_path / 'out/report.html').read_text(encoding='utf-8')
    assert 'The same recording twice: alpha/one' in page
    assert 'Bags that are the same recording to the byte' in page


def test_a_bag_that_has_changed_is_done_again_and_its_old_rows_go(batch, fleet, tmp_path):
    ours, out = tmp_path / 'bags', tmp_path / 'out'
    shutil.copytree(fleet / 'alpha', ours)
    batch(bags=ours)
    before = written(out)
    shutil.rmtree(ours / 'flight1')
    write_flight(ours / 'flight1', flight(LENGTH, seed=8))
    assert batch(bags=ours)[0] == 0
    after = written(out)
    assert len(after) == len(before) == 2
    assert len(after.items() & before.items()) == 1


def test_other_parameters_need_another_folder(batch, fleet, tmp_path):
    one = fleet / 'alpha/flight1'
    assert batch(bags=one)[0] == 0
    before = written(tmp_path / 'out')
    code, out, err = batch('--budget', '7', bags=one)
    assert (code, out) == (1, '')
    assert 'made with other parameters or another version' in err
    assert written(tmp_path / 'out') == before
    assert batch('--budget', '7', '--force', bags=one)[0] == 0
    after = written(tmp_path / 'out')
    assert after.keys() == before.keys()
    assert not after.items() & before.items()


def test_failures_of_the_computer_are_tried_again_and_of_the_bag_on_request(batch, fleet,
                                                                           tmp_path):
    ours, out = tmp_path / 'bags', tmp_path / 'out'
    ours.mkdir()
    listed = tmp_path / 'list.txt'
    listed.write_text(f'{ours}/late.mcap\n{fleet}/beta/broken.mcap\n')
    code, text, _ = batch(bags=listed)
    assert code == 1                                   # every bag failed
    assert 'it cannot be read (No such file or directory)' in ' '.join(text.split())
    before = written(out)
    write_mcap(ours / 'late.mcap', flight(LENGTH, seed=1))
    assert batch(bags=listed)[0] == 0                  # now it is there
    after = written(out)
    assert len(after) == 2
    assert len(after.items() & before.items()) == 1    # the broken one was left alone
    assert batch('--retry', bags=listed)[0] == 0
    assert not [name for name, time_ns in written(out).items()
                if name.startswith('broken') and after[name] == time_ns]


def test_a_version_that_differs_is_refused_by_the_worker(batch, fleet, tmp_path, monkeypatch):
    monkeypatch.setattr(Recipe, 'of', classmethod(lambda cls, config: cls(config, '0.0 x', 1.0)))
    code, _, err = batch(bags=fleet / 'alpha/flight1')
    assert code == 1
    assert 'but the batch was begun with 0.0 x' in err
    assert not tables(tmp_path / 'out')


def test_what_cannot_be_is_said(capsys, fleet, tmp_path):
    params = fleet / 'params.yaml'
    for words, text in ((('--scheduler', 'tcp://127.0.0.1:9'), 'no scheduler of Dask answers'),
                        (('--vehicle', '('), 'is no regular expression')):
        with dask.config.set({'distributed.comm.timeouts.connect': '0.2s'}):
            code = main([str(w) for w in ('batch', fleet / 'alpha/flight1', '--params', params,
                                          '--out', tmp_path / 'out', *words)])
        assert (code, text in capsys.readouterr().err) == (1, True)


# --- which bags are odd


def test_outliers_are_named_and_equal_bags_are_not():
    rng = np.random.default_rng(3)

    def bag(*poles: complex) -> Numbers:
        values = np.array(poles, dtype=complex)
        noise = rng.standard_normal(len(poles)) + 1j * rng.standard_normal(len(poles)) * (
            values.imag > 0)
        return Numbers(values + 0.02 * noise, np.full(len(poles), 0.02))

    fleet_ = {f'b{k}': bag(-1.5 + 3j, -8.0) for k in range(30)}
    assert outliers(fleet_) == {}
    odd = {'slow': bag(-1.5 + 2.5j, -8.0), 'simple': bag(-1.5 + 3j), 'far': bag(-1.5 + 3j, -90.0)}
    found = outliers(fleet_ | odd)
    assert sorted(found) == sorted(odd)
    assert 'standard deviations from the median -1.' in found['slow']
    assert found['simple'] == '1 modes, but 2 in 32 of 33 bags'
    assert found['far'].startswith('no pole near -')
    assert outliers({f'b{k}': bag(-1.0 - k) for k in range(4)}) == {}    # too few to tell
    # Over its size a pole of 0 is far from any other.
    near_0 = {f'b{k}': Numbers(np.array([x, -0.7 + 0j]), np.array([0.05, 0.02]))
              for k, x in enumerate((-0.02, -0.05, 0.0, 0.06, -0.1))}
    assert outliers(near_0) == {}


def test_a_payload_shows_in_gains_where_poles_are_those_of_the_others():
    rng = np.random.default_rng(4)

    def bag(gain: float, std: float = 0.1) -> Numbers:
        return Numbers(np.array([-2.0 + 0.05 * rng.standard_normal() + 0j]), np.array([0.05]), {
            'gain of u to y': (gain + std * rng.standard_normal(), std),
            'rate gain of u to y': (math.nan, math.nan)})

    fleet_ = {f'b{k}': bag(3.0) for k in range(20)}
    assert outliers(fleet_) == {}
    found = outliers(fleet_ | {'loaded': bag(2.0), 'hardly known': bag(2.0, 1.0)})
    assert list(found) == ['loaded']
    assert found['loaded'].startswith('gain of u to y ')
    assert ' standard deviations from the median ' in found['loaded']
    # Bags that scatter by more than each says of itself are alike all the same.
    assert outliers({f'b{k}': bag(3.0 + 0.1 * k, 0.01) for k in range(12)}) == {}


# --- processes that are killed, disks that are full


def command(*words: object) -> list[str]:
    return [sys.executable, '-m', 'ctsid_ros.cli', 'batch', *map(str, words)]


def start(words: list[str], folder: Path, before=lambda: None) -> subprocess.Popen[str]:
    def prepare() -> None:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # a shell may ignore it
        before()

    return subprocess.Popen(
        words, cwd=folder, text=True, start_new_session=True, preexec_fn=prepare,
        env=os.environ | {'PYTHONPATH': str(ROOT), 'PYTHONUNBUFFERED': '1'},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def workers(group: int) -> list[int]:
    """Return the processes of a group that do tasks."""
    found = []
    for folder in Path('/proc').glob('[0-9]*'):
        with suppress(OSError):
            words = (folder / 'stat').read_text().rpartition(')')[2].split()
            line = (folder / 'cmdline').read_text()
            if int(words[2]) == group and words[0] != 'Z' and 'spawn_main' in line:
                found.append(int(folder.name))
    return found


def processor_time(pid: int) -> float:
    """Return the processor time of a process [s]; 0 if it has ended."""
    with suppress(OSError):
        words = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
        return (int(words[11]) + int(words[12])) / os.sysconf('SC_CLK_TCK')
    return 0.0


def wait_for(condition, process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.mark.slow
def test_killed_workers_and_ctrl_c_lose_nothing_and_nothing_is_done_twice(fleet, tmp_path):
    bags = tmp_path / 'bags'
    bags.mkdir()
    for k in range(24):
        write_mcap(bags / f'{k:02}.mcap', flight(LENGTH, seed=k))
    recipe, out, serial = Recipe.of(CONFIG), tmp_path / 'out', tmp_path / 'serial'
    for bag in find_bags([str(bags)]):
        perform(Task(bag, str(serial / ROWS), recipe))
    words = command(bags, '--params', fleet / 'params.yaml', '--out', out, '--jobs', 2)

    def done() -> int:
        return len(tables(out)) if (out / ROWS).exists() else 0

    process = start(words, tmp_path)
    wait_for(lambda: done() >= 4, process)
    for pid in workers(process.pid):
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    wait_for(lambda: done() >= 8, process)
    begin = time.monotonic()
    os.killpg(process.pid, signal.SIGINT)
    text, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130, err
    assert time.monotonic() - begin < 60.0
    assert 'Traceback' not in err
    assert re.search(r'interrupted: \d+ of 24 bags are done', err)
    assert workers(process.pid) == []
    first = written(out)
    assert 8 <= len(first) < 24
    process = start(words, tmp_path)
    wait_for(lambda: done() > len(first), process)
    process.kill()                                      # no time to clean up
    process.communicate(timeout=PATIENCE)
    process = start(words, tmp_path)
    text, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, err
    assert re.search(r'\d+ of 24 bags are done already', err)
    assert first.items() <= written(out).items()
    same(tables(out), tables(serial))


@pytest.mark.slow
def test_a_bag_that_no_process_lives_through_is_given_up_and_named(fleet, tmp_path, alone):
    """A worker ends itself at that bag, as the system ends what takes too much memory."""
    tries = tmp_path / 'tries'
    folder = tmp_path / 'patched'
    folder.mkdir()
    (folder / 'sitecustomize.py').write_text(f"""
import os, signal
from ctsid_ros.batch import task

rows = task._rows

def poisoned(own):
    if own.bag.endswith('flight2'):
        with open({str(tries)!r}, 'a') as file:
            file.write('x')
        os.kill(os.getpid(), signal.SIGKILL)
    return rows(own)

task._rows = poisoned
""")
    words = command(fleet, '--params', fleet / 'params.yaml', '--out', tmp_path / 'out',
                    '--jobs', 2)
    done = subprocess.run(words, env=os.environ | {'PYTHONPATH': f'{folder}:{ROOT}'}, text=True,
                          capture_output=True, check=False, timeout=PATIENCE, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert 'Traceback' not in done.stderr
    assert 'was killed 3 times' in done.stdout
    assert tries.read_text() == 'xxx'
    found = tables(tmp_path / 'out')
    (name,) = (name for name in found if name.startswith('flight2'))
    (row,) = found.pop(name).to_pylist()
    assert row['failure'].startswith('given up')
    same(found, {key: table for key, table in alone.items() if key != name})


@pytest.mark.slow
def test_a_full_disk_is_said_and_the_batch_goes_on_from_there(fleet, tmp_path, alone):
    """Files may not be larger than rows are: a failure fits, windows do not."""
    out = tmp_path / 'out'
    words = command(fleet, '--params', fleet / 'params.yaml', '--out', out, '--jobs', 1)
    process = start(words, tmp_path, lambda: resource.setrlimit(
        resource.RLIMIT_FSIZE, (8000, resource.RLIM_INFINITY)))
    text, err = process.communicate(timeout=PATIENCE)
    assert (process.returncode, text) == (1, ''), err
    assert 'Traceback' not in err
    assert re.search(r'cannot be written \(File too large\).*has room', err, re.S)
    assert 'run the same command again' in err
    assert set(tables(out)) < set(alone)
    assert not list((out / ROWS).glob('.*'))
    before = written(out)
    done = subprocess.run(words, env=os.environ | {'PYTHONPATH': str(ROOT)}, text=True,
                          capture_output=True, check=False, timeout=PATIENCE, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert before.items() <= written(out).items()
    same(tables(out), alone)


@pytest.mark.slow
def test_two_processes_share_the_work_of_many_bags(tmp_path, fleet):
    """
    By processor time, as if each process had a core of its own, for others disturb the clock.

    One process would do what both have done, but for the start of one of them. What the main
    process does before the first row and after the last is added to either.
    """
    bags, out = tmp_path / 'bags', tmp_path / 'out'
    bags.mkdir()
    for k in range(200):
        first, *rest = flight(12.0, seed=k % 5)
        other = replace(first, publish_ns=first.log_ns - k)   # another content each
        write_mcap(bags / f'{k:03}.mcap', [other, *rest])
    process = start(command(bags, '--params', fleet / 'params.yaml', '--out', out, '--jobs', 2,
                            '--quiet'), tmp_path)
    busy: dict[int, float] = {}
    begun: dict[int, float] = {}
    ended = 0.0
    while process.poll() is None:
        for pid in (process.pid, *workers(process.pid)):
            busy[pid] = processor_time(pid) or busy.get(pid, 0.0)
        if not begun and (out / ROWS).exists() and any((out / ROWS).iterdir()):
            begun = dict(busy)
        if workers(process.pid):
            ended = busy[process.pid]
        time.sleep(0.05)
    text, err = process.communicate()
    assert process.returncode == 0, err
    assert len(written(out)) == 200
    main_time = busy.pop(process.pid)
    around = main_time - ended + begun[process.pid]
    alone_ = around + sum(busy.values()) - min(begun.get(pid, 0.0) for pid in busy)
    both = around + max(busy.values())
    print(f'main {main_time}, {around} of it alone, workers {busy}, at the first row {begun}: '
          f'{alone_ / both:.3f}')
    assert alone_ > 1.8 * both


def test_stores_know_what_is_done(fleet, tmp_path):
    recipe = Recipe.of(CONFIG)
    store = Store(tmp_path, recipe)
    bag = str(fleet / 'beta/broken.mcap')
    assert store.done([bag]) == {}
    name = perform(Task(bag, str(store.folder), recipe))
    assert store.done([bag]) == {bag: tmp_path / ROWS / name}
    assert Store(tmp_path, recipe, retry=True).done([bag]) == {}
