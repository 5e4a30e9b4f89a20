# SPDX-License-Identifier: Apache-2.0
"""Windows one after the other: states and rows that stay, tests on data that are new."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import fields, replace
import pickle

from marks import slow
import numpy as np
from plants import PLANTS, Plant, flown, held_response, plant, running
import pytest
from scipy.linalg import expm

from ctsid_core.bases.preparation import without_corrupt
from ctsid_core.errors import DataError
from ctsid_core.identify import identify
from ctsid_core.model.estimate import Choice, Estimate, Status
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.validation import simulation
from ctsid_core.model.verdict import EXPLAINED, Grade, Verdict
from ctsid_core.sequence import tracking
from ctsid_core.sequence.alignment import aligning
from ctsid_core.sequence.tracking import Tracked, Tracker
from ctsid_core.settings import Settings
from ctsid_core.signals.record import Record, Signal
from ctsid_core.signals.samples import Group
from ctsid_core.signals.windows import SlidingWindow

S = 10**9
SETTINGS = Settings(order=2)


def pair(omega: float = 6.0, damping: float = 0.3) -> Plant:
    return plant([[0, 1], [-omega ** 2, -2 * damping * omega]], [[0], [omega ** 2]], [[1, 0]])


def windows(system: Plant, seed: int = 1, count: int = 5, length: float = 5.0,
            stride: float = 2.0, start: float = 0.0, snr: float = 25.0) -> list[Record]:
    """Overlapping windows of one run, which starts at an absolute time [s]."""
    whole = running(np.random.default_rng(seed), system, snr, rate=100.0,
                    duration=length + stride * (count - 1), band=4.0)
    whole = replace(whole, epoch_ns=round(start * S))
    return [whole.between(k * stride, k * stride + length) for k in range(count)]


def silent(record: Record) -> Record:
    """The same window with an input that does not move."""
    (u,) = record.inputs
    return replace(record, inputs=(replace(u, values=np.ones_like(u.values)),))


def run(records, settings: Settings = SETTINGS) -> list[Tracked]:
    tracker = Tracker(settings)
    return [tracker.take(record) for record in records]


def same(a: Tracked, b: Tracked) -> bool:
    """Whether all of two results agree to the last bit."""
    return all(same_value(getattr(a, f.name), getattr(b, f.name)) for f in fields(Tracked))


def same_value(a, b) -> bool:
    if isinstance(a, Estimate | Verdict):
        return all(same_value(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    if isinstance(a, np.ndarray):
        return np.array_equal(a, b, equal_nan=True)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same_value(a[key], b[key]) for key in a)
    return a == b or (a != a and b != b)


@pytest.fixture(scope='module')
def steady() -> list[Record]:
    return windows(pair())


@pytest.fixture(scope='module')
def tracked(steady) -> list[Tracked]:
    return run(steady)


@pytest.fixture(scope='module')
def alone(steady) -> list[Estimate]:
    return [identify(record, SETTINGS) for record in steady]


@pytest.fixture(scope='module')
def untested(steady) -> Estimate:
    """The first window, of which nothing is held out."""
    return identify(steady[0], SETTINGS.replace(held_out=0.0))


@pytest.fixture(scope='module')
def _begun(steady) -> Tracker:
    tracker = Tracker(SETTINGS)
    tracker.take(steady[0])
    return tracker


@pytest.fixture
def begun(_begun) -> Tracker:
    """A tracker of its own that has taken the first window."""
    return deepcopy(_begun)


def test_estimates_are_those_of_identify_in_other_states(alone, tracked):
    for plain, found in zip(alone, tracked, strict=True):
        for f in fields(Estimate):
            if f.name not in ('model', 'pole_std', 'verdict', 'covariance'):
                assert same_value(getattr(found.estimate, f.name), getattr(plain, f.name)), f.name
        for f in fields(Verdict):
            if f.name not in ('fresh_ratio', 'apart'):
                assert same_value(getattr(found.estimate.verdict, f.name),
                                  getattr(plain.verdict, f.name)), f.name
        again = plain.model.transform(aligning(plain.model, tracked[0].estimate.model))
        np.testing.assert_allclose(found.estimate.model.A, again.A, atol=1e-9)
        np.testing.assert_allclose(found.estimate.pole_std, plain.pole_std, rtol=1e-9)


def test_the_covariance_follows_the_states(alone, tracked):
    for plain, found in zip(alone, tracked, strict=True):
        moved = found.estimate
        for name in ('natural_frequency_std', 'damping_std', 'dc_gain_std', 'pole_covariance'):
            np.testing.assert_allclose(getattr(moved, name), getattr(plain, name), rtol=1e-7,
                                       atol=1e-12)
        for a, b in zip(moved.frequency_response_std([0.3, 2.0, 9.0]),
                        plain.frequency_response_std([0.3, 2.0, 9.0]), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-7)


def test_matrices_move_no_more_than_their_uncertainty(tracked):
    A = np.array([t.estimate.model.A for t in tracked])
    poles = np.array([t.estimate.model.poles for t in tracked])
    assert {t.realisation for t in tracked} == {1}
    assert np.ptp(A, axis=0).max() < 3 * np.abs(np.ptp(poles.real, axis=0)
                                                + 1j * np.ptp(poles.imag, axis=0)).max()
    spread = np.array([t.estimate.pole_std.max() for t in tracked]).max()
    assert np.abs(A - A.mean(axis=0)).max() < 5 * spread


def test_results_depend_on_the_records_only(steady, tracked):
    assert all(same(a, b) for a, b in zip(tracked, run(steady[:3]), strict=False))


def test_eigenvalues_keep_rows_and_deviations(tracked):
    for found in tracked:
        model = found.estimate.model
        assert found.modes == (1, 2)
        np.testing.assert_array_equal(found.eigenvalues, model.poles)
        np.testing.assert_array_equal(found.eigenvalue_std, found.estimate.pole_std)


def test_deviations_follow_their_poles_when_poles_change_places():
    """A real pole as large as a pair: rounding decides which of them comes first."""
    def system(real):
        return StateSpace([[-1, 2, 0], [-2, -1, 0], [0, 0, -real]], np.ones((3, 2)),
                          np.ones((2, 3)))
    model, moved = (system(np.sqrt(5) * (1 + e)) for e in (-1e-15, 1e-15))
    assert model.poles[0].imag == 0 != moved.poles[0].imag
    estimate = Estimate(status=Status.OK, settings=Settings(), model=model,
                        pole_std=np.array([0.1, 0.3, 0.3]))
    np.testing.assert_array_equal(tracking._carried(estimate, model, moved), [0.3, 0.3, 0.1])
    unknown = replace(estimate, pole_std=np.empty(0))
    assert np.isnan(tracking._carried(unknown, model, moved)).all()


def test_fresh_fit_is_that_of_the_last_model_on_what_is_new(steady, tracked):
    assert np.isnan(tracked[0].fresh_fit).all()
    assert (tracked[0].fresh_start_ns, tracked[0].fresh_end_ns) == (0, 0)
    for before, record, found in zip(tracked, steady[1:], tracked[1:], strict=False):
        simulated = simulation(before.estimate.model, record)
        new = simulated.times > before.estimate.end_ns / S + 1e-9
        assert 190 < new.sum() < 210  # 2 s of 100 Hz
        y = simulated.y[:, 0]
        rms = np.sqrt(np.mean((y - simulated.y_hat[:, 0])[new] ** 2))
        expected = 100 * (1 - rms / np.sqrt(np.mean((y - y.mean()) ** 2)))
        np.testing.assert_allclose(found.fresh_fit, [expected], rtol=1e-12)
        assert found.fresh_fit[0] > 85
        assert found.fresh_start_ns == before.estimate.end_ns
        assert found.fresh_end_ns == found.estimate.end_ns


def test_fresh_data_of_a_later_window_are_all_of_it(steady, tracked):
    late = replace(steady[1], epoch_ns=60 * S)
    found = run([steady[0], late])[1]
    assert found.fresh_start_ns == 60 * S + round(late.start * S)
    np.testing.assert_allclose(
        found.fresh_fit, simulation(tracked[0].estimate.model, late).fit, rtol=1e-9)


@pytest.mark.parametrize(('stride', 'tested'), [(0.08, False), (0.2, True)])
def test_few_new_samples_are_no_test(stride, tested):
    found = run(windows(pair(), count=2, stride=stride))[1]
    assert np.isfinite(found.fresh_fit).all() == tested
    assert (found.fresh_end_ns > 0) == tested


@pytest.mark.slow
def test_a_changed_plant_shows_before_it_is_learnt():
    old, new = windows(pair(), count=2), windows(pair(9.0), seed=2, count=4, start=8.0)
    found = run([*old, *new])
    fits = [t.fresh_fit[0] for t in found]
    assert fits[1] > 85
    assert fits[2] < 50
    assert min(fits[3:]) > 85
    # The same mode in the same row and the same states, one step further.
    assert {t.modes for t in found} == {(1, 2)}
    assert {t.realisation for t in found} == {1}
    C = np.array([t.estimate.model.C for t in found])
    assert np.ptp(C) < np.abs(C).max()


def changing(at: float, duration: float) -> Record:
    """One run of a resonance that turns from 6 to 9 rad/s at a time [s]; u is held."""
    rng, h = np.random.default_rng(5), 0.01
    count = round(duration / h)
    u = np.repeat(rng.choice([-1.0, 1.0], count // 20 + 1), 20)[:count]
    steps = []
    for omega in (6.0, 9.0):
        M = np.zeros((3, 3))
        M[:2] = [[0.0, 1.0, 0.0], [-omega ** 2, -0.6 * omega, omega ** 2]]
        steps.append(expm(M * h)[:2])
    x, y = np.zeros(2), np.zeros(count)
    for k in range(count):
        y[k] = x[0]
        x = steps[k * h >= at] @ [*x, u[k]]
    t = h * np.arange(count)
    y += 0.05 * y.std() * rng.standard_normal(count)
    return Record.from_arrays(t, u, t, y, input_hold='zoh')


def test_once_a_change_is_known_no_window_that_straddles_it_is_accepted():
    whole, at = changing(12.0, 26.0), 12.0
    starts = [1.0, 8.0, 10.0, 11.0, 13.0, 15.0]
    records = [whole.between(float(start), float(start) + 8.0) for start in starts]
    found = [t.estimate for t in run(records)]
    names = [e.status.name for e in found]
    assert names[0] == 'OK'
    seen = names.index('CHANGED')
    assert starts[seen] + 8.0 > at
    for start, estimate in zip(starts[seen:], found[seen:], strict=True):
        if start < at - 0.5:
            assert not estimate.ok, start
    assert names[-2:] == ['OK', 'OK']
    np.testing.assert_allclose(np.abs(found[-1].model.poles), 9.0, rtol=0.03)
    # By itself, the last window that the change is in might have been believed.
    late = starts.index(11.0)
    alone = identify(records[late], SETTINGS)
    assert found[late].rejected_model is not None
    assert alone.status is Status.CHANGED or 'earlier window' in found[late].notes[-1]


def test_faults_of_samples_are_the_reason_and_no_change_of_the_plant():
    """The samples change for 2 s, which looks like a change of the plant."""
    whole, fault = changing(12.0, 26.0), 'Samples are mixed; stop one.'
    faulty = replace(whole.between(8.0, 16.0), faults=(fault,))
    tracker = Tracker(SETTINGS)
    found = tracker.take(faulty).estimate
    assert found.status is Status.CHANGED
    assert found.verdict.reason == fault
    short = replace(whole.between(11.6, 19.6), faults=(fault,))
    assert tracker.take(short).estimate.verdict.reason == fault
    found = tracker.take(whole.between(13.0, 21.0)).estimate
    assert 'earlier window' not in found.verdict.reason
    found = tracker.take(replace(whole.between(15.0, 23.0), faults=(fault,))).estimate
    assert (found.verdict.grade, found.verdict.reason) == (Grade.WEAK, fault)


@pytest.mark.slow
def test_a_change_is_forgotten_with_a_reset():
    whole = changing(12.0, 26.0)
    tracker = Tracker(SETTINGS)
    assert tracker.take(whole.between(8.0, 16.0)).estimate.status is Status.CHANGED
    short = whole.between(11.6, 19.6)
    before = tracker.take(short).estimate
    tracker.reset()
    after = tracker.take(short).estimate
    alone = identify(short, SETTINGS)
    assert after.status is alone.status
    assert not before.ok


def test_a_window_without_a_model_changes_nothing(steady, tracked, begun):
    bad = begun.take(silent(steady[1]))
    assert bad.estimate.status is Status.NO_EXCITATION
    assert (bad.realisation, bad.modes, len(bad.eigenvalues)) == (1, (), 0)
    assert np.isfinite(bad.fresh_fit).all()  # the earlier model is tested all the same
    assert same(begun.take(steady[1]), tracked[1])


def test_nothing_before_the_first_model(steady):
    tracker = Tracker(SETTINGS)
    bad = tracker.take(silent(steady[0]))
    assert (bad.realisation, bad.modes) == (0, ())
    assert np.isnan(bad.fresh_fit).all()
    assert tracker.take(steady[0]).realisation == 1


def test_another_order_starts_new_states_but_keeps_known_modes(steady):
    tracker, found = Tracker(), []
    for order, record in zip((2, 3, 3, 2, 3), steady, strict=True):
        tracker.settings = SETTINGS.replace(order=order)
        found.append(tracker.take(record))
    assert [t.estimate.model.n for t in found] == [2, 3, 3, 2, 3]
    realisations = [t.realisation for t in found]
    assert realisations[:2] == [1, 2]
    assert realisations[2] < realisations[3] < realisations[4]
    for t in found:
        assert t.modes[:2] == (1, 2)  # the pair; the third one is of the noise
        np.testing.assert_allclose(np.abs(t.eigenvalues[:2]), 6, rtol=0.1)
        np.testing.assert_allclose(np.sort_complex(t.eigenvalues),
                                   np.sort_complex(t.estimate.model.poles))
        for pole, std in zip(t.eigenvalues, t.eigenvalue_std, strict=True):
            assert std in t.estimate.pole_std[t.estimate.model.poles == pole]
    assert found[4].modes[2] not in found[1].modes + found[2].modes


def test_reset_forgets_models_but_counts_on(steady, begun):
    begun.reset()
    found = begun.take(steady[1])
    assert (found.realisation, found.modes) == (2, (3, 4))
    assert np.isnan(found.fresh_fit).all()


def test_a_reset_while_a_window_is_identified_holds(steady, monkeypatch):
    tracker = Tracker(SETTINGS)

    def interrupted(record, settings, **how):
        tracker.reset()  # as another thread would
        return identify(record, settings, **how)
    monkeypatch.setattr(tracking, 'identify', interrupted)
    tracker.take(steady[0])
    monkeypatch.undo()
    assert np.isnan(tracker.take(steady[1]).fresh_fit).all()


def test_other_channels_are_a_mistake_until_reset(begun):
    other = windows(PLANTS['hd51'])[1]
    with pytest.raises(DataError, match='output channels'):
        begun.take(other)
    begun.reset()
    assert begun.take(other).estimate.ok


def test_nothing_but_the_last_model_is_kept(steady):
    tracker, sizes = Tracker(SETTINGS.replace(refine=False, held_out=0.0)), []
    for record in [*steady, *steady]:
        tracker.take(record)
        sizes.append(len(pickle.dumps(vars(tracker))))
    assert max(sizes[5:]) < max(sizes[:5]) + 100  # bytes
    assert max(sizes) < 10_000


def test_a_model_that_explodes_is_told_as_such(steady, begun):
    """Poles that coincide, and more than e^700 within the window."""
    wild = StateSpace([[1e3, 1], [0, 1e3]], [[0], [1]], [[1, 0]])
    begun._past = replace(begun._past, model=wild)
    found = begun.take(steady[1])
    assert found.estimate.ok
    assert found.fresh_fit[0] < EXPLAINED       # what of it is bounded is next to nothing


def test_an_unstable_plant_is_tracked():
    rng = np.random.default_rng(4)
    records = [replace(flown(rng, rate=100.0, duration=6.0), epoch_ns=6 * k * S)
               for k in range(3)]
    found = run(records, SETTINGS.replace(feedthrough=False))
    assert {t.realisation for t in found} == {1}
    assert {t.modes for t in found} == {(1, 2)}
    for t in found:
        np.testing.assert_allclose(t.eigenvalues, [2, -3], atol=0.2)
    A = np.array([t.estimate.model.A for t in found])
    assert np.ptp(A, axis=0).max() < 0.2


def test_spikes_in_new_data_do_not_speak_against_a_model():
    first, second = windows(pair(), count=2)
    output, = second.outputs
    values = output.values.copy()
    values[[420, 460]] += 20.0 * np.ptp(values)
    spiky = replace(second, outputs=(replace(output, values=values),))
    clean, spoilt = run([first, second])[1], run([first, spiky])[1]
    assert spoilt.fresh_fit == pytest.approx(clean.fresh_fit, abs=1.0)
    assert spoilt.estimate.verdict.grade == clean.estimate.verdict.grade
    less, notes = without_corrupt(spiky, SETTINGS)
    assert len(less.outputs[0].time) == len(output.time) - 2
    assert notes == ('2 corrupt samples of y1 are left out of the fits',)
    assert without_corrupt(second, SETTINGS) == (second, ())


@pytest.mark.parametrize('acts', [False, *slow(True)])
def test_inputs_are_bridged_where_a_model_says_so(acts):
    """A test of a model used spikes of inputs that identification had left out."""
    rng, t = np.random.default_rng(0), 0.02 * np.arange(1500)
    u = np.sin(np.outer(t, rng.uniform(0.5, 4.0, 8)) + rng.uniform(0.0, 6.0, 8)).sum(axis=1)
    jabs = np.zeros(1500)
    jabs[rng.choice(1400, 6) + 50] = 40.0
    x = np.zeros(1500)
    for k, now in enumerate((u + acts * jabs)[:-1]):
        x[k + 1] = np.exp(-0.06) * x[k] - np.expm1(-0.06) * now
    x += 0.01 * rng.standard_normal(1500)
    record, clean = (Record.from_arrays(t, log, t, x, input_hold='smooth')
                     for log in (u + jabs, u + acts * jabs))
    found = identify(clean, SETTINGS.replace(feedthrough=False, order=1))
    assert found.model.n == 1
    seen, notes = without_corrupt(record, SETTINGS, found.model)
    assert any('of input u1 are bridged' in note for note in notes) != acts
    assert simulation(found.model, seen).fit[0] == pytest.approx(found.fit[0], abs=0.2)
    assert acts or simulation(found.model, record).fit[0] < found.fit[0] - 5.0


def test_of_several_models_all_have_to_say_so():
    """The wrong one, named first, had jabs of the input that act called corrupt."""
    rng, t = np.random.default_rng(0), 0.02 * np.arange(1500)
    u, x = np.sin(np.outer(t, rng.uniform(0.5, 4.0, 8))).sum(axis=1), np.zeros(1500)
    u[rng.choice(1400, 6) + 50] += 40.0
    for k, now in enumerate(u[:-1]):
        x[k + 1] = np.exp(-0.06) * x[k] - np.expm1(-0.06) * now
    record = Record.from_arrays(t, u, t, x + 0.01 * rng.standard_normal(1500),
                                input_hold='smooth')
    right, wrong = (StateSpace(*np.array([[[-p]], [[p]], [[1.0]], [[0.0]]])) for p in (3.0, 30.0))
    one, other = (without_corrupt(record, SETTINGS, *models)[0] for models in (
        (right, wrong), (wrong, right)))
    assert [s.values.tolist() for s in (*one.inputs, *one.outputs)] == [
        s.values.tolist() for s in (*other.inputs, *other.outputs)]
    np.testing.assert_array_equal(one.inputs[0].values, record.inputs[0].values)


@pytest.mark.parametrize(('apart', 'grade'), [(0.09, 'GOOD'), (0.12, 'WEAK'), (np.inf, 'WEAK'),
                                              (np.nan, 'GOOD')])
def test_successive_models_that_simulate_a_window_apart_are_not_good(alone, apart, grade):
    good = alone[0]
    assert good.good
    found = tracking.in_sequence(good, np.array([99.0]), np.array([1.0]), np.array([apart]))
    assert found.verdict.grade.name == grade
    assert ('of its motion apart' in found.verdict.reason) == (grade == 'WEAK')
    np.testing.assert_array_equal(found.verdict.apart, [apart])


def test_how_far_apart_models_are_is_what_a_user_simulates(steady, alone):
    """A gain of 0.8 on the motion that is not free: offsets and states are fitted."""
    good, record = alone[0], steady[0]

    def apart(model, by_predictions=False):
        past = tracking._Past(model=model, by_predictions=by_predictions)
        return tracking._apart(past, good, record, tracking._simulated(model, record))[0]
    weaker = replace(good.model, B=0.8 * good.model.B)
    y = record.outputs[0].values[record.outputs[0].rows(record.start, record.end)]
    one, other = (simulation(m, record, trim='refit').y_hat for m in (good.model, weaker))
    assert apart(weaker) == pytest.approx(np.sqrt(np.mean((one - other) ** 2)) / y.std(), rel=1e-9)
    assert 0.1 < apart(weaker) < 0.25
    # In other states it is the same model.
    assert apart(good.model.transform([[2.0, 1.0], [0.0, 3.0]])) < 1e-8
    assert np.isnan(apart(None))
    assert np.isnan(apart(weaker, by_predictions=True))


def test_models_are_as_far_apart_as_outputs_at_their_own_stamps_say(steady, alone):
    """Of one every third sample, and of a second one that has others."""
    good, record = alone[0], steady[0]
    y, = record.outputs
    seldom = replace(record, outputs=(y.of(np.arange(len(y.time)) % 3 == 0),))
    weaker = replace(good.model, B=0.8 * good.model.B)
    past = tracking._Past(model=weaker)
    whole, thin = (tracking._apart(past, good, one, tracking._simulated(weaker, one))[0]
                   for one in (record, seldom))
    assert thin == pytest.approx(whole, rel=0.1)
    model = replace(good.model, C=np.vstack((good.model.C, good.model.C)), D=np.zeros((2, 1)),
                    K=np.zeros((2, 2)), y_trim=np.zeros(2), noise=None,
                    output_names=('y', 'z'), output_units=('', ''))
    both = replace(record, outputs=(y, seldom.outputs[0].of(
        np.arange(len(seldom.outputs[0].time)) % 2 == 1)))
    last = tracking._simulated(replace(model, B=0.8 * model.B), both)
    found = tracking._apart(past, replace(good, model=model), both, last)
    assert found == pytest.approx([whole, whole], rel=0.15)


def late_lag(delay: float, duration: float) -> Record:
    """A lag of 0.5 s behind a dead time, moved every half second."""
    rng = np.random.default_rng(0)
    t_u, t_y = np.arange(0.0, duration, 0.05), np.arange(0.0, duration, 0.02)
    u = np.repeat(rng.uniform(-1.0, 1.0, len(t_u) // 10 + 1), 10)[:len(t_u), np.newaxis]
    y = StateSpace([[-2.0]], [[2.0]], [[1.0]], delay=(delay,)).simulate(
        (Signal(t_u, u, 'zoh'),), t_y)[:, 0]
    return Record.from_arrays(t_u, u, t_y, y + 0.02 * rng.standard_normal(len(y)),
                              input_hold='zoh')


def windows_of(whole: Record, length: float, stride: float, settings: Settings) -> list[Record]:
    """The windows of a stream of these samples, by the way of the node and of a replay."""
    slider = SlidingWindow((Group('u', 1, 'input', 'zoh'), Group('y', 1, 'output', 'smooth')),
                           length, stride, 0.1, settings.longest_delay(1, length))
    samples = [(stamp, name, row) for name, (signal,) in (('u', whole.inputs),
                                                          ('y', whole.outputs))
               for stamp, row in zip(signal.time, signal.values, strict=True)]
    found = []
    for stamp, name, row in sorted(samples, key=lambda sample: sample[0]):
        slider.push(name, 1000 * S + round(stamp * 1e9), row)
        found += slider.due()
    return found + list(slider.flush())


@pytest.mark.parametrize('feedthrough', [True, *slow(False)])
@pytest.mark.parametrize('delay', [0.5, *slow(0.05, 2.0, 4.0)])
def test_windows_answer_to_inputs_that_came_before_them(delay, feedthrough):
    """Cut at its start, one in three of 2 s was of another order, and REJECT or another plant."""
    settings = Settings(feedthrough=feedthrough)
    first, *others = windows_of(late_lag(delay, 46.0), 20.0, 5.0, settings)
    assert first.inputs[0].time[0] == 0.0
    assert len(others) == 5
    for record in others:
        assert record.inputs[0].time[0] == pytest.approx(-5.0, abs=0.16)
        assert record.outputs[0].time[0] == pytest.approx(0.0, abs=0.07)
        found = identify(record, settings)
        lags = -1.0 / found.model.poles.real        # perhaps with one of less than a sample
        assert (found.verdict.grade, found.model.n <= 2) == (Grade.GOOD, True)
        assert max(lags) == pytest.approx(0.5, abs=0.025)
        assert found.model.delay[0] + sum(lags) - max(lags) == pytest.approx(delay, abs=0.015)


@pytest.mark.slow
def test_windows_of_five_dead_times_invent_no_change():
    """Without the inputs before them two of three were "does not follow the inputs"."""
    tracker = Tracker(Settings(feedthrough=False))
    for record in windows_of(late_lag(2.0, 35.0), 10.0, 5.0, tracker.settings)[1:]:
        found = tracker.take(record).estimate
        assert (found.status, found.model.n) == (Status.OK, 1)
        assert found.model.delay[0] == pytest.approx(2.0, abs=0.02)


def test_inputs_before_a_window_change_nothing_where_none_acts_later():
    whole, settings = late_lag(0.0, 30.0), Settings(delay=0.0)
    alone, known = (identify(whole.between(10.0, 30.0, lead=lead), settings)
                    for lead in (0.0, 5.0))
    np.testing.assert_allclose(known.model.poles, alone.model.poles, rtol=1e-6)
    np.testing.assert_allclose(known.fit, alone.fit, rtol=1e-6)
    # Independent samples are counted up to a lag, which rounding may move by one.
    np.testing.assert_allclose(known.pole_std, alone.pole_std, rtol=0.03)
    np.testing.assert_allclose([one.uncertainty for one in known.verdict.excitation],
                               [one.uncertainty for one in alone.verdict.excitation], rtol=0.03)
    assert (known.start_ns, known.end_ns, known.notes) == (
        alone.start_ns, alone.end_ns, alone.notes)
    assert known.statistics.keys() == alone.statistics.keys()
    assert {k: known.statistics[k] for k in known.statistics if 'samples' in k} == {
        k: alone.statistics[k] for k in alone.statistics if 'samples' in k}


@pytest.mark.parametrize('held_out', [0.0, *slow(0.3)])
def test_windows_apart_tell_of_a_change_by_what_the_model_left_in_its_own(held_out):
    """There are no older data in a window that begins after the one before has ended."""
    settings = Settings(order=1, feedthrough=False, delay=0.0, held_out=held_out)
    whole = late_lag(0.0, 60.0)
    y, = whole.outputs
    weaker = replace(y, values=np.where(y.time >= 40.0, 0.7, 1.0)[:, np.newaxis] * y.values)
    for output, grades in ((y, ('GOOD',) * 3), (weaker, ('GOOD', 'WEAK', 'GOOD'))):
        record = replace(whole, outputs=(output,))
        found = run([record.between(20.0 * k - 18.0, 20.0 * k) for k in (1, 2)]
                    + [record.between(41.0, 50.0), record.between(50.5, 60.0)], settings)
        assert tuple(t.estimate.verdict.grade.name for t in found[1:]) == grades
        changed = found[2].estimate.verdict
        assert ('previous model simulates the new data of output y1 badly' in changed.reason) == (
            output is weaker)
        assert (changed.fresh_ratio > 3.0) == (output is weaker)
        assert 0.7 < found[3].estimate.verdict.fresh_ratio < 1.4
    first = found[0].estimate.verdict
    assert ('has not been tested' in first.reason) == (held_out == 0.0)


def test_a_window_whose_sensor_has_fallen_silent_tells_nothing_of_now():
    settings = Settings(order=1, feedthrough=False, delay=0.0)
    whole = late_lag(0.0, 40.0)
    (u,), (y,) = whole.inputs, whole.outputs
    died = replace(whole, outputs=(replace(y, time=y.time[y.time < 25.0],
                                           values=y.values[y.time < 25.0]),))
    seen = 0
    for record in windows_of(died, 10.0, 2.0, settings):
        end = record.epoch_ns / S - 1000.0 + record.duration
        if end > 34.0:          # it is too short for a model then
            continue
        seen += 1
        verdict = run([record], settings)[0].estimate.verdict
        assert verdict.grade is (Grade.GOOD if end < 25.9 else Grade.WEAK), end
        if end > 26.1:
            silent_for = f'No sample of y1 has come in the last {end - 24.98:.3g} s of the window'
            assert verdict.reason.startswith(silent_for)
    assert seen == 13
    # A command that is sent when it changes is known all the time.
    rests = replace(whole, inputs=(replace(u, time=u.time[u.time < 25.0],
                                           values=u.values[u.time < 25.0]),)).between(20.0, 30.0)
    assert 'No sample' not in run([rests], settings)[0].estimate.verdict.reason
    measured = replace(rests, inputs=(replace(rests.inputs[0], hold='linear'),))
    found, = run([measured], settings.replace(delay='auto'))    # levels seem late if it is linear
    assert 'No sample of u1' in found.estimate.verdict.reason


def test_spikes_of_the_window_of_a_model_are_none_of_its_errors():
    """Of a window without older data; ten spikes made what the model leaves a tenth of it."""
    settings = Settings(order=1, feedthrough=False, delay=0.0)
    whole = late_lag(0.0, 40.0)
    y, = whole.outputs
    values = y.values * np.where(y.time >= 20.0, 0.7, 1.0)[:, np.newaxis]
    values[100:1000:100] += 100.0
    spiky = replace(whole, outputs=(replace(y, values=values),))
    before, after = run([spiky.between(1.0, 20.0), spiky.between(21.0, 40.0)], settings)
    assert before.estimate.statistics['corrupt_samples'] == 9
    assert 'the new data of output y1 badly' in after.estimate.verdict.reason


@pytest.mark.parametrize(('fit', 'ratio', 'grade'), [
    ((95.0, 60.0), (np.nan, np.nan), 'WEAK'), ((95.0, 60.0), (1.1, 1.2), 'GOOD'),
    ((95.0, np.nan), (1.1, np.nan), 'GOOD'), ((95.0, 20.0), (1.1, 1.0), 'WEAK'),
    ((np.nan, np.nan), (np.nan, np.nan), 'WEAK')])
def test_what_nothing_was_held_out_of_is_good_if_all_new_outputs_are_simulated_well(
        untested, fit, ratio, grade):
    """An output may be too seldom sampled to tell."""
    assert 'not been tested' in untested.verdict.reason
    numbers = np.array(fit), np.array(ratio), np.full(2, 0.05)
    verdict = tracking.in_sequence(untested, *numbers).verdict
    assert verdict.grade.name == grade
    assert ('not been tested' in verdict.reason) == (grade == 'WEAK')


@pytest.mark.parametrize(('what', 'ratio'), [
    ('nothing', 1.0), ('offset', 1.0), ('gain', 9.0), ('gust', 7.0), ('gust again', 1.0)])
def test_new_data_are_compared_with_stretches_as_long_before_them(what, ratio):
    """What an offset of its own explains is no change, nor a gust as large as one before."""
    rng = np.random.default_rng(0)
    times, t_u = np.arange(0.0, 12.0, 0.01), np.arange(0.0, 12.0, 0.02)
    u = np.repeat(rng.choice([-1.0, 1.0], 60), 10)[:, np.newaxis]
    lag = plant([[-2.0]], [[2.0]], [[1.0]])
    new, load = times > 10.0, 0.3 * ((times >= 11.0) | (what == 'gust again') & (
        (times >= 7.0) & (times < 8.0)))
    y = held_response(lag, t_u, u, times)[:, 0]
    y *= np.where(new & (what == 'gain'), 1.5, 1.0)
    y += 0.3 * (new & (what == 'offset')) + load * (what in ('gust', 'gust again'))
    y += 0.02 * rng.standard_normal(len(times))
    record = Record.from_arrays(t_u, u, times, y[:, np.newaxis], input_hold='zoh')
    past = tracking._Past(model=StateSpace(lag.A, lag.B, lag.C), end_ns=10 * S)
    window = record.between(0.1, 12.0)
    test = tracking._fresh(past, window, tracking._simulated(past.model, window))
    assert (test.fit[0] > 95.0) == (what == 'nothing')
    assert test.ratio[0] == pytest.approx(ratio, rel=0.35)


def three_modes(gain, end, start_of_change, seed=0):
    """Six states, 5 % of noise, and a gain that changes."""
    rng = np.random.default_rng(seed)
    A, B, C = np.zeros((6, 6)), np.zeros((6, 1)), np.zeros((1, 6))
    for k, omega in enumerate((2.0, 5.0, 9.0)):
        A[2 * k:2 * k + 2, 2 * k:2 * k + 2] = [[0.0, 1.0], [-omega ** 2, -0.4 * omega]]
        B[2 * k + 1], C[0, 2 * k] = omega, omega
    times, t_u = np.arange(0.0, end, 0.02), np.arange(0.0, end, 0.02)
    u = np.repeat(rng.choice([-1.0, 1.0], len(t_u) // 20 + 1), 20)[:len(t_u), np.newaxis]
    changed = np.where(t_u[:, np.newaxis] >= start_of_change, gain, 1.0) * u
    y = held_response(plant(A, B, C), t_u, changed, times)
    y += 0.05 * y.std() * rng.standard_normal(y.shape)
    return StateSpace(A, B, C), Record.from_arrays(t_u, u, times, y, input_hold='zoh')


@pytest.mark.parametrize(('gain', 'told'), [(1.0, False), (1.5, True)])
@pytest.mark.parametrize('seed', range(5))
def test_a_gain_that_changes_shows_in_a_tenth_of_a_window_of_many_states(gain, told, seed):
    """Six states of its own would imitate it."""
    model, record = three_modes(gain, 20.0, 19.0, seed)
    window = record.between(10.0, 20.0)
    test = tracking._fresh(tracking._Past(model=model, end_ns=19 * S), window,
                           tracking._simulated(model, window))
    assert (test.ratio[0] > 2.0) == told


@pytest.mark.parametrize('epoch', [0.0, 1.7e9 + 0.1])
@pytest.mark.parametrize('end', [8.0, 5.1, 4.0, 9.9])
def test_new_data_are_told_at_any_stamps(end, epoch):
    """A fifth of a window, half and more, and a thirtieth, of which a tenth is compared."""
    model, record = three_modes(1.0, 12.0, 99.0)
    (u,), (y,) = record.inputs, record.outputs
    late = replace(record, inputs=(replace(u, time=u.time + epoch),), outputs=(
        replace(y, time=y.time + epoch),), start=epoch, end=epoch + 10.2)
    past = tracking._Past(model=model, end_ns=round((end + epoch) * S), error=np.array([0.1]))
    test = tracking._fresh(past, late, tracking._simulated(model, late))
    assert np.isfinite(test.ratio).all()
    if end > 5.0:
        assert test.ratio[0] == pytest.approx(1.0, abs=0.3)
    early = replace(past, end_ns=round((epoch - 3.0) * S))
    assert np.isfinite(tracking._fresh(early, late, tracking._simulated(model, late)).ratio).all()


@pytest.mark.parametrize(('fit', 'ratio', 'grade'), [
    (60.0, 1.9, 'GOOD'), (60.0, 2.1, 'WEAK'), (91.0, 2.1, 'GOOD'), (-50.0, np.nan, 'WEAK')])
def test_new_data_that_are_simulated_badly_are_a_reason(alone, fit, ratio, grade):
    good = alone[0]
    found = tracking.in_sequence(good, *(np.array([x]) for x in (fit, ratio, 0.05)))
    assert found.verdict.grade.name == grade
    assert ('badly' in found.verdict.reason) == (grade == 'WEAK')


def test_an_order_that_was_set_meanwhile_is_no_reason(steady):
    tracker = Tracker(Settings(order=1))
    before = tracker.take(steady[0]).estimate
    tracker.settings = Settings(order=2)
    found = tracker.take(steady[1]).estimate
    assert 'of its motion apart' not in found.verdict.reason
    assert np.isnan(found.verdict.apart).all()
    assert before.model is None or before.model.n != found.model.n
    assert np.isfinite(tracker.take(steady[2]).estimate.verdict.apart).all()


def test_offsets_of_windows_apart_are_their_own():
    """A sensor whose zero has wandered meanwhile is no other plant."""
    settings = Settings(order=1, feedthrough=False, delay=0.0)
    whole = late_lag(0.0, 40.0)
    y, = whole.outputs
    moved = replace(whole, outputs=(replace(y, values=y.values + 0.5 * (
        y.time >= 20.0)[:, np.newaxis]),))
    after = run([moved.between(1.0, 20.0), moved.between(20.5, 40.0)], settings)[1]
    assert after.fresh_fit[0] < 60.0
    assert after.estimate.verdict.fresh_ratio[0] == pytest.approx(1.0, abs=0.2)
    assert after.estimate.good


def test_few_older_data_are_no_measure_of_what_a_model_leaves():
    """The window before ended within this one, after the plant had changed."""
    settings = Settings(order=1, feedthrough=False, delay=0.0)
    whole = late_lag(0.0, 40.0)
    y, = whole.outputs
    weaker = replace(whole, outputs=(replace(y, values=0.7 * y.values),))
    after = run([whole.between(1.0, 20.0), weaker.between(18.0, 36.0)], settings)[1]
    assert after.estimate.verdict.fresh_ratio[0] > 3.0
    assert after.estimate.verdict.grade is Grade.WEAK


def test_what_a_model_leaves_is_what_it_leaves_of_what_it_has_not_seen(steady, alone):
    found = alone[0]
    motion = np.std(steady[0].outputs[0].values[steady[0].outputs[0].rows(
        steady[0].start, steady[0].end)])
    for held_out, wanted in ((0.2, 0.2), (0.05, 0.1), (np.nan, 0.1)):
        verdict = replace(found.verdict, error=np.array([0.1]),
                          held_out_error=np.array([held_out]))
        assert tracking._error(replace(found, verdict=verdict), steady[0]) == pytest.approx(
            [wanted * motion])
    predicted = replace(found, choices=(Choice('domain', 'predictions', 'why'),))
    assert np.isnan(tracking._error(predicted, steady[0])).all()


def test_an_uncertain_pole_is_told_where_new_data_lift_a_verdict(untested):
    unsure = replace(untested, verdict=replace(untested.verdict, pole_uncertainty=1.6))
    numbers = (np.array([number]) for number in (98.0, 1.0, 0.05))
    verdict = tracking.in_sequence(unsure, *numbers).verdict
    assert verdict.grade is Grade.GOOD
    assert verdict.reason.endswith('of its size: do not use that pole by itself.')
