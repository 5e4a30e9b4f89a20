# SPDX-License-Identifier: Apache-2.0
"""The demonstration judges rightly, and ends what it has started."""

from __future__ import annotations

from dataclasses import replace
import os
from pathlib import Path
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest

from ctsid_core.model.estimate import Estimate, Status
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.verdict import Grade
from ctsid_core.settings import Settings
from ctsid_ros.examples.demo_table import AGAIN, Truth, judge, line, summary
from ctsid_ros.examples.domain import claim_domain
from ctsid_ros.examples.quadrotor_roll import Plant

ROOT = Path(__file__).resolve().parent.parent
S = 10**9
PATIENCE = 180.0  # s
BEFORE, AFTER = Plant().true_model(), Plant(0.5).true_model()
TRUTHS = [Truth(100 * S, BEFORE), Truth(115 * S, AFTER)]


def estimate(start: float, model: StateSpace | None, std: float = 0.01) -> Estimate:
    """A window of 8 s."""
    return Estimate(
        status=Status.OK if model else Status.UNEXPLAINED, settings=Settings(), model=model,
        pole_std=std * abs(model.poles) if model else np.empty(0), fit=np.array([97.0]),
        start_ns=round(start * S), end_ns=round((start + 8) * S))


def good(start: float, model: StateSpace) -> Estimate:
    """A window with a model that may be acted on."""
    found = estimate(start, model)
    return replace(found, verdict=replace(found.verdict, grade=Grade.GOOD))


def moved(model: StateSpace, by: float) -> StateSpace:
    return replace(model, A=(1 + by) * model.A)


def test_distances_are_in_reported_deviations():
    window = judge(estimate(100, moved(BEFORE, 0.02)), TRUTHS)
    assert (window.phase, window.right) == ('before', True)
    assert window.comparison.distance == pytest.approx(2.0 / 1.02)
    assert judge(estimate(100, moved(BEFORE, 0.04)), TRUTHS).right
    assert not judge(estimate(100, moved(BEFORE, 0.05)), TRUTHS).right
    assert not judge(estimate(100, BEFORE, std=np.nan), TRUTHS).right


def test_missing_and_additional_modes_are_wrong():
    slow = StateSpace([[-2.0]], [[1.0]], [[1.0]])
    window = judge(estimate(100, slow), TRUTHS)
    assert not window.right
    assert '-20.0: not found' in line(window, 100 * S)
    more = StateSpace(np.block([[BEFORE.A, np.zeros((4, 1))], [np.zeros((1, 4)), -7.0]]),
                      np.ones((5, 1)), np.ones((1, 5)))
    window = judge(estimate(100, more), TRUTHS)
    assert not window.right
    assert 'not there: -7.00' in line(window, 100 * S)


def test_straddling_windows_may_be_right_of_either_plant():
    for model, right in ((BEFORE, True), (AFTER, True), (moved(AFTER, 0.3), False)):
        window = judge(estimate(110, model), TRUTHS)
        assert (window.phase, window.right) == ('straddling', right)
    assert judge(estimate(116, AFTER), TRUTHS).phase == 'after'
    assert not judge(estimate(116, BEFORE), TRUTHS).right


def test_a_line_has_the_grade_of_a_model_or_why_there_is_none():
    weak = estimate(100, BEFORE)  # nobody has judged it
    for given, word in ((weak, 'WEAK'), (good(100, BEFORE), 'GOOD'),
                        (estimate(100, None), 'UNEXPLAINED')):
        assert line(judge(given, TRUTHS), 100 * S).split()[3] == word
    lines, _ = summary([judge(estimate(110, BEFORE), TRUTHS), judge(estimate(111, None), TRUTHS)])
    assert lines[1].startswith('straddling the change: 2 windows: 1 WEAK and right, 1 UNEXPLAINED')


def windows(*more) -> list:
    """A flight as it shall be, and windows more, in order of time."""
    kept = [judge(good(start, BEFORE if start < 110 else AFTER), TRUTHS, 'Accepted: x')
            for start in (100, 101, 102, 115, 116, 117)]
    seen = judge(replace(estimate(110, None), status=Status.CHANGED), TRUTHS, 'Refused: x')
    return sorted([*kept, seen, *(judge(e, TRUTHS, v) for e, v in more)],
                  key=lambda window: window.estimate.end_ns)


def test_promise_is_kept_if_nothing_wrong_was_good():
    lines, kept = summary(windows((estimate(109.5, None), 'Refused: x')))
    assert kept
    assert lines[0] == ('before the change: 3 windows: 3 GOOD and right '
                        '(the worst pole at 0.0 standard deviations)')
    assert lines[1] == 'straddling the change: 2 windows: 1 UNEXPLAINED, 1 CHANGED'
    assert lines[-1].startswith('as promised')


def test_a_model_that_says_its_doubts_may_be_wrong():
    lines, kept = summary(windows((estimate(109, moved(BEFORE, 0.5)), 'Refused: x')))
    assert kept
    assert '1 WEAK but WRONG' in lines[1]


@pytest.mark.parametrize(('wrong', 'verdict', 'why'), [
    (good(110, moved(BEFORE, 0.5)), 'Refused: x', 'a GOOD model is wrong'),
    (good(103, AFTER), 'Refused: x', 'a GOOD model is wrong'),
    (estimate(111, moved(BEFORE, 0.5)), 'Accepted: x', 'the tuner used a wrong model')])
def test_promise_is_broken_by_a_wrong_model(wrong, verdict, why):
    lines, kept = summary(windows((wrong, verdict)))
    assert not kept
    assert lines[-1] == f'NOT as promised: {why}'


def test_a_false_alarm_before_the_change_is_not_to_notice_it():
    early = judge(replace(estimate(103, None), status=Status.CHANGED), TRUTHS, 'Refused: x')
    lines, kept = summary([w for i, w in enumerate(windows()) if i != 3] + [early])
    assert not kept
    assert lines[-1] == 'NOT as promised: no window noticed the change'


@pytest.mark.parametrize(('left_out', 'why'), [
    (range(3), 'no model was GOOD before the change'), ([3], 'no window noticed the change'),
    (range(4, 7), f'no model was GOOD within {AGAIN} windows after the change')])
def test_promise_is_broken_by_what_is_missing(left_out, why):
    lines, kept = summary([w for i, w in enumerate(windows()) if i not in left_out])
    assert not kept
    assert lines[-1] == f'NOT as promised: {why}'


def test_models_have_to_be_good_again_soon():
    doubts = [(estimate(115 + 0.1 * i, AFTER), 'Refused: x') for i in range(AGAIN)]
    flight = [w for w in windows(*doubts[1:]) if w.estimate.start_ns != 115 * S]
    assert summary(flight)[1]
    flight = [w for w in windows(*doubts) if w.estimate.start_ns != 115 * S or not w.estimate.good]
    assert not summary(flight)[1]


def test_a_domain_is_claimed_that_nobody_is_in():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as third_participant:
        third_participant.bind(('127.0.0.1', 7410 + 250 * 90 + 4))
        domain, claim = claim_domain([90, 91])
        with claim:
            assert domain == 91
            with pytest.raises(OSError, match='all ROS domains'):
                claim_domain([90, 91])
    claim_domain([91])[1].close()


def demo(*arguments: str) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, '-m', 'ctsid_ros.examples.live_demo', '--params',
         str(ROOT / 'config/live_demo.yaml'), *arguments], stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True, env=os.environ | {'PYTHONUNBUFFERED': '1'})


def children(pid: int) -> list[int]:
    found = Path(f'/proc/{pid}/task/{pid}/children').read_text(encoding='ascii')
    return [int(child) for child in found.split()]


@pytest.mark.slow
def test_interrupted_demo_leaves_nothing_behind():
    pytest.importorskip('rclpy')
    process = demo('--duration', '20')
    end = time.monotonic() + PATIENCE
    while len(started := children(process.pid)) < 3 and time.monotonic() < end:
        time.sleep(0.1)
    assert len(started) == 3
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130, out
    assert [pid for pid in started if Path(f'/proc/{pid}').exists()] == []


def test_demo_says_what_is_wrong_with_its_parameters(tmp_path):
    pytest.importorskip('rclpy')
    process = demo('--params', str(tmp_path / 'none.yaml'))
    out, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == 1
    assert 'none.yaml' in out


@pytest.mark.slow
def test_demo_shows_what_it_promises():
    pytest.importorskip('rclpy')
    process = demo()
    out, _ = process.communicate(timeout=2 * PATIENCE)
    assert process.returncode == 0, out
    assert 'as promised' in out
