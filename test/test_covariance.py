# SPDX-License-Identifier: Apache-2.0
"""Covariance of models: its derivatives, its invariance, and what it says of the truth."""

from dataclasses import replace

from marks import slow
import numpy as np
from plants import PLANTS, flown, held_response, jittered, noisy, plant, random_plant, running
import pytest
from regions import regions
from scipy.optimize import linear_sum_assignment
from scipy.stats import binom

from ctsid_core import Record, Settings, identify
from ctsid_core.errors import DataError
from ctsid_core.model.covariance import (
    Covariance,
    Entries,
    Rival,
    damping_deviation,
    gain_deviation,
    natural_frequency_deviation,
    pole_covariance,
    pole_deviation,
    response_deviation,
    scatter_of_poles,
)
from ctsid_core.model.estimate import Estimate, Status
from ctsid_core.model.statespace import StateSpace

OMEGA = np.array([0.0, 0.7, 4.0, 30.0])
STEP = 1e-6


def model(seed, n=3, nu=2, ny=2) -> StateSpace:
    rng = np.random.default_rng(seed)
    p = random_plant(rng, n, nu, ny, feedthrough=True)
    T = rng.standard_normal((n, n)) + 2.0 * np.eye(n)
    return StateSpace(p.A, p.B, p.C, p.D, delay=tuple(rng.uniform(0, 0.2, nu))).transform(T)


def changes(seed, m: StateSpace, rows: int = 40) -> Entries:
    rng = np.random.default_rng(seed)
    return Entries(*(0.1 * rng.standard_normal((rows, *shape)) for shape in (
        m.A.shape, m.B.shape, m.C.shape, m.D.shape, (m.nu,))))


def moved(m: StateSpace, e: Entries, row: int, size: float = STEP) -> StateSpace:
    return replace(m, A=m.A + size * e.A[row], B=m.B + size * e.B[row], C=m.C + size * e.C[row],
                   D=m.D + size * e.D[row], delay=tuple(m.delay + size * e.delay[row]))


@pytest.mark.parametrize('n', [1, 3, 4])
def test_deviations_are_those_of_differences(n):
    m = model(n, n)
    e = changes(n, m, rows=5)
    known = Covariance(np.hstack([part.reshape(5, -1) for part in e]), n, m.nu, m.ny)

    def differences(what):
        return np.array([(what(moved(m, e, row)) - what(moved(m, e, row, -STEP))) / (2 * STEP)
                         for row in range(5)])

    def total(values):
        return np.sqrt(np.sum(np.abs(values) ** 2, axis=0))

    near = {'rtol': 1e-5, 'atol': 1e-7}
    poles = differences(lambda x: x.poles)
    np.testing.assert_allclose(known.pole_changes(m), poles, **near)
    small = replace(known, root=1e-4 * known.root)      # as derivatives are
    np.testing.assert_allclose(1e4 * pole_deviation(small, m), total(poles), **near)
    parts = np.stack((poles.real, poles.imag), axis=-1)
    np.testing.assert_allclose(1e8 * pole_covariance(small, m),
                               np.einsum('rik,ril->ikl', parts, parts), **near)
    s = 1j * OMEGA[1:, np.newaxis, np.newaxis]          # G beside exp(-s delay)
    np.testing.assert_allclose(
        known.response_changes(m, OMEGA[1:]), differences(lambda x: replace(
            x, delay=(0.0,) * x.nu).frequency_response(OMEGA[1:]) * np.exp(
                -s * (np.array(x.delay) - m.delay))), **near)
    for name, claim in (('natural_frequency', natural_frequency_deviation),
                        ('damping', damping_deviation)):
        truth = total(differences(lambda x, name=name: getattr(x, name)))
        np.testing.assert_allclose(1e4 * claim(small, m), truth, **near)
    np.testing.assert_allclose(gain_deviation(known, m), total(differences(lambda x: x.dc_gain)),
                               **near)
    ratio = differences(lambda x: x.frequency_response(OMEGA)) / m.frequency_response(OMEGA)
    found = response_deviation(known, m, OMEGA)
    np.testing.assert_allclose(found.magnitude, total(ratio.real), **near)
    np.testing.assert_allclose(found.phase, total(ratio.imag), **near)


def invariants(known: Covariance, m: StateSpace) -> np.ndarray:
    response = response_deviation(known, m, OMEGA)
    return np.concatenate([x.ravel() for x in (
        pole_covariance(known, m), damping_deviation(known, m), gain_deviation(known, m),
        *response)])


def test_few_rows_tell_what_many_do_whatever_the_states():
    m = model(1)
    e = changes(2, m)
    whole = Covariance(np.hstack([part.reshape(40, -1) for part in e]), 3, 2, 2)
    few = Covariance.of_entries(e, m)
    assert len(few.root) == 9 + 6 + 6 + 4 + 2 - 9  # entries less choices of states
    np.testing.assert_allclose(invariants(few, m), invariants(whole, m), rtol=1e-9, atol=1e-14)
    T = np.random.default_rng(3).standard_normal((3, 3))
    np.testing.assert_allclose(invariants(few.transform(T), m.transform(T)),
                               invariants(few, m), rtol=1e-7, atol=1e-12)
    again = few.transform(T).transform(np.linalg.inv(T))
    np.testing.assert_allclose(again.root, few.root, atol=1e-9)


def test_a_root_of_another_shape_is_refused():
    for root in (np.zeros((2, 26)), np.zeros(27), np.full((1, 27), np.nan)):
        with pytest.raises(DataError, match='wanted are rows of 27 finite'):
            Covariance(root, 3, 2, 2)


def test_the_response_varies_by_rivals_too():
    m, other = model(1), replace(model(2), delay=(0.3, 0.0))
    own = Covariance.of_entries(changes(2, m), m)
    both = replace(own, rivals=(Rival(0.25, other),))
    before, after = (response_deviation(known, m, OMEGA) for known in (own, both))
    ratio = other.frequency_response(OMEGA) / m.frequency_response(OMEGA) - 1.0
    np.testing.assert_allclose(after.magnitude, np.hypot(before.magnitude, 0.5 * ratio.real))
    np.testing.assert_allclose(after.phase, np.hypot(before.phase, 0.5 * ratio.imag))
    slow = [0.1 * np.min(np.abs(m.poles))]
    apart = (other.frequency_response(slow) - m.frequency_response(slow))[0]
    np.testing.assert_allclose(gain_deviation(both, m),
                               np.hypot(gain_deviation(own, m), 0.5 * np.abs(apart)))
    drifting = Rival(0.5, replace(other, A=np.zeros((3, 3))))
    found = response_deviation(replace(own, rivals=(drifting,)), m, OMEGA)
    assert np.isfinite(found.magnitude).all()          # at 0 Hz it has no response
    assert both != own
    for wrong in (Rival(0.0, other), Rival(0.5, StateSpace([[-1.0]], [[1.0]], [[1.0]]))):
        with pytest.raises(DataError, match='2 inputs and 2 outputs'):
            replace(own, rivals=(wrong,))


@pytest.mark.slow
def test_deviations_know_that_the_order_might_be_another_one():
    """A fast pole that noise hides: of order 1 the response is off by more than it would say."""
    p, omega = plant([[-4.0, 0.0], [20.0, -20.0]], [[4.0], [0.0]], [[0.0, 1.0]]), np.array([8.0])
    truth = StateSpace(p.A, p.B, p.C).frequency_response(omega)[0, 0, 0]
    away, orders = [], set()
    for seed in range(24):
        rng = np.random.default_rng(seed)
        t_u, t_y = jittered(rng, 30.0, 10.5) - 0.5, jittered(rng, 80.0)[1:]
        levels = rng.uniform(-1.0, 1.0, (8, 1))
        u = np.where(t_u[:, np.newaxis] < 0.0, 0.0, levels[np.maximum(t_u / 1.5, 0).astype(int)])
        y = noisy(rng, held_response(p, t_u, u, t_y), 20)
        found = identify(Record.from_arrays(t_u, u, t_y, y, input_hold='zoh'),
                         Settings(held_out=0.0, max_order=3))
        response = found.model.frequency_response(omega)[0, 0, 0]
        away.append([abs(response - truth) / abs(response) / np.hypot(said.magnitude, said.phase)[
            0, 0, 0] for said in (found.frequency_response_std(omega), response_deviation(
                replace(found.covariance, rivals=()), found.model, omega))])
        orders.add(found.model.n)
    assert {1, 2} <= orders
    with_rivals, without = np.mean(np.array(away) < 2.5, axis=0)
    print(f'within 2.5 deviations: {with_rivals:.2f}, order taken for granted {without:.2f}')
    assert with_rivals > 0.94 > 0.88 > without


def test_what_is_not_known_is_nan():
    m = model(1)
    for given, n, nu, ny in ((Estimate(status=Status.OK, settings=Settings(), model=m), 3, 2, 2),
                             (Estimate(status=Status.TOO_SHORT, settings=Settings()), 0, 0, 0)):
        assert given.pole_covariance.shape == (n, 2, 2)
        assert given.natural_frequency_std.shape == given.damping_std.shape == (n,)
        assert given.dc_gain_std.shape == (ny, nu)
        assert given.delay_std.shape == (nu,)
        assert given.frequency_response_std(OMEGA).phase.shape == (4, ny, nu)
        assert np.isnan(given.frequency_response_std(OMEGA).magnitude).all()
        assert np.isnan(given.pole_covariance).all()


def test_an_integrator_has_no_steady_gain():
    m = StateSpace([[0.0, 1.0], [0.0, -2.0]], [[0.0], [6.0]], [[1.0, 0.0]])
    known = Covariance.of_entries(changes(1, m), m)
    assert np.isinf(gain_deviation(known, m)).all()
    turned = m.transform(np.array([[1.0, 0.3], [-0.7, 2.0]]))    # singular but for rounding
    assert np.isinf(turned.dc_gain).all()
    known_turned = Covariance.of_entries(changes(1, turned), turned)
    assert np.isinf(gain_deviation(known_turned, turned)).all()
    found = response_deviation(known, m, np.array([0.0, 1.0]))
    assert np.isnan(found.magnitude[0]).all()
    assert np.isfinite(found.magnitude[1]).all()
    assert np.isnan(damping_deviation(known, m)[0])


def test_constant_channels_have_no_deviation_and_change_nothing():
    plain = running(np.random.default_rng(1), PLANTS['hd51'], 20, rate=200.0)
    t, u, y = plain.inputs[0].time, plain.inputs[0].values, plain.outputs[0].values
    still = np.ones((len(t), 1))
    wider = Record.from_arrays(t, np.hstack((still, u)), t,
                               np.hstack((y[:, :1], still, y[:, 1:])), input_hold='smooth')
    settings = Settings(order=2, held_out=0.0)
    one, other = identify(plain, settings), identify(wider, settings)
    assert (other.covariance.n, other.covariance.nu, other.covariance.ny) == (2, 2, 3)
    entries = other.covariance.entries
    assert not entries.B[:, :, 0].any()
    assert not entries.C[:, 1].any()
    assert not entries.D.any()           # no output of this plant follows the input at once
    assert not entries.delay[:, 0].any()
    assert entries.B[:, :, 1].any()
    assert entries.C[:, [0, 2]].any()
    np.testing.assert_allclose(other.pole_covariance, one.pole_covariance, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(other.dc_gain_std[[0, 2], 1], one.dc_gain_std[:, 0], rtol=1e-6)
    assert np.isnan(other.frequency_response_std(OMEGA).phase[:, 1]).all()


def test_real_poles_move_on_the_axis_only():
    found = identify(running(np.random.default_rng(2), PLANTS['hd52'], 20, rate=200.0),
                     Settings(order=3, held_out=0.0))
    real = found.model.poles.imag == 0
    assert real.sum() == 1
    assert not found.damping_std[real].any()
    assert not found.pole_covariance[real, 1].any()
    np.testing.assert_allclose(np.trace(found.pole_covariance, axis1=1, axis2=2),
                               found.pole_std ** 2)
    assert (found.damping_std[~real] > 0).all()


def shaken(gain):
    return lambda rng: flown(rng, 1.0, 0.05, rate=200.0, name='shaken', gain=(gain,))


# Measured over how many of 500 runs hold the truth: see docs/method.md.
STRICT = Settings(feedthrough=False, held_out=0.0)
FREE = Settings(held_out=0.0)
STUDIES = {
    'open loop': ('hd52', lambda rng: running(rng, PLANTS['hd52'], 20, rate=200.0), FREE),
    'open loop, 10 dB': ('hd51', lambda rng: running(rng, PLANTS['hd51'], 10, rate=200.0), FREE),
    'unstable, closed loop': ('unstable', lambda rng: flown(rng, 0.0, 0.01, rate=200.0), STRICT),
    'unstable, process noise': ('unstable', lambda rng: flown(rng, 0.1), STRICT),
    'closed loop': ('shaken', lambda rng: flown(rng, 0.0, 0.5, rate=200.0, name='shaken',
                                                gain=((1.0, 1.0, 0.5),)), STRICT),
    'process noise': ('shaken', shaken((0.0, 0.0, 0.0)), STRICT),
    'process noise, closed loop': ('shaken', shaken((1.0, 1.0, 0.5)), STRICT),
}
LAST = list(STUDIES)[-1]


def test_covariances_that_are_equal_count_once():
    root = np.random.default_rng(0).standard_normal((3, 10))
    first, same, other = (Covariance(values, 2, 1, 1) for values in (root, root.copy(), -root))
    assert first == same != other
    assert len({first, same, other}) == 2


@pytest.mark.parametrize('gap', [0.001, 0.2j, 0.5, 1.0j, 3.0])
@pytest.mark.parametrize('rows', [1, 30])
def test_deviations_of_poles_that_nearly_meet_are_those_of_the_scatter(gap, rows):
    """Their derivatives are infinite where they meet; in however many rows the covariance is."""
    poles = np.array([-3.0 + gap / 2, -3.0 - gap / 2])
    rng = np.random.default_rng(0)
    m = StateSpace(np.array([[0.0, 1.0], [-np.prod(poles).real, np.sum(poles).real]]),
                   np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]]), np.zeros((1, 1)))
    root = np.zeros((rows, 4 + 2 + 2 + 1 + 1))
    root[:, 2:4] = rng.standard_normal((rows, 2)) * [0.2, 0.05] / np.sqrt(rows)
    known = Covariance(root, 2, 1, 1)
    drawn = m.A + np.einsum('sr,rij->sij', rng.standard_normal((4000, rows)), known.entries.A)
    found = np.linalg.eigvals(drawn).astype(complex)
    away = np.abs(found - m.poles), np.abs(found[:, ::-1] - m.poles)
    nearest = np.where((away[0].sum(axis=1) < away[1].sum(axis=1))[:, np.newaxis], *away)
    scatter = np.sqrt(np.mean(nearest ** 2, axis=0))
    claim = pole_deviation(known, m)
    assert (0.75 < claim / scatter).all()
    assert (claim / scatter < 1.3).all()
    real = m.poles.imag == 0.0
    assert (natural_frequency_deviation(known, m)[real] == claim[real]).all()


@pytest.mark.parametrize('gap', [0.0003, 0.3, *slow(0.03, 3.0)])
@pytest.mark.parametrize('count', [2, 3])
def test_poles_that_meet_by_chance_are_known_as_each_by_itself(gap, count):
    """Those of axes that have nothing in common; and of one coefficient that all poles have."""
    poles = -3.0 - gap * np.arange(count)
    apart = scatter_of_poles(poles.astype(complex), 0.1 * np.eye(count))
    assert np.sqrt(np.mean(apart ** 2)) == pytest.approx(0.1, rel=0.25)    # of all together
    coefficient = np.zeros(count + 1)
    coefficient[-1] = 0.05                          # of s^0
    slopes = np.array([-0.05 / np.prod([p - q for q in poles if q != p]) for p in poles])
    claim = scatter_of_poles(poles.astype(complex), slopes[np.newaxis].astype(complex))
    draws = np.random.default_rng(0).standard_normal(2000)
    away = []
    for draw in draws:
        moved = np.roots(np.poly(poles) + draw * coefficient)
        cost = np.abs(moved - poles[:, np.newaxis])
        away.append(cost[linear_sum_assignment(cost ** 2)])
    scatter = np.sqrt(np.mean(np.square(away), axis=0))
    assert (0.9 < claim / scatter).all()
    assert (claim / scatter < 1.2).all()


def test_a_pole_that_is_hardly_known_does_not_move_those_that_are():
    """A fast one, off by more than what it is: on its way it passes the others."""
    known = scatter_of_poles(np.array([2.0 + 0j, -3.0, -62.0]), np.diag([4e-4, 5e-4, 74.0]) + 0j)
    np.testing.assert_allclose(known[:2], [4e-4, 5e-4], rtol=1e-3)


def test_poles_that_coincide_or_are_not_known_have_deviations():
    same = np.array([-3.0 + 0j, -3.0])
    both = scatter_of_poles(same, 0.1 * np.eye(2))
    assert np.sqrt(np.mean(both ** 2)) == pytest.approx(0.1)
    assert not np.isfinite(scatter_of_poles(same, np.full((1, 2), np.inf))).any()
    # A pole that is there three times moves as a whole, beside one that moves by itself.
    tied = np.array([[0.1, 0.1, 0.1, 0.0], [0.0, 0.0, 0.0, 0.3]])
    found = scatter_of_poles(np.array([-3.0 + 0j, -3.0, -3.0, -8.0]), tied)
    np.testing.assert_allclose(found, [0.1, 0.1, 0.1, 0.3], rtol=0.02)


def coverage(name: str, runs: int, *, order: bool = True) -> dict[str, tuple[int, int]]:
    """Return how many regions of each kind hold the truth, of how many."""
    plant, experiment, settings = STUDIES[name]
    p = PLANTS[plant]
    settings = settings.replace(order=len(p.A)) if order else settings
    omega = np.array([0.3, 1.5, 6.0] if plant == 'hd52' else [0.5, 3.0, 10.0])
    found: dict[str, list[bool]] = {}
    for seed in range(runs):
        estimate = identify(experiment(np.random.default_rng(seed)), settings)
        for what, size in regions(estimate, p, omega).items():
            found.setdefault(what, []).append(size <= 1.0)
    return {what: (sum(hits), len(hits)) for what, hits in found.items()}


@pytest.mark.slow
def test_95_percent_regions_hold_the_truth():
    """Less than the least that a truth of 95 % gives once in a thousand times."""
    found, runs = coverage('open loop, 10 dB', 10), 10
    least = binom.ppf(1e-3, runs, 0.95)
    assert all(count == runs and hits >= least for hits, count in found.values()), found
    assert sum(hits for hits, _ in found.values()) < runs * len(found)


@pytest.mark.slow
@pytest.mark.parametrize(('name', 'order'), [
    *((name, True) for name in STUDIES if name != LAST), ('open loop', False),
    pytest.param(LAST, True, marks=pytest.mark.xfail(
        reason='85.8 %: the controller acts on states that are not recorded, which is a bias'))])
def test_95_percent_regions_hold_93_to_97_percent(name, order):
    found = coverage(name, 500, order=order)
    share = {what: 100 * hits / count for what, (hits, count) in found.items()}
    print(f'\n{name}, order {"given" if order else "found"}: '
          + ', '.join(f'{what} {value:.1f}' for what, value in share.items()))
    assert 93.0 <= np.mean(list(share.values())) <= 97.0
    for what, (hits, count) in found.items():  # 93 to 97 %, but for what chance does in 500 runs
        assert binom.ppf(1e-3, count, 0.93) <= hits <= binom.ppf(1 - 1e-3, count, 0.97), what


def test_of_models_without_states_rivals_vary_the_gain():
    m = StateSpace(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), [[2.0]])
    known = Covariance(np.zeros((0, Covariance.entry_count(0, 1, 1))), 0, 1, 1, (Rival(
        0.25, StateSpace([[-2.0]], [[2.0]], [[3.0]])),))
    assert gain_deviation(known, m)[0, 0] == pytest.approx(0.5)


def test_a_rival_that_outlasts_all_records_leaves_the_dc_gain_known():
    """Its own gain nobody knows, but it moves next to nothing where the model has settled."""
    m = StateSpace([[-2.0]], [[1.0]], [[4.0]])
    known = Covariance(np.zeros((0, Covariance.entry_count(1, 1, 1))), 1, 1, 1, (Rival(
        0.25, StateSpace(np.diag([-2.0, -1e-6]), [[1.0], [1e-3]], [[4.0, 1.0]])),))
    assert gain_deviation(known, m)[0, 0] == pytest.approx(0.5 * 1e-3 / 0.2, rel=1e-3)
