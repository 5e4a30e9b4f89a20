# SPDX-License-Identifier: Apache-2.0
"""Without packages that no ROS release has: the node works; what reads bags says why not."""

from __future__ import annotations

import os
from pathlib import Path
import subprocess
import sys

from marks import slow
import pytest

from ctsid_ros.errors import BAG_PACKAGES

ROOT = Path(__file__).resolve().parent.parent
BAG = ROOT / 'bags/quadrotor_roll'
# Before a program: these packages, and one that commands can do without, are not installed.
WITHOUT = f"""
import sys

class Absent:
    @staticmethod
    def find_spec(name, path=None, target=None):
        if name.partition('.')[0] in {(*BAG_PACKAGES, 'rich')}:
            raise ModuleNotFoundError(f'No module named {{name!r}}', name=name)

sys.meta_path.insert(0, Absent)
"""
COMMAND = WITHOUT + 'from ctsid_ros.cli import main; sys.exit(main())'
NODE = WITHOUT + 'from ctsid_ros.node import main; sys.exit(main())'


def ctsid(*words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, '-c', COMMAND, *map(str, words)], capture_output=True,
                          text=True, check=False, env=os.environ | {'PYTHONPATH': str(ROOT)})


@pytest.mark.parametrize('verb', [
    'info', 'identify', 'replay', *slow('init', 'try', 'compare', 'advise')])
def test_what_reads_bags_says_what_to_install(verb, tmp_path):
    more = ['--out', tmp_path / 'results'] if verb in ('try', 'identify', 'replay') else []
    done = ctsid(verb, BAG, *more)
    assert (done.returncode, done.stdout) == (1, '')
    assert done.stderr.startswith('ctsid: error: reading bags needs the Python package ')
    assert done.stderr.endswith(f': pip install {" ".join(BAG_PACKAGES)}\n')
    assert done.stderr.count('\n') == 1
    assert not (tmp_path / 'results').exists()


def test_what_reads_no_bag_works():
    done = ctsid('params')
    assert (done.returncode, done.stderr) == (0, '')
    done = ctsid('show', ROOT / 'bags/quadrotor_roll_truth.json')
    assert (done.returncode, done.stderr) == (0, '')


@pytest.fixture
def identifier(tmp_path):
    """Start the node without these packages, with a parameter file."""
    pytest.importorskip('rclpy')
    from live import Identifier, Live
    with Live(tmp_path) as live:
        def start(text: str) -> Identifier:
            path = tmp_path / 'params.yaml'
            path.write_text(text, encoding='utf-8')
            return Identifier(live, live.start('-c', NODE, '--ros-args', '--params-file', path),
                              '/identifier')

        yield live, start


@pytest.mark.slow
def test_the_node_says_what_recording_needs_and_identifies_without(identifier, tmp_path):
    live, start = identifier
    from robot import Robot, motion, params
    node = start(params(f"ingest.record: '{tmp_path}/flight.mcap'"))
    live.wait(lambda: 'not activated: `ingest.record` needs the Python package mcap, which is not '
              'installed here: pip install' in node.log, 'the refusal')
    assert node.state() == 'inactive'
    assert 'Traceback' not in node.log
    assert node.change_state('cleanup')
    assert node.set(ingest__record='') == ''
    assert node.change_state('configure')
    assert node.change_state('activate')
    robot = Robot(live, motion(5.0), node.name)
    robot.send(5.0)
    (model,) = node.wait_models(1)
    assert model.ok
