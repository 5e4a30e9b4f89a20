# SPDX-License-Identifier: Apache-2.0
"""Windows of which it is known what a verdict on them has to be."""

from __future__ import annotations

import numpy as np
from plants import PLANTS, asynchronous, flown, held, match, noisy, paper, random_plant, running
from scipy.signal import butter, lfilter, sosfilt

from ctsid_core import Record
from ctsid_core.model.estimate import Estimate

COUNT, STEP = 2000, 0.005


def steps(rng, count: int, channels: int, hold: int = 20) -> np.ndarray:
    return np.repeat(rng.uniform(-1, 1, (count // hold + 1, channels)), hold, axis=0)[:count]


def smooth(rng, count: int, channels: int, band: float = 3.0) -> np.ndarray:
    sos = butter(2, band, fs=1 / STEP, output='sos')
    return sosfilt(sos, rng.standard_normal((count + 500, channels)), axis=0)[500:]


def sweeps(rng, count: int, channels: int) -> np.ndarray:
    t = STEP * np.arange(count)
    return np.sin(np.pi * rng.uniform(0.3, 0.8, channels) * t[:, np.newaxis] ** 2
                  + rng.uniform(0, 6, channels))


def walk(rng, count: int, channels: int) -> np.ndarray:
    return np.cumsum(rng.standard_normal((count, channels)), axis=0)


def white(rng, count: int, channels: int) -> np.ndarray:
    return rng.standard_normal((count, channels))


def coloured(rng, count: int, channels: int) -> np.ndarray:
    """AR(2): a pair of poles of random frequency and damping."""
    out = np.empty((count, channels))
    for i in range(channels):
        w, zeta = rng.uniform(2, 40), rng.uniform(0.05, 1.0)
        z = np.exp(STEP * w * (-zeta + 1j * np.sqrt(1 - zeta ** 2)))
        noise = rng.standard_normal(count + 2000)
        out[:, i] = lfilter([1.0], [1.0, -2 * z.real, abs(z) ** 2], noise)[2000:]
    return out


def vibration(rng, count: int, channels: int) -> np.ndarray:
    t = STEP * np.arange(count)
    lines = [np.sin(rng.uniform(1, 60, channels) * t[:, np.newaxis] + rng.uniform(0, 6, channels))
             for _ in range(3)]
    return np.sum(lines, axis=0) + 0.1 * rng.standard_normal((count, channels))


def still(rng, count: int, channels: int) -> np.ndarray:
    return np.tile(rng.standard_normal(channels), (count, 1))


def driven_by_another(rng, count: int, channels: int) -> np.ndarray:
    """The answer of a plant to an input that nobody has measured."""
    p = random_plant(rng, int(rng.integers(1, 5)), 1, channels)
    t = STEP * np.arange(count)
    t_u = np.arange(-5.0, t[-1], 0.1)
    from plants import held_response
    return noisy(rng, held_response(p, t_u, rng.uniform(-1, 1, (len(t_u), 1)), t), 20)


INPUTS = {'steps': steps, 'smooth': smooth, 'sweeps': sweeps, 'walk': walk, 'white': white,
          'still': still}
OUTPUTS = {'white': white, 'coloured': coloured, 'walk': walk, 'vibration': vibration,
           'another': driven_by_another}


def nothing(seed: int) -> tuple[str, Record]:
    """Return a window whose outputs have nothing to do with its inputs."""
    rng = np.random.default_rng([11, seed])
    size = 1 + seed % 2
    makers = list(OUTPUTS.items())
    drives = list(INPUTS.items())
    out, output = makers[seed // 2 % len(makers)]
    drive, inputs = drives[seed // (2 * len(makers)) % len(drives)]
    t = STEP * np.arange(COUNT)
    u, y = inputs(rng, COUNT, size), output(rng, COUNT, size)
    hold = 'zoh' if drive in ('steps', 'still') else 'smooth'
    return f'{size} {drive} -> {out}', Record.from_arrays(t, u, t, y, input_hold=hold)


def excited(seed: int) -> tuple[str, Record, np.ndarray]:
    """Return a well-excited window at 20 dB, and its true poles."""
    rng = np.random.default_rng([12, seed])
    kind = seed % 10
    if kind < 4:
        n = 2 + kind
        p = random_plant(rng, n, int(rng.integers(1, 3)), int(rng.integers(1, 3)))
        how = ['held', 'asynchronous', 'running'][seed // 10 % 3]
        record = (held(rng, p, 50.0, 100.0, snr=20) if how == 'held' else
                  asynchronous(rng, p, 100.0, 60.0, snr=20) if how == 'asynchronous' else
                  running(rng, p, 20, rate=200.0))
        return f'random {n} {p.B.shape[1]}x{p.C.shape[0]} {how}', record, p.poles
    if kind == 4:
        return 'hd51 running', running(rng, PLANTS['hd51'], 20, rate=200.0), PLANTS['hd51'].poles
    if kind == 5:
        return 'hd51 paper', paper(rng, 'hd51', 20), PLANTS['hd51'].poles
    if kind == 6:
        return 'hd52 held', held(rng, PLANTS['hd52'], 50.0, 100.0, snr=20), PLANTS['hd52'].poles
    if kind == 7:
        return 'hd52 running', running(rng, PLANTS['hd52'], 20, rate=200.0), PLANTS['hd52'].poles
    if kind == 8:
        return ('flexible', held(rng, PLANTS['flexible'], 100.0, 100.0, snr=20, band=12.0),
                PLANTS['flexible'].poles)
    q, r = [(0.0, 0.01), (0.3, 0.01)][seed // 10 % 2]
    return f'closed loop {q}', flown(rng, q, r, rate=200.0), PLANTS['unstable'].poles


def distance(estimate: Estimate, truth: np.ndarray) -> float:
    """Return how far the worst pole is from the truth, in deviations; infinite if one lacks."""
    model = estimate.model or estimate.rejected_model
    if model is None or model.n < len(truth):
        return np.inf
    found = match(model.poles, truth)
    rows = [int(np.argmin(np.abs(model.poles - f))) for f in found]
    return float(np.max(np.abs(found - truth) / estimate.pole_std[rows]))


def curved(seed: int, what: str) -> Record:
    """Return what a plant does that is not linear, moved by steps every 0.6 s, at 30 dB."""
    rng = np.random.default_rng([13, seed])
    t_u, fine = np.arange(0.0, 12.0, 0.02), 1e-3
    u = np.repeat(rng.uniform(-1, 1, len(t_u) // 30 + 1), 30)[:len(t_u)]
    force = np.repeat(u, 20)
    if what == 'saturates':
        force = np.clip(force, -0.4, 0.4)
    if what == 'dead zone':
        force -= np.clip(force, -0.3, 0.3)
    y, x, v = np.empty(len(force)), 0.0, 0.0
    for k, one in enumerate(force.tolist()):
        y[k] = x
        if what == 'drags':
            x += fine * (3.0 * one - 0.3 * x - 3.0 * abs(x) * x)
        else:
            x, v = x + fine * v, v + fine * (25.0 * (one - x) - 7.0 * v)
    if what == 'clips':
        y = np.clip(y, -0.4, 0.4)
    y = y[::10]
    if what == 'gusts':
        gusts = coloured(rng, len(y), 1)[:, 0]
        y += 0.2 * y.std() / gusts.std() * gusts
    return Record.from_arrays(t_u, u, fine * np.arange(0, len(force), 10),
                              noisy(rng, y[:, np.newaxis], 30)[:, 0], input_hold='zoh')
