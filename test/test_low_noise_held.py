# SPDX-License-Identifier: Apache-2.0
"""Low noise and held inputs: what outputs do between their samples is told by their response."""

from __future__ import annotations

from itertools import product

from marks import slow
import numpy as np
from plants import PLANTS, Plant, jittered, match, noisy, plant, random_plant, random_signal
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import zpk2ss

from ctsid_core import Record, Settings, Signal, StateSpace, identify
from ctsid_ros.studies import takenaka_malmquist as study

FIRST = plant(*zpk2ss([-5.0], [-3.0, -12.0], 7.2))                    # relative degree 1
SECOND = plant(*zpk2ss([-4 + 9j, -4 - 9j], [-1.5 + 6j, -1.5 - 6j, -2 + 15j, -2 - 15j], 100.0))
MANY = random_plant(np.random.default_rng(0), 3, 2, 2)
RATES = {'same stamps': (100.0, 100.0, False), 'input slower': (50.0, 200.0, True),
         'input faster': (200.0, 100.0, True)}


def driven(p: Plant, hold: str, rates: str, snr: float | None, seed: int = 1, *,
           delay: float = 0.0, white: bool = True, duration: float = 10.0) -> Record:
    """Return exact samples of a plant under steps or straight lines, and noise."""
    rng, (rate_u, rate_y, jitter) = np.random.default_rng(seed), RATES[rates]
    if jitter:
        t_u, t_y = jittered(rng, rate_u, duration + 4.0) - 4.0, jittered(rng, rate_y, duration)
    else:
        t_u = np.arange(round((duration + 4.0) * rate_u) + 1) / rate_u - 4.0
        t_y = np.arange(round(duration * rate_y) + 1) / rate_y
    t_y = t_y[(t_y >= 0.0) & (t_y <= duration)]
    nu = p.B.shape[1]
    u = rng.standard_normal((len(t_u), nu)) if white else random_signal(rng, nu).at(t_u)
    truth = StateSpace(A=p.A, B=p.B, C=p.C, D=p.D, delay=(delay,) * nu)
    y = truth.simulate((Signal(t_u, u, hold),), np.concatenate((t_u[:1], t_y)))[1:]
    kept = t_u > -0.5
    return Record.from_arrays(t_u[kept], u[kept], t_y, noisy(rng, y, snr), input_hold=hold)


def errors(found, p: Plant):
    """Return the relative errors of the poles, and the errors over `pole_std`."""
    order = [int(np.argmin(np.abs(found.model.poles - q)))
             for q in match(found.model.poles, p.poles)]
    off = np.abs(found.model.poles[order] - p.poles)
    return off / np.abs(p.poles), off / found.pole_std[order]


SYSTEMS = {'degree 1': FIRST, 'degree 2': SECOND, '2 x 2': MANY}
QUICK = [('degree 2', 'linear', 'input faster', None),
         ('degree 1', 'linear', 'same stamps', 90.0), ('degree 2', 'zoh', 'input slower', 90.0)]


@pytest.mark.parametrize(('name', 'hold', 'rates', 'snr'), [*QUICK, *slow(*(
    case for case in product(SYSTEMS, ('zoh', 'linear'), RATES, (60.0, 90.0, 120.0, None))
    if case not in QUICK))])
def test_order_and_poles_to_the_noise(name, hold, rates, snr):
    p = SYSTEMS[name]
    found = identify(driven(p, hold, rates, snr), Settings(delay=0.0))
    assert found.ok
    assert found.model.n == len(p.poles)
    relative, deviations = errors(found, p)
    if snr is None:
        assert relative.max() < 1e-8
    else:
        assert deviations.max() < 4.0
        assert relative.max() < 10.0 ** (-snr / 20.0)


@pytest.mark.parametrize(('rates', 'hold'), [
    ('same stamps', 'zoh'), *slow(*((rates, hold) for rates in RATES for hold in ('zoh', 'linear')
                                    if (rates, hold) != ('same stamps', 'zoh')))])
def test_feedthrough_and_moderate_noise(hold, rates):
    p = PLANTS['hd52']
    found = identify(driven(p, hold, rates, 40.0), Settings(delay=0.0))
    assert found.ok
    assert found.model.n == 3
    relative, deviations = errors(found, p)
    assert deviations.max() < 4.0
    assert relative.max() < 3e-3


@pytest.mark.slow
def test_deviation_is_what_is_seen():
    z = [errors(identify(driven(FIRST, 'zoh', 'same stamps', 40.0, seed, duration=5.0),
                         Settings(delay=0.0, order=2)), FIRST)[1] for seed in range(10)]
    assert 0.5 < np.sqrt(np.mean(np.square(z))) < 1.6


@pytest.mark.xfail(reason='climbs end at 99.91 to 99.9995 % of two seconds: five of six are GOOD, '
                   'and their responses are off by 20 to 220 %')
@pytest.mark.parametrize(('order', 'seeds'), [(0, 1), *slow((0, 3), (4, 3))])
def test_printed_example(order, seeds):
    """Of [TM] section V, in which a spline through the outputs loses the slow poles."""
    truth = study.response(study.plant())
    for seed in range(seeds):
        found = identify(study.example(seed), Settings(order=order, delay=0.0))
        assert found.model.n == 4
        assert study.relative(np.abs(study.response(found.model) - truth)[np.newaxis])[0] < 1e-4


def bouncing(seed: int, rate: float) -> Record:
    """Return a mass on a spring that hits a stiff stop, under steps at 50 Hz, without noise."""
    u = np.random.default_rng(seed).standard_normal(301)

    def motion(t, x):
        stop = (400.0 * (x[0] + 0.2) + 5.0 * x[1]) * (x[0] < -0.2)
        return [x[1], -4.0 * x[0] - 2.0 * x[1] + 10.0 * u[min(int(t * 50.0), 300)] - stop]

    t = np.arange(round(6.0 * rate) + 1) / rate
    y = solve_ivp(motion, (0.0, 6.0), [0.0, 0.0], t_eval=t, max_step=0.01, rtol=1e-6).y[0]
    return Record.from_arrays(np.arange(301) / 50.0, u, t, y, input_hold='zoh')


@pytest.mark.parametrize(('seed', 'rate'), [
    *slow((0, 50.0), (0, 100.0), (1, 100.0), (1, 200.0), (7, 200.0))])
def test_a_plant_that_is_not_linear_ends_with_a_word(seed, rate):
    """No response of a linear model is this output; models on the way may explode."""
    found = identify(bouncing(seed, rate), Settings(delay=0.0))
    assert np.isfinite(found.fit).all()
    assert found.verdict.reason
