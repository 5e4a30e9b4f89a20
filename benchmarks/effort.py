# SPDX-License-Identifier: Apache-2.0
"""
What identifications of several sizes take, whether a budget is kept, and how soon they end.

    OPENBLAS_NUM_THREADS=1 python benchmarks/effort.py [CASE ...]

Seconds of processor: without a budget beside what was asked for, what was counted (`effort.py`),
with a budget of 0.5 s, and the longest time between two questions whether it is cancelled.
"""

import sys
from time import process_time

import numpy as np
from scipy.signal import cont2discrete

from ctsid_core.identify import identify
from ctsid_core.settings import Settings
from ctsid_core.signals.record import Record
from ctsid_core.subspace.methods import METHODS

BUDGET = 0.5
CASES = {                       # inputs, outputs, states, duration [s], rate [Hz], asked [s]
    '1x1': (1, 1, 2, 52.0, 100.0, 0.4),
    '3x2': (3, 2, 4, 198.0, 50.0, 6.0),
    '4x3': (4, 3, 6, 65.0, 100.0, 4.0),
    '6x6': (6, 6, 12, 10.0, 250.0, 5.0),
    '5x2': (5, 2, 6, 60.0, 100.0, None),
    '1x12': (1, 12, 6, 30.0, 100.0, None),
    '10000': (1, 1, 2, 100.0, 100.0, None),
    'ct-pbsid': (2, 2, 4, 100.0, 200.0, None),
    'gobf': (2, 2, 4, 100.0, 200.0, None),
}


def recorded(nu: int, ny: int, n: int, duration: float, rate: float) -> Record:
    """Return a record of a random stable plant of pairs, held noise as inputs, 20 dB of noise."""
    rng = np.random.default_rng(n)
    size, damping = np.geomspace(1.0, 0.08 * np.pi * rate, n // 2), rng.uniform(0.2, 0.8, n // 2)
    A = np.zeros((n, n))
    for k, (w, z) in enumerate(zip(size, damping, strict=True)):
        A[2 * k:2 * k + 2, 2 * k:2 * k + 2] = [[0.0, w], [-w, -2.0 * z * w]]
    B, C = rng.standard_normal((n, nu)) * np.repeat(size, 2)[:, np.newaxis], \
        rng.standard_normal((ny, n))
    F, G, *_ = cont2discrete((A, B, C, np.zeros((ny, nu))), 1.0 / rate)
    count = int(duration * rate)
    u = np.repeat(rng.standard_normal((count // 20 + 1, nu)), 20, axis=0)[:count]
    x = np.zeros((count, n))
    for k in range(count - 1):
        x[k + 1] = F @ x[k] + G @ u[k]
    y = x @ C.T
    y += 0.1 * y.std(axis=0) * rng.standard_normal(y.shape)
    t = np.arange(count) / rate
    return Record.from_arrays(t, u, t, y, input_hold='zoh')


def main(names: list[str]) -> None:
    """Print a row for every case."""
    print('case       asked    takes  counted  budgeted  fits           unasked')
    for name in names or CASES:
        *shape, asked = CASES[name]
        record = recorded(*shape)
        times = [process_time()]

        def asked_now(seen: list[float] = times) -> bool:
            seen.append(process_time())
            return False

        settings = Settings(method=name if name in METHODS else 'hd-pbsid')
        whole = identify(record, settings, cancelled=asked_now)
        times.append(process_time())
        middle = process_time()
        short = identify(record, settings.replace(budget=BUDGET))
        budgeted = process_time() - middle
        print(f'{name:8} {asked or float("nan"):7.1f} {times[-1] - times[0]:8.2f} '
              f'{whole.statistics["seconds_spent"]:8.2f} {budgeted:9.2f}  '
              f'{np.min(whole.fit):5.1f} {np.min(short.fit):5.1f} %  '
              f'{1e3 * np.max(np.diff(times)):6.0f} ms', flush=True)


if __name__ == '__main__':
    main(sys.argv[1:])
