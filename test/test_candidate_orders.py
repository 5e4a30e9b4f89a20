# SPDX-License-Identifier: Apache-2.0
"""The table of orders, what next data say of it, and the warm start of the search."""

from marks import slow
import numpy as np
from plants import PLANTS, random_plant, running
import pytest

from ctsid_core import Record, Settings, identify
from ctsid_core.model.model_json import from_json, to_json
from ctsid_core.model.validation import simulation
from ctsid_core.search.tried import AKAIKE, Tried, criterion

QUICK = Settings(held_out=0.0)


@pytest.fixture(scope='module')
def found():
    return identify(running(np.random.default_rng(0), PLANTS['hd52'], 20, rate=200.0), QUICK)


def test_the_table_of_orders_is_in_the_estimate(found):
    assert [o.order for o in found.orders] == list(
        range(found.orders[0].order, found.orders[-1].order + 1))
    assert min(found.orders, key=lambda o: o.criterion).order == found.model.n == 3
    assert min(o.criterion for o in found.orders) == 0.0
    third = next(o for o in found.orders if o.order == 3)
    assert third.fit == pytest.approx(found.fit.min(), abs=0.5)
    assert third.fit > found.orders[0].fit + 5.0        # two states cannot
    given = identify(running(np.random.default_rng(0), PLANTS['hd52'], 20, rate=200.0),
                     QUICK.replace(order=3))
    assert given.orders == ()


def test_the_table_is_stored(found):
    assert from_json(to_json(found)).orders == found.orders


def of_known_plant(name, snr, seed):
    return running(np.random.default_rng(seed), PLANTS[name], snr, rate=200.0)


def of_any_plant(n):
    return running(np.random.default_rng(n), random_plant(np.random.default_rng(n), n, 2, 2), 15,
                   rate=200.0)


@pytest.mark.parametrize('more', [1, *slow(0, -1)])
@pytest.mark.parametrize(('make', 'arguments'), [
    (of_known_plant, ('hd51', 20, 0)), *slow(
        (of_any_plant, (2,)), *((of_known_plant, given) for given in (
            ('hd51', 20, 1), ('hd52', 20, 0), ('hd52', 20, 1), ('hd52', 6, 0), ('hd52', 6, 1))),
        (of_any_plant, (4,)), (of_any_plant, (5,)))])
def test_a_warm_start_gives_the_same_bits(make, arguments, more):
    """From the right order, from one too low and one too high, as after a change of the plant."""
    record = make(*arguments)
    cold = identify(record, QUICK)
    assert cold.ok
    like = random_plant(np.random.default_rng(0), max(cold.model.n + more, 1), 1, 1)
    warm = identify(record, QUICK, like=_model(like))
    assert warm.model == cold.model


def _model(plant):
    from ctsid_core import StateSpace
    return StateSpace(plant.A, plant.B, plant.C)


@pytest.mark.slow
def test_an_arm_with_lost_samples_has_enough_states(data_folder):
    """Three states and process noise are about as likely, and simulate far worse."""
    u, y = np.loadtxt(data_folder / 'daisy' / 'robot_arm.dat').T[:2]
    t, half, rng = np.arange(len(u)) * 0.01, len(u) // 2, np.random.default_rng(0)
    t_y = t + 0.01 * rng.uniform(-0.05, 0.05, len(t))
    kept = rng.uniform(size=len(t)) > 0.25
    record, other = (
        Record.from_arrays(t[part], u[part], t_y[part][kept[part]], y[part][kept[part]],
                           input_hold='zoh') for part in (slice(0, half), slice(half, len(t))))
    found, four = (identify(record, Settings(delay=0.0, order=order)).model for order in (0, 4))
    assert found.n >= 4
    assert simulation(found, other).fit[0] >= simulation(four, other).fit[0]


def seen(power: float, numbers: int, independent: float) -> Tried:
    """Return a model of one output that leaves so much, and so many independent errors."""
    one = Tried(None, None, np.array([power]), numbers)
    vars(one)['independent'] = np.array([independent])
    return one


def test_numbers_are_paid_by_the_independent_errors_that_are_left():
    """Of 42 errors of a vibration 24 further numbers may leave a third by chance, of noise not."""
    smaller = seen(1.0, 8, 42.0)
    left = [criterion(smaller, seen(0.1, 32, m)) for m in (5.0, 20.0, 33.0, 50.0, 200.0, 2000.0)]
    assert np.all(np.diff(left) >= 0.0)
    assert left[-2] - left[-3] > 20.0
    # None is paid that is not there, and Akaike's price is one of its own.
    more = criterion(smaller, seen(0.1, 8, 42.0))
    assert criterion(smaller, seen(0.1, 8, 2000.0)) == pytest.approx(more)
    assert criterion(smaller, seen(0.1, 32, 5.0), AKAIKE) == pytest.approx(more - 48.0)
