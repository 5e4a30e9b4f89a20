# SPDX-License-Identifier: Apache-2.0
"""The running node under load: messages while it identifies, publishers that die, long runs."""

import os
from pathlib import Path
import signal
import time

import numpy as np
import pytest

pytest.importorskip('rclpy')
from live import Live  # noqa: E402
from robot import params  # noqa: E402

SENDER = Path(__file__).with_name('sender.py')


@pytest.fixture
def live(tmp_path):
    with Live(tmp_path) as made:
        yield made


def sent_by(live, program, timeout) -> tuple[int, int]:
    """Wait until a sender has done its part; return how many messages of /imu and /command."""
    live.wait(lambda: 'sent' in program.log, 'the sender', timeout)
    imu, command = program.log.split('sent ')[1].split()[:2]
    return int(imu), int(command)


def test_nothing_is_lost_while_identification_takes_longer_than_the_stride(live):
    node = live.identifier(params('order: 0\nhermite.nmax: 1600\nwindow.stride: 0.05\n'
                                  'ingest.timeout: 60.0', length=2.0))
    imu, command = sent_by(live, live.start(SENDER, 4000, 1500, 4), 60)
    assert imu + command >= 21_000
    values = node.next_health('ingest').values
    assert (values['/imu lost'], values['/command lost']) == ('0', '0')
    assert (values['/imu messages'], values['/command messages']) == (str(imu), str(command))
    assert (values['p samples'], values['torque samples']) == (str(imu), str(command))
    said = node.health('identification')[-1]
    skipped, windows = (int(said.values[key]) for key in ('skipped windows', 'windows'))
    assert windows == int(values['windows']) > 15
    assert 0 < skipped < windows
    assert f'{skipped} windows were skipped' in said.message
    computing = [data['computing_seconds'] for data in node.metadata()]
    assert np.median(computing) > 0.05  # the stride
    live.wait(lambda: len(node.models) == windows - skipped, 'a model for every other window')
    numbers = [data['window'] for data in node.metadata()]
    assert numbers == sorted(set(numbers))


def test_a_publisher_dies_and_returns(live):
    node = live.identifier(params('window.stride: 0.25\ningest.timeout: 0.5', length=1.5))
    first = live.start(SENDER, 200, 50, 60)
    node.wait_models(3, 20.0)
    os.kill(first.process.pid, signal.SIGKILL)
    first.process.wait()
    died_ns = time.time_ns()
    said = node.wait_health('ingest', lambda h: 'silent' in h.message, 'silence')
    assert '/imu has been silent for' in said.message
    assert '/command has been silent for' in said.message
    live.start(SENDER, 200, 50, 60)
    live.wait(lambda: any(e.ok and e.start_ns > died_ns for e in node.estimates()),
              'a model of data from after the return', 20.0)
    said = node.next_health('ingest')
    assert 'silent' not in said.message
    assert (said.values['/imu lost'], said.values['/command lost']) == ('0', '0')
    assert said.values['resets'] == '0'


@pytest.mark.slow
def test_ten_minutes_leave_no_trace(live):
    node = live.identifier(params('ingest.timeout: 60.0', length=10.0))
    sender = live.start(SENDER, 1000, 500, 600)
    node.wait_models(1, 60.0)
    memory, threads = [], []
    for _ in range(60):
        if 'sent' in sender.log:
            break
        time.sleep(10.0)
        memory.append(node.program.memory())
        threads.append(node.program.threads())
        del node.models[:-1]
    imu, command = sent_by(live, sender, 120)
    values = node.next_health('ingest').values
    assert (values['/imu lost'], values['/command lost']) == ('0', '0')
    assert (values['/imu messages'], values['/command messages']) == (str(imu), str(command))
    assert node.health('identification')[-1].values['faults'] == '0'
    assert int(node.health('identification')[-1].values['windows']) >= 585
    print('resident memory [MB]:', [round(m / 1e6, 1) for m in memory], 'threads:', threads)
    assert max(memory[6:]) < 1.02 * max(memory[:6])
    assert max(threads[6:]) <= max(threads[:6])
