# SPDX-License-Identifier: Apache-2.0
"""Plants and experiments of the studies, with all that a bound has to know of a run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.signal import butter, sosfilt

from ctsid_core.bases.hermite_functions import hermite_functions
from ctsid_core.linear.types import Array
from ctsid_core.model.simulation import respond
from ctsid_core.model.statespace import StateSpace
from ctsid_core.signals.record import Record, Signal

_HIGHEST = 250        # order of the Hermite functions of the sweep from rest


@dataclass(frozen=True, eq=False)
class Run:
    """
    One run of an experiment, and the truth of it.

    Parameters
    ----------
    record : Record
        What an estimator gets: one input signal, one output signal.
    model : StateSpace
        The plant.
    x0 : ndarray, shape (n,)
        Its state at the first output.
    noise : ndarray, shape (ny,)
        Standard deviation of the white noise of the outputs' samples.
    """

    record: Record
    model: StateSpace
    x0: Array
    noise: Array

    @property
    def u(self) -> Signal:
        """The input."""
        return self.record.inputs[0]

    @property
    def y(self) -> Signal:
        """The outputs."""
        return self.record.outputs[0]


def second_order() -> StateSpace:
    """Return the plant of [HD] 5.1, poles -2 and -4, one input, two outputs."""
    return _model([[-2.0, 1.0], [0.0, -4.0]], [[0.5], [1.0]], [[1.0, 4.0], [2.0, 1.0]])


def quadrotor() -> StateSpace:
    """Return the longitudinal motion of a quadrotor, poles -5 and -1 +- i ([HD] 5.2)."""
    return _model(
        [[-0.2588, 0.2115, -9.5751], [0.7629, -6.7412, -10.4169], [0.0, 1.0, 0.0]],
        [[-10.1647], [450.71], [0.0]],
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-0.1068, 0.1192, 0.0]],
        [[0.0], [0.0], [0.0], [-10.1647]])


def _model(A: list[list[float]], B: list[list[float]], C: list[list[float]],
           D: list[list[float]] | None = None) -> StateSpace:
    feed = np.zeros((len(C), len(B[0]))) if D is None else np.array(D)
    return StateSpace(np.array(A), np.array(B), np.array(C), feed)


def flexible(damping: float) -> StateSpace:
    """Return three modes at 2, 5 and 9 Hz of a damping ratio, 2 inputs, 3 outputs of like size."""
    omega = 2.0 * np.pi * np.array([2.0, 5.0, 9.0])
    A, B, C = np.zeros((6, 6)), np.zeros((6, 2)), np.zeros((3, 6))
    A[0::2, 1::2], A[1::2, 0::2] = np.diag(omega), -np.diag(omega)
    A[1::2, 1::2] = -2.0 * damping * np.diag(omega)
    B[1::2] = [[1.0, 0.5], [0.8, -1.0], [0.6, 0.7]]
    C[:, 0::2] = [[1.0, 0.7, 0.4], [0.5, -1.0, 0.8], [-0.6, 0.4, 1.0]]
    return StateSpace(A, B, C)


def unstable() -> StateSpace:
    """Return x'' = -x' + 6 x + u, poles 2 and -3."""
    return _model([[0.0, 1.0], [6.0, -1.0]], [[0.0], [1.0]], [[1.0, 0.0]])


def from_rest(seed: int, snr: float, count: int = 2001, *,
              plant: Callable[[], StateSpace] = quadrotor, together: bool = False) -> Run:
    """
    Return a run of [HD] 5: a sweep built from Hermite functions, 10 s, from rest.

    Parameters
    ----------
    seed : int
        Of the noise.
    snr : float
        Power of each output over that of its noise [dB].
    count : int
        Samples.
    plant : callable
        Of this module.
    together : bool
        Whether all outputs have the same noise: `snr` is then of all powers together.
    """
    model = plant()
    t, u, y = _from_rest(plant, count)
    return _with_noise(np.random.default_rng(seed), model, np.zeros(model.n), t, u, y, snr,
                       'smooth', together)


@lru_cache
def _from_rest(plant: Callable[[], StateSpace], count: int) -> tuple[Array, Array, Array]:
    finer = -(-20000 // (count - 1))                    # the plant sees the input at 2 kHz or more
    t = np.linspace(0.0, 10.0, (count - 1) * finer + 1)
    alpha = 5.0 / np.sqrt(2.0 * _HIGHEST + 1.0)
    dense = np.linspace(0.0, 10.0, 20001)
    weights = hermite_functions(_HIGHEST, (dense - 5.0) / alpha) @ np.sin(0.8 * np.pi * dense ** 2)
    u = (weights * (dense[1] / alpha) @ hermite_functions(
        _HIGHEST, (t - 5.0) / alpha))[:, np.newaxis]
    model = plant()
    x, _ = respond(model.A, model.B, model.x_trim, [Signal(t, u)], model.delay, t,
                   np.zeros(model.n))
    return t[::finer], u[::finer], (x @ model.C.T + u @ model.D.T)[::finer]


def _with_noise(rng: np.random.Generator, model: StateSpace, x0: Array, t: Array, u: Array,
                y: Array, snr: float, hold: str, together: bool = False) -> Run:
    power = np.mean(y ** 2, axis=0)
    if together:
        power[:] = np.mean(power)
    noise = np.sqrt(power * 10.0 ** (-0.1 * snr))
    measured = y + noise * rng.standard_normal(y.shape)
    record = Record.from_arrays(t, u, t, measured, input_hold=hold)  # type: ignore[arg-type]
    return Run(record, model, x0, noise)


def running(seed: int, snr: float, model: StateSpace, *, rate: float = 500.0,
            duration: float = 10.0, band: float = 8.0) -> Run:
    """
    Return a window of a plant that has been running since long before it.

    Inputs are sums of sines, normal noise behind a low-pass of four poles, of period 40 s; outputs
    are the exact steady response.

    Parameters
    ----------
    seed : int
    snr : float
        [dB]
    model : StateSpace
        Stable.
    rate : float
        Samples per second.
    duration : float
        [s]
    band : float
        Of the inputs [Hz].
    """
    rng, period = np.random.default_rng(seed), 40.0
    f = np.arange(1, int(4 * band * period)) / period
    size = 1.0 / np.sqrt(1.0 + (f / band) ** 8)
    size /= np.linalg.norm(size)
    amplitude = size * (rng.standard_normal((model.nu, len(f)))
                        + 1j * rng.standard_normal((model.nu, len(f))))
    s = 2j * np.pi * f[:, np.newaxis, np.newaxis] * np.eye(model.n)
    states = np.linalg.solve(s - model.A, (model.B @ amplitude).T[:, :, np.newaxis])[:, :, 0].T
    count = round(duration * rate) + 1
    both = _on_grid(2.0 * np.pi * f, np.vstack((amplitude, states)), count, 1.0 / rate)
    u, x = both[:, :model.nu], both[:, model.nu:]
    y = x @ model.C.T + u @ model.D.T
    t = np.arange(count) / rate
    return _with_noise(rng, model, x[0], t, u, y, snr, 'smooth')


def _on_grid(omega: Array, amplitude: NDArray[np.complex128], count: int, step: float) -> Array:
    """Return Re sum amplitude exp(i omega t) at t = 0, step, ...: the grid is cut in a square."""
    size = int(np.sqrt(count)) + 1
    first = np.exp(1j * step * np.outer(np.arange(size), omega))
    turned = amplitude * np.exp(1j * step * size * np.outer(np.arange(size), omega)
                                )[:, np.newaxis]
    blocks = (first @ turned.reshape(-1, len(omega)).T).real.reshape(size, size, -1)
    return np.swapaxes(blocks, 0, 1).reshape(size * size, -1)[:count]


def flown(seed: int, q: float, r: float = 1e-3, *, noise_seed: int = -1, rate: float = 500.0,
          duration: float = 10.0) -> Run:
    """
    Return a window of the unstable plant under a sampled PD controller of what is measured.

    u = ref - 20 y - 6 v is held from sample to sample; v is the difference quotient of the
    measured y behind a lag of 10 ms; ref is noise of standard deviation 10, low-passed at 3 Hz.
    White noise of intensity q^2 adds to u in the plant. The window begins when all is stationary.

    Parameters
    ----------
    seed : int
    q : float
        Process noise.
    r : float
        Standard deviation of the output's noise.
    noise_seed : int
        For other noise on the same reference.
    rate : float
        Samples per second.
    duration : float
        [s]
    """
    model, rng, h, lead = unstable(), np.random.default_rng(seed), 1.0 / rate, 5.0
    ref = _reference(rng, round((duration + lead) * rate) + 1, rate)
    if noise_seed >= 0:
        rng = np.random.default_rng((seed, noise_seed))
    F, G, root = sampled(model, q * q * model.B @ model.B.T, h)
    kick = rng.standard_normal((len(ref), 2)) @ root.T
    noise, keep = r * rng.standard_normal(len(ref)), np.exp(-h / 0.01)
    x, u, y = np.zeros((len(ref) + 1, 2)), np.empty(len(ref)), np.empty(len(ref))
    v = last = 0.0
    for k in range(len(ref)):
        y[k] = x[k, 0] + noise[k]
        v, last = keep * v + (1.0 - keep) * (y[k] - last) / h, y[k]
        u[k] = ref[k] - 20.0 * y[k] - 6.0 * v
        x[k + 1] = F @ x[k] + G[:, 0] * u[k] + kick[k]
    first = round(lead * rate)
    t = np.arange(len(ref) - first) * h
    record = Record.from_arrays(t, u[first:], t, y[first:], input_hold='zoh')
    return Run(record, model, x[first], np.array([r]))


def _reference(rng: np.random.Generator, count: int, rate: float) -> Array:
    sections = butter(3, 3.0, fs=rate, output='sos')
    raw = sosfilt(sections, rng.standard_normal(count + round(2.0 * rate)))
    unit = sosfilt(sections, np.concatenate(([1.0], np.zeros(round(4.0 * rate)))))
    reference: Array = raw[-count:] * (10.0 / np.linalg.norm(unit))
    return reference


def sampled(model: StateSpace, intensity: Array, h: float) -> tuple[Array, Array, Array]:
    """
    Return F, G and a root of Q of x+ = F x + G u + noise of covariance Q, for held inputs.

    Parameters
    ----------
    model : StateSpace
    intensity : ndarray, shape (n, n)
        Of the white noise that drives the states (Van Loan 1978).
    h : float
        Between samples [s].
    """
    n, nu = model.n, model.nu
    joined = expm(h * np.block([[-model.A, intensity], [np.zeros((n, n)), model.A.T]]))
    F = joined[n:, n:].T
    driven = expm(h * np.block([[model.A, model.B], [np.zeros((nu, n + nu))]]))
    return F, driven[:n, n:], _root(F @ joined[:n, n:])


def _root(covariance: Array) -> Array:
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    root: Array = vectors * np.sqrt(np.maximum(values, 0.0))
    return root
