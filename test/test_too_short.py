# SPDX-License-Identifier: Apache-2.0
"""What too short a window lacks is said: its length."""

from dataclasses import replace
import re

from marks import slow
import numpy as np
import pytest

from ctsid_core import Record, Settings, identify
from ctsid_core.judge.rules import KNOWN
from ctsid_core.model.estimate import Status
from ctsid_core.model.verdict import Remedy
from ctsid_core.signals.record import Signal


def motor(length: float, seed: int, *, noise: float, rate: float = 100.0) -> Record:
    """Return a window out of the middle of a motor's motion: dy/dt = -3 y + 3 u(t - 0.1)."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(20 * rate)) / rate
    u = np.repeat(rng.uniform(-1, 1, 101), round(rate / 5))[:len(t)]
    late = np.concatenate([np.zeros(round(0.1 * rate)), u])
    y = np.zeros(len(t))
    for k in range(len(t) - 1):
        y[k + 1] = late[k] + (y[k] - late[k]) * np.exp(-3.0 / rate)
    y += noise * rng.standard_normal(len(t))
    return Record.from_arrays(t, u, t, y, input_hold='zoh').between(10.0, 10.0 + length, lead=0.0)


@pytest.mark.parametrize('hold', ['zoh', 'linear'])
def test_an_input_of_torn_values_alone_beside_a_gap(hold):
    t = 0.02 * np.arange(600)
    u = np.repeat(np.random.default_rng(0).standard_normal(30), 20)[:, np.newaxis]
    seen = t[(t < 3.0) | (t > 9.0)]
    found = identify(Record(
        (Signal(t, u, 'zoh'), Signal(t, np.full_like(u, 1e300), hold)),
        (Signal(seen, np.sin(seen)[:, np.newaxis], 'smooth'),), 0.0, float(t[-1])))
    assert found.status is Status.TOO_SHORT
    assert 'too few samples of u2 that can be used' in found.verdict.reason


@pytest.mark.parametrize('feedthrough', [True, False])
@pytest.mark.parametrize('length', [0.2, *slow(0.15, 0.25)])
def test_a_window_of_two_dead_times_is_too_short(length, feedthrough):
    found = [identify(motor(length, seed, noise=0.02), Settings(feedthrough=feedthrough))
             for seed in range(3)]
    assert not any(one.good for one in found)
    told = [one.verdict.reason for one in found if not one.ok]
    assert len(told) >= 2
    assert all(re.search('longer window|window is long enough', reason) for reason in told)


@pytest.mark.parametrize('seeds', [2, *slow(4, 8)])
def test_how_much_longer_is_true(seeds):
    reached = []
    for seed in range(seeds):
        found = identify(motor(2.0, seed, noise=0.3))
        if told := re.search(r'take a window (\S+) times as long', found.verdict.reason):
            longer = identify(motor(min(2.0 * float(told[1]), 9.9), seed, noise=0.3))
            reached.append(longer.verdict.excitation[0].uncertainty)
    assert len(reached) >= 0.6 * seeds
    assert np.median(reached) < 1.1 * KNOWN
    assert np.median(reached) > 0.6 * KNOWN


@pytest.mark.parametrize('order', [8, 12])
def test_fewer_samples_than_numbers_are_too_few(order):
    record = motor(0.22, 0, noise=0.02)
    found = identify(record, Settings(order=order))
    assert found.status is Status.TOO_SHORT
    assert 'longer window' in found.verdict.reason


def test_a_budget_that_is_too_small_is_not_a_window_that_is():
    """So few samples can be looked at that 305 numbers explain them all."""
    rng, t = np.random.default_rng(4), np.arange(6000) / 100.0
    u = np.repeat(rng.standard_normal((300, 12)), 20, axis=0)
    y = 0.1 * np.cumsum(u.sum(axis=1)) + rng.standard_normal(6000)
    found = identify(Record.from_arrays(t, u, t, y, input_hold='zoh'),
                     Settings(order=20, budget=0.05))
    assert found.model is None
    assert found.verdict.reason == ('The budget of 0.05 s is spent before there is a model of '
                                    'order 20; raise `budget`.')
    assert found.verdict.remedy is Remedy.SETTING


def test_signals_that_are_missing_from_a_window_are_named():
    """As all of a sensor that is not finite is: a longer window may not help."""
    record, t = motor(4.0, 0, noise=0.02), np.arange(400) / 100.0
    t = t + record.outputs[0].time[0]
    kept = t < t[0] + 0.1
    other = Signal(t[kept], np.sin(t[kept])[:, np.newaxis], 'linear', ('roll',))
    found = identify(replace(record, outputs=(*record.outputs, other)))
    assert found.status is Status.TOO_SHORT
    assert ('too few samples of roll that can be used (less than 20); check that they come'
            in found.verdict.reason)


@pytest.mark.parametrize('settings', [
    Settings(order=6), *slow(Settings(), Settings(order=8))])
def test_many_signals_in_a_short_window_do_not_stop_the_program(settings):
    rng, t = np.random.default_rng(0), np.arange(20) / 50.0
    record = Record.from_arrays(t, np.repeat(rng.uniform(-1, 1, (4, 4)), 5, axis=0), t,
                                np.cumsum(rng.standard_normal((20, 3)), axis=0),
                                input_hold='zoh')
    assert identify(record, settings).status in Status


def test_a_good_model_says_how_well_its_poles_are_known():
    """The response to a window of five dead times is known to 9 %, its pole to 61 %."""
    found = identify(motor(0.5, 4, noise=0.02))
    assert found.good
    assert found.pole_std[0] > 0.5 * abs(found.model.poles[0])
    assert 'do not use that pole' in found.verdict.reason
    told = re.search(r'the least known pole one of (\S+) % of its size', found.verdict.reason)
    assert float(told[1]) == pytest.approx(100 * found.verdict.pole_uncertainty, rel=0.05)
    long = identify(motor(9.0, 4, noise=0.02))
    assert long.good
    assert 'do not use' not in long.verdict.reason
