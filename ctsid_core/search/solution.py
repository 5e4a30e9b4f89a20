# SPDX-License-Identifier: Apache-2.0
"""A model of the moving channels at the maximum of the likelihood, before it is judged."""

from __future__ import annotations

from collections.abc import Callable, Container
from dataclasses import dataclass, field

import numpy as np

from ctsid_core.bases.records import Joint
from ctsid_core.likelihood.modal_model import ModalModel
from ctsid_core.likelihood.output_error import Fit, Fitted, Free
from ctsid_core.likelihood.samples import Samples
from ctsid_core.linear.types import Array, Matrices
from ctsid_core.model.estimate import Choice, OrderTried
from ctsid_core.search.by_order import MORE
from ctsid_core.search.task import FASTEST, Task
from ctsid_core.search.tried import SEARCH, Tried
from ctsid_core.settings import Actuator, Settings

DISTURBED = 0.35        # error that is not white noise, over the motion: a simulation is nothing
                        # to act on, and of plants that predictions found nothing to judge by

# What it looks like if a setting is not right, in words, and that setting
Doubt = tuple[str, str]
# Those of an order that is given and too small or too large, of dead times that are given and not
# these, and of D beside a mode that grows: what they leave is explained by curves, or by signals
# that are missing, too
ANY_ORDER, ANY_DELAY, NO_DIRECT = GIVEN = ('order: 0', 'delay: auto', 'feedthrough: false')
DIRECT = 'feedthrough: true'
OTHER_HOLD = '.hold: '  # after the name of an input, before what it should be

GROWS = 1.0           # times e within the record: less does not tell a plant that grows
NEARLY = 0.95         # of a bound: what is near it stands in for more


def at_fastest(fit: Fit, free: Free) -> bool:
    """Return whether a pole is about as fast as any that is looked for."""
    return bool(np.max(np.abs(fit.model.poles), initial=0.0) >= NEARLY * free.fastest)


@dataclass(frozen=True, eq=False)
class Solution:
    """A model of the moving channels, and how it was identified."""

    settings: Settings  # as used: automatic values filled in
    part: Joint         # the records
    samples: Samples
    fit: Fit
    free: Free
    independent: Array  # (ny,): number of independent samples of the errors of each output
    orders: tuple[OrderTried, ...] = ()  # empty if the order was given
    choices: tuple[Choice, ...] = ()
    notes: tuple[str, ...] = ()
    doubt: Doubt | None = None
    # From the samples of the first part to the model that the same method makes of them; None:
    # output error from the poles of the whole
    refit: Callable[[Samples], Fit | None] | None = None
    # Of a model that was found by its predictions: `samples`, `fit` and `free` are those of its
    # predictor, with the outputs' own past among the inputs. None: the model is that of `fit`
    plant: Matrices | None = None
    # Of a plant that predictions found and simulations are judged by: its predictor
    predictor: Fitted | None = None
    # With inputs that drift, of which the model is the mean; time is among the inputs
    drifting: Fitted | None = None
    # The same where the records do not tell its mean, too
    drifts: Tried | None = None
    # (horizons, ny): of its predictions, over the motion
    errors_ahead: Array = field(default_factory=lambda: np.empty((0, 0)))
    # What tells whether the plant changes or is curved: of a stable plant that was found by its
    # predictions, and is judged by them, how it simulates; of a disturbed one the best simulation
    simulating: Fitted | None = None
    # The best ones of smaller orders that simulate, and what was free in them
    smaller: tuple[tuple[ModalModel, Free], ...] = ()
    # Others that might be right: share of the Akaike weights, plant
    rivals: tuple[tuple[float, ModalModel], ...] = ()
    # Standard deviations of the numbers that act of all inputs, as far as they were found
    deviations: tuple[Actuator, ...] = ()
    # Of a subspace method's regression; their drop shows the order
    singular_values: Array = field(default_factory=lambda: np.empty(0))
    condition: float = float('nan')
    unproven: bool = False  # modes grow of which the samples do not show that they do

    @property
    def by_prediction(self) -> bool:
        """Whether the model was found by its predictions, and is judged by them."""
        return self.plant is not None and self.predictor is None

    @property
    def source(self) -> Fitted:
        """What the likelihood was of: a simulation, or a predictor."""
        return self.predictor or (self.samples, self.fit, self.free)

    @property
    def simulated(self) -> Fitted | None:
        """What simulates: the model, or what stands for it; None of a plant that grows."""
        return self.simulating or (
            None if self.by_prediction else (self.samples, self.fit, self.free))

    @property
    def telling(self) -> tuple[Fitted | None, bool]:
        """The predictor, where it tells changes, and whether simulations tell them, too."""
        simulates = self.plant is None or None not in (self.predictor, self.simulating)
        return (None if self.plant is None or simulates and self.settings.feedthrough
                else self.source), simulates

    @property
    def delay(self) -> Array:
        """Dead times of the moving inputs, (nu,) [s]."""
        return np.asarray(self.fit.model.delay[:len(self.part.parts[0].u)])


def used(task: Task, order: int, delay: Array) -> Settings:
    """Return the settings with what was found; dead times as one number if given so and alike."""
    settings, first = task.settings, task.part.parts[0]
    delays = np.array(settings.delays(first.whole.nu))
    delays[list(first.u)] = delay
    alike = not isinstance(settings.delay, tuple) and bool(np.all(delays == delays[0]))
    return settings.replace(order=order,
                            delay=float(delays[0]) if alike else tuple(delays.tolist()))


def table_of(found: dict[int, Tried], chosen: Tried, settings: Settings) -> tuple[OrderTried, ...]:
    """Return the orders among which was chosen; none if it was given."""
    if settings.order:
        return ()
    # All by the independent samples of the chosen one
    n_eff, rows = max(float(np.min(chosen.independent)), 2.0), []
    for n, one in sorted(found.items()):
        power = one.power / np.maximum(chosen.power, 1e-300)
        price = (one.parameters - chosen.parameters) * float(np.log(n_eff))
        rows.append(OrderTried(
            n, n_eff * float(np.sum(np.log(np.maximum(power, 1e-300)))) + price,
            100.0 * (1.0 - float(np.sqrt(np.max(one.power))))))
    return tuple(rows)


def at_bound(fit: Fit, free: Free) -> tuple[str, ...]:
    """Return that a pole is about as fast as any that is looked for, in words."""
    return () if not at_fastest(fit, free) else (
        f'the pole of {np.max(np.abs(fit.model.poles)):.3g} rad/s is about the fastest that '
        f'is looked for ({FASTEST:g} of the Nyquist frequency of the outputs) and stands for '
        'anything faster: it is a bound',)


def left_out(task: Task, found: Container[int], order: int) -> tuple[str, ...]:
    """Return what the budget has left out, in words."""
    settings = task.settings
    near = range(max(order - MORE, 1), min(order + MORE, settings.max_order) + 1)
    if settings.order or not task.effort.beyond(SEARCH) or all(n in found for n in near):
        return ()
    return (f'the budget of {settings.budget:.3g} s ended the search at order {order}; raise '
            '`budget`, or set `order`',)
