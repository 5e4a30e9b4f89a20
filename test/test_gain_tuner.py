# SPDX-License-Identifier: Apache-2.0
"""The tuner takes good models only, and never lets go of good gains for bad ones."""

from __future__ import annotations

from dataclasses import replace
import time

import numpy as np
import pytest

from ctsid_core.model.estimate import Estimate, Status
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.verdict import UNJUDGED, Grade, Verdict
from ctsid_core.sequence.tracking import Tracked
from ctsid_core.settings import Settings
from ctsid_ros.examples.acceptance import Limits, objection
from ctsid_ros.examples.lqr import Weights, compute_gains
from ctsid_ros.examples.quadrotor_roll import Plant

S = 10**9
TRUTH = Plant().true_model()
LIMITS = Limits(('torque',), ('rate',))
GOOD = Estimate(status=Status.OK, settings=Settings(), model=TRUTH,
                pole_std=0.01 * abs(TRUTH.poles), fit=np.array([97.0]),
                held_out_fit=np.array([95.0]),
                verdict=Verdict(grade=Grade.GOOD, reason='Every test is passed.'),
                start_ns=100 * S, end_ns=108 * S)
FRESH = np.array([93.0])


def test_good_model_meets_no_objection():
    assert objection(GOOD, FRESH, 109 * S, LIMITS) == ''
    unknown = replace(GOOD, held_out_fit=np.array([np.nan]))
    for fresh in (np.array([np.nan]), np.empty(0)):
        assert objection(unknown, fresh, 109 * S, LIMITS) == ''


@pytest.mark.parametrize(('changes', 'words'), [
    ({'status': Status.TOO_SHORT, 'model': None}, 'REJECT: The window holds too few samples'),
    ({'verdict': replace(UNJUDGED, reason='A reason.')}, 'WEAK: A reason'),
    ({'status': Status.OK, 'model': replace(TRUTH, input_names=('other',))},
     'from other to rate; wanted is from torque to rate'),
    ({'end_ns': 80 * S, 'start_ns': 72 * S}, 'ended 29.0 s ago'),
    ({'end_ns': 120 * S}, 'ended -11.0 s ago'),
    ({'pole_std': np.array([0.02, 5.0, 0.3, 0.3])}, 'deviation of 5, 25 % of its size'),
    ({'pole_std': np.array([0.02, np.nan, 0.3, 0.3])}, 'is not known'),
    ({'pole_std': np.empty(0)}, 'is not known'),
    ({'start_ns': 108 * S}, 'ends before it begins'),
    ({'start_ns': 109 * S}, 'ends before it begins'),
    ({'model': replace(TRUTH, noise=np.array([[-1e-4]]))}, 'not positive semidefinite'),
    ({'fit': np.array([65.0])}, 'fit on the window is 65 %'),
    ({'held_out_fit': np.array([-20.0])}, 'fit on data held out is -20 %'),
])
def test_what_is_objected_to(changes, words):
    assert words in objection(replace(GOOD, **changes), FRESH, 109 * S, LIMITS)


def test_noise_of_several_outputs_has_to_be_a_covariance():
    two = StateSpace(TRUTH.A, TRUTH.B, np.vstack([TRUTH.C] * 2), input_names=('torque',),
                     output_names=('a', 'b'))
    limits = replace(LIMITS, outputs=('a', 'b'))
    for noise, good in (([[1, 1], [1, 1]], True), ([[1, 0.2], [0.2, 0]], False),
                        ([[1, 0.2], [0.1, 1]], False), ([[0, 0], [0, 0]], True)):
        why = objection(replace(GOOD, model=replace(two, noise=1e-4 * np.array(noise))), FRESH,
                        109 * S, limits)
        assert (why == '') is good, why
        assert good or 'positive semidefinite' in why


def test_collapse_of_the_model_before_is_objected_to():
    assert 'did the plant change?' in objection(GOOD, np.array([-3.0]), 109 * S, LIMITS)


def test_slow_pole_is_measured_by_the_window():
    drifting = replace(TRUTH, A=TRUTH.A - TRUTH.poles[0].real * np.eye(4))
    std = np.array([0.05, 0.2, 0.3, 0.3])
    assert abs(drifting.poles[0]) < 1e-9
    assert objection(replace(GOOD, model=drifting, pole_std=std), FRESH, 109 * S, LIMITS) == ''


class Tuned:
    """A gain tuner in a domain, what it says, and who gives it models."""

    def __init__(self, live, *arguments: str) -> None:
        from live import LATCHED
        from std_msgs.msg import Float64MultiArray, String
        self.live = live
        self.verdicts = live.listen(String, '/gain_tuner/verdict')
        self.controllers = live.listen(Float64MultiArray, '/gain_tuner/controller')
        self.program = live.start('-m', 'ctsid_ros.examples.gain_tuner', '--ros-args', *arguments)
        self._models, = live.publishers({'/robot/identifier/model': String}, LATCHED,
                                        '/gain_tuner')

    def give(self, message) -> str:
        count = len(self.verdicts)
        self._models.publish(message)
        self.live.wait(lambda: len(self.verdicts) > count, 'a verdict')
        return self.verdicts[-1].data


@pytest.fixture
def live(tmp_path):
    pytest.importorskip('rclpy')
    from live import Live
    with Live(tmp_path) as domain:
        yield domain


def encoded(estimate: Estimate, fresh: float = 93.0):
    from ctsid_ros.messages import encode_model
    now_ns = time.time_ns()
    return encode_model(Tracked(replace(estimate, start_ns=now_ns - 8 * S, end_ns=now_ns),
                                fresh_fit=np.array([fresh])), {'window': 7})


def test_node_tunes_by_good_models_and_keeps_the_gains_through_bad_ones(live):
    from std_msgs.msg import Float64MultiArray, String

    from ctsid_ros.messages import decode_matrix, decode_system_matrix
    tuned = Tuned(live, '-r', 'identifier/model:=robot/identifier/model')
    assert 'Refused: this message is not a model' in tuned.give(String(data='{'))
    assert tuned.give(encoded(GOOD)).startswith('Window 7: Accepted: disc margin 1.7')
    live.wait(lambda: tuned.controllers, 'a controller')
    for bad, words in (
            (encoded(replace(GOOD, status=Status.NO_EXCITATION, model=None)),
             'REJECT: No input moves'),
            (encoded(replace(GOOD, verdict=UNJUDGED)), 'WEAK: Nobody has judged'),
            (encoded(GOOD, fresh=10.0), 'did the plant change?'),
            (encoded(replace(GOOD, pole_std=0.03 * abs(TRUTH.poles))), 'disc margin of 0.00'),
            (String(data='nonsense'), 'not a model')):
        assert words in tuned.give(bad)
    late = {name: live.listen(Float64MultiArray, f'/gain_tuner/{name}')
            for name in ('controller', 'feedback', 'observer')}
    live.wait(lambda: all(late.values()), 'the gains, for one who comes late')
    assert len(tuned.controllers) == 1

    wanted = compute_gains(TRUTH, Weights((1.0,), (0.1,)))
    np.testing.assert_allclose(decode_matrix(late['feedback'][0]), wanted.feedback)
    np.testing.assert_allclose(decode_matrix(late['observer'][0]), wanted.observer)
    controller = decode_system_matrix(late['controller'][0])
    closed = np.block([[TRUTH.A, TRUTH.B @ controller.C], [controller.B @ TRUTH.C, controller.A]])
    assert np.linalg.eigvals(closed).real.max() < -1.0
    code, seconds = tuned.program.end()
    assert code == 0
    assert seconds < 3.0


@pytest.mark.slow
def test_parameters_that_do_not_fit_are_said_and_not_fatal(live):
    tuned = Tuned(live, '-r', 'identifier/model:=robot/identifier/model',
                  '-p', 'outputs_allowed:=[1.0, 1.0]', '-p', 'outputs:=[rate]')
    verdict = tuned.give(encoded(GOOD))
    assert verdict.startswith('Refused: `weights.outputs` has 2 numbers, but the model wants 1')
    assert tuned.program.alive


def test_age_counts_again_after_the_design(monkeypatch):
    rclpy = pytest.importorskip('rclpy')
    from ctsid_ros.examples.domain import claim_domain
    from ctsid_ros.examples.tuner_node import GainTuner
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    domain, claim = claim_domain()
    rclpy.init(args=[], domain_id=domain)
    node = GainTuner()
    try:
        for second, refused in ((110 * S, False), (114 * S, True)):
            times = iter((109 * S, second))
            node._now_ns = lambda: next(times)  # noqa: B023
            verdict, gains = node._tune(GOOD, FRESH)
            assert (gains is None) is refused, verdict
        assert verdict == ('Refused after the design, which took its time: the window of the '
                           'model ended 6.0 s ago, on the clock of this node.')
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
        claim.close()
