# SPDX-License-Identifier: Apache-2.0
"""Models on the topics of the running node."""

import numpy as np
import pytest

pytest.importorskip('rclpy')
from live import LATCHED, MATRICES, Live  # noqa: E402
from plants import match  # noqa: E402
from robot import EPOCH, SOFT, STIFF, Robot, S, motion, params  # noqa: E402
from std_msgs.msg import Float64MultiArray, String  # noqa: E402

from ctsid_ros.messages import (  # noqa: E402
    Level,
    decode_diagnostics,
    decode_eigenvalues,
    decode_matrix,
    decode_system_matrix,
)


@pytest.fixture
def live(tmp_path):
    with Live(tmp_path) as made:
        yield made


def assert_poles(estimate, truth, deviations=4.0):
    """Poles lie near the true ones, by their own account of how near."""
    found = match(estimate.model.poles, truth.poles)
    order = [int(np.argmin(abs(estimate.model.poles - pole))) for pole in found]
    std = estimate.pole_std[order]
    assert np.all(std < 0.1 * abs(truth.poles))
    assert np.all(abs(found - truth.poles) < deviations * std)


@pytest.fixture(scope='module')
def flight(tmp_path_factory):
    """Return a node that has seen 9.5 s of the plant, and its robot."""
    with Live(tmp_path_factory.mktemp('flight')) as live:
        node = live.identifier(params('ingest.timeout: 60.0'))
        robot = Robot(live, motion(9.5), node.name)
        robot.feed(node)
        live.wait(lambda: all(len(node.matrices[name]) == len(node.models)
                              for name in MATRICES), 'matrices')
        yield live, node, robot


def test_models_are_on_the_topics(flight):
    _, node, _ = flight
    estimates = node.wait_models(5)
    first = estimates[0].start_ns
    assert EPOCH <= first < EPOCH + S // 10
    assert [(e.start_ns, e.end_ns) for e in estimates] == [
        (first + k * S, first + (k + 4) * S) for k in range(len(estimates))]
    for estimate in estimates:
        assert_poles(estimate, SOFT)
        model = estimate.model
        assert (model.input_names, model.input_units) == (('torque',), ('N m',))
        assert (model.output_names, model.output_units) == (('p', 'q'), ('rad/s', 'rad/s'))
        assert estimate.settings.order == 2
    metadata = node.metadata()
    assert [data['window'] for data in metadata] == list(range(1, 1 + len(estimates)))
    assert all(data['node'] == '/identifier' for data in metadata)
    assert [channel['topic'] for channel in metadata[0]['channels']] == [
        '/command', '/imu', '/imu']
    assert np.isnan(metadata[0]['fresh_fit']).all()
    assert (metadata[-1]['fresh_fit'] > 90).all()


def test_matrices_are_those_of_the_model(flight):
    _, node, _ = flight
    for k, (estimate, data) in enumerate(zip(node.estimates(), node.metadata(), strict=True)):
        model = estimate.model
        whole = decode_system_matrix(node.matrices['system_matrix'][k])
        for letter in 'ABCDK':
            published = decode_matrix(node.matrices[letter.lower()][k])
            np.testing.assert_array_equal(published, getattr(model, letter), strict=True)
            np.testing.assert_array_equal(getattr(whole, letter), published, strict=True)
        modes, values = decode_eigenvalues(node.matrices['eigenvalues'][k])
        assert modes == data['modes']
        np.testing.assert_array_equal(values, data['eigenvalues'])
        np.testing.assert_allclose(match(values, model.poles), model.poles, rtol=1e-9)


def test_the_summary_has_the_stamp_of_the_window_and_the_poles_by_name(flight):
    live, node, _ = flight
    live.wait(lambda: len(node.summaries) == len(node.models), 'summaries')
    for message, estimate, data in zip(node.summaries, node.estimates(), node.metadata(),
                                       strict=True):
        stamp, statuses = decode_diagnostics(message)
        found = {status.name: status.values for status in statuses}
        assert stamp == estimate.end_ns
        assert found['verdict']['grade'] == '2'
        assert [float(found['fit'][name]) for name in ('p', 'q')] == estimate.fit.tolist()
        assert [complex(float(found[f'mode {mode}']['re']), float(found[f'mode {mode}']['im']))
                for mode in data['modes']] == data['eigenvalues'].tolist()


def test_late_joiners_get_the_last_model(flight):
    live, node, _ = flight
    late = {'model': live.listen(String, '/identifier/model', LATCHED), **{
        name: live.listen(Float64MultiArray, f'/identifier/{name}', LATCHED)
        for name in MATRICES}}
    live.wait(lambda: all(late.values()), 'the last model for a late joiner')
    assert all(len(messages) == 1 for messages in late.values())
    assert late['model'][0] == node.models[-1]
    assert all(late[name][0] == node.matrices[name][-1] for name in MATRICES)


def test_diagnostics_tell_latency_and_counts(flight):
    _, node, robot = flight
    ingest = robot.wait_taken(node)
    identification = node.next_health('identification')
    assert (ingest.level, identification.level) == (Level.OK, Level.OK), (ingest, identification)
    values = ingest.values
    assert values['/imu messages'] == values['p samples'] == str(robot.sent['imu'])
    assert values['/command messages'] == values['torque samples'] == str(robot.sent['command'])
    assert values['/imu lost'] == values['/command lost'] == '0'
    assert values['p stamps from'] == 'header'
    assert int(values['windows']) == len(node.models) == int(identification.values['windows'])
    computing = float(identification.values['computing time [s]'])
    assert 0 < computing < float(identification.values['latency [s]'])
    assert int(identification.values['window end [ns]']) == node.estimates()[-1].end_ns


@pytest.mark.slow
def test_a_changed_plant_is_seen_within_two_windows_and_what_is_rejected_says_so(live):
    node = live.identifier(params('ingest.timeout: 60.0\nwindow.stride: 2.0'))
    made = motion(16.5, phases=((0.0, SOFT), (6.5, STIFF)))
    made.u[made.t_u > 12.5] = 0.0  # a lie from here on: the input says nothing of the output
    Robot(live, made, node.name).feed(node, stride=2.0)
    estimates = node.wait_models(7)
    before = [e for e in estimates if e.end_ns <= EPOCH + 6.5 * S]
    after = [e for e in estimates
             if e.start_ns >= EPOCH + 6.5 * S and e.end_ns <= EPOCH + 12.5 * S]
    assert len(before) >= 2
    for estimate in before:
        assert_poles(estimate, SOFT)
    assert after[0].end_ns <= EPOCH + (6.5 + 2 * 4) * S
    for estimate in after:
        assert_poles(estimate, STIFF)

    assert not estimates[-1].ok
    reason = estimates[-1].verdict.reason
    said = node.wait_health('identification', lambda h: reason in h.message, 'the rejection')
    assert said.level == Level.ERROR
    assert said.message.startswith('REJECT: ')
    assert 'REJECT: ' in node.log
    accepted = [e for e in node.accepted() if e.good]
    live.wait(lambda: len(node.matrices['a']) == len(accepted), 'matrices of good models only')
    np.testing.assert_array_equal(decode_matrix(node.matrices['a'][-1]), accepted[-1].model.A)


@pytest.mark.slow
def test_two_identifiers_in_one_domain(live):
    one = live.identifier(
        params('ingest.reliability: best_effort', command='command', imu='imu'),
        '-r', '__ns:=/one', name='/one/identifier')
    other = live.identifier(params(command='command', imu='imu'), '-r', '__ns:=/two',
                            '-r', '__node:=tuner', '-r', 'imu:=/two/other', name='/two/tuner')
    robots = (Robot(live, motion(4.6), one.name, command='/one/command', imu='/one/imu'),
              Robot(live, motion(4.6, phases=((0.0, STIFF),), seed=1), other.name,
                    command='/two/command', imu='/two/other'))
    for robot, node in zip(robots, (one, other), strict=True):
        robot.feed(node)
    for node, truth in ((one, SOFT), (other, STIFF)):
        for estimate in node.wait_models(1):
            assert_poles(estimate, truth)
        assert node.metadata()[0]['node'] == node.name
        live.wait(lambda: node.health('ingest'), 'diagnostics')  # noqa: B023
