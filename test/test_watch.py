# SPDX-License-Identifier: Apache-2.0
"""`ctsid watch` beside a real node, and what it says where there is none."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
import io
import os
import re
import signal
import subprocess
import sys
from threading import Thread

from flights import TRUTH
import numpy as np
import pytest

from ctsid_core.model.estimate import Estimate, Status
from ctsid_core.model.verdict import Grade, Verdict
from ctsid_core.settings import Settings
from ctsid_ros.cli import main
from ctsid_ros.messages.health import Health, Level
from ctsid_ros.report.watching import Watched, picture

GOOD = Estimate(status=Status.OK, settings=Settings(), model=TRUTH, fit=np.array([95.0]),
                held_out_fit=np.array([93.0]), verdict=Verdict(grade=Grade.GOOD, reason='Good.'))


def told(pole: complex, std: float = 0.01, **more) -> dict:
    return {'modes': (1, 1), 'eigenvalues': np.array([pole, np.conj(pole)]),
            'eigenvalue_std': np.array([std, std]), 'fresh_fit': np.array([91.25]), **more}


def test_arrows_say_where_a_mode_went():
    watched = Watched('/identifier')
    arrows = []
    for pole in (-1 + 3j, -1 + 3.001j, -1 + 3.2j, -1 + 2.5j):
        watched.model(GOOD, told(pole, window=len(arrows) + 1))
        arrows.append(watched.modes[0].arrow)
    assert arrows == ['new', '→', '↑', '↓']
    watched.model(replace(GOOD, model=None, rejected_model=TRUTH), {'window': 5})
    assert [g.name[0] for g in watched.strip] == list('GGGGR')
    assert watched.modes == ()
    watched.model(GOOD, told(-1 + 2.5j, window=6))
    assert watched.modes[0].arrow == '→'        # since the last window that had a model
    assert watched.line().startswith(
        'window 6: GOOD, fit 95.0 %, on new data 91.2 %, poles -1.00 ± 2.50j →')


def test_a_picture_has_numbers_for_people():
    rich = pytest.importorskip('rich.console')
    watched = Watched('/identifier')
    watched.diagnostics([
        Health('/identifier: ingest', Level.OK, 'messages come in', {
            '/imu rate [1/s]': '199.98437', '/imu messages': '412', '/imu lost': '0',
            '/imu age [s]': '0.021374225', 'window filled [%]': '40.0'}),
        Health('/identifier: identification', Level.OK, 'good', {
            'budget [s]': '1.6000000000000001', 'computing time [s]': '0.13982', 'windows': '3',
            'latency [s]': '0.2049', 'window under way': '4', 'under way for [s]': '0.0612'})],
        0.0)
    watched.model(GOOD, told(-1 + 3j, window=3) | {'modes': (4, 5)})
    console = rich.Console(width=120, record=True, file=io.StringIO())
    console.print(picture(watched, 0.0, 1e-9 * GOOD.end_ns + 7.2))
    text = console.export_text()
    assert re.search(r'/imu +200\.0 +412 +0 +0\.02\n', re.sub(' +\n', '\n', text))
    assert '0.14 s of 1.60 s   published 0.20 s after' in text
    assert 'window 4 under way for 0.06 s' in text
    assert 'window 3, which ended 7 s ago' in text
    console.print(picture(watched, 0.0, 1.7e9))     # of another clock
    assert 's ago' not in console.export_text()
    assert re.search(r'mode +pole \[rad/s\].*\n.*\n *4, 5 +-1\.000 ± 3\.000j', text)
    assert 'age [s]' in text            # no markup


def test_nodes_are_told_apart():
    watched = Watched('/a')
    watched.diagnostics([Health('/b: ingest', Level.OK, 'x'), Health('cpu', Level.OK, 'x')], 1.0)
    assert not watched.answered
    assert watched.others == {'/b'}
    watched.diagnostics([Health('/a: ingest', Level.OK, 'x')], 2.0)
    assert watched.answered
    assert watched.heard == 2.0


@pytest.mark.parametrize(('missing', 'cure'), [
    ('rich', 'pip install rich'), ('rclpy', "in the folder of ctsid: pip install '.[ros]'")])
def test_what_is_not_installed_is_named_with_its_cure(missing, cure, monkeypatch, capsys):
    monkeypatch.setattr('importlib.util.find_spec', lambda name: None if name == missing else 1)
    assert main(['watch']) == 1
    assert cure in capsys.readouterr().err


@pytest.fixture
def live(tmp_path):
    pytest.importorskip('rclpy')
    from live import Live

    with Live(tmp_path) as made:
        yield made


class Screen:
    """A program on a terminal of its own, and what it has shown."""

    def __init__(self, live, *words: str) -> None:
        ours, theirs = os.openpty()
        self.process = subprocess.Popen(
            [sys.executable, '-m', 'ctsid_ros.cli', 'watch', *words], stdout=theirs,
            stderr=theirs, env=live.env | {'TERM': 'xterm', 'COLUMNS': '120', 'LINES': '60'})
        os.close(theirs)
        self._shown, self._ours = b'', ours
        self._reader = Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        with suppress(OSError):     # the end of a terminal
            while part := os.read(self._ours, 65536):
                self._shown += part
        os.close(self._ours)

    @property
    def text(self) -> str:
        return re.sub(r'\x1b\[[0-9;?]*[A-Za-z]', '', self._shown.decode(errors='replace'))

    def end(self) -> int:
        self.process.send_signal(signal.SIGINT)
        code = self.process.wait(60.0)
        self._reader.join()
        return code


@pytest.mark.slow
def test_a_running_node_is_watched_until_ctrl_c(live, capfd):
    from robot import Robot, motion, params

    node = live.identifier(params('window.stride: 2.0'))
    words = 'listening to /command (sensor_msgs/msg/JointState): input torque = effort[0]'
    live.wait(lambda: words in node.log, 'what it listens to')
    assert 'The first model is due 4.3 s after the first samples' in node.log
    screen = Screen(live)
    robot = Robot(live, motion(7.0), node.name)
    live.wait(lambda: 'no window is full yet' in screen.text, 'the first picture')
    robot.feed(node, stride=2.0)
    live.wait(lambda: re.search(r'verdicts +GG', screen.text), 'verdicts')
    live.wait(lambda: re.search(r'computing \S+ \S+ s of 1\.60 s', screen.text), 'the budget')
    text = screen.text
    assert re.search(r'/imu +\d+(\.\d+)? +\d+ +0 ', text)       # rate, messages, lost
    assert re.search(r'window +[█░]{24} +\d+ % full', text)
    assert re.search(r'\bp +9\d\.\d +9\d\.\d +9\d\.\d', text)   # own, held out, fresh
    assert re.search(r'-0\.9\d+ ± [34]\.\d+j|-1\.0\d+ ± [34]\.\d+j', text)
    assert screen.end() == 0
    assert 'Traceback' not in screen.text
    done = subprocess.run([sys.executable, '-m', 'ctsid_ros.cli', 'watch', '--once'],
                          env=live.env, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0
    assert re.search(r'verdicts +G', done.stdout)
    assert '\x1b' not in done.stdout


@pytest.mark.slow
def test_another_node_that_runs_is_named(live):
    from robot import params

    node = live.identifier(params())
    live.wait(lambda: 'listening to' in node.log, 'what it listens to')
    absent = subprocess.run(
        [sys.executable, '-m', 'ctsid_ros.cli', 'watch', 'other', '--timeout', '10'], env=live.env,
        capture_output=True, text=True, timeout=60, check=False)
    assert absent.returncode == 1
    assert 'there is /identifier: give that name' in absent.stderr


def test_where_no_node_answers_it_is_said_what_to_check(live):
    done = subprocess.run([sys.executable, '-m', 'ctsid_ros.cli', 'watch', '--timeout', '0.5'],
                          env=live.env, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout) == (1, '')
    assert f'answers as /identifier in ROS domain {live.domain}' in done.stderr
    assert 'ros2 node list' in done.stderr
