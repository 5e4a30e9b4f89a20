# SPDX-License-Identifier: Apache-2.0
"""Plants and records on which a plausible method goes wrong without a word."""

from marks import slow
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import butter, sosfilt

from ctsid_core import Record, Settings, Status, identify
from ctsid_core.model.validation import simulation


def steps(rng, count, hold):
    """Return random steps, each held for a number of samples: shape (count, )."""
    return np.repeat(np.sign(rng.standard_normal(count // hold + 1)), hold)[:count]


def lag(u, pole, dt):
    """Respond with 1 / (1 - s / pole) to a held input, exactly."""
    decay, y = np.exp(pole * dt), np.zeros(len(u))
    for k in range(len(u) - 1):
        y[k + 1] = u[k] + (y[k] - u[k]) * decay
    return y


@pytest.mark.parametrize('poles', [
    (-3.0, -3.0), (-3.0, -3.3), *slow(((-3.0, -3.0, -3.0),))])
def test_equal_poles_on_several_axes(poles):
    """Roll and pitch of a symmetric vehicle: one pole with a free residue would explain both."""
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 10.0, 0.01)
    u = np.column_stack([steps(rng, len(t), 20) for _ in poles])
    y = np.column_stack([lag(u[:, j], p, 0.01) for j, p in enumerate(poles)])
    y += 0.02 * rng.standard_normal(y.shape)
    estimate = identify(Record.from_arrays(t, u, t, y, input_hold='zoh'))
    assert estimate.ok
    assert estimate.model.n == len(poles)
    np.testing.assert_allclose(np.sort(estimate.model.poles.real), np.sort(poles), atol=0.08)
    assert estimate.fit.min() > 95.0


@pytest.mark.parametrize(('offset_u', 'offset_y'), [(1500.0, 1e5), *slow((0.0, -1e6))])
def test_large_offsets_change_nothing(offset_u, offset_y):
    """Pulse widths of 1500 us and metres of a map grid are offsets, not dynamics."""
    rng = np.random.default_rng(1)
    t = np.arange(0.0, 10.0, 0.01)
    u = steps(rng, len(t), 20)
    y = lag(u, -3.0, 0.01) + 0.02 * rng.standard_normal(len(t))
    plain, moved = (identify(Record.from_arrays(t, u + a, t, y + b, input_hold='zoh'))
                    for a, b in ((0.0, 0.0), (offset_u, offset_y)))
    assert moved.model.n == plain.model.n == 1
    np.testing.assert_allclose(moved.model.poles, plain.model.poles, rtol=1e-6)
    record = Record.from_arrays(t, u + offset_u, t, y + offset_y, input_hold='zoh')
    assert simulation(moved.model, record).fit.min() > 95.0


@pytest.mark.parametrize('duration', [40.0, *slow(200.0)])
def test_a_long_record_keeps_its_fast_mode(duration):
    """The time-bandwidth product of a long record exceeds one basis: it is divided into parts."""
    rng = np.random.default_rng(2)
    A = np.array([[-2.0, 0.0, 0.0], [0.0, -1.57, 31.4], [0.0, -31.4, -1.57]])
    B, C = np.array([[10.0], [3.0], [3.0]]), np.array([1.0, 1.0, 0.5])
    step = expm(np.block([[A, B], [np.zeros((1, 4))]]) * 0.005)
    slow = sosfilt(butter(2, 3.0, fs=50.0, output='sos'), rng.standard_normal(int(50 * duration)))
    u = np.repeat(slow, 4)
    x, y = np.zeros(3), np.empty(len(u))
    for k in range(len(u)):
        y[k] = C @ x
        x = step[:3, :3] @ x + step[:3, 3] * u[k]
    y += 0.1 * y.std() * rng.standard_normal(len(y))
    t = 0.005 * np.arange(len(u))
    estimate = identify(Record.from_arrays(t[::4], u[::4], t, y, input_hold='zoh'))
    assert estimate.ok
    truth = np.array([-2.0, -1.57 - 31.4j, -1.57 + 31.4j])
    assert estimate.model.n == 3
    error = np.abs(estimate.model.poles - truth)
    assert (error < 4.0 * estimate.pole_std).all()
    assert error.max() < 0.2


def shaken(rng, force):
    """Return 10 s of an oscillator, poles -0.6 +- 2.94i, driven by steps and by a white force."""
    h, lead = 0.002, 5.0
    A, B = np.array([[0.0, 1.0], [-9.0, -1.2]]), np.array([[0.0], [9.0]])
    step = expm(np.block([[A, B], [np.zeros((1, 3))]]) * h)
    count = int((10.0 + lead) / h)
    u = steps(rng, count, 50)
    kick = force / np.sqrt(h) * rng.standard_normal(count)
    x, y = np.zeros(2), np.empty(count)
    for k in range(count):
        y[k] = x[0]
        x = step[:2, :2] @ x + step[:2, 2] * (u[k] + kick[k])
    t = h * np.arange(count) - lead
    inside = np.flatnonzero(t >= -1e-9)
    noisy = y[inside[::5]] + 0.02 * rng.standard_normal(len(inside[::5]))
    return Record.from_arrays(t[inside[::50]], u[inside[::50]], t[inside[::5]], noisy,
                              input_hold='zoh')


@pytest.mark.slow
def test_process_noise_is_seen_and_its_deviation_is_honest():
    truth = np.array([-0.6 - 2.94j, -0.6 + 2.94j])
    ratio, seen = [], 0
    for seed in range(8):
        estimate = identify(shaken(np.random.default_rng(seed), 0.05), Settings(order=2))
        # So much of y is noise that the status of some of these windows is not OK.
        model = estimate.model or estimate.rejected_model
        seen += model.K.any()
        ratio.append(np.abs(model.poles - truth) / estimate.pole_std)
    assert seen >= 6
    assert 0.5 < np.sqrt(np.mean(np.square(ratio))) < 1.8


@pytest.mark.parametrize('seed', [0, *slow(1, 2, 3)])
def test_an_oscillation_that_inputs_do_not_cause_is_not_explained(seed):
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 10.0, 0.01)
    y = np.sin(0.8 * t + seed) + 0.1 * rng.standard_normal(len(t))
    estimate = identify(Record.from_arrays(t, steps(rng, len(t), 20), t, y, input_hold='zoh'))
    assert estimate.status in (Status.UNEXPLAINED, Status.UNRELIABLE)
    assert estimate.model is None
