# SPDX-License-Identifier: Apache-2.0
"""The running node under load: messages while it identifies, publishers that die, long runs."""

import os
from pathlib import Path
import signal
import time

from marks import slow
import numpy as np
import pytest

pytest.importorskip('rclpy')
from live import Live  # noqa: E402
from robot import params  # noqa: E402

from ctsid_ros.messages import Health  # noqa: E402

SENDER = Path(__file__).with_name('sender.py')


@pytest.fixture
def live(tmp_path):
    with Live(tmp_path) as made:
        yield made


def all_sent(live, program, node) -> Health:
    """Return what the node says of its ingest once it has all that a sender has sent."""
    live.wait(lambda: program.log.endswith('\n'), 'the sender')
    imu, command = program.log.split('sent ')[1].split()
    said = node.wait_health('ingest', lambda h: (
        h.values['/imu messages'], h.values['/command messages']) == (imu, command),
        f'{imu} and {command} messages')
    # Every message is a sample at once; late is one that the middleware had to send again.
    taken = {name: sum(int(said.values.get(f'{name} {what}', 0)) for what in ('samples', 'late'))
             for name in ('p', 'torque')}
    assert taken == {'p': int(imu), 'torque': int(command)}, said
    assert (said.values['/imu lost'], said.values['/command lost']) == ('0', '0')
    return said


@pytest.mark.parametrize(('imu', 'command', 'least'), [
    (1500, 600, 5_000), *slow((4000, 1500, 13_000))])
def test_nothing_is_lost_while_identification_takes_longer_than_the_stride(
        live, imu, command, least):
    stride = 0.02
    node = live.identifier(params(f'order: 0\nhermite.nmax: 1600\nwindow.stride: {stride}\n'
                                  'ingest.timeout: 60.0', length=1.0, max_delay=0.5))
    values = all_sent(live, live.start(SENDER, imu, command, 2.5), node).values
    assert int(values['/imu messages']) + int(values['/command messages']) >= least
    # A window may become due after its last message has come.
    said = node.wait_health('identification', lambda h: 'window' in h.values and node.metadata()
                            and h.values['windows'] == node.health('ingest')[-1].values['windows']
                            == h.values['window'] == str(node.metadata()[-1]['window']),
                            'a model of the last window')
    skipped, windows = (int(said.values[key]) for key in ('skipped windows', 'windows'))
    assert windows > 15
    assert 0 < skipped < windows - 1
    # A topic with a history of one need not deliver a model that a newer one has replaced: on a
    # busy machine this process may see the last one only.
    assert 1 <= len(node.models) <= windows - skipped
    assert said.values['faults'] == node.health('ingest')[-1].values['resets'] == '0'
    computing = [data['computing_seconds'] for data in node.metadata()]
    assert np.median(computing) > stride
    numbers = [data['window'] for data in node.metadata()]
    assert numbers == sorted(set(numbers))


@pytest.mark.slow
def test_a_publisher_dies_and_returns(live):
    node = live.identifier(params('ingest.reliability: best_effort\ningest.timeout: 0.5',
                                  length=1.5))
    first = live.start(SENDER, 200, 50, 60)
    node.wait_models(1)
    os.kill(first.process.pid, signal.SIGKILL)
    first.process.wait()
    died_ns = time.time_ns()
    said = node.wait_health('ingest', lambda h: 'silent' in h.message, 'silence')
    assert '/imu has been silent for' in said.message
    assert '/command has been silent for' in said.message
    live.start(SENDER, 200, 50, 60)
    live.wait(lambda: any(e.ok and e.start_ns > died_ns for e in node.estimates()),
              'a model of data from after the return')
    said = node.wait_health('ingest', lambda h: 'silent' not in h.message, 'both topics')
    assert (said.values['/imu lost'], said.values['/command lost']) == ('0', '0')
    assert said.values['resets'] == '0'


@pytest.mark.slow
def test_ten_minutes_leave_no_trace(live):
    node = live.identifier(params('ingest.timeout: 60.0', length=10.0))
    sender = live.start(SENDER, 1000, 500, 600)
    node.wait_models(1)
    memory, threads = [], []
    for _ in range(60):
        if 'sent' in sender.log:
            break
        time.sleep(10.0)
        memory.append(node.program.memory())
        threads.append(node.program.threads())
        del node.models[:-1]
    all_sent(live, sender, node)
    assert node.health('identification')[-1].values['faults'] == '0'
    assert int(node.health('identification')[-1].values['windows']) >= 585
    print('resident memory [MB]:', [round(m / 1e6, 1) for m in memory], 'threads:', threads)
    assert max(memory[6:]) < 1.02 * max(memory[:6])
    assert max(threads[6:]) <= max(threads[:6])
