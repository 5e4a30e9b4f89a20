# SPDX-License-Identifier: Apache-2.0
"""What a family of robots is, and how one of them is flown, recorded and flown again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from zlib import crc32

import numpy as np

from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.statespace import StateSpace
from ctsid_core.settings import Settings
from ctsid_core.signals.record import Record
from ctsid_ros.studies.robots.inputs import KINDS, NOISE_LIKE, drive
from ctsid_ros.studies.robots.linear import Held

LEAD = 2.0              # so long before the record noise-like inputs may have begun [s]
Random = np.random.Generator
Response = Callable[[Array], ComplexArray]


def as_measured(times: Array, y: Array, rng: Random | None) -> tuple[Array, Array]:
    """Return stamps and samples of a sensor without faults."""
    return times, y


@dataclass(frozen=True, eq=False)
class Robot:
    """
    One robot: what its outputs are, and what its sensors make of them.

    Parameters
    ----------
    move : callable
        Of the inputs (`Held`), instants, and a generator: outputs (N, ny) without measurement
        noise. Without a generator nothing disturbs.
    band : float
        That inputs should excite [Hz].
    nu : int
    response : callable, optional
        True frequency response, of omega (M,), as seen by the stamps; None: not linear.
    sense : callable
        Of instants, samples and a generator: stamps and samples. Without a generator, what is
        always the same.
    duration, input_rate, output_rate : pair of float
        Least and largest [s, Hz].
    snr : pair of float
        [dB]
    """

    move: Callable[[Held, Array, Random | None], Array]
    band: float
    nu: int = 1
    response: Response | None = None
    sense: Callable[[Array, Array, Random | None], tuple[Array, Array]] = as_measured
    duration: tuple[float, float] = (5.0, 20.0)
    input_rate: tuple[float, float] = (20.0, 100.0)
    output_rate: tuple[float, float] = (50.0, 200.0)
    snr: tuple[float, float] = (10.0, 40.0)


@dataclass(frozen=True, eq=False)
class Experiment:
    """
    A record, and the truth of it.

    Parameters
    ----------
    family, kind : str
        Of robots; of inputs.
    seed, number : int
        Which of the family.
    record : Record
        What an identification gets.
    judge : str
        'simulation' or 'prediction' of `test`; 'none' if there is no right model.
    settings : Settings or None
    test : Record or None
        Another experiment of the same kind with the same robot: without noise if it is to be
        simulated, with noise if it is to be predicted.
    response : callable or None
        True frequency response of a linear robot.
    noise_time, noise : ndarray, shapes (N,), (N, ny)
        Outputs less what the inputs caused, where `response` is known.
    truth : StateSpace or None
        The robot with the gain of its Kalman filter, if it is to be predicted.
    """

    family: str
    kind: str
    seed: int
    number: int
    record: Record
    judge: str = 'simulation'
    settings: Settings | None = None
    test: Record | None = None
    response: Response | None = None
    noise_time: Array = field(default_factory=partial(np.empty, 0))
    noise: Array = field(default_factory=partial(np.empty, (0, 0)))
    truth: StateSpace | None = None

    @property
    def name(self) -> str:
        """Of the experiment, for files."""
        return f'{self.family}-{self.seed}-{self.number}'


Maker = Callable[[str, str, int, int], Experiment]


@dataclass(frozen=True, eq=False)
class Family:
    """
    Robots of one sort.

    Parameters
    ----------
    build : callable
        Of a generator and the kind of input: one robot; of a family with a `make` not used.
    what : str
        In a few words.
    kinds : tuple of str
        Of inputs, dealt out in turn.
    make : callable, optional
        Of family, kind, seed and number: the experiment, unless it is that of a plain robot.
    """

    build: Callable[[Random, str], Robot] | None
    what: str
    kinds: tuple[str, ...] = KINDS
    make: Maker | None = None


def generator(family: str, seed: int, number: int, part: int) -> Random:
    """Return the generator of one part (robot, training, test) of an experiment."""
    return np.random.default_rng((seed, crc32(family.encode()), number, part))


def stamps(rng: Random, start: float, end: float, rate: float) -> Array:
    """Return stamps of about a rate, with jitter of 0.1 to 1 ms (an eighth of the period)."""
    period = 1.0 / rate
    jitter = min(rng.uniform(1e-4, 1e-3), 0.125 * period)
    even = np.arange(start + rng.uniform(0.0, period), end, period)
    return np.asarray(even + jitter * np.clip(rng.standard_normal(len(even)), -3.0, 3.0))


@dataclass(frozen=True)
class Layout:
    """How long and how densely a robot is recorded."""

    duration: float
    input_rate: float
    output_rate: float
    snr: float
    running: bool

    @classmethod
    def drawn(cls, robot: Robot, kind: str, rng: Random) -> Layout:
        """Draw one."""
        low, high = np.log(robot.input_rate), np.log(robot.output_rate)
        return cls(rng.uniform(*robot.duration), float(np.exp(rng.uniform(*low))),
                   float(np.exp(rng.uniform(*high))), rng.uniform(*robot.snr),
                   kind in NOISE_LIKE and rng.random() < 0.5)


def flown(robot: Robot, kind: str, layout: Layout, rng: Random) -> tuple[Held, Array]:
    """Return inputs and the instants of the outputs of a new experiment."""
    lead = LEAD if layout.running else 0.5
    time = stamps(rng, -lead, layout.duration, layout.input_rate)
    values = drive(kind, rng, time, layout.duration, robot.band, robot.nu)
    if not layout.running:
        values[time < 0.0] = 0.0
    return Held(time, values), stamps(rng, 0.0, layout.duration, layout.output_rate)


def record_of(held: Held, times: Array, y: Array) -> Record:
    """Join what was recorded; inputs are known from half a second before the outputs."""
    first = max(int(np.searchsorted(held.time, -0.5)) - 1, 0)
    return Record.from_arrays(held.time[first:], held.values[first:], times, y,
                              input_hold='zoh')


def of_robot(robot: Robot, family: str, kind: str, seed: int, number: int) -> Experiment:
    """Return the experiment with a robot whose inputs are known beforehand."""
    layout = Layout.drawn(robot, kind, generator(family, seed, number, 1))
    rng = generator(family, seed, number, 2)
    held, times = flown(robot, kind, layout, rng)
    clean, moved = robot.move(held, times, None), robot.move(held, times, rng)
    noise = clean.std(axis=0) * 10.0 ** (-0.05 * layout.snr)
    offset = clean.std(axis=0) * rng.normal(0.0, 0.5, clean.shape[1])
    measured = moved + noise * rng.standard_normal(moved.shape)
    other, later = flown(robot, kind, layout, generator(family, seed, number, 3))
    truth = robot.sense(later, robot.move(other, later, None), None)
    return Experiment(
        family, kind, seed, number, record_of(held, *robot.sense(times, measured + offset, rng)),
        test=record_of(other, *truth), response=robot.response, noise_time=times,
        noise=measured - clean)
