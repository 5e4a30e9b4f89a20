# SPDX-License-Identifier: Apache-2.0
"""
Slow, bursty outputs: ctsid on the raw samples, beside linear interpolation and SLICOT.

Plant of [HD] 5.1 (poles -2 and -4) and a lightly damped pair at 1 Hz, one input held at 100 Hz
with jitter, two outputs in bursts of 3 to 8 samples at 60 Hz, 20 Hz on average, but for two gaps
of 1 s; 10 s, white noise 20 dB below each output, not from rest. What is printed is the root mean
square error of each pole over the Cramer-Rao bound of the very stamps of that run.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
import os
import time

os.environ |= {'OPENBLAS_NUM_THREADS': '1', 'OMP_NUM_THREADS': '1', 'MKL_NUM_THREADS': '1'}

from common import Array, machine, table  # noqa: E402
from contenders import slicot  # noqa: E402
import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402
from scipy.optimize import linear_sum_assignment  # noqa: E402
from scipy.signal import butter, lfilter  # noqa: E402

from ctsid_core import Record, Settings, identify  # noqa: E402

Poles = NDArray[np.complex128]
Run = Callable[['Window'], tuple[Poles, int | None]]

LENGTH = 10.0                   # s
RATE_U, RATE_BURST, RATE_Y = 100.0, 60.0, 20.0      # Hz
BAND = 4.0                      # Hz, of the input
BEFORE = 3.0                    # s from rest to the window
POLES = np.array([-2.0, -4.0, 2.0 * np.pi * (-0.05 + 1j * np.sqrt(1.0 - 0.05 ** 2))])
# Of the outputs (rows) at the poles: those of [HD] 5.1 for the real ones.
RESIDUES = np.array([[1.0, 2.0, 0.3 - 0.1j], [2.0, -0.5, -0.2 - 0.3j]])
HEAD = ('who', 'RMSE/bound at -2', 'at -4', 'at 1 Hz', 'order 4', 'ms')


@dataclass(frozen=True)
class Window:
    """One run: held input (own stamps), output samples, and the bound of the poles."""

    t_u: Array
    u: Array
    t_y: Array
    y: Array
    bound: Array


def bursts(rng: np.random.Generator) -> Array:
    """Return the stamps of the outputs."""
    stamps: list[float] = []
    t = rng.uniform(0.0, 0.1)
    while t < LENGTH:
        count = int(rng.integers(3, 9))
        stamps += list(t + (np.arange(count) + rng.uniform(-0.2, 0.2, count)) / RATE_BURST)
        t += count / RATE_Y * rng.uniform(0.7, 1.3)
    t_y = np.array(stamps)
    for low, high in ((0.15, 0.35), (0.55, 0.75)):
        gap = LENGTH * rng.uniform(low, high)
        t_y = t_y[(t_y < gap) | (t_y > gap + 1.0)]
    return np.sort(t_y[(t_y > 0.0) & (t_y < LENGTH)])


def states(t_u: Array, u: Array, t_y: Array) -> tuple[Array, Array]:
    """
    Return the modes' responses from rest at t_u[0] and their derivatives by the poles, (N, 3).

    From knot to knot, both have closed forms for an input that is held.
    """
    knots = np.union1d(t_u, t_y)
    held = u[np.searchsorted(t_u, knots, side='right') - 1]
    x, slope = np.zeros(3, dtype=complex), np.zeros(3, dtype=complex)
    found = {}
    for at, h, value in zip(knots, np.diff(knots, append=knots[-1]), held, strict=True):
        found[at] = x, slope
        grown = np.exp(POLES * h)
        area = (grown - 1.0) / POLES
        slope = grown * slope + h * grown * x + (h * grown - area) / POLES * value
        x = grown * x + area * value
    return (np.array([found[at][0] for at in t_y]), np.array([found[at][1] for at in t_y]))


def window(seed: int, snr: float) -> Window:
    """Return one experiment with its noise."""
    rng = np.random.default_rng(seed)
    count = int((LENGTH + BEFORE) * RATE_U)
    t_u = (np.arange(count) + rng.uniform(-0.2, 0.2, count)) / RATE_U - BEFORE
    u = lfilter(*butter(2, 2.0 * BAND / RATE_U), rng.standard_normal(count))
    u /= u.std()
    t_y = bursts(rng)
    x, slope = states(t_u, u, t_y)
    clean = (x @ RESIDUES.T).real
    size = clean.std(axis=0) * 10.0 ** (-snr / 20.0)
    y = clean + size * rng.standard_normal(clean.shape)
    known = t_u > -2.0 / RATE_U
    return Window(t_u[known], u[known], t_y, y, least_deviation(t_y, x, slope, size))


def least_deviation(t_y: Array, x: Array, slope: Array, size: Array) -> Array:
    """
    Return the Cramer-Rao bound of the poles, sqrt E|error|^2, from the raw samples.

    Poles, residues, the initial state (one for both outputs) and the offsets of the outputs are
    unknown; that there is no feedthrough is known.
    """
    free = np.exp(POLES * (t_y - t_y[0])[:, np.newaxis])
    rows = []
    for i, residue in enumerate(RESIDUES):
        other = np.zeros_like(x)
        own = [x, other] if i == 0 else [other, x]
        level = np.zeros((len(t_y), 2))
        level[:, i] = 1.0
        # The slope of the free motion is that of an initial state times a constant.
        shared = np.hstack([residue * slope, residue * free, *own])
        rows.append(np.hstack([shared.real, -shared[:, 2::3].imag, level]) / size[i])
    jacobian = np.vstack(rows)
    triangle = np.linalg.qr(jacobian / np.linalg.norm(jacobian, axis=0), mode='r')
    deviation = np.linalg.norm(np.linalg.inv(triangle), axis=1) / np.linalg.norm(jacobian, axis=0)
    return np.array([*deviation[:2], np.hypot(deviation[2], deviation[12])])


def ctsid(**given: int) -> Run:
    """Return a run of this project."""
    settings = Settings(**given)  # type: ignore[arg-type]

    def run(w: Window) -> tuple[Poles, int | None]:
        found = identify(Record.from_arrays(w.t_u, w.u, w.t_y, w.y, input_hold='zoh'), settings)
        if found.model is None:
            raise ArithmeticError(found.status.value)
        return found.model.poles, None if settings.order else found.model.n

    return run


def interpolated(rate: float, rows: int) -> Run:
    """Return a run of SLICOT on straight lines between the samples, order given."""
    method = slicot(rows, order=4)

    def run(w: Window) -> tuple[Poles, int | None]:
        t = np.arange(w.t_y[0], w.t_y[-1], 1.0 / rate)
        y = np.stack([np.interp(t, w.t_y, row) for row in w.y.T], axis=1)
        area = np.concatenate(([0.0], np.cumsum(np.diff(w.t_u) * w.u[:-1])))
        edges = np.append(t, t[-1] + 1.0 / rate)
        u = np.diff(np.interp(edges, w.t_u, area)) * rate        # its mean over each step
        return method(t, u, y)[0], None

    return run


RUNS = {'ctsid, nothing set': ctsid(), 'ctsid, order given': ctsid(order=4),
        **{f'SLICOT on straight lines at {rate:g} Hz, s = {rows}': interpolated(rate, rows)
           for rate in (20.0, 50.0) for rows in (10, 20)}}


def pole_errors(poles: Poles) -> Array:
    """Return the distances of the true poles from the found ones, paired for the least sum."""
    truth = np.append(POLES, POLES[2].conj())
    distance = np.abs(truth[:, np.newaxis] - poles)
    first, second = linear_sum_assignment(np.where(np.isfinite(distance), distance, 1e6))
    return distance[first, second][:3]


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--seeds', type=int, default=100, help='runs of each [%(default)s]')
    parser.add_argument('--snr', type=float, default=20.0, help='dB [%(default)s]')
    options = parser.parse_args(arguments)
    there = bool(find_spec('ctrlsys'))
    runs = {name: run for name, run in RUNS.items() if there or 'SLICOT' not in name}
    ratios: dict[str, list[Array]] = {name: [] for name in runs}
    orders: dict[str, list[bool]] = {name: [] for name in runs}
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for seed in range(options.seeds):
        w = window(seed, options.snr)
        for name, run in runs.items():
            begin = time.process_time()
            try:
                poles, order = run(w)
            except ArithmeticError:
                poles, order = np.empty(0, dtype=complex), 0
            seconds[name].append(time.process_time() - begin)
            orders[name] += [order == 4] if order is not None else []
            if len(poles) == 4:
                ratios[name].append(pole_errors(poles) / w.bound)
    print(f'Outputs in bursts: {options.snr:g} dB, {options.seeds} seeds, 10 s.\n{machine()}')
    print('Root mean square error over the Cramer-Rao bound of the raw samples, where the order\n'
          'is 4; median processor time.\n')
    print(table(HEAD, [_line(name, ratios[name], orders[name], seconds[name]) for name in runs]))
    if not there:
        print('Skipped: the module ctrlsys is not installed.')
    return 0


def _line(name: str, ratios: list[Array], orders: list[bool],
          seconds: list[float]) -> tuple[str, ...]:
    right = f'{100 * np.mean(orders):.0f} %' if orders else ''
    rms = np.sqrt(np.mean(np.square(ratios), axis=0)) if ratios else np.full(3, np.nan)
    return name, *(f'{r:.3g}' for r in rms), right, f'{1e3 * np.median(seconds):.0f}'


if __name__ == '__main__':
    raise SystemExit(main())
