# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from functools import cache

from marks import slow
import numpy as np
from plants import (
    PLANTS,
    asynchronous,
    flown,
    held,
    held_response,
    jittered,
    match,
    noisy,
    paper,
    plant,
    random_plant,
    random_signal,
    running,
)
import pytest

from ctsid_core import Record, Settings, Signal, Status, identify
from ctsid_core.bases.preparation import corrupt_outputs
from ctsid_core.errors import CtsidError
from ctsid_core.model.validation import simulation
from ctsid_core.sequence.tracking import Tracker

QUICK = Settings(held_out=0.0)
FIRST = plant([[-3.0]], [[3.0]], [[1.0]])


def either(estimate):
    return estimate.model or estimate.rejected_model


def arrays(model):
    return {name: getattr(model, name) for name in
            ('A', 'B', 'C', 'D', 'K', 'x_trim', 'y_trim', 'noise')}


@cache
def window(name: str) -> Record:
    """Return a noisy window of a plant: hd51 is quick to identify, hd52 has D and 4 outputs."""
    rate = {'hd51': 100.0, 'hd52': 200.0}[name]
    return running(np.random.default_rng(0), PLANTS[name], 30, rate=rate)


@cache
def known(name: str):
    return identify(window(name))


@pytest.fixture(scope='module')
def record() -> Record:
    """A noisy window of the plant of [HD] 5.2, with names and units."""
    plain = window('hd52')
    return Record((replace(plain.inputs[0], names=('thrust',), units=('N',)),),
                  (replace(plain.outputs[0], names=('u', 'q', 'theta', 'az'),
                           units=('m/s', 'rad/s', 'rad', 'm/s^2')),), plain.start, plain.end)


@pytest.fixture(scope='module')
def estimate(record):
    return identify(record)


# What an estimate says.


def test_a_good_window_gives_a_model(record, estimate):
    assert estimate.ok
    assert estimate.status is Status.OK
    assert estimate.rejected_model is None
    model, truth = estimate.model, PLANTS['hd52'].poles
    np.testing.assert_allclose(match(model.poles, truth), truth, atol=0.05)
    assert (model.input_names, model.input_units) == (('thrust',), ('N',))
    assert model.output_names == ('u', 'q', 'theta', 'az')
    assert model.output_units == ('m/s', 'rad/s', 'rad', 'm/s^2')
    assert estimate.fit.shape == estimate.held_out_fit.shape == (4,)
    assert (estimate.fit > 90.0).all()
    assert (estimate.held_out_fit > 85.0).all()
    assert (np.diff(estimate.singular_values) <= 0.0).all()
    assert estimate.condition > 1.0
    assert estimate.notes == ()
    assert estimate.start_ns == 0
    assert estimate.end_ns == 10_000_000_000


def test_every_automatic_value_is_filled_in_and_explained(estimate):
    settings, by_name = estimate.settings, {c.name: c for c in estimate.choices}
    assert by_name['order'].value == settings.order == 3
    assert settings.delay == estimate.model.delay[0]
    assert ('delay' in by_name) == (settings.delay > 0.0)
    assert all(len(c.why) > 20 for c in estimate.choices)


def test_the_condition_tells_good_data_from_bad(estimate):
    assert estimate.condition < 1e12


def test_the_values_found_can_be_given_by_hand(record, estimate):
    again = identify(record, estimate.settings)
    np.testing.assert_allclose(match(again.model.poles, estimate.model.poles),
                               estimate.model.poles, atol=0.2 * estimate.pole_std.min())
    assert again.choices == ()


def test_the_deviations_belong_to_the_poles(record, estimate):
    model = estimate.model
    assert estimate.pole_std.shape == (3,)
    fast = np.argmax(np.abs(model.poles))
    assert np.argmax(estimate.pole_std) == fast
    slow = estimate.pole_std[np.arange(3) != fast]
    assert slow[0] == pytest.approx(slow[1], rel=1e-6)
    truth = match(PLANTS['hd52'].poles, model.poles)
    assert (np.abs(model.poles - truth) < 4.0 * estimate.pole_std).all()


def test_the_noise_is_that_of_the_outputs(record, estimate):
    """White noise of variance r at rate f has intensity r / f."""
    rms = np.sqrt(np.mean(record.outputs[0].values ** 2, axis=0))
    wanted = (rms * 10 ** (-30 / 20)) ** 2 / 200.0
    np.testing.assert_allclose(np.diag(estimate.model.noise), wanted, rtol=0.35)


def test_the_held_out_test_can_be_left_out():
    quick = identify(window('hd51'), QUICK)
    assert quick.ok
    assert np.isnan(quick.held_out_fit).all()


def test_the_plain_subspace_estimate(record):
    plain = identify(record, Settings(refine=False, order=3))
    truth = PLANTS['hd52'].poles
    np.testing.assert_allclose(match(plain.model.poles, truth), truth, atol=0.1)
    assert 'noise' not in {c.name for c in plain.choices}


@pytest.mark.slow
def test_the_form_of_the_paper():
    rest = paper(np.random.default_rng(0), 'hd52', 50)
    settings = Settings(edges='paper', order=3, nmax=300, beta=3.0, gamma=30.0, past=3,
                        refine=False)
    truth = PLANTS['hd52'].poles
    np.testing.assert_allclose(match(identify(rest, settings).model.poles, truth), truth,
                               atol=0.02)
    # Its premise, rest at both ends, is needed: see the method.
    moving = running(np.random.default_rng(0), PLANTS['hd52'], 50)
    off = match(either(identify(moving, settings)).poles, truth) - truth
    assert np.abs(off).max() > 0.05


def test_without_feedthrough_d_is_zero():
    direct = replace(PLANTS['hd51'], D=np.array([[0.1], [-0.05]]))
    given = running(np.random.default_rng(0), direct, 30, rate=100.0)
    found, free = (identify(given, QUICK.replace(feedthrough=feedthrough, order=2))
                   for feedthrough in (False, True))
    assert not either(found).D.any()
    assert either(free).D.all()


# Laws.


@pytest.mark.parametrize('name', ['hd51', *slow('hd52')])
def test_the_same_record_gives_the_same_bits(name):
    """With the settings that are meant where none are given, too."""
    estimate, again = known(name), identify(window(name), Settings())
    for matrix, value in arrays(estimate.model).items():
        np.testing.assert_array_equal(getattr(again.model, matrix), value, err_msg=matrix)
    for number in ('fit', 'held_out_fit', 'pole_std', 'singular_values'):
        np.testing.assert_array_equal(getattr(again, number), getattr(estimate, number))
    assert (again.choices, again.settings) == (estimate.choices, estimate.settings)


def test_the_arrays_are_left_alone():
    rng = np.random.default_rng(1)
    t_u, t_y = jittered(rng, 100.0), jittered(rng, 80.0)
    given = [t_u, rng.standard_normal((len(t_u), 2)), t_y, rng.standard_normal((len(t_y), 2))]
    kept = [a.copy() for a in given]
    identify(Record.from_arrays(*given), QUICK.replace(order=2))
    for a, b in zip(given, kept, strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_epoch_changes_the_time_of_the_window_only():
    epoch, record = 1_700_000_000_123_456_789, running(
        np.random.default_rng(0), FIRST, 30, rate=100.0)
    late = identify(replace(record, epoch_ns=epoch))
    assert late.start_ns == epoch
    assert late.end_ns == epoch + 10_000_000_000
    np.testing.assert_array_equal(late.model.A, identify(record).model.A)


def test_stamps_of_the_unix_epoch_cost_digits_but_no_sense(record, estimate):
    """Doubles of 1.7e9 s resolve 0.24 us."""
    moved = Record(tuple(replace(s, time=s.time + 1.7e9) for s in record.inputs),
                   tuple(replace(s, time=s.time + 1.7e9) for s in record.outputs),
                   1.7e9, 1.7e9 + 10.0)
    found = identify(moved, Settings(order=3, nmax=estimate.settings.nmax))
    np.testing.assert_allclose(match(found.model.poles, estimate.model.poles),
                               estimate.model.poles, atol=estimate.pole_std.max())


@pytest.mark.parametrize(('name', 'c'), [
    ('hd51', 1e-3), *slow(('hd51', 1e3), ('hd52', 1e-3), ('hd52', 1e3))])
def test_slow_and_fast_plants_alike(name, c):
    """Nothing is tied to the second: the same samples over c times the time."""
    record, estimate = window(name), known(name)
    stretched = Record(tuple(replace(s, time=c * s.time) for s in record.inputs),
                       tuple(replace(s, time=c * s.time) for s in record.outputs),
                       c * record.start, c * record.end)
    found = identify(stretched)
    np.testing.assert_allclose(match(c * found.model.poles, estimate.model.poles),
                               estimate.model.poles, atol=0.1 * estimate.pole_std.min())


@pytest.mark.parametrize(('name', 'size'), [
    ('hd51', 1e-6), *slow(('hd51', 1e6), ('hd52', 1e-6), ('hd52', 1e6))])
def test_units_do_not_matter(name, size):
    record, estimate = window(name), known(name)
    scale = np.array([size, 1.0, 1.0 / size, 1.0])[:len(PLANTS[name].C)]
    other = Record(
        tuple(replace(s, values=s.values / size) for s in record.inputs),
        tuple(replace(s, values=s.values * scale) for s in record.outputs), 0.0, 10.0)
    found = identify(other)
    np.testing.assert_allclose(match(found.model.poles, estimate.model.poles),
                               estimate.model.poles, atol=0.1 * estimate.pole_std.min())
    np.testing.assert_allclose(found.model.dc_gain / scale[:, np.newaxis] / size,
                               estimate.model.dc_gain, rtol=1e-2)


def test_trim_is_estimated_not_averaged_away():
    """The mean of a short window is not the trim: here the means are far from it."""
    rng = np.random.default_rng(2)
    p = replace(PLANTS['hd51'], D=np.array([[0.1], [-0.05]]))
    whole = running(rng, p, None, rate=100.0, duration=20.0, band=1.0)
    offset_u, offset_y = 40.0, np.array([5.0, -300.0])
    moved = Record(tuple(replace(s, values=s.values + offset_u) for s in whole.inputs),
                   tuple(replace(s, values=s.values + offset_y) for s in whole.outputs),
                   0.0, 20.0)
    found = identify(moved.between(0.0, 6.0), Settings(order=2))
    np.testing.assert_allclose(match(found.model.poles, p.poles), p.poles, atol=1e-3)
    # The trim belongs to the model: it predicts another part of the record as it stands.
    assert simulation(found.model, moved.between(8.0, 20.0)).fit.min() > 99.9
    naive = identify(moved.between(0.0, 6.0), Settings(trim=False, order=2))
    assert np.abs(match(either(naive).poles, p.poles) - p.poles).max() > 0.05
    # A mode that takes the trim's place seems to grow.
    other = identify(moved.between(0.0, 6.0), Settings(trim=False, max_order=1))
    assert other.rejected_model.poles.real.max() > 0.1
    assert not other.ok
    assert not identify(moved.between(0.0, 6.0), Settings(trim=False, max_order=2)).good


@pytest.mark.slow
def test_dead_time_set_by_hand():
    rng = np.random.default_rng(3)
    p = random_plant(rng, 2, 1, 2)
    late = held(rng, p, 50.0, 200.0, delay=0.6, band=3.0)
    right = identify(late, Settings(delay=0.6, order=2))
    assert right.model.delay == (0.6,)
    assert right.held_out_fit.min() > 99.9
    np.testing.assert_allclose(match(right.model.poles, p.poles), p.poles, atol=5e-3)
    assert simulation(right.model, late).fit.min() > 99.0
    wrong = identify(late, QUICK.replace(delay=0.5, order=2))
    assert wrong.fit.max() < right.fit.min() - 5.0


@pytest.mark.slow
def test_dead_times_stay_with_their_inputs_where_some_do_not_move():
    rng = np.random.default_rng(3)
    p = random_plant(rng, 2, 1, 2)
    late = held(rng, p, 50.0, 200.0, delay=0.13, band=3.0)
    idle = replace(late.inputs[0], values=np.ones_like(late.inputs[0].values))
    three = replace(late, inputs=(idle, late.inputs[0], idle))
    found = identify(three, Settings(delay=(0.3, 0.13, 0.0), order=2, held_out=0.0))
    assert found.model.delay == (0.3, 0.13, 0.0)
    np.testing.assert_allclose(match(found.model.poles, p.poles), p.poles, atol=5e-3)


def test_a_dead_time_of_each_input():
    rng = np.random.default_rng(4)
    p = random_plant(rng, 2, 2, 2)
    t = np.arange(-5.0, 10.0, 0.02)
    u = random_signal(rng, 2, 3.0).at(t)
    t_y = jittered(rng, 200.0)
    parts = [held_response(replace(p, B=p.B[:, [j]], D=p.D[:, [j]]), t + d, u[:, [j]],
                           t_y[t_y > 0]) for j, d in enumerate((0.21, 0.04))]
    late = Record.from_arrays(t, u, t_y[t_y > 0], sum(parts), input_hold='zoh')
    found = identify(late, Settings(delay=(0.21, 0.04), order=2))
    np.testing.assert_allclose(match(found.model.poles, p.poles), p.poles, atol=5e-3)
    assert found.model.delay == (0.21, 0.04)


@pytest.mark.parametrize(('nu', 'ny', 'n'), [
    (1, 1, 2), *slow((2, 3, 4), (1, 1, 1), (1, 1, 4), (2, 3, 1), (2, 3, 2))])
def test_noise_free_data_give_the_plant(n, nu, ny):
    rng = np.random.default_rng(n)
    p = random_plant(rng, n, nu, ny, feedthrough=n == 2)
    found = identify(running(rng, p, rate=200.0, band=5.0))
    assert found.model.n == n
    np.testing.assert_allclose(match(found.model.poles, p.poles), p.poles, atol=1e-4)
    np.testing.assert_allclose(found.model.dc_gain, p.D - p.C @ np.linalg.solve(p.A, p.B),
                               atol=1e-3)


def test_signals_may_each_have_their_own_stamps():
    rng = np.random.default_rng(5)
    p = random_plant(rng, 3, 2, 3)
    u = random_signal(rng, 2, 4.0)
    y = u.output(p)
    inputs = [Signal(t, u.at(t)[:, [j]]) for j, t in
              enumerate((jittered(rng, 120.0), jittered(rng, 90.0)))]
    outputs = [Signal(t, y.at(t)[:, columns]) for columns, t in
               (([0], jittered(rng, 150.0)), ([1, 2], jittered(rng, 70.0)))]
    found = identify(Record.from_signals(inputs, outputs), Settings(order=3))
    np.testing.assert_allclose(match(found.model.poles, p.poles), p.poles, atol=5e-3)


@pytest.mark.parametrize('parts', slow(2, 5))
def test_a_long_record_may_be_divided(parts):
    """Parts with one model and each its own state at the ends cost no accuracy."""
    rng = np.random.default_rng(12)
    p = PLANTS['hd52']
    long = running(rng, p, 30, rate=50.0, duration=40.0, band=4.0)
    one, divided = (identify(long, Settings(order=3, nmax=600 // k, parts=k))
                    for k in (1, parts))
    for found in (one, divided):
        aligned = match(p.poles, found.model.poles)
        assert (np.abs(found.model.poles - aligned) < 4.0 * found.pole_std).all()
    np.testing.assert_allclose(divided.pole_std, one.pole_std, rtol=0.2)


def test_an_unstable_plant_gets_a_gain_that_tames_it():
    found = identify(flown(np.random.default_rng(6), rate=200.0), Settings(feedthrough=False))
    model = found.model
    np.testing.assert_allclose(match(model.poles, [2, -3]), [2, -3], atol=0.02)
    assert np.linalg.eigvals(model.A - model.K @ model.C).real.max() < 0.0
    assert not model.D.any()


# Data that are no good: a status, never an exception.


def test_constant_channels_leave_zero_rows_and_columns(record):
    signal, other = record.inputs[0], record.outputs[0]
    idle = replace(signal, values=np.full_like(signal.values, 1500.0), names=('idle',))
    stuck = replace(other, values=np.column_stack((np.full(len(other.time), -4.0),
                                                   other.values)),
                    names=('stuck', *other.names), units=('', *other.units))
    found = identify(Record((idle, signal), (stuck,), 0.0, 10.0), Settings(order=3))
    assert found.status is Status.NO_RESPONSE
    assert found.verdict.reason.startswith('Output stuck does not move')
    assert found.model is None
    model = found.rejected_model
    assert (model.nu, model.ny) == (2, 5)
    for matrix in (model.B[:, 0], model.D[:, 0], model.C[0], model.D[0], model.K[:, 0],
                   model.noise[0], model.noise[:, 0]):
        assert not matrix.any()
    assert model.B[:, 1].all()
    assert model.y_trim[0] == -4.0
    assert np.isnan(found.fit[0])
    assert (found.fit[1:] > 90.0).all()
    assert any('idle is constant' in note for note in found.notes)
    assert any('stuck is constant' in note for note in found.notes)
    simulated = simulation(model, Record((idle, signal), (stuck,), 0.0, 10.0))
    assert simulated.fit[1:].min() > 90.0


T = np.linspace(0.0, 10.0, 501)
WAVE = np.sin(3.0 * T) + np.sin(1.1 * T ** 1.3)


@pytest.mark.parametrize(('status', 'u', 'y'), [
    (Status.NO_EXCITATION, np.ones(501), WAVE),
    (Status.NO_EXCITATION, np.zeros(501), WAVE),
    (Status.NO_RESPONSE, WAVE, np.ones(501)),
    (Status.NO_RESPONSE, np.zeros(501), np.zeros(501)),
    (Status.NO_RESPONSE, WAVE, np.full((501, 3), 1e-300)),
])
def test_nothing_moves(status, u, y):
    found = identify(Record.from_arrays(T, u, T, y))
    assert found.status is status
    assert found.model is None
    assert found.rejected_model is None


def test_a_window_with_too_few_samples():
    for count in (2, 3, 8, 19):
        t = np.linspace(0.0, 10.0, count)
        found = identify(Record.from_arrays(T, WAVE, t, np.sin(t)))
        assert found.status is Status.TOO_SHORT
        assert found.model is None


@pytest.mark.parametrize(('end', 'share'), [(4.1, '1.1 %'), *slow((9.0, '50 %'))])
def test_gaps_of_outputs_are_survived_and_noted(end, share):
    """Half of the samples tell as much as a record of half the length."""
    rng = np.random.default_rng(7)
    p = PLANTS['hd51']
    given = running(rng, p, 40, rate=200.0, band=1.0)
    signal = given.outputs[0]
    kept = (signal.time < 4.0) | (signal.time > end)
    found = identify(replace(given, outputs=(replace(
        signal, time=signal.time[kept], values=signal.values[kept]),)))
    assert found.good
    assert any(f'{share} of the window has no samples of' in note for note in found.notes)
    np.testing.assert_allclose(match(found.model.poles, p.poles), p.poles, atol=0.1)


@pytest.mark.parametrize('seed', [0, *slow(*range(1, 8))])
def test_pure_noise_is_not_explained(seed):
    rng = np.random.default_rng(seed)
    t = jittered(rng, 100.0)
    found = identify(Record.from_arrays(t, random_signal(rng).at(t), t,
                                        rng.standard_normal((len(t), 2))))
    assert found.status is Status.UNEXPLAINED
    assert found.model is None
    assert found.rejected_model is not None
    assert found.fit.shape == (2,)


@pytest.mark.parametrize('seed', [0, *slow(1, 2, 3)])
def test_an_output_of_another_plant_is_not_explained(seed):
    """Coloured, but not by these inputs."""
    rng = np.random.default_rng(seed)
    given, other = (running(rng, PLANTS['hd51'], 40, rate=100.0) for _ in range(2))
    found = identify(replace(given, outputs=other.outputs))
    assert found.status is Status.UNEXPLAINED
    assert found.model is None


def nasty(kind: str, rng) -> Record:
    """Records that are legal, but hardly a sensible experiment."""
    t, u = T, WAVE
    y = held_response(FIRST, t, u[:, np.newaxis], t)[:, 0]
    if kind == 'output is the input':
        y = u
    elif kind == 'output is twice there':
        y = np.column_stack((y, y))
    elif kind == 'input is twice there':
        u = np.column_stack((u, u, -2.0 * u))
    elif kind == 'one step':
        u = (t > 5.0).astype(float)
        y = held_response(FIRST, t, u[:, np.newaxis], t)[:, 0]
    elif kind == 'one spike':
        u = u.copy()
        y = 0.0 * y
        y[250] = 1.0
    elif kind == 'coarse steps':
        y = np.round(4.0 * y) / 4.0
    elif kind == 'huge':
        u, y = 1e150 * u, 1e140 * y
    elif kind == 'tiny':
        u, y = 1e-150 * u, 1e-140 * y
    elif kind == 'ramp':
        y = t
    elif kind == 'blows up':
        y = np.exp(3.0 * t)
    elif kind == 'steady sine':
        u = np.sin(2.0 * t)
        y = np.sin(2.0 * t - 0.3)
    elif kind == 'random walk':
        y = np.cumsum(rng.standard_normal((501, 2)), axis=0)
    elif kind == 'more channels than sense':
        u, y = rng.standard_normal((501, 5)), rng.standard_normal((501, 7))
    elif kind == 'two input samples':
        return Record.from_arrays([0.0, 6.0], [0.0, 1.0], t, y, input_hold='zoh')
    elif kind == 'microseconds':
        t = 1e-6 * t
    elif kind == 'years':
        t = 1e8 * t
    elif kind == 'bursts':
        t_y = np.unique(np.round(np.sort(rng.uniform(0.0, 10.0, 200)), 1)[:, np.newaxis]
                        + 1e-6 * np.arange(4))
        return Record.from_arrays(t, u, t_y, np.sin(t_y))
    elif kind == 'noise in both':
        u, y = rng.standard_normal(501), rng.standard_normal(501)
    return Record.from_arrays(t, u, t, y, input_hold='zoh')


NASTY = ('output is twice there', 'one step', 'huge')
NASTY_TOO = ('blows up', 'two input samples', 'bursts', 'one spike', 'tiny', 'random walk',
             'output is the input', 'input is twice there', 'coarse steps', 'ramp', 'steady sine',
             'more channels than sense', 'microseconds', 'years', 'noise in both')


@pytest.mark.parametrize('kind', [*NASTY, *slow(*NASTY_TOO)])
def test_no_data_raise(kind):
    rng = np.random.default_rng(8)
    for settings in (Settings(), Settings(order=4, trim=False, feedthrough=False, edges='paper')):
        found = identify(nasty(kind, rng), settings)
        assert isinstance(found.status, Status)
        assert (found.model is not None) == (found.status is Status.OK)
        model = either(found)
        if model is not None:
            assert np.isfinite(model.A).all()
            assert len(found.pole_std) == model.n


@pytest.mark.parametrize('order', [1, *slow(7, 20, 50)])
def test_any_order_may_be_asked_for(order):
    found = identify(window('hd51'), QUICK.replace(order=order))
    assert either(found) is None or either(found).n == order


@pytest.mark.parametrize('options', [
    {'nmax': 1}, {'gamma': 1e-3}, {'max_order': 1}, {'delay': 60.0}, *slow(
        {'past': 50}, {'beta': 1e6}, {'nmax': 8}, {'nmax': 1200}, {'past': 1}, {'beta': 1e-6},
        {'edge_margin': 20.0}, {'rank_tolerance': 1e-2}, {'held_out': 0.5})])
def test_no_settings_raise(options):
    record = running(np.random.default_rng(0), PLANTS['hd51'], 30, rate=200.0)
    found = identify(record, Settings(order=2).replace(**options))
    assert isinstance(found.status, Status)


def test_a_dead_time_that_leaves_nothing_to_tell_feedthrough_from_raises_nothing():
    found = identify(window('hd51'), Settings(order=2, delay=9.9))
    assert isinstance(found.status, Status)


def test_nearly_noise_free_lightly_damped_modes_that_the_window_hardly_holds():
    rng = np.random.default_rng(9)
    p = plant([[0, 1], [-0.01, -0.002]], [[0], [1]], [[1, 0]])
    found = identify(running(rng, p, 40, rate=50.0))
    assert isinstance(found.status, Status)


# Misuse: a ValueError that names the argument, the value and the cure.


@pytest.mark.parametrize(('changes', 'words'), [
    ({'y': np.where(T == 5.0, np.nan, WAVE)}, ('`y`', 'sample 250', 'nan', 'remove')),
    ({'u': np.where(T == 5.0, np.inf, WAVE)}, ('`u`', 'sample 250', 'inf', 'remove')),
    ({'t_y': np.where(T == 5.0, np.nan, T)}, ('`t_y`', 'stamp 250', 'remove')),
    ({'t_u': T[::-1]}, ('`t_u`', 'increase', 'sort')),
    ({'t_y': T + 20.0}, ('do not overlap', '[0, 10] s', '[20, 30] s', 'clock')),
    ({'u': WAVE[:-1]}, ('`u`', '501 stamps', '500 samples')),
    ({'y': np.vstack((WAVE, WAVE))}, ('`y`', '501 stamps', 'transpose')),
    ({'u': WAVE.astype(str)}, ('`u`', 'real numbers', 'convert')),
    ({'t_u': [], 'u': []}, ('no sample',)),
    ({'t_u': [1.0], 'u': [2.0]}, ('do not overlap',)),
    ({'input_hold': 'spline'}, ("'spline'", 'zoh', 'linear', 'smooth')),
])
def test_misuse_of_records(changes, words):
    given = {'t_u': T, 'u': WAVE, 't_y': T, 'y': WAVE} | changes
    with pytest.raises(ValueError) as caught:
        identify(Record.from_arrays(**given))
    assert isinstance(caught.value, CtsidError)
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize(('options', 'words'), [
    ({'order': -1}, ('`order`', '-1', 'between 0 and 50')),
    ({'order': 2.5}, ('`order`', '2.5', 'whole number')),
    ({'method': 'n4sid'}, ('`method`', "'n4sid'", 'hd-pbsid')),
    ({'edges': 'sharp', 'past': 99}, ('`hermite.edges`', "'sharp'", '`pbsid.past`', '99')),
    ({'past': 3, 'future': 4}, ('`pbsid.future`', '4', 'lower')),
])
def test_misuse_of_settings(options, words):
    with pytest.raises(ValueError) as caught:
        Settings(**options)
    for word in words:
        assert word in str(caught.value)


def test_misuse_of_dead_times(record):
    with pytest.raises(ValueError, match='`delay` has 2 values but there are 1 inputs; give'):
        identify(record, Settings(delay=(0.1, 0.2)))


def test_asynchronous_data_need_no_common_stamps():
    p = PLANTS['hd51']
    given = asynchronous(np.random.default_rng(10), p, 90.0, 70.0, snr=30, band=3.0)
    found = identify(given)
    assert found.model.n == 2
    np.testing.assert_allclose(match(found.model.poles, p.poles), p.poles, atol=0.2)


@pytest.mark.parametrize('seed', [0, *slow(1, 2)])
def test_a_response_may_be_known_where_its_pole_is_not(seed):
    """A static gain has no pole: that of a first-order model of it is anywhere."""
    rng = np.random.default_rng(seed)
    t = np.arange(1001) / 100.0
    u = random_signal(rng, 1, 1.0).on_grid(1001, 0.01)
    found = identify(Record.from_arrays(t, u, t, noisy(rng, 2.0 * u, 30), input_hold='smooth'),
                     Settings(order=1))
    omega = np.geomspace(0.5, 5.0, 20)
    deviation = found.frequency_response_std(omega)
    error = np.abs(found.model.frequency_response(omega)[:, 0, 0] - 2.0)
    assert (error < 3.0 * 2.0 * np.hypot(deviation.magnitude, deviation.phase)[:, 0, 0]).all()
    assert found.pole_std[0] > 0.5 * abs(found.model.poles[0])


def test_bursts_of_noise_do_not_fake_a_fit():
    rng = np.random.default_rng(11)
    given = running(rng, PLANTS['hd51'], None, rate=100.0)
    signal = given.outputs[0]
    loud = replace(signal, values=noisy(rng, signal.values, -30))
    found = identify(replace(given, outputs=(loud,)))
    assert found.status is Status.UNEXPLAINED


@pytest.mark.filterwarnings('error::RuntimeWarning')
@pytest.mark.parametrize('size', [
    1e160, 1.7e308, 5e-324, *slow(1e300, 1e-160, 1e-300)])
def test_absurd_sizes_are_said_and_end_nothing(size):
    rng, t = np.random.default_rng(5), np.arange(1000) * 0.02
    u, y = np.repeat(rng.choice([-1.0, 1.0], 50), 20), np.zeros(1000)
    for k in range(999):
        y[k + 1] = np.exp(-0.06) * y[k] + (1.0 - np.exp(-0.06)) * u[k]
    y += 0.03 * rng.standard_normal(1000)
    y /= np.abs(y).max()
    torn = y.copy()
    torn[[100, 500, 501]] = size, -size, size
    found = identify(Record.from_arrays(t, u, t, torn, input_hold='zoh'))
    assert found.good
    assert size < 1.0 or any('3 of 1000 samples of y1' in note for note in found.notes)
    for own, other in ((u * size, y), (u, y * size), (u * size, y * size)):
        found = identify(Record.from_arrays(t, own, t, other, input_hold='zoh'))
        assert found.status in (Status.NO_EXCITATION, Status.NO_RESPONSE, Status.TOO_SHORT)
        assert size < 1.0 or any('1000 of 1000 samples of' in note for note in found.notes)


@pytest.mark.filterwarnings('error::RuntimeWarning')
def test_a_model_is_not_tested_on_torn_values():
    """Over a motion of 1e308 any model would have a fit of 100 %."""
    rng, t = np.random.default_rng(5), np.arange(2000) * 0.02
    u, y = np.repeat(rng.choice([-1.0, 1.0], 100), 20), np.zeros(2000)
    for k in range(1999):
        y[k + 1] = np.exp(-0.06) * y[k] + (1.0 - np.exp(-0.06)) * u[k]
    y += 0.03 * rng.standard_normal(2000)
    y[1200], y[1700] = 1.7e308, -1.7e308
    record, tracker = Record.from_arrays(t, u, t, y, input_hold='zoh'), Tracker()
    tracker.take(record.between(0.0, 20.0))
    assert 90.0 < tracker.take(record.between(15.0, 35.0)).fresh_fit[0] < 99.0
    assert corrupt_outputs(record, Settings())[0].tolist() == [24.0, 34.0]
