# SPDX-License-Identifier: Apache-2.0
from collections import Counter

from marks import slow
import numpy as np
from plants import (
    PLANTS,
    Plant,
    flown,
    held_response,
    match,
    noisy,
    paper,
    plant,
    random_plant,
    running,
)
import pytest

from ctsid_core import Record, Settings, identify
from ctsid_core.bases.hermite import project_record
from ctsid_core.subspace.hd_pbsid import Subspaces
from ctsid_ros.studies import windows


def window(p, snr=20, seed=0, *, nmax=150, settings=None):
    rng = np.random.default_rng(seed)
    record = running(rng, p, snr, rate=200.0, band=5.0)
    return project_record(record, settings or Settings(), nmax)


@pytest.fixture(scope='module')
def lines():
    return window(PLANTS['hd52'])


def chosen(p, snr, seed=0) -> int:
    record = running(np.random.default_rng(seed), p, snr, rate=200.0, band=5.0)
    return identify(record, Settings(held_out=0.0)).settings.order


@pytest.mark.parametrize(('nu', 'ny', 'n'), [
    (1, 1, 3), *slow(
        (2, 3, 2), (2, 3, 5), *((1, 1, n) for n in (1, 2, 4, 5, 6)),
        *((2, 3, n) for n in (1, 3, 4, 6)))])
def test_the_order_of_clean_plants(n, nu, ny):
    p = random_plant(np.random.default_rng(n), n, nu, ny)
    assert chosen(p, 60, n) == n


@pytest.mark.parametrize(('nu', 'n', 'seeds'), [
    *slow((2, 8, (51, 53, 55)), (1, 8, (52, 55))), (1, 7, (71,)),
    *slow((1, 7, range(60, 80)), (2, 8, range(60, 80)))])
def test_plants_of_many_resonances_are_found(nu, n, seeds):
    """
    Each explains but a part, so that two states more hardly help, and few samples are independent.

    The search ended at 2 to 5 states, which left 18 to 60 % of the motion.
    """
    left = []
    for seed in seeds:
        p = random_plant(np.random.default_rng(seed), n, nu, 1)
        record = running(np.random.default_rng(seed), p, 60, rate=200.0, band=5.0)
        left.append(100.0 - identify(record, Settings(held_out=0.0)).fit[0])
    print(np.round(left, 2))
    assert np.mean(np.array(left) < 0.5) >= 0.9


def test_what_few_samples_hide_all_of_them_show():
    """
    As much noise as motion: the search looks at one of six samples, HD-PBSID at all.

    Of the few three real poles explain as much as a pair, from which no climb comes back.
    """
    found = identify(windows.experiment(164, 'quadrotor', 0.0).record)
    assert np.max(np.abs(found.model.poles.imag)) > 0.5
    assert np.all(np.abs(found.model.poles - [-1.0 - 1.0j, -1.0 + 1.0j, -5.0])
                  < 3.0 * found.pole_std)


@pytest.mark.parametrize('seed', [53, *slow(51, 55, 59)])
def test_orders_that_hd_pbsid_does_not_see_hide_no_smaller_ones(seed):
    """Of 400 samples it has no model of 30 states; was it not asked for fewer, 7 % was left."""
    p = random_plant(np.random.default_rng(seed), 8, 1, 1)
    record = running(np.random.default_rng(seed), p, 60, rate=40.0, band=5.0)
    assert identify(record, Settings(held_out=0.0, max_order=30)).fit[0] > 99.5


@pytest.mark.parametrize('n', [*slow(1), 3])
def test_noise_free_data_do_not_raise_the_order(n):
    p = random_plant(np.random.default_rng(n), n, 1, 2)
    assert chosen(p, None) == n


def test_given_tunings_are_kept(lines):
    for settings, wanted in ((Settings(beta=3.0), {'beta': {3.0}, 'gamma': {12.0}}),
                             (Settings(gamma=30.0), {'gamma': {30.0}}),
                             (Settings(past=5), {'past': {5}, 'future': {5}}),
                             (Settings(past=5, future=2), {'past': {5}, 'future': {2}}),
                             (Settings(beta=3.0, gamma=20.0, past=4, future=3),
                              {'beta': {3.0}, 'gamma': {20.0}, 'past': {4}, 'future': {3}})):
        tunings = Subspaces(lines, settings).tunings(3)
        assert tunings
        for name, values in wanted.items():
            assert {getattr(t, name) for t in tunings} == values


def test_tunings_suit_the_order_and_the_data(lines):
    subspaces = Subspaces(lines, Settings())
    for n in (1, 4, 9, 20):
        for t in subspaces.tunings(n):
            assert t.past * len(lines.y) > n
            assert t.future == t.past
            assert 0.0 < t.beta < t.gamma
    spread = [t.beta for t in subspaces.tunings(3)]
    assert max(spread) > 10.0 * min(spread)              # slow and fast plants are both met
    assert len(subspaces.tunings(3)) >= 10


def test_one_output_can_hold_any_order():
    one = window(random_plant(np.random.default_rng(0), 2, 1, 1), nmax=600)
    for n in (11, 20, 40):
        tunings = Subspaces(one, Settings()).tunings(n)
        assert tunings
        assert all(t.past > n for t in tunings)


def test_parts_are_judged_by_their_own_length():
    settings = Settings(parts=4)
    rng = np.random.default_rng(0)
    record = running(rng, PLANTS['hd51'], 20, rate=100.0, duration=40.0, band=3.0)
    subspaces = Subspaces(project_record(record, settings, 100), settings)
    assert min(t.beta for t in subspaces.tunings(2)) == pytest.approx(1.0)


@pytest.mark.slow
@pytest.mark.parametrize(('q', 'seed'), [
    *((0.2, seed) for seed in (0, 1, 3)), (0.0, 0), (0.0, 1), (0.0, 2),
    pytest.param(0.2, 2, marks=pytest.mark.xfail(reason='and a state of -130 rad/s'))])
def test_the_order_of_an_unstable_plant(q, seed):
    """
    Simulations of a disturbed plant would want more states: the innovation form does not.

    One more seed is in test_process_noise.py, with its poles.
    """
    settings = Settings(feedthrough=False, held_out=0.0)
    assert identify(flown(np.random.default_rng(seed), q), settings).model.n == 2


def test_a_short_window_gives_no_model():
    assert Subspaces(window(PLANTS['hd52'], nmax=8), Settings()).tunings(3) == []


@pytest.mark.parametrize(('name', 'snr'), [('hd51', 10), *slow(
    ('hd52', 10), ('hd51', 40), ('hd52', 40), ('flexible', 10), ('flexible', 40))])
def test_stable_plants_give_stable_models(name, snr):
    p = PLANTS[name]
    record = running(np.random.default_rng(0), p, snr, rate=200.0, band=5.0)
    found = identify(record, Settings(order=len(p.A), held_out=0.0))
    assert (found.model or found.rejected_model).poles.real.max() < 0.1   # 1 / duration


@pytest.mark.parametrize(('q', 'seeds'), [
    (0.05, 1), *slow((0.0, 3), (0.05, 3), (0.2, 3))])
def test_an_unstable_plant_is_seen_to_be_unstable(q, seeds):
    for seed in range(seeds):
        found = identify(flown(np.random.default_rng(seed), q),
                         Settings(feedthrough=False, order=2, held_out=0.0))
        model = found.model or found.rejected_model
        np.testing.assert_allclose(match(model.poles, [2, -3]), [2, -3], atol=0.5)


# The chosen orders of whole identifications: the plants of [HD] 5.1 and 5.2 at 20 dB, a flexible
# structure with 1 % damping at 40 dB. 95 % of the runs have to be right.
EXPERIMENTS = {
    'hd51': lambda rng: paper(rng, 'hd51', 20, count=2000),
    'hd52': lambda rng: paper(rng, 'hd52', 20),
    'flexible': lambda rng: running(rng, PLANTS['flexible'], 40, rate=200.0, band=15.0),
}


def orders(name, seeds) -> list[int]:
    found = []
    for seed in seeds:
        estimate = identify(EXPERIMENTS[name](np.random.default_rng(seed)))
        assert estimate.ok, (seed, estimate.status)
        found.append(estimate.model.n)
    return found


def test_the_order_is_found():
    assert orders('hd51', range(1)) == [len(PLANTS['hd51'].A)]


@pytest.mark.slow
@pytest.mark.parametrize('name', EXPERIMENTS)
def test_the_order_is_found_in_95_of_100_runs(name):
    found = orders(name, range(100))
    right = found.count(len(PLANTS[name].A))
    print(f'{name}: order right in {right} of 100 runs: {Counter(found)}')
    assert right >= 95


@pytest.mark.parametrize('seeds', [1, *slow(2)])
def test_poles_that_stand_for_feedthrough_give_way_to_it(seeds):
    """At 50 dB a further fast pole is likelier; with D none of them is needed."""
    p = PLANTS['hd52']
    found = [identify(running(np.random.default_rng(seed), p, 50)) for seed in range(seeds)]
    assert [e.settings.order for e in found] == [3] * seeds
    assert all(e.model.D.any() for e in found)


def slung_load(rng, duration: float) -> tuple[Plant, Record]:
    """Return a multicopter's speed by its tilt command, with a load below it, and a record."""
    p = plant([[-6.0, 0.0, 0.0, 0.0], [9.8, -0.3, 1.5, 0.0], [0.0, 0.0, 0.0, 1.0],
               [-1.5, 0.05, -3.2, -0.1]], [[6.0], [0.0], [0.0], [0.0]], [[0.0, 1.0, 0.0, 0.0]])
    t_u, t_y = np.arange(0.0, duration, 0.02), np.arange(0.0, duration, 0.01)
    u = rng.choice([-1.0, 1.0], int(2.0 * duration) + 1)[(2.0 * t_u).astype(int)] + \
        0.6 * rng.uniform(-1.0, 1.0, int(duration / 4.0) + 1)[(t_u / 4.0).astype(int)]
    y = held_response(p, t_u, u[:, np.newaxis], t_y)
    return p, Record.from_arrays(t_u, u, t_y, noisy(rng, y, 20), input_hold='zoh')


@pytest.mark.parametrize(('feedthrough', 'duration', 'seed'), [
    (False, 60.0, 1),
    *slow(*((d, t, s) for d, t in ((False, 60.0), (True, 120.0)) for s in range(2, 10)))])
def test_a_resonance_of_little_damping_is_found(feedthrough, duration, seed):
    """
    It makes 6 % of the motion, beside noise of 10 %; a grid of poles steps over it.

    Predictions from the past gave a model of two states, GOOD, that simulated another flight to 85
    to 93 %.
    """
    p, record = slung_load(np.random.default_rng(seed), duration)
    found = identify(record, Settings(feedthrough=feedthrough))
    assert found.good
    assert found.model.n == 4
    near = match(found.model.poles, p.poles)
    resonance = near[p.poles.imag != 0.0]
    np.testing.assert_allclose(resonance, p.poles[p.poles.imag != 0.0], atol=0.05)


def arm(rng, duration: float, rate: float) -> tuple[Plant, Record]:
    """Return a flexible arm with four resonances of 1 to 2 %, and a record of random steps."""
    sizes = 2.0 * np.pi * np.array([3.1, 7.9, 15.7, 27.0]) * rng.uniform(0.9, 1.1, 4)
    A, B, C = np.zeros((8, 8)), np.zeros((8, 1)), np.zeros((1, 8))
    for k, (size, damping) in enumerate(zip(sizes, rng.uniform(0.01, 0.02, 4), strict=True)):
        A[2 * k:2 * k + 2, 2 * k:2 * k + 2] = [[0.0, size], [-size, -2.0 * damping * size]]
        B[2 * k + 1], C[0, 2 * k] = np.sqrt(size), (1.0, -0.8, 0.7, -0.6)[k]
    p = plant(A, B, C)
    t = np.arange(0.0, duration, 1.0 / rate)
    u = np.repeat(rng.choice([-1.0, 1.0], len(t) // 3 + 1), 3)[:len(t)]
    y = held_response(p, t, u[:, np.newaxis], t)
    return p, Record.from_arrays(t, u, t, noisy(rng, y, 25), input_hold='zoh')


@pytest.mark.slow
@pytest.mark.parametrize(('feedthrough', 'seed'), [
    (False, 1), (True, 2), *slow(*((d, s) for d in (False, True) for s in range(3, 9)))])
def test_resonances_in_a_long_record_are_all_found(feedthrough, seed):
    """Each is narrower than grids of poles and subspaces of long records see."""
    p, record = arm(np.random.default_rng(seed), 60.0, 250.0)
    found = identify(record, Settings(feedthrough=feedthrough))
    assert found.good
    assert found.model.n == 8
    assert found.fit[0] > 94.0                       # the noise leaves 94.4 %
    np.testing.assert_allclose(match(found.model.poles, p.poles), p.poles, atol=0.1)
