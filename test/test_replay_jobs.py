# SPDX-License-Identifier: Apache-2.0
"""Windows identified by several processes: the same results, whatever becomes of the processes."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
import multiprocessing
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from flights import PARAMS, write_flight, write_params
import numpy as np
import pytest
import yaml

from ctsid_core.model.storage import load_series, to_json
from ctsid_ros.config.parameter_file import parse_config
from ctsid_ros.recordings.bag import open_bag
from ctsid_ros.recordings.playback import Interval
from ctsid_ros.replay import ahead, replay
from ctsid_ros.replay.replay import Replay

ROOT = Path(__file__).resolve().parent.parent
CONFIG = parse_config(yaml.safe_load(PARAMS))
PATIENCE = 120.0  # [s] for a process, on a machine that has much else to do


@pytest.fixture(scope='module')
def path(tmp_path_factory) -> str:
    return write_flight(tmp_path_factory.mktemp('flight') / 'bag')


@pytest.fixture(scope='module')
def alone(path) -> Replay:
    with open_bag(path) as bag:
        run = Replay(bag, CONFIG)
        run.run()
    return run


@pytest.fixture
def eager(monkeypatch) -> None:
    """Start processes for the second window, however short the work is."""
    monkeypatch.setattr(ahead, '_WORTH', 0.0)


def same(run: Replay, other: Replay) -> None:
    assert len(run.results) == len(other.results)
    for one, two in zip(run.results, other.results, strict=True):
        assert to_json(one.estimate) == to_json(two.estimate)
        assert (one.tracked.realisation, one.tracked.modes) == (
            two.tracked.realisation, two.tracked.modes)
        for name in ('eigenvalues', 'eigenvalue_std', 'fresh_fit'):
            assert getattr(one.tracked, name).tobytes() == getattr(two.tracked, name).tobytes()
        assert one.next_fit.tobytes() == two.next_fit.tobytes()
    assert run.best == other.best


@pytest.mark.usefixtures('eager')
def test_two_processes_give_the_bits_of_one(path, alone):
    seen = set()
    with open_bag(path) as bag:
        run = Replay(bag, CONFIG, jobs=2)
        run.run(lambda *_: seen.update(p.pid for p in multiprocessing.active_children()))
    assert len(seen) == 2
    assert multiprocessing.active_children() == []
    same(run, alone)
    assert run.played.complaints == ()


@pytest.mark.usefixtures('eager')
def test_windows_of_a_killed_process_are_done_again(path, alone):
    def kill(*_: object) -> None:
        for process in multiprocessing.active_children():
            process.kill()

    with open_bag(path) as bag:
        run = Replay(bag, CONFIG, jobs=2)
        run.run(kill)
    same(run, alone)
    assert run.played.complaints == (ahead.KILLED,)


@pytest.mark.usefixtures('eager')
def test_ctrl_c_ends_the_processes_and_keeps_what_is_joined(path):
    """Of 31 windows: no more are at work, or done and not joined, than are read ahead."""
    config = replace(CONFIG, settings=CONFIG.settings.replace(window_stride=0.5))

    def interrupted(jobs, after):
        def press(*_: object) -> None:
            if len(run.results) == after:
                raise KeyboardInterrupt

        with open_bag(path) as bag:
            run = Replay(bag, config, jobs=jobs)
            with pytest.raises(KeyboardInterrupt):
                run.run(press)
        return run.results

    found = interrupted(2, 3)
    assert multiprocessing.active_children() == []
    assert 3 <= len(found) <= 3 + 2 * ahead._AHEAD + 1
    for one, two in zip(found, interrupted(1, len(found)), strict=True):
        assert to_json(one.estimate) == to_json(two.estimate)


def test_processes_are_not_started_where_they_do_not_pay(path, alone, monkeypatch):
    monkeypatch.setattr(ahead, '_WORTH', 60.0)  # on a machine that has much else to do
    children: list[list[object]] = []
    with open_bag(path) as bag:
        run = Replay(bag, CONFIG, jobs=2)
        run.run(lambda *_: children.append(multiprocessing.active_children()))
    assert children
    assert not any(children)
    same(run, alone)


def test_the_record_of_the_best_window_is_kept_and_not_read_again(path, monkeypatch):
    """Whichever window is the best at any time; and few others are."""
    bests = set()

    def look(*_: object) -> None:
        if run.results:
            number = len(run.results) - 1 if run.best is None else run.best
            bests.add(number)
            record = run.record(number)
            start_ns = record.epoch_ns + round(record.start * 1e9)
            assert start_ns == run.results[number].estimate.start_ns

    monkeypatch.setattr(replay, 'islice', None)  # with which windows are read again
    config = replace(CONFIG, settings=CONFIG.settings.replace(
        window_length=1.0, window_stride=0.5, delay='auto'))
    with open_bag(path) as bag:
        run = Replay(bag, config, Interval(0.0, 6.0))
        run.run(look)
        assert len(bests) > 1
        assert len(run.results) == 10
        kept = []
        for number in range(len(run.results)):
            with suppress(TypeError):
                kept.append(run.record(number))
        orders = {r.estimate.model.n for r in run.results if r.estimate.model}
        assert 1 <= len(kept) <= len(orders) + 3  # those that wait for a test are two, and a last


def running(group: int) -> list[int]:
    """Return the processes of a group."""
    found = []
    for stat in Path('/proc').glob('[0-9]*/stat'):
        with suppress(OSError):
            words = stat.read_text().rpartition(')')[2].split()
            if int(words[2]) == group and words[0] != 'Z':
                found.append(int(stat.parent.name))
    return found


@pytest.mark.slow
@pytest.mark.parametrize('ending', [signal.SIGINT, signal.SIGKILL])
def test_no_process_is_left_when_the_command_is_ended(path, tmp_path, ending):
    params = write_params(tmp_path / 'p.yaml', PARAMS.replace('stride: 2.5', 'stride: 0.02')
                          .replace('order: 2', 'order: 0'))
    process = subprocess.Popen(
        [sys.executable, '-m', 'ctsid_ros.cli', 'replay', path, '--params', params, '--jobs', '2',
         '--out', tmp_path / 'res'], cwd=tmp_path, text=True, start_new_session=True,
        env=os.environ | {'PYTHONPATH': str(ROOT), 'PYTHONUNBUFFERED': '1'},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))
    deadline = time.monotonic() + PATIENCE
    while len(running(process.pid)) < 4 and time.monotonic() < deadline:  # a server, two workers
        time.sleep(0.1)
    assert process.poll() is None
    time.sleep(1.0)
    if ending == signal.SIGINT:
        os.killpg(process.pid, ending)
    else:
        process.kill()
    _, err = process.communicate(timeout=PATIENCE)
    assert 'Traceback' not in err
    if ending == signal.SIGINT:
        assert process.returncode == 130
        assert 'the results are those of the first' in err
        assert np.all(np.diff([e.start_ns for e in load_series(
            tmp_path / 'res/estimates.npz')]) > 0)
    while running(process.pid) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert running(process.pid) == []
