# SPDX-License-Identifier: Apache-2.0
"""What is measured of a bag."""

from __future__ import annotations

from dataclasses import replace
import math

from bag_fixtures import IMU, START, Sent, imu, write_mcap
from bag_fixtures import flight as flight_bag
from flights import flight, spoilt
import numpy as np
import pytest

from ctsid_ros.decoding.field_path import parse_field
from ctsid_ros.recordings.bag import open_bag
from ctsid_ros.recordings.guess_ranking import rank
from ctsid_ros.recordings.survey import RUN, survey
from ctsid_ros.recordings.survey_stats import field_stats, stamp_stats

FIELD = parse_field('x')


def surveyed(path, **more):
    with open_bag(path) as bag:
        return survey(bag, **more)


# --- measurements


def test_stamps_are_measured():
    steps = np.full(999, 10_000_000)
    steps[100], steps[200], steps[300] = 50_000_000, -5_000_000, 0
    found = stamp_stats('log', START + np.concatenate([[0], np.cumsum(steps)]))
    assert found.usable
    assert (found.period, found.gaps, found.longest) == pytest.approx((0.01, 1, 0.05))
    assert (found.backward, found.repeated) == (1, 1)
    assert found.jitter == pytest.approx(0, abs=1e-12)
    jittered = START + np.arange(5000) * 10_000_000 + np.random.default_rng(0).integers(
        0, 2_000_000, 5000)
    assert stamp_stats('log', jittered).jitter == pytest.approx(0.002 / math.sqrt(6), rel=0.05)


@pytest.mark.parametrize(('stamps', 'usable', 'why'), [
    ([0, 0, 0, 0], False, 'all are zero'), ([0, 0, 0, START], False, '3 of 4 are zero'),
    ([0, START, START + 1, START + 2], True, '1 of 4 are zero'), ([START] * 4, False, 'increase'),
    ([START], True, ''), ([], False, ''),
    ([START + k // 20 * 10**9 for k in range(200)], False, 'increase'),  # a clock of seconds
    ([START + k // 5 * 10**9 for k in range(200)], True, ''),  # a driver that stamps 5 alike
    ([START + 10**12, START, START + 12 * 10**11], False, 'increase')])
def test_stamps_that_cannot_be_used(stamps, usable, why):
    found = stamp_stats('header', np.array(stamps, dtype=np.int64))
    assert found.usable is usable
    assert why in found.why


def test_movement_is_told_from_noise_constants_and_counters():
    t, rng = np.arange(1000.0), np.random.default_rng(0)
    sine, noise = np.sin(t / 20), rng.standard_normal(1000)
    kinds = {'sine': sine, 'noisy': sine + 0.1 * noise, 'noise': noise, 'constant': 0 * t + 3.3,
             'counter': t, 'rounding': 1e6 + 1e-5 * noise}
    found = {name: field_stats(FIELD, values, RUN) for name, values in kinds.items()}
    assert {n for n, f in found.items() if f.moves} == {'sine', 'noisy', 'noise', 'counter'}
    assert {n for n, f in found.items() if f.white} == {'noise'}
    assert {n for n, f in found.items() if f.monotone} == {'counter'}
    assert found['sine'].std == pytest.approx(math.sqrt(0.5), rel=0.02)
    spoilt_values = np.where(t % 10 == 0, np.nan, sine)
    assert field_stats(FIELD, spoilt_values, RUN).finite == pytest.approx(0.9)
    assert not field_stats(FIELD, np.full(9, np.nan), RUN).moves


def test_noise_is_judged_within_runs_only():
    """Between two runs a signal may have gone anywhere."""
    values = np.repeat(np.tile([1.0, -1.0], 500), 2)
    assert field_stats(FIELD, values, 10_000).white
    assert not field_stats(FIELD, values, 2).white


def test_angles_are_unwrapped():
    angle = np.mod(np.arange(1000) * 0.01 + math.pi, 2 * math.pi) - math.pi
    found = field_stats(parse_field('euler(q).yaw'), angle, RUN)
    assert found.high - found.low == pytest.approx(9.99)


def test_long_topics_are_decoded_in_part_and_all_over(tmp_path):
    sent = [Sent('/imu', IMU, START + k * 1_000_000, imu(START + k * 1_000_000, k / 100))
            for k in range(4000)]
    (topic,) = surveyed(write_mcap(tmp_path / 'bag.mcap', sent)).topics
    assert topic.rate == pytest.approx(1000.0)
    (moving,) = topic.moving
    assert moving.low == 0.0
    assert moving.high > 35.0  # hundredths of the number of the message


def test_the_number_of_messages_is_bounded(tmp_path):
    found = surveyed(write_mcap(tmp_path / 'bag.mcap', flight(10.0)), most=300)
    assert found.covered < 3
    assert 'only the first 300 messages were looked at' in found.notes


def test_undecodable_messages_are_counted(tmp_path):
    sent = spoilt('/imu', lambda k, s: replace(s, message=b'\0\1\0\0') if k % 10 == 5 else s,
                  flight(4.0))
    topics = {t.info.name: t for t in surveyed(write_mcap(tmp_path / 'bag.mcap', sent)).topics}
    assert topics['/imu'].undecodable == 40
    assert [f.field for f in topics['/imu'].moving] == ['angular_velocity.x']


@pytest.mark.parametrize('text', ['float64 x\nwstring name\nfloat64 y\n', 'float64 x\n'],
                         ids=['wstring', 'XCDR2'])
def test_a_topic_that_cannot_be_decoded_leaves_the_others(tmp_path, text):
    """As `ctsid info` and `ctsid init` look at it."""
    body = np.array([1.5]).tobytes() + b'\2\0\0\0x\0y\0' + np.array([2.5]).tobytes()
    kind = b'\0\7\0\0' if 'wstring' not in text else b'\0\1\0\0'
    write_mcap(tmp_path / 'a.mcap', flight_bag(200))
    write_mcap(tmp_path / 'b.mcap', [Sent('/odd', IMU, START + k * 10**7, kind + body)
                                     for k in range(50)], schema=('ros2msg', text.encode()))
    found = {t.info.name: t for t in surveyed(tmp_path).topics}
    assert found['/odd'].undecodable == 50
    assert found['/odd'].fields == ()
    assert found['/imu'].moving
    with open_bag(tmp_path) as bag:
        assert '/odd' not in {c.topic.info.name for c in rank(bag, survey(bag)).found}
