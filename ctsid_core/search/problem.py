# SPDX-License-Identifier: Apache-2.0
"""What is to be identified from which samples, and what the user is told of what was chosen."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass

import numpy as np

from ctsid_core.bases.records import Joint
from ctsid_core.effort import Effort
from ctsid_core.likelihood.output_error import Free
from ctsid_core.likelihood.samples import Samples, samples_of
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.estimate import Choice, OrderTried
from ctsid_core.search.by_order import MORE, SEARCH, Tried, affordable
from ctsid_core.search.corrupt import Corrupt, corrupt_rows
from ctsid_core.search.solution import Doubt, own_delays
from ctsid_core.settings import Settings, longest_sought

_NEARLY = 0.95        # of the longest dead time that is looked for: states may stand in for more
_NEAREST = 1e-5       # of a pole to the imaginary axis, over 1 / window: nobody can tell it from 0
                      # and nearer ones leave too few digits between a mode and the trim
_FASTEST = 0.8        # of the outputs' Nyquist frequency: the fastest pole
_STEADY = 0.05        # times e within the record: less does not tell a mode that decays
AT_ONCE = 0.4         # of the fastest pole that is looked for: a pole beyond it may stand for D


@dataclass(frozen=True, eq=False)
class Problem:
    """Records, settings and budget; rows of outputs that are found corrupt are marked on it."""

    part: Joint
    settings: Settings
    effort: Effort
    corrupt: Corrupt
    most: int           # samples of a stream that the budget suffices for

    @classmethod
    def of(cls, part: Joint, settings: Settings, effort: Effort) -> Problem:
        """Return the problem of records as they are."""
        corrupt = corrupt_rows(part)
        return cls(part, settings, effort, corrupt, affordable(samples_of(
            [p.record for p in part.parts], corrupt, effort=effort)))

    def seen(self, ahead: float = 0.0) -> Samples:
        """Return the samples, outputs left out for so long [s] after the start of the inputs."""
        return samples_of([p.record for p in self.part.parts], self.corrupt, ahead,
                          self.effort).thinned(self.most)

    @property
    def own(self) -> Settings:
        """The settings with the dead times of the moving inputs only."""
        return own_delays(self.part, self.settings)

    @property
    def known_delay(self) -> Array:
        """The dead times that are given, 0 where they are looked for, (nu,) [s]."""
        return np.array(self.own.delays(len(self.part.parts[0].u)))

    @property
    def names(self) -> list[str]:
        """The names of the moving inputs."""
        names = self.part.parts[0].whole.input_names
        return [names[j] for j in self.part.parts[0].u]

    def used(self, order: int, delay: Array) -> Settings:
        """Return the settings with what was found; dead times as one number if given so, alike."""
        delays = np.array(self.settings.delays(self.part.parts[0].whole.nu))
        delays[list(self.part.parts[0].u)] = delay
        alike = not isinstance(self.settings.delay, tuple) and bool(np.all(delays == delays[0]))
        return self.settings.replace(
            order=order, delay=float(delays[0]) if alike else tuple(delays.tolist()))

    def table(self, found: dict[int, Tried], chosen: Tried) -> tuple[OrderTried, ...]:
        """Return the orders among which was chosen; none if it was given."""
        return () if self.settings.order else tuple(
            order_row(one, chosen, n) for n, one in sorted(found.items()))

    def choices(self, best: Tried, free: Free, beside: int) -> tuple[Choice, ...]:
        """Return what was chosen, and why."""
        why = f', and one {"more" if beside > 0 else "less"}: likelier once it is allowed for ' \
            'that errors last from sample to sample'
        found = [] if self.settings.order else [Choice(
            'order', best.fit.model.n, 'the smallest that no larger one beats, counting '
            'independent samples' + (why if beside else ''))]
        found += [Choice('delay', round(float(best.fit.model.delay[k]), 6),
                         f'of input {name}: the most likely, with the poles')
                  for k, name in enumerate(self.names) if free.delays[k]]
        return tuple(found)

    def left_out(self, found: Container[int], order: int) -> tuple[str, ...]:
        """Return what the budget has left out, in words."""
        near = range(max(order - MORE, 1), min(order + MORE, self.settings.max_order) + 1)
        if self.settings.order or not self.effort.beyond(SEARCH) or all(n in found for n in near):
            return ()
        return (f'the budget of {self.settings.budget:.3g} s ended the search at order {order}; '
                'raise `budget`, or set `order`',)

    def doubt(self, best: Tried | None, poles: Array | ComplexArray, samples: Samples, free: Free,
              grows: bool = False) -> Doubt | None:
        """Return what a model looks like if a setting is not right, and that setting."""
        for name, late, delay in zip(self.names, free.delays, best.fit.model.delay,
                                     strict=True) if best else ():
            if late and delay > _NEARLY * free.longest:
                return (f'the dead time of input {name} is near the longest that is looked for, '
                        f'{free.longest:.3g} s, and states may stand in for more', 'delay')
        near = poles.real * samples.length >= -_STEADY
        steady = int(np.sum(near) + np.sum(near & (poles.imag > 0.0)))
        if self.own.feedthrough and (grows or steady > 1):
            what = 'predictions find a mode that grows' if grows else \
                'modes neither grow nor decay'
            return (f'{what}, as when a controller keeps an unstable plant in place',
                    'feedthrough: false')
        if not self.own.feedthrough and np.max(np.abs(poles), initial=0.0) > \
                AT_ONCE * free.fastest:
            return ('a mode is nearly as fast as any that is looked for, as when outputs follow '
                    'inputs at once, and no controller acts', 'feedthrough: true')
        return None


def at_bound(best: Tried, free: Free) -> tuple[str, ...]:
    """Return that a pole is about as fast as any that is looked for, in words."""
    fast = float(np.max(np.abs(best.fit.model.poles), initial=0.0))
    return () if fast < _NEARLY * free.fastest else (
        f'the pole of {fast:.3g} rad/s is about the fastest that is looked for ({_FASTEST:g} of '
        'the Nyquist frequency of the outputs) and stands for anything faster: it is a bound',)


def order_row(one: Tried, chosen: Tried, n: int) -> OrderTried:
    """Return a row of the table of orders: all by the independent samples of the chosen one."""
    n_eff = max(float(np.min(chosen.independent)), 2.0)
    power = one.power / np.maximum(chosen.power, 1e-300)
    price = (one.parameters - chosen.parameters) * float(np.log(n_eff))
    return OrderTried(n, n_eff * float(np.sum(np.log(np.maximum(power, 1e-300)))) + price,
                      100.0 * (1.0 - float(np.sqrt(np.max(one.power)))))


def free_of(samples: Samples, own: Settings) -> Free:
    """Return what is free, and within which bounds."""
    return Free(own.feedthrough, own.trim, own.unknown_delays(samples.nu),
                longest_sought(samples.length), -_NEAREST / samples.length,
                _FASTEST * np.pi / samples.finest)
