# SPDX-License-Identifier: Apache-2.0
"""The compiled kernel and NumPy: the same columns, fits and slopes, for every kind of samples."""

from dataclasses import replace
import os
import subprocess
import sys

import numpy as np
import pytest

from ctsid_core.likelihood import kernel
from ctsid_core.likelihood.kernel import Shape
from ctsid_core.likelihood.mode_columns import _layout, columns_of
from ctsid_core.likelihood.output_error import Free, _slopes, climb, fit_at, jacobian, steps_around
from ctsid_core.likelihood.samples import Samples, samples_of
from ctsid_core.model.statespace import StateSpace
from ctsid_core.signals.record import Record, Signal

pytestmark = pytest.mark.skipif(not kernel.built(),
                                reason='the kernel was not built: there is no C compiler')

POLES = {'real': [-2.0, -30.0], 'pair': [-1.0 + 4.0j],
         'both': [-0.02, -400.0, -3.0 + 9.0j, -0.01 + 60.0j]}


def record(rng, nu, ny, hold, streams=1, samples=400):
    """
    Return one of some seconds, with jitter, a gap, and outputs that move.

    The second of several streams goes on for longer, and the last has no noise.
    """
    def stamps(count):
        t = np.sort(rng.uniform(0.0, 6.0, count))
        return t[(t < 3.0) | (t > 3.2)]

    inputs = []
    for _ in range(nu):
        t = stamps(150)
        inputs.append(Signal(t, np.cumsum(rng.normal(size=(len(t), 1)), axis=0), hold))
    if nu > 1:                                     # two channels that share their stamps
        two = np.cumsum(rng.normal(size=(len(inputs[0].time), 2)), axis=0)
        inputs[:2] = [Signal(inputs[0].time, two, hold)]
    parts = np.array_split(np.arange(ny), streams)
    outputs = []
    for k, part in enumerate(parts):
        t = stamps(samples) * (1.0 if k or streams == 1 else 0.7)
        noise = rng.normal(size=(len(t), len(part))) * (k < 1 or k < streams - 1)
        outputs.append(Signal(t, np.sin(np.outer(t, 1.0 + part)) + noise, 'smooth'))
    return Record(tuple(inputs), tuple(outputs), 0.1, 6.0)


def both_ways(samples: Samples):
    """Return the same samples twice: for the kernel, and for NumPy."""
    plain = replace(samples)
    plain.__dict__['kernel'] = None
    assert samples.kernel is not None
    return samples, plain


def free_of(samples, direct):
    return Free(direct, True, (True,) + (False,) * (samples.nu - 1), 0.5, -1e-6, 500.0)


CASES = [(1, 1, 'zoh', 1, 1, 400), (1, 2, 'linear', 2, 1, 400), (3, 2, 'zoh', 1, 2, 400),
         (2, 3, 'smooth', 2, 1, 2600), (2, 1, 'linear', 1, 3, 12), (1, 1, 'zoh', 1, 1, 5000)]


@pytest.mark.parametrize('direct', [False, True])
@pytest.mark.parametrize('poles', POLES)
@pytest.mark.parametrize(('nu', 'ny', 'hold', 'streams', 'records', 'count'), CASES)
def test_an_evaluation_is_that_of_numpy(nu, ny, hold, streams, records, count, poles, direct):
    rng = np.random.default_rng(count + nu)
    found = [record(rng, nu, ny, hold, streams, count) for _ in range(records)]
    samples = samples_of(found, [[None] * streams] * records)
    free, p = free_of(samples, direct), np.array(POLES[poles], dtype=complex)
    delay = np.where(np.arange(nu) == 0, 0.21, 0.0)
    compiled, plain = both_ways(samples)
    for slopes in (False, True):
        rows = [columns_of(s, p, delay, direct=direct, turned=False, slopes=slopes)
                for s in (compiled, plain)]
        assert np.array_equal(rows[0].layout.rows, rows[1].layout.rows)
        np.testing.assert_allclose(rows[0].values, rows[1].values, rtol=1e-12, atol=3e-12)
        np.testing.assert_allclose(rows[0].first, rows[1].first, rtol=1e-12)
        triangles = [columns_of(s, p, delay, direct=direct, slopes=slopes)
                     for s in (compiled, plain)]
        for mine, theirs in zip(*(t.triangles for t in triangles), strict=True):
            for a, b in zip(mine, theirs, strict=True):
                products = [np.hstack((t.z[:, :, 0], t.u, t.one[:, np.newaxis])).T @ t.y
                            for t in (a, b)]
                np.testing.assert_allclose(*products, rtol=1e-9, atol=1e-9 * count)
    one, other = (fit_at(s, p, delay, free) for s in (compiled, plain))
    np.testing.assert_allclose(one.power, other.power, rtol=1e-8)
    assert one.cost == pytest.approx(other.cost, rel=1e-8, abs=1e-6)
    (a, e, places), (b, f, others) = (jacobian(s, one, free) for s in (compiled, plain))
    assert places == others
    np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-9 * np.max(np.abs(b)))
    np.testing.assert_allclose(e, f, rtol=1e-7, atol=1e-9 * np.linalg.norm(f) + 1e-9)
    mine, theirs = (_slopes(s, one, free, steps_around(s, one.model)) for s in (compiled, plain))
    np.testing.assert_allclose(mine.curvature, theirs.curvature, atol=1e-8)
    np.testing.assert_allclose(mine.scale, theirs.scale, rtol=1e-8)
    size = np.linalg.norm(f)
    np.testing.assert_allclose(mine.gradient, theirs.gradient, atol=1e-9 * size)
    assert mine.linear == pytest.approx(theirs.linear, rel=1e-7, abs=1e-9 * size ** 2)


def test_slopes_are_those_of_numpy_where_columns_are_alike():
    """An input that stands still is an offset: what nothing determines takes no sample away."""
    rng = np.random.default_rng(3)
    t = np.arange(200) * 0.05
    u = np.column_stack((rng.normal(size=200), np.ones(200)))
    given = Record.from_arrays(t, u, t, rng.normal(size=(200, 2)), input_hold='zoh')
    compiled, plain = both_ways(samples_of([given], [[None]]))
    free = free_of(compiled, True)
    one = fit_at(compiled, np.array([-2.0 + 0j, -30.0]), np.zeros(2), free)
    mine, theirs = (_slopes(s, one, free, steps_around(s, one.model)) for s in (compiled, plain))
    np.testing.assert_allclose(mine.curvature, theirs.curvature, atol=1e-8)
    assert mine.linear == pytest.approx(theirs.linear, abs=1e-9)


def test_what_a_pole_beside_zero_leaves_of_a_start_keeps_its_digits():
    """Beside it free response and offset differ by 1e-6: what stamps multiply must not add up."""
    t = np.arange(20000) * 1e-3
    given = Record.from_arrays(t, np.sign(np.sin(3.0 * t)), t, np.cos(t), input_hold='zoh')
    samples, p = samples_of([given], [[None]]), -1e-7
    ((table, _),), = columns_of(samples, np.array([p + 0j]), np.zeros(1), direct=False,
                                turned=False, slopes=False).tables
    wanted = np.exp(p * (t - t[0]))
    away = np.min(np.max(np.abs(table - wanted[:, np.newaxis]), axis=0))
    assert away < 32 * np.finfo(float).eps          # so many products, one after another


@pytest.mark.parametrize('direct', [False, True])
def test_stamps_that_coincide_are_read_alike(direct):
    """A sample at a stamp, or a dead time of whole intervals: the new value counts."""
    t = np.arange(0.0, 4.0, 0.125)                          # sums of powers of 2 are exact
    u = np.sign(np.sin(3.0 * t))
    samples = samples_of([Record.from_arrays(t, u, t, np.cumsum(u), input_hold='zoh')], [[None]])
    for delay in (0.0, 0.25):
        one, other = (columns_of(s, np.array([-3.0 + 0.0j]), np.array([delay]), direct=direct,
                                 turned=False) for s in both_ways(samples))
        np.testing.assert_allclose(one.values, other.values, rtol=1e-12, atol=1e-13)


def test_outputs_without_noise_are_fitted_alike():
    t = np.arange(0.0, 8.0, 0.01)
    u = np.sign(np.sin(1.5 * t))
    first = samples_of([Record.from_arrays(t, u, t, u, input_hold='zoh')], [[None]])
    poles, delay, free = np.array([-2.0 + 0.0j]), np.zeros(1), free_of(first, False)
    y = 3.0 + 2.0 * columns_of(first, poles, delay, direct=False).samples.kernel.columns(
        _layout(first, Shape((0,), 1, 0, False, False), False), poles, delay)[:len(t)]
    samples = samples_of([Record.from_arrays(t, u, t, y, input_hold='zoh')], [[None]])
    for s in both_ways(samples):
        fit = fit_at(s, poles, delay, free)
        assert np.max(fit.power) < 1e-24
        rows, error, _ = jacobian(s, fit, free)
        assert np.isfinite(rows).all()
        assert np.isfinite(error).all()


def test_an_output_without_samples_is_no_fault():
    """Nothing is known of it: its columns count for nothing, in both ways."""
    rng = np.random.default_rng(2)
    whole = samples_of([record(rng, 1, 2, 'zoh', 2)], [[None] * 2])
    own = whole.records[0]
    empty = replace(own.streams[0], times=own.streams[0].times[:0], y=own.streams[0].y[:0])
    samples = replace(whole, records=(replace(own, streams=(empty, own.streams[1])),))
    free, start = free_of(samples, False), np.array([-2.0, -1.0 + 4.0j])
    one, other = (fit_at(s, start, np.zeros(1), free) for s in both_ways(samples))
    np.testing.assert_allclose(one.power, other.power, rtol=1e-8)
    assert not one.model.c[0].any()


def test_an_older_kernel_is_left_out(tmp_path, monkeypatch):
    (tmp_path / 'kernel.c').write_text('other')
    monkeypatch.setattr(kernel, '__file__', str(tmp_path / 'kernel.py'))
    kernel._library.cache_clear()
    try:
        with pytest.warns(UserWarning, match='older than its source'):
            assert not kernel.built()
    finally:
        kernel._library.cache_clear()


@pytest.mark.parametrize(('nu', 'ny'), [(1, 1), (2, 2)])
def test_a_climb_ends_at_the_same_maximum(nu, ny):
    rng = np.random.default_rng(3)
    flown = record(rng, nu, ny, 'zoh')
    plant = StateSpace(np.array([[-1.5, 0.0, 0.0], [0.0, -1.0, 4.0], [0.0, -4.0, -1.0]]),
                       rng.normal(size=(3, nu)), rng.normal(size=(ny, 3)), np.zeros((ny, nu)))
    own, = flown.outputs
    y = plant.simulate(flown.inputs, own.time)
    flown = replace(flown, outputs=(replace(own, values=y + rng.normal(size=y.shape)),))
    samples = samples_of([flown], [[None]])
    free = free_of(samples, False)
    start = np.array([-1.0, -2.0 + 3.0j])
    one, other = (climb(s, fit_at(s, start, np.full(nu, 0.1), free), free)
                  for s in both_ways(samples))
    assert one.cost == pytest.approx(other.cost, abs=1e-3)


def test_the_kernel_can_be_switched_off():
    code = ('from ctsid_core.likelihood import kernel; '
            'raise SystemExit(1 if kernel.built() else 0)')
    for value, status in (('0', 0), ('1', 1)):
        done = subprocess.run([sys.executable, '-c', code], check=False,
                              env={**os.environ, kernel.VARIABLE: value})
        assert done.returncode == status
