# SPDX-License-Identifier: Apache-2.0
"""Plants with known truth, and experiments on them whose samples are exact at any stamps."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import expm, solve_continuous_lyapunov
from scipy.optimize import linear_sum_assignment
from scipy.signal import butter, lfilter, lsim

from ctsid_core import Record, Settings
from ctsid_core.bases.hermite_functions import hermite_functions


@dataclass(frozen=True, eq=False)
class Plant:
    """dx/dt = A x + B u, y = C x + D u."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray

    @property
    def poles(self) -> np.ndarray:
        return np.linalg.eigvals(self.A)


# Whatever lies before a plant is taken for a part of it.
LINEAR = Settings(dead_zone=0.0, limit=0.0, backlash=0.0, rate_limit=0.0)


def plant(A, B, C, D=None) -> Plant:
    A, B, C = (np.array(M, dtype=float) for M in (A, B, C))
    return Plant(A, B, C, np.zeros((len(C), B.shape[1])) if D is None else np.array(D, float))


def flexible_structure() -> Plant:
    """Three modes at 2, 5 and 9 Hz with 1 % damping, 2 inputs, 3 outputs of like size."""
    omega = 2 * np.pi * np.array([2.0, 5.0, 9.0])
    A, B, C = np.zeros((6, 6)), np.zeros((6, 2)), np.zeros((3, 6))
    A[0::2, 1::2], A[1::2, 0::2] = np.diag(omega), -np.diag(omega)
    A[1::2, 1::2] = -2 * 0.01 * np.diag(omega)
    B[1::2] = [[1.0, 0.5], [0.8, -1.0], [0.6, 0.7]]
    C[:, 0::2] = [[1.0, 0.7, 0.4], [0.5, -1.0, 0.8], [-0.6, 0.4, 1.0]]
    return plant(A, B, C)


PLANTS = {
    # [HD] section 5.1: two real poles, -2 and -4; one input, two outputs.
    'hd51': plant([[-2, 1], [0, -4]], [[0.5], [1]], [[1, 4], [2, 1]]),
    # [HD] section 5.2: longitudinal motion of a quadrotor, -5 and -1 +- i, with feedthrough.
    'hd52': plant(
        [[-0.2588, 0.2115, -9.5751], [0.7629, -6.7412, -10.4169], [0, 1, 0]],
        [[-10.1647], [450.71], [0]],
        [[1, 0, 0], [0, 1, 0], [0, 0, 1], [-0.1068, 0.1192, 0]], [[0], [0], [0], [-10.1647]]),
    'flexible': flexible_structure(),
    # Poles +2 and -3: has to be flown under a controller.
    'unstable': plant([[0, 1], [6, -1]], [[0], [1]], [[1, 0]]),
    # Poles -0.8 +- 4i and -2; gusts shake all of its states.
    'shaken': plant([[-0.8, 4, 0], [-4, -0.8, 0], [0, 0, -2]], [[1], [2], [2]],
                    [[1, 0, 1], [0, 1, -0.5]]),
}


def random_plant(rng, n: int, nu: int, ny: int, *, feedthrough: bool = False) -> Plant:
    """Well separated stable poles between 1 and 20 rad/s: pairs, and one real pole if n is odd."""
    A = np.zeros((n, n))
    size = np.geomspace(1.5, 15.0, max((n + 1) // 2, 2))[:(n + 1) // 2] * rng.uniform(0.9, 1.1)
    for i, w in zip(range(0, n - 1, 2), size, strict=False):
        zeta = rng.uniform(0.1, 0.7)
        A[i:i + 2, i:i + 2] = w * np.array([[-zeta, np.sqrt(1 - zeta ** 2)],
                                            [-np.sqrt(1 - zeta ** 2), -zeta]])
    if n % 2:
        A[-1, -1] = -size[-1]
    B, C = rng.uniform(0.5, 2.0, (n, nu)), rng.uniform(0.5, 2.0, (ny, n))
    B, C = B * rng.choice([-1, 1], B.shape), C * rng.choice([-1, 1], C.shape)
    return plant(A, B, C, rng.standard_normal((ny, nu)) if feedthrough else None)


@dataclass(frozen=True, eq=False)
class Multisine:
    """Re sum_k amplitude_k exp(i omega_k t): exact at any stamps, and so is what it drives."""

    omega: np.ndarray
    amplitude: np.ndarray

    def at(self, t) -> np.ndarray:
        t = np.asarray(t, dtype=float)
        blocks = [(np.exp(1j * np.outer(part, self.omega)) @ self.amplitude.T).real
                  for part in np.array_split(t, len(t) // 500 + 1)]
        return np.concatenate(blocks)

    def on_grid(self, count: int, step: float) -> np.ndarray:
        """Return the same as `at(step * arange(count))`, twenty times faster."""
        size = int(np.sqrt(count)) + 1
        first = np.exp(1j * step * np.outer(np.arange(size), self.omega))
        turned = self.amplitude * np.exp(1j * step * size * np.outer(np.arange(size), self.omega)
                                         )[:, np.newaxis]
        blocks = first @ turned.reshape(-1, len(self.omega)).T
        blocks = blocks.real.reshape(size, size, -1)
        return np.swapaxes(blocks, 0, 1).reshape(size * size, -1)[:count]

    def through(self, A, B, C, D) -> Multisine:
        """Return the steady response of a linear system: that of an experiment begun long ago."""
        systems = 1j * self.omega[:, np.newaxis, np.newaxis] * np.eye(len(A)) - A
        x = np.linalg.solve(systems, (B @ self.amplitude).T[:, :, np.newaxis])[:, :, 0].T
        return Multisine(self.omega, C @ x + D @ self.amplitude)

    def output(self, p: Plant) -> Multisine:
        return self.through(p.A, p.B, p.C, p.D)

    def states(self, p: Plant) -> Multisine:
        return self.through(p.A, p.B, np.eye(len(p.A)), np.zeros_like(p.B))


def random_signal(rng, channels: int = 1, band: float = 8.0, period: float = 40.0) -> Multisine:
    """Gaussian noise of unit variance behind a 4-pole low-pass [Hz]; it repeats after `period`."""
    f = np.arange(1, int(4 * band * period)) / period
    size = 1.0 / np.sqrt(1.0 + (f / band) ** 8)
    size /= np.sqrt(0.5 * np.sum(2.0 * size ** 2))
    normal = rng.standard_normal((2, channels, len(f)))
    return Multisine(2 * np.pi * f, size * (normal[0] + 1j * normal[1]))


def noisy(rng, y, snr=None):
    """Add white noise, `snr` in dB below each output."""
    if snr is None:
        return y
    return y + np.sqrt(np.mean(y ** 2, axis=0) * 10 ** (-snr / 10)) * rng.standard_normal(y.shape)


def jittered(rng, rate: float, duration: float = 10.0, jitter: float = 0.9) -> np.ndarray:
    """Return stamps that lie up to half an interval times `jitter` off a uniform grid [s]."""
    k = np.arange(round(duration * rate) + 1)
    return (k + jitter * rng.uniform(-0.5, 0.5, len(k))) / rate


def running(rng, p: Plant, snr=None, *, rate: float = 500.0, duration: float = 10.0,
            band: float = 8.0, hold: str = 'smooth') -> Record:
    """Uniform samples of a plant that has been running since long before the window."""
    count = round(duration * rate) + 1
    t, u = np.arange(count) / rate, random_signal(rng, p.B.shape[1], band)
    y = u.output(p).on_grid(count, 1 / rate)
    return Record.from_arrays(t, u.on_grid(count, 1 / rate), t, noisy(rng, y, snr),
                              input_hold=hold)


def asynchronous(rng, p: Plant, rate_u: float, rate_y: float, *, hold: str = 'smooth',
                 snr=None, duration: float = 10.0, band: float = 8.0) -> Record:
    """Input and output at their own rates, each stamp with 90 % jitter."""
    t_u, t_y = jittered(rng, rate_u, duration), jittered(rng, rate_y, duration)
    u = random_signal(rng, p.B.shape[1], band)
    return Record.from_arrays(t_u, u.at(t_u), t_y, noisy(rng, u.output(p).at(t_y), snr),
                              input_hold=hold)


def held(rng, p: Plant, rate_u: float, rate_y: float, *, delay: float = 0.0, snr=None,
         duration: float = 10.0, band: float = 8.0) -> Record:
    """Input held between jittered stamps and acting `delay` late; exact output at its own."""
    lead = 8.0
    t_u = jittered(rng, rate_u, duration + lead) - lead
    t_y = jittered(rng, rate_y, duration)
    u = random_signal(rng, p.B.shape[1], band).at(t_u)
    y = held_response(p, t_u + delay, u, t_y[t_y > 0])
    kept = t_u > -0.5
    return Record.from_arrays(t_u[kept], u[kept], t_y[t_y > 0], noisy(rng, y, snr),
                              input_hold='zoh')


def held_response(p: Plant, t_u, u, t_y) -> np.ndarray:
    """Return the exact output at `t_y`, from rest at the first stamp of a held input."""
    knots = np.unique(np.concatenate((t_u, t_y)))
    knots = knots[knots >= t_u[0]]
    level = u[np.searchsorted(t_u, knots, side='right') - 1]
    n, nu = p.B.shape
    joined = np.zeros((n + nu, n + nu))
    joined[:n] = np.hstack((p.A, p.B))
    steps = expm(np.diff(knots)[:, np.newaxis, np.newaxis] * joined)[:, :n]
    x = np.zeros((len(knots), n))
    for k, step in enumerate(steps):
        x[k + 1] = step @ np.concatenate((x[k], level[k]))
    rows = np.searchsorted(knots, t_y)
    return x[rows] @ p.C.T + level[rows] @ p.D.T


def sweep(t, end: float = 10.0, top: float = 8.0) -> np.ndarray:
    """Return the sine sweep of [HD] eq. 58, from 0 to `top` Hz."""
    return np.sin(np.pi * top / end * np.asarray(t) ** 2)


def projected_sweep(t, eta: int = 250) -> np.ndarray:
    """Return the input of [HD] eq. 59: 10 s of the sweep projected on h_0 .. h_eta."""
    alpha = 5.0 / np.sqrt(2.0 * eta + 1.0)
    dense = np.linspace(0.0, 10.0, 20001)
    c = hermite_functions(eta, (dense - 5.0) / alpha) @ sweep(dense) * (dense[1] / alpha)
    return c @ hermite_functions(eta, (t - 5.0) / alpha)


@lru_cache
def _from_rest(name: str, count: int, finer: int = 20) -> tuple[np.ndarray, ...]:
    """Return t, u, y of one of the paper's experiments; both start at rest."""
    p, t = PLANTS[name], np.linspace(0.0, 10.0, (count - 1) * finer + 1)
    u = projected_sweep(t) if name == 'hd52' else sweep(t)
    y = lsim((p.A, p.B, p.C, p.D), u, t)[1]
    return t[::finer], u[::finer], y[::finer]


def paper(rng, name: str, snr=None, *, count: int = 2001) -> Record:
    """Return one run of [HD] section 5.1 (`hd51`: sweep) or 5.2 (`hd52`: projected sweep)."""
    t, u, y = _from_rest(name, count)
    return Record.from_arrays(t, u, t, noisy(rng, y, snr), input_hold='smooth')


def flown(rng, q: float = 0.0, r: float = 1e-3, *, rate: float = 500.0,
          duration: float = 10.0, name: str = 'unstable', gain=((20.0, 6.0),)) -> Record:
    """
    Return a window of a plant of one input, the unstable one, under u = ref - 20 x1 - 6 x2.

    ref is low-passed noise (3 poles at 3 Hz) of standard deviation 10; white noise of intensity
    q^2 adds to u in the plant (process noise), and of deviation r to the samples of y. All is
    one linear stochastic system from its stationary state, sampled without approximation.
    """
    p, gain = PLANTS[name], np.array(gain)
    n = len(p.A)
    num, den = butter(3, 2 * np.pi * 3.0, analog=True)
    shape = np.vstack((-den[1:] / den[0], np.eye(2, 3)))
    F = np.zeros((n + 3, n + 3))
    F[:n, :n], F[n:, n:] = p.A - p.B @ gain, shape
    drive = np.eye(3, 1) * num[-1]
    spread = solve_continuous_lyapunov(shape, -drive @ drive.T)
    F[:n, n + 2:] = p.B
    G = np.zeros_like(F)
    G[n:, n:] = drive @ drive.T * 100.0 / spread[2, 2]
    G[:n, :n] = q * q * p.B @ p.B.T
    x = _stationary(rng, F, G, 1.0 / rate, round(duration * rate) + 1)
    t = np.arange(len(x)) / rate
    u = x[:, n + 2:] - x[:, :n] @ gain.T
    y = x[:, :n] @ p.C.T
    return Record.from_arrays(t, u, t, y + r * rng.standard_normal(y.shape))


def _stationary(rng, F, G, h: float, count: int) -> np.ndarray:
    """Return samples of dx = F x dt + dw, E dw dw^T = G dt, stationary (Van Loan 1978)."""
    n = len(F)
    joined = expm(h * np.block([[-F, G], [np.zeros((n, n)), F.T]]))
    step = joined[n:, n:].T
    noise = step @ joined[:n, n:]
    kick = rng.standard_normal((count, n)) @ _root(noise).T
    x = np.empty((count, n))
    x[0] = _root(solve_continuous_lyapunov(F, -G)) @ rng.standard_normal(n)
    for k in range(1, count):
        x[k] = step @ x[k - 1] + kick[k]
    return x


def _root(covariance) -> np.ndarray:
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    return vectors * np.sqrt(np.maximum(values, 0.0))


def match(found, truth) -> np.ndarray:
    """Return the found poles in the order of the true ones: the assignment of least distance."""
    found, truth = np.asarray(found), np.asarray(truth)
    rows, columns = linear_sum_assignment(np.abs(found[:, np.newaxis] - truth))
    out = np.full(len(truth), np.nan, dtype=complex)
    out[columns] = found[rows]
    return out


def held_lag(rng, noise: float, count: int = 500) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return stamps of 50 Hz, an input of levels of 0.4 s, and 2 / (s + 2) of it."""
    t, keep = 0.02 * np.arange(count), np.exp(-0.04)
    u = np.repeat(rng.standard_normal(count // 20), 20)
    y = lfilter([0.0, 1.0 - keep], [1.0, -keep], u)
    return t, u, y + noise * rng.standard_normal(count)


def moved_before(rng: np.random.Generator, duration: float, delay: float) -> Record:
    """Return a record that begins in an experiment: 2 exp(-s delay) / (s + 2), u held for 1 s."""
    t, early = np.arange(0.0, duration, 0.02), round(delay / 0.02)
    u = np.repeat(rng.standard_normal(int(duration + delay) + 2), 50)
    x, y = 0.0, np.empty(len(t))
    for k in range(len(t)):
        y[k] = x + 0.02 * rng.standard_normal()
        x = u[k] + (x - u[k]) * np.exp(-0.04)
    return Record.from_arrays(t, u[early:early + len(t)], t, y, input_hold='zoh')


def stick_flown(seed: int) -> Record:
    """Return 60 s of a pair of 6 rad/s, 0.08 s after a pilot's stick, in gusts of 1 rad/s."""
    rng, step = np.random.default_rng(seed), 0.004
    level, at = np.zeros(3000), 100
    while at < 3000:
        until = at + int(rng.uniform(0.6, 3.0) / 0.02)
        level[at:until] = 0.0 if rng.random() < 0.3 else rng.uniform(-1.0, 1.0)
        at = until
    u, x = np.zeros(3000), 0.0
    for k in range(3000):
        x += (level[k] - x) / 6.0
        u[k] = x
    u += 0.02 * rng.standard_normal(3000)
    u = np.sign(u) * np.maximum(np.abs(u) - 0.1, 0.0) / 0.9
    moves = expm(step * np.array([[0, 1, 0, 0], [-36, -6, 12.6, 1], [0] * 4, [0, 0, 0, -1.0]]))
    z, y = np.zeros(4), []
    for k in range(15000):
        late = int(np.floor((k * step - 0.08) / 0.02 + 1e-9))
        z[2] = u[late] if late >= 0 else 0.0
        if k % 2 == 0:
            y.append(z[0] + 0.004 * rng.standard_normal())
        z = moves @ z
        z[3] += 0.25 * np.sqrt(step) * rng.standard_normal()
    return Record.from_arrays(0.02 * np.arange(3000), u, 0.008 * np.arange(7500), np.array(y),
                              input_hold='zoh')
