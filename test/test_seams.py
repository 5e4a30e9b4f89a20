# SPDX-License-Identifier: Apache-2.0
"""What lies between parts that were made for themselves, found by a review."""

from dataclasses import replace

from marks import slow
import numpy as np
from plants import PLANTS, running
import pytest

from ctsid_core import Record, Settings, Signal, StateSpace, Status, identify
from ctsid_core.advice.advice import advise
from ctsid_core.errors import DataError
from ctsid_core.model.verdict import Grade

QUICK = Settings(delay=0.0, order=2)


def first_order(t_u, u, t_y, delay=0.0, pole=-1.0):
    """Return exact outputs of pole / (s - pole) that follow a held input from rest."""
    model = StateSpace(np.array([[pole]]), np.array([[-pole]]), np.eye(1), delay=(delay,))
    return model.simulate([Signal(t_u, u, 'zoh')], t_y)


@pytest.mark.parametrize('delay', [('auto', 0.0), (0.01, 0.02), *slow(
    ((0.0, 0.0),), ((0.01, 0.01),), (('auto', 'auto'),))])
def test_an_input_at_rest_does_not_mind_how_dead_times_are_given(delay):
    record = running(np.random.default_rng(0), PLANTS['hd51'], 20, rate=100.0)
    u = record.inputs[0]
    still = replace(u, values=np.column_stack((u.values, np.ones(len(u.time)))))
    found = identify(replace(record, inputs=(still,)), Settings(order=2, delay=delay))
    assert found.model is not None
    assert found.model.nu == 2
    assert found.verdict.grade is Grade.WEAK                 # the second column is not measured


def test_a_record_at_rest_does_not_hide_the_excitation_of_another():
    rng = np.random.default_rng(1)
    moving = running(rng, PLANTS['hd51'], 20, rate=100.0)
    quiet = replace(moving, inputs=(replace(moving.inputs[0], values=np.zeros_like(
        moving.inputs[0].values)),), outputs=(replace(
            moving.outputs[0], values=1e-2 * rng.standard_normal(
                moving.outputs[0].values.shape)),))
    verdicts = [identify(pair, QUICK).verdict for pair in ([moving, quiet], [quiet, moving])]
    assert len({verdict.grade for verdict in verdicts}) == 1
    for verdict in verdicts:
        one = verdict.excitation[0]
        assert one.frequencies > 10.0
        assert one.uncertainty < 0.05


@pytest.mark.parametrize('delay', [0.9, *slow(0.0)])
def test_the_time_of_a_change_counts_from_the_start_of_the_window(delay):
    rng = np.random.default_rng(2)
    t = np.arange(0.0, 10.0, 0.01)
    t_u, t_y = np.arange(0.0, 10.0, 0.05), t
    u = np.repeat(rng.choice([-1.0, 1.0], len(t_u) // 4), 4)[:, np.newaxis]
    slow, fast = (first_order(t_u, u, t_y, delay, pole) for pole in (-1.0, -3.0))
    y = np.where(t_y[:, np.newaxis] < 4.0, slow, 2.0 * fast)
    y = y + 0.01 * rng.standard_normal(y.shape)
    record = Record.from_arrays(t_u, u, t_y, y, input_hold='zoh')
    found = identify(record, Settings(order=1, delay=delay, held_out=0.0))
    assert found.status is Status.CHANGED
    assert found.statistics['change_share'] * 10.0 == pytest.approx(4.0, abs=0.5)
    assert '4' in found.verdict.reason or '3.' in found.verdict.reason


@pytest.mark.parametrize('at', [1.0, 3.0, 5.0, 7.5])
def test_a_step_response_is_no_reason_to_reject_a_right_model(at):
    """After a step little moves; what is held out then tells little, and nothing against it."""
    rng, t = np.random.default_rng(3), np.arange(0.0, 10.0, 0.01)
    t_u = np.arange(0.0, 10.0, 0.05)
    u = (t_u >= at).astype(float)[:, np.newaxis]
    y = first_order(t_u, u, t)
    y = y + 0.01 * y.std() * rng.standard_normal(y.shape)
    found = identify(Record.from_arrays(t_u, u, t, y, input_hold='zoh'), Settings(order=1))
    assert found.model is not None, found.verdict.reason
    assert found.model.poles[0].real == pytest.approx(-1.0, abs=0.05)
    assert found.verdict.grade is not Grade.REJECT


def test_there_is_a_forecast_of_several_records():
    records = [running(np.random.default_rng(s), PLANTS['hd51'], 20, rate=100.0) for s in (0, 1)]
    found = identify(records, QUICK)
    told = advise(found, records)
    assert [p.std for p in told.poles] == pytest.approx(found.pole_std)
    assert all(0.0 < b.ratio < 1.0 for p in told.poles for b in p.bands)


def test_the_same_samples_do_not_count_twice():
    record = running(np.random.default_rng(0), PLANTS['hd51'], 20, rate=100.0)
    with pytest.raises(DataError, match='given twice'):
        identify([record, replace(record)], QUICK)
