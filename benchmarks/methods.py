# SPDX-License-Identifier: Apache-2.0
"""
What HD-PBSID and CT-PBSID cost, over records of 10 to 600 s.

Plant of [HD] 5.1, sweep from 0 to 8 Hz over the whole record, 200 Hz, noise 20 dB below each
output. First the subspace step alone, from samples to matrices, with all parameters given as
[HD] has them: beta 3, gamma 20; Laguerre pole 25; past and future window 10 for both; nmax as
ctsid chooses it, in proportion to the length. CT-PBSID is ctsid's, one sweep over the samples,
and the plain one of `plain_laguerre.py`, projections summed for every instant. Then all of
`identify`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
import os

os.environ |= {'OPENBLAS_NUM_THREADS': '1', 'OMP_NUM_THREADS': '1', 'MKL_NUM_THREADS': '1'}

from common import experiment, interleaved, machine, noisy, sweep, table  # noqa: E402
import numpy as np  # noqa: E402
from plain_laguerre import poles  # noqa: E402

from ctsid_core import Record, Settings, identify  # noqa: E402
from ctsid_core.bases.hermite import project_record  # noqa: E402
from ctsid_core.bases.records import choose_nmax  # noqa: E402
from ctsid_core.linear.types import Matrices  # noqa: E402
from ctsid_core.subspace.ct_pbsid import laguerre_levels, reach, to_continuous  # noqa: E402
from ctsid_core.subspace.hd_pbsid import Levels, Tuning, realise, regress, stack_levels  # noqa: E402

DURATIONS = (10.0, 20.0, 60.0, 120.0, 300.0, 600.0)     # s
RATE = 200.0                                            # Hz
SNR = 20.0                                              # dB
ORDER, BETA, GAMMA, POLE, PAST = 2, 3.0, 20.0, 25.0, 10
AIM, AIM_AT = 10.0, 60.0        # times faster than CT-PBSID, on a record of so many seconds
SLOW = 'CT, anew'
STEPS = ('HD', 'CT', 'CT, kept', SLOW)
WHOLE = ('all given', 'CT, all given', 'nothing given')


def recorded(duration: float) -> Record:
    """Return the experiment; all signals are smooth."""
    t = np.arange(round(duration * RATE) + 1) / RATE
    y = noisy(experiment(t, duration), SNR, 0)
    return Record.from_arrays(t, sweep(t, duration), t, y, input_hold='smooth')


def by_hermite(record: Record, nmax: int, parts: int) -> Matrices:
    """Return the model by HD-PBSID."""
    projection = project_record(record, Settings(parts=parts, delay=0.0), nmax)
    return _realised(stack_levels(projection, BETA, GAMMA, PAST + 1), BETA, GAMMA)


def by_laguerre(record: Record) -> Matrices:
    """Return the model by CT-PBSID as ctsid has it."""
    levels = laguerre_levels([record], Settings(delay=0.0), POLE, PAST + 2)
    return to_continuous(_realised(levels, 0.0, 1.0), POLE)


def _realised(levels: Levels, beta: float, gamma: float) -> Matrices:
    return realise(regress(levels, Tuning(beta, gamma, PAST, PAST), feedthrough=True,
                           rank_tolerance=1e-10), ORDER)


def plainly(record: Record, keep: bool) -> object:
    """Return the poles by the plain CT-PBSID."""
    u, y = record.inputs[0], record.outputs[0]
    return poles(y.time, u.values.T, y.values.T, order=ORDER, a=POLE, past=PAST,
                 length=reach(PAST + 2) / POLE, keep=keep)


def least(cases: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Return the least seconds: what disturbs a case of few rounds only ever adds to its time."""
    return interleaved(cases, rounds, min)


def measured(duration: float, rounds: int, longest: float) -> dict[str, float]:
    """Return the seconds of each case for a record of a duration."""
    record = recorded(duration)
    nmax, parts = choose_nmax(record)
    steps: dict[str, Callable[[], object]] = {
        'HD': lambda: by_hermite(record, nmax, parts), 'CT': lambda: by_laguerre(record),
        'CT, kept': lambda: plainly(record, keep=True)}
    found = least(steps, rounds)
    if duration <= longest:
        found |= least({SLOW: lambda: plainly(record, keep=False)}, 1)
    given = Settings(order=ORDER, nmax=nmax, parts=parts, beta=BETA, gamma=GAMMA, past=PAST,
                     refine=False, held_out=0.0, delay=0.0)
    laguerre = given.replace(method='ct-pbsid', laguerre_pole=POLE)
    return found | least({
        'all given': lambda: identify(record, given),
        'CT, all given': lambda: identify(record, laguerre),
        'nothing given': lambda: identify(record)}, max(rounds // 2, 1))


def exponent(durations: Sequence[float], seconds: Sequence[float]) -> float:
    """Return e of seconds ~ duration^e, by least squares of logarithms."""
    if len(seconds) < 2:
        return float('nan')
    return float(np.polyfit(np.log(durations[:len(seconds)]), np.log(seconds), 1)[0])


def report(durations: Sequence[float], rows: Sequence[dict[str, float]], names: Sequence[str],
           over: str) -> str:
    """Return a table of milliseconds, in brackets over those of one case, and exponents."""
    lines = [[f'{duration:g} s', *(
        f'{1e3 * row[name]:.1f}' + (f' ({row[name] / row[over]:.1f})' if name != over else '')
        if name in row else '-' for name in names)]
        for duration, row in zip(durations, rows, strict=True)]
    powers = [f'{exponent(durations, [row[name] for row in rows if name in row]):.2f}'
              for name in names]
    return table(('record', *names), [*lines, ['exponent', *powers]])


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--durations', type=float, nargs='+', default=DURATIONS, metavar='S')
    parser.add_argument('--rounds', type=int, default=7, help='per row [%(default)s]')
    parser.add_argument('--longest', type=float, default=120.0, metavar='S',
                        help='record on which functions are evaluated anew [%(default)s]')
    options = parser.parse_args(arguments)
    durations = sorted(options.durations)
    print(f'Cost over the length of a record.\n{machine()}')
    print(f'Milliseconds of the processor, the least of {options.rounds} interleaved rounds; in '
          'brackets: over the first column.\n')
    rows = [measured(duration, options.rounds, options.longest) for duration in durations]
    print('Subspace step alone, all parameters given. CT: one sweep; kept, anew: plain sums, '
          'functions kept or\nevaluated for every instant.\n')
    print(report(durations, rows, STEPS, 'HD'))
    print('\nAll of `identify`: order and parameters given, not refined, nothing held out; '
          'CT-PBSID likewise;\nnothing given at all, HD-PBSID refined and tested.\n')
    print(report(durations, rows, WHOLE, 'all given'))
    for duration, row in zip(durations, rows, strict=True):
        for name in (n for n in STEPS[1:] if duration == AIM_AT and n in row):
            ratio = row[name] / row['HD']
            print(f'Aim: HD at least {AIM:g} times faster than {name} at {AIM_AT:g} s: '
                  f'{ratio:.1f}, {"reached" if ratio >= AIM else "NOT reached"}.')
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
