# SPDX-License-Identifier: Apache-2.0
"""Recordings of hundreds of channels: `ctsid info` shows a page, and with --all everything."""

from __future__ import annotations

import json

import numpy as np
import pytest
from recording_files import ULogWriter, flight

from ctsid_ros.cli import main
from ctsid_ros.report.overview import PAGE, grouped


@pytest.mark.parametrize(('names', 'shown'), [
    ([], []),
    (['a'], ['a']),
    (['xyz[0]', 'xyz[1]', 'xyz[2]'], ['xyz[0:3]']),
    (['q[0]', 'q[2]', 'q[3]', 'b'], ['q[0]', 'q[2:4]', 'b']),
    (['esc[0].rpm', 'esc[0].amps', 'esc[1].rpm', 'esc[1].amps'], ['esc[0:2].{rpm,amps}']),
    (['a.x', 'a.y', 'a', 'b.z'], ['a.{x,y}', 'a', 'b.z']),
    (['a.velocity', 'a.position'], ['a.velocity', 'a.position'])])
def test_fields_that_belong_together_are_one(names, shown):
    assert grouped(names) == shown


@pytest.fixture(scope='module')
def log(tmp_path_factory):
    """An autopilot's log: an experiment among 70 topics of bookkeeping."""
    pytest.importorskip('pyulog')
    rng = np.random.default_rng(1)
    t_u, u, t_y, y = flight(20.0)
    writer = ULogWriter()
    writer.format('vehicle_torque_setpoint', 'uint64_t timestamp;float[3] xyz;')
    writer.format('vehicle_angular_velocity', 'uint64_t timestamp;float[3] xyz;')
    torque, rate = (writer.subscribe(name) for name in
                    ('vehicle_torque_setpoint', 'vehicle_angular_velocity'))
    for number, t, v in ((torque, t_u, u), (rate, t_y, y)):
        for at, value in zip(np.round(t * 1e6).astype(int), v, strict=True):
            writer.data(number, int(at), np.array([value, 0, 0], np.float32).tobytes())
    for k in range(70):
        writer.format(f'aa_status_{k}', 'uint64_t timestamp;float[12] level;uint8_t[20] state;')
        number = writer.subscribe(f'aa_status_{k}')
        for at in np.arange(t_u[0], t_u[-1], 0.4 if k % 2 else 4.0) * 1e6:
            writer.data(number, int(at), rng.standard_normal(12).astype(np.float32).tobytes(),
                        bytes(20))
    path = tmp_path_factory.mktemp('many') / 'log.ulg'
    path.write_bytes(writer.bytes())
    return str(path)


def test_info_of_hundreds_of_fields_fits_on_a_page(log, capsys):
    assert main(['info', log]) == 0
    page = capsys.readouterr().out
    rows = [line.split() for line in page.splitlines() if line]
    assert len(page.splitlines()) <= PAGE
    # What is offered comes first, with all that is known of a signal in its line.
    assert [(row[0], row[-1]) for row in rows[3:5]] == [
        ('vehicle_torque_setpoint', 'xyz[0]'), ('vehicle_angular_velocity', 'xyz[0]')]
    assert any(row[0] == 'aa_status_1' and row[-1] == 'level[0:12]' for row in rows)
    assert '35 topics move, but have few messages: ' in page
    assert '12 further topics move' in page
    assert '--all' in page
    assert 'Next: ctsid init' in page


@pytest.mark.slow
def test_all_of_it_is_behind_all_and_json(log, capsys):
    assert main(['info', log, '--all']) == 0
    page = capsys.readouterr().out
    assert sum(line.strip().startswith('aa_status_69') for line in page.splitlines()) == 14
    assert 'more fields move' not in page
    assert main(['info', log, '--json']) == 0
    topics = json.loads(capsys.readouterr().out)['topics']
    assert len(topics) == 72
    assert sum(len(topic['fields']) for topic in topics) == 6 + 70 * 32
