# SPDX-License-Identifier: Apache-2.0
"""Alignment of states: exact for one system, in proportion for neighbouring ones."""

from __future__ import annotations

from dataclasses import replace

from marks import slow
import numpy as np
from plants import PLANTS, random_plant
import pytest
from scipy.optimize import least_squares

from ctsid_core.errors import DataError
from ctsid_core.model import realisation
from ctsid_core.model.statespace import StateSpace
from ctsid_core.sequence.alignment import aligning, referring
from ctsid_core.signals.record import Signal

RNG = np.random.default_rng
INTEGRATORS = StateSpace([[0, 1, 0], [0, 0, 1], [0, 0, -5]], [[0], [0], [5]], [[1, 0, 0]])
# A quadrotor's axis: twice unstable, with a motor lag and three sensors in mixed units
FLYING = StateSpace([[0.1, 1, 0], [0.5, 0.2, 300], [0, 0, -20]], [[0], [0], [20]],
                    [[57, 0, 0], [0, 1, 0], [0, 0.0002, 0.05]])


def reference_form(system):
    return referring(system)[0]


def align(system, reference):
    T = aligning(system, reference)
    return None if T is None else system.transform(T)


def model(plant) -> StateSpace:
    return StateSpace(plant.A, plant.B, plant.C, plant.D)


def random_model(seed: int, n: int, nu: int, ny: int) -> StateSpace:
    return model(random_plant(RNG(seed), n, nu, ny))


MODELS = {
    **{f'random{n}{nu}{ny}': random_model(n, n, nu, ny)
       for n, nu, ny in ((1, 1, 1), (2, 1, 1), (3, 1, 2), (4, 2, 1), (5, 2, 3), (8, 3, 3))},
    **{name: model(plant) for name, plant in PLANTS.items()},
    'integrators': INTEGRATORS, 'flying': FLYING,
    'equal poles': StateSpace(-np.eye(2), np.eye(2), [[1.0, 0.5], [0.2, 1.0]]),
    'defective': StateSpace([[-1, 1], [0, -1]], [[0], [1]], [[1, 0]]),
}


def away(a: StateSpace, b: StateSpace) -> float:
    """The largest change of an entry, over the size of its matrix's rows or columns."""
    def largest(x, y, axis):
        size = np.linalg.norm(y, axis=axis, keepdims=True)
        return np.max(np.abs(x - y) / np.where(size > 0, size, 1.0))
    return max(np.max(np.abs(a.A - b.A)) / np.linalg.norm(b.A), largest(a.B, b.B, 0),
               largest(a.C, b.C, 1))


def disguised(system: StateSpace, seed: int = 0, condition: float = 1e3) -> StateSpace:
    """The same system in other states."""
    rng, n = RNG(seed), system.n
    left, right = (np.linalg.qr(rng.standard_normal((n, n)))[0] for _ in range(2))
    return system.transform(left @ np.diag(np.geomspace(1, condition, n)) @ right)


@pytest.mark.parametrize('name', MODELS)
@pytest.mark.parametrize('seed', range(3))
def test_similar_systems_become_the_same(name, seed):
    reference = reference_form(MODELS[name])
    found = align(disguised(MODELS[name], seed), reference)
    assert found is not None
    assert away(found, reference) < 1e-8


@pytest.mark.parametrize('name', MODELS)
def test_any_states_of_the_reference_will_do(name):
    found = align(MODELS[name], disguised(MODELS[name], 7))
    assert away(found, disguised(MODELS[name], 7)) < 1e-7


@pytest.mark.parametrize('name', MODELS)
def test_the_states_a_model_came_with_do_not_matter(name):
    reference = reference_form(MODELS[name])
    rng = RNG(4)
    near = replace(MODELS[name], **{key: getattr(MODELS[name], key) * (
        1 + 0.05 * rng.standard_normal(getattr(MODELS[name], key).shape)) for key in 'ABC'})
    one, other = align(near, reference), align(disguised(near, 5), reference)
    assert away(one, other) < 1e-7
    np.testing.assert_allclose(one.poles, near.poles, rtol=1e-6, atol=1e-6)


def oscillator(damping: float) -> StateSpace:
    """A pair that meets on the real axis at 1, beside a mode it is coupled to, and a gain."""
    return StateSpace([[0, 1, 0], [-9, -6 * damping, 2], [0.5, 0, -1]], [[0], [9], [1]],
                      [[1, 0, 0], [0, 0.3, 1]])


def steps(form, path) -> np.ndarray:
    """The change from each model of a path to the next."""
    models = [form(system) for system in path]
    return np.array([away(b, a) for a, b in zip(models[:-1], models[1:], strict=True)])


@pytest.mark.slow
def test_entries_move_in_proportion_while_modes_meet_and_part():
    there = 0.7 + 0.6 * np.sin(np.linspace(0, np.pi, 101))  # complex, real, complex again
    path = [oscillator(z) for z in there]
    kinds = {bool(system.poles.imag.any()) for system in path}
    assert kinds == {True, False}
    reference = reference_form(path[0])
    change = steps(lambda system: disguised(system), path)  # what one would do by hand
    aligned = steps(lambda system: align(disguised(system), reference), path)
    assert aligned.max() < 2.0 * change.max()
    assert away(align(path[-1], reference), reference) < 1e-9  # back to where it began
    # half the step, half the change
    finer = [oscillator(z) for z in 0.7 + 0.6 * np.sin(np.linspace(0, np.pi, 201))]
    halved = steps(lambda system: align(system, reference), finer)
    assert halved.max() == pytest.approx(aligned.max() / 2, rel=0.1)


def test_balanced_states_swap_where_aligned_ones_do_not():
    path = [StateSpace(np.diag([-1.0, -3.0]), [[1.0, 0.0], [0.0, g]], np.eye(2))
            for g in np.linspace(2, 4, 41)]  # Hankel singular values 0.5 and g/6
    assert steps(lambda system: system.transform(
        realisation.balancing(system.A, system.B, system.C)), path).max() > 0.5
    reference = reference_form(path[0])
    assert steps(lambda system: align(system, reference), path).max() < 0.05


@pytest.mark.parametrize('name', ['flying', *slow('integrators', 'unstable')])
def test_plants_pass_from_stable_to_unstable_without_a_jump(name):
    system = MODELS[name]
    rate = 0.1 * np.abs(system.poles).max()
    reference = reference_form(replace(system, A=system.A - rate * np.eye(system.n)))

    def moved(count):
        path = [replace(system, A=system.A - s * np.eye(system.n))
                for s in np.linspace(rate, -rate, count)]
        return steps(lambda given: align(disguised(given, 3), reference), path).max()
    assert moved(41) < 0.05
    assert moved(81) == pytest.approx(moved(41) / 2, rel=0.2)


def test_a_reference_does_not_drift():
    rng = RNG(2)
    start = system = random_model(3, 4, 2, 2)
    reference = reference_form(start)
    for _ in range(50):
        system = replace(system, A=system.A * (1 + 0.01 * rng.standard_normal((4, 4))))
        assert align(system, reference) is not None
    assert away(align(start, reference), reference) < 1e-10


@pytest.mark.parametrize('name', ['random523', 'random833', 'hd52', 'flying'])
def test_units_do_not_matter(name):
    system, rng = MODELS[name], RNG(6)
    u, y = 10.0 ** rng.uniform(-3, 3, system.nu), 10.0 ** rng.uniform(-3, 3, system.ny)

    def converted(given: StateSpace) -> StateSpace:
        return replace(given, B=given.B / u, C=(given.C.T * y).T,
                       D=(given.D.T * y).T / u, K=given.K / y)

    near = replace(system, A=system.A * 1.1, B=system.B + 0.05 * system.B[::-1])
    reference = reference_form(system)
    plain = align(near, reference)
    other = align(converted(near), converted(reference))
    assert away(other, converted(plain)) < 1e-9


def changes(system: StateSpace, reference: StateSpace) -> np.ndarray:
    """All changes of entries; A, B and C count alike."""
    scale = np.linalg.norm(reference.B, axis=0), np.linalg.norm(reference.C, axis=1)
    return np.concatenate([
        ((system.A - reference.A) / np.linalg.norm(reference.A)).ravel(),
        ((system.B - reference.B) / scale[0] / np.sqrt(system.nu)).ravel(),
        ((system.C - reference.C).T / scale[1] / np.sqrt(system.ny)).ravel()])


@pytest.mark.parametrize('name', ['random211', 'random312', 'random421', 'hd51', 'hd52',
                                  'unstable', 'flying'])
def test_entries_move_hardly_more_than_they_must(name):
    reference, rng = reference_form(MODELS[name]), RNG(8)
    near = replace(reference, A=reference.A * (1 + 0.1 * rng.standard_normal(reference.A.shape)),
                   B=reference.B * (1 + 0.1 * rng.standard_normal(reference.B.shape)))
    found = align(disguised(near), reference)
    n = reference.n
    least = least_squares(  # the rival: a general search
        lambda t: changes(near.transform(np.eye(n) + t.reshape(n, n)), reference),
        np.zeros(n * n), method='lm').fun
    assert np.linalg.norm(changes(found, reference)) < 1.05 * np.linalg.norm(least)


def test_everything_else_of_the_model_comes_along():
    rng = RNG(9)
    system = replace(random_model(4, 3, 2, 2), K=rng.standard_normal((3, 2)), delay=(0.1, 0.0),
                     x_trim=rng.standard_normal(3), y_trim=rng.standard_normal(2),
                     noise=np.eye(2), input_names=('a', 'b'), output_units=('m', 's'))
    found = align(disguised(system), reference_form(replace(system, A=1.1 * system.A)))
    times = np.linspace(0, 3, 50)
    inputs = (Signal(times, rng.standard_normal((50, 2)), 'linear'),)
    # At rest before the trim sets in: any states mean the same.
    np.testing.assert_allclose(found.simulate(inputs, times), system.simulate(inputs, times),
                               atol=1e-9)
    s = 2.0j * np.eye(3)
    np.testing.assert_allclose(found.C @ np.linalg.solve(s - found.A, found.K),
                               system.C @ np.linalg.solve(s - system.A, system.K), atol=1e-9)
    assert (found.delay, found.input_names, found.output_units) == (
        (0.1, 0.0), ('a', 'b'), ('m', 's'))
    np.testing.assert_array_equal(found.noise, np.eye(2))


def test_channels_that_are_constant_in_one_of_them_do_not_count():
    system = random_model(1, 3, 2, 2)
    half = replace(system, B=system.B * [1, 0], C=system.C * [[0], [1]])
    reference = reference_form(system)
    assert away(replace(align(disguised(half), reference), B=reference.B, C=reference.C),
                reference) < 1e-9
    back = align(disguised(system), reference_form(half))
    np.testing.assert_allclose(back.A, reference_form(half).A, atol=1e-9)


@pytest.mark.slow
def test_an_input_may_lose_a_mode_and_find_it_again_with_the_other_sign():
    def moved(count):
        path = [StateSpace(np.diag([-1.0, -3.0]), [[1.0], [b]], [[1.0, 1.0], [0.0, 1.0]])
                for b in np.linspace(1, -1, count)]
        reference = reference_form(path[0])
        return steps(lambda system: align(system, reference), path).max()
    # The other sign is nearer to other states: it turns into them, fast but without a jump.
    coarse, fine = moved(161), moved(321)
    assert coarse < 0.2
    assert fine == pytest.approx(coarse / 2, rel=0.2)


@pytest.mark.parametrize('other', [
    random_model(1, 2, 1, 1),                                               # another order
    StateSpace(np.diag([-1.0, -2, -3]), [[1], [1], [1]], [[1, 1, 0]]),      # a state is not seen
    StateSpace(np.diag([-500.0, -2e3, -1e4]), [[1], [1], [1]], [[1, 1, 1]]),
])
def test_none_where_no_states_are_alike(other):
    assert align(other, reference_form(random_model(1, 3, 1, 1))) is None


def test_other_channels_are_a_mistake():
    with pytest.raises(DataError, match='2 input channels given, but the model has 1'):
        align(random_model(1, 2, 2, 1), random_model(1, 2, 1, 1))
    with pytest.raises(DataError, match='output'):
        align(random_model(1, 2, 1, 2), random_model(1, 2, 1, 1))


def test_a_gain_without_states_is_aligned():
    gain = StateSpace(np.empty((0, 0)), np.empty((0, 1)), np.empty((1, 0)), [[2.0]])
    assert align(gain, reference_form(gain)) == gain


@pytest.mark.parametrize('name', MODELS)
def test_reference_form_is_well_conditioned(name):
    system = MODELS[name]
    form, again = reference_form(disguised(system)), reference_form(disguised(system, 1))
    np.testing.assert_allclose(form.poles, system.poles, atol=1e-5 * np.abs(system.poles).max())
    omega = np.geomspace(0.1, 30, 5)
    np.testing.assert_allclose(form.frequency_response(omega), system.frequency_response(omega),
                               rtol=1e-6, atol=1e-9)
    sizes = np.linalg.norm(form.A, axis=1)
    assert sizes.max() < 1e3 * max(sizes.min(), np.abs(system.poles).mean())
    assert form.n == again.n


def test_reference_form_of_what_cannot_be_balanced():
    undriven = StateSpace([[-1, 5], [0, -2]], [[1], [0]], [[1, 1]])
    assert reference_form(undriven) == undriven
