# SPDX-License-Identifier: Apache-2.0
"""
What a flight of the simulated quadrotor sends: commands and measurements, with all their flaws.

Stamps are jittered, messages are sent later than they are stamped, some measurements are lost.
Time is data time: whoever asks late, gets all the same what a punctual one would have got.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count
from typing import NamedTuple, TypeVar

import numpy as np

from ctsid_ros.examples.quadrotor_roll import (
    ANGLE_NOISE,
    COMMAND_RATE,
    GYRO_NOISE,
    GYRO_STEP,
    IMU_RATE,
    Motion,
    Plant,
    quantised,
)

_COMMAND_JITTER, _IMU_JITTER = 0.1, 0.25  # largest displacement of a stamp, in periods
_STALLED, _STALL_NS = 0.005, 2e7  # share of the messages that are held up, and how long
_HOLD, _ANGLE = (0.2, 0.9), 0.4  # how long [s] and which (+-) roll angles [rad] are wanted


@dataclass(frozen=True)
class Conditions:
    """
    How a flight is measured and sent.

    Parameters
    ----------
    command_rate, imu_rate : float
        Messages per second [Hz].
    noise : float
        Noise of the sensor, as a factor of the usual one.
    lost : float
        Share of the measurements that are never sent.
    """

    command_rate: float = COMMAND_RATE
    imu_rate: float = IMU_RATE
    noise: float = 1.0
    lost: float = 0.005


class Command(NamedTuple):
    """A torque command [N m]: when it is sent, and from when on it is held [ns since start]."""

    sent_ns: int
    stamp_ns: int
    torque: float


class Measurement(NamedTuple):
    """Measured body rates (3) [rad/s], roll angle [rad]: when sent, when measured [ns]."""

    sent_ns: int
    stamp_ns: int
    rates: tuple[float, float, float]
    roll: float


_Message = TypeVar('_Message', Command, Measurement)


class _Slot(NamedTuple):
    """When a message is to be made, and when sent [ns since start]."""

    stamp_ns: int
    sent_ns: int


class _Clock:
    """When the messages of one kind are made and sent: `head` is the next one."""

    def __init__(self, rng: np.random.Generator, rate: float, jitter: float) -> None:
        self._slots = _slots(rng, rate, jitter)
        self.head = next(self._slots)

    def take(self) -> _Slot:
        head, self.head = self.head, next(self._slots)
        return head


class Flight:
    """
    A flight that goes on for as long as somebody asks what it has sent.

    Parameters
    ----------
    conditions : Conditions
    seed : int
        The same seed, conditions and changes of the plant give the same messages.
    plant : Plant
    """

    def __init__(self, conditions: Conditions, seed: int, plant: Plant) -> None:
        wind, self._noise, self._pilot, *clocks = np.random.default_rng(seed).spawn(5)
        self._conditions = conditions
        self._motion = Motion(wind, plant)
        self._commands = _Clock(clocks[0], conditions.command_rate, _COMMAND_JITTER)
        self._samples = _Clock(clocks[1], conditions.imu_rate, _IMU_JITTER)
        self._sent_commands: deque[Command] = deque()
        self._sent_samples: deque[Measurement] = deque()
        self._wanted, self._wanted_until_ns = 0.0, 0  # the pilot's roll angle

    @property
    def plant(self) -> Plant:
        """The plant as it flies now."""
        return self._motion.plant

    def change(self, plant: Plant, time_ns: int) -> None:
        """Fly on with another plant from `time_ns` on, or from what was asked for already."""
        self._fly(time_ns)
        self._motion.move(time_ns)
        self._motion.plant = plant

    def sent(self, until_ns: int) -> list[Command | Measurement]:
        """Return what is sent until `until_ns`, since the start [ns], and was not asked yet."""
        self._fly(until_ns)
        due: list[Command | Measurement] = [*_until(self._sent_commands, until_ns),
                                            *_until(self._sent_samples, until_ns)]
        return sorted(due, key=lambda message: message.sent_ns)

    def next_ns(self) -> int:
        """Return when the next message may be sent: there is nothing to ask before [ns]."""
        queues = (self._sent_commands, self._sent_samples)
        return min(self._commands.head.sent_ns, self._samples.head.sent_ns,
                   *(queue[0].sent_ns for queue in queues if queue))

    def _fly(self, until_ns: int) -> None:
        while True:
            measured = self._samples.head.stamp_ns <= self._commands.head.stamp_ns
            clock = self._samples if measured else self._commands
            if clock.head.stamp_ns > until_ns:
                return
            slot = clock.take()
            self._motion.move(slot.stamp_ns)
            if measured:
                self._measure(slot)
            else:
                torque = self._motion.command(self._angle(slot.stamp_ns))
                self._sent_commands.append(Command(slot.sent_ns, slot.stamp_ns, torque))

    def _measure(self, slot: _Slot) -> None:
        errors = self._conditions.noise * self._noise.standard_normal(4)
        rate, roll = self._motion.measure(GYRO_NOISE * errors[0], ANGLE_NOISE * errors[1])
        if self._noise.uniform() >= self._conditions.lost:
            x, y, z = quantised(np.array([rate, *(GYRO_NOISE * errors[2:])]), GYRO_STEP).tolist()
            self._sent_samples.append(Measurement(slot.sent_ns, slot.stamp_ns, (x, y, z), roll))

    def _angle(self, time_ns: int) -> float:
        """Return the roll angle that the pilot wants [rad]: random steps."""
        while time_ns >= self._wanted_until_ns:
            self._wanted = self._pilot.uniform(-_ANGLE, _ANGLE)
            self._wanted_until_ns += int(1e9 * self._pilot.uniform(*_HOLD))
        return self._wanted


def _slots(rng: np.random.Generator, rate: float, jitter: float) -> Iterator[_Slot]:
    """Yield stamps of about `rate` [Hz], in whole microseconds, and when they are sent."""
    sent_ns = 0
    for number in count(1):
        stamp_ns = round((number + jitter * rng.uniform(-1, 1)) / rate * 1e6) * 1000
        late = 1e6 + rng.gamma(2.0, 1.5e6) + _STALL_NS * (rng.uniform() < _STALLED)
        sent_ns = max(sent_ns, stamp_ns + int(late))  # a topic keeps its order
        yield _Slot(stamp_ns, sent_ns)


def _until(queue: deque[_Message], until_ns: int) -> Iterator[_Message]:
    while queue and queue[0].sent_ns <= until_ns:
        yield queue.popleft()
