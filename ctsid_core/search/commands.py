# SPDX-License-Identifier: Apache-2.0
"""Samples whose inputs may act otherwise than they were sent, and models of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from ctsid_core.bases.records import Joint
from ctsid_core.likelihood.mode_columns import evaluation_work
from ctsid_core.likelihood.output_error import Fit, Free, climb_roughly, fit_at
from ctsid_core.likelihood.samples import Samples
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.search.tried import Tried, tried
from ctsid_core.settings import LARGEST_INPUT, LONGEST_DELAY, Actuator
from ctsid_core.signals.actuators import behind
from ctsid_core.signals.gaps import silent_between
from ctsid_core.signals.record import Signal

TIMEOUTS = (0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0, 1.5, 2.0)      # to begin with [s]
_VALUES = {           # and of the largest command, and of the range of all
    'timeout': TIMEOUTS, 'dead_zone': (0.06, 0.15, 0.3, 0.5),
    'limit': (0.9, 0.7, 0.5, 0.3, 0.2),
    'backlash': (0.06, 0.15, 0.35)}
_RATES, _SLOWEST, _FASTEST = 8, 8.0, 0.9    # so many rates, from 8 deviations of the command over
                                            # the length to this part of its fastest change
_WORK = 5e3           # of computing what acts, for each sample of an input
_NONE = 1e-9          # of the largest command: that is 0
_STEPS = 3            # after so many steps of a climb; the best of each kind climbs on

Start = tuple[ComplexArray, Array]     # poles and dead times
Acting = dict[int, Actuator]           # of moving inputs, by their places


@dataclass(frozen=True, eq=False)
class Commands:
    """Samples whose inputs, each a signal of its own, may act otherwise than they were sent."""

    samples: Samples
    levels: Sequence[Array]     # that were taken off the inputs of each record, (nu,)
    free: Free

    def acting(self, actuators: Mapping[int, Actuator]) -> Samples:
        """Return the samples with inputs as they act."""
        return replace(self.samples, records=tuple(
            replace(r, inputs=tuple(self._acting(number, k, actuators[k])
                                    for k in range(len(r.inputs))))
            for number, r in enumerate(self.samples.records)))

    def _acting(self, record: int, channel: int, own: Actuator) -> Signal:
        signal = self.samples.records[record].inputs[channel]
        if not any(own):
            return signal
        self.samples.effort.spend(_WORK * len(signal.time))
        return behind(signal, own, float(self.levels[record][channel]))

    def work(self, fit: Fit) -> float:
        """Return the work of computing what acts, and a model of it."""
        return evaluation_work(self.samples, len(fit.model.poles), slopes=False) + _WORK * sum(
            float(len(s.time)) for r in self.samples.records for s in r.inputs)

    def at(self, acting: Samples, start: Start, near: Fit | None = None) -> Fit | None:
        """Return the model of what acts with some poles and dead times, if there is one."""
        with suppress(np.linalg.LinAlgError):
            return fit_at(acting, *start, self.free, near, slopes=False)
        return None

    def climbed(self, actuators: Mapping[int, Actuator], starts: Sequence[Start]) -> Fit | None:
        """Return what the best of some starts leads to in a few steps; itself of large models."""
        acting = self.acting(actuators)
        fits = [one for start in starts if (one := self.at(acting, start)) is not None]
        best = min(fits, key=lambda f: f.cost, default=None)
        return best if best is None or acting.rank > 2 else climb_roughly(
            acting, best, self.free, steps=_STEPS)

    def reached(self, actuators: Mapping[int, Actuator], starts: Sequence[Start]) -> Tried | None:
        """Return the best of what some starts lead to."""
        samples, best = self.acting(actuators), None
        begun = [one for start in starts if (one := self.at(samples, start)) is not None]
        for one in sorted(begun, key=lambda fit: fit.cost):
            other = climb_roughly(samples, one, self.free, np.inf if best is None else best.cost)
            best = other if best is None or other.cost < best.cost else best
        return None if best is None else tried(samples, best, self.free)

    def values(self, channel: int, kind: str, beside: Actuator) -> list[float]:
        """Return numbers to begin with, beside what acts of the channel already."""
        sent = self._sent(channel)
        u = np.concatenate(sent)
        if kind == 'rate_limit':
            steps = [np.max(np.abs(np.diff(u)), initial=0.0) / r.inputs[channel].period
                     for r, u in zip(self.samples.records, sent, strict=True)]
            slow = _SLOWEST * float(np.std(u)) / self.samples.length
            values = np.geomspace(slow, max(_FASTEST * max(steps), slow), _RATES).tolist()
        else:
            size = 1.0 if kind == 'timeout' else float(
                np.ptp(u) if kind == 'backlash' else np.max(np.abs(u)))
            values = [share * size for share in _VALUES[kind]]
        least, most = self.bounds(channel, kind, beside)
        return sorted({max(value, least) for value in values if max(value, least) < most})

    def bounds(self, channel: int, kind: str, beside: Actuator) -> tuple[float, float]:
        """Return the numbers beyond which all are alike: a limit of every command, and of none."""
        # Behind a dead zone commands are smaller; before play and rates no two limits are alike.
        if kind == 'timeout':
            return 0.0, LONGEST_DELAY
        if kind != 'limit' or beside.dead_zone or beside.backlash or beside.rate_limit:
            return 0.0, LARGEST_INPUT
        sizes = np.abs(np.concatenate(self._sent(channel)))
        largest = float(min(np.max(sizes), LARGEST_INPUT))
        return float(np.min(sizes, where=sizes > _NONE * largest, initial=largest)), largest

    def _sent(self, channel: int) -> list[Array]:
        return [r.inputs[channel].values[:, 0] + level[channel]
                for r, level in zip(self.samples.records, self.levels, strict=True)]

    def silent(self, channel: int) -> bool:
        """Return whether an input that is held is silent, and not at rest."""
        return any(np.any(silent_between(r.inputs[channel], *r.span, -level[channel]))
                   for r, level in zip(self.samples.records, self.levels, strict=True))


def commands_of(samples: Samples, part: Joint, free: Free) -> Commands:
    """Return samples of records with inputs as they were sent."""
    records = []
    for r, one in zip(samples.records, part.parts, strict=True):
        sent = (s.columns([j]) for s in r.commands for j in range(s.width))
        records.append(replace(r, inputs=tuple(
            replace(s, values=s.values - level) if one.record.sent else s
            for s, level in zip(sent, one.u_level, strict=True))))
    return Commands(replace(samples, records=tuple(records)), [p.u_level for p in part.parts],
                    free)


def with_number(acting: Acting, channels: Sequence[int], kind: str, value: float) -> Acting:
    """Return what acts with another number of one kind, of some inputs."""
    return acting | {k: acting[k]._replace(**{kind: value}) for k in channels}
