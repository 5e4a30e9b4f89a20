# SPDX-License-Identifier: Apache-2.0
"""
Models of several orders, compared.

How much evidence there is for one more state depends on how many samples are independent:

    N_eff = N / (1 + 2 sum_k rho_k)

with the autocorrelation rho_k of the errors of the smaller of two models. White errors: N_eff = N.
Model errors are neither white nor new information, and states that imitate them are not bought.
Nor is there more evidence than N_eff log N, N the independent samples of all outputs, however much
errors fall: as many numbers as there are independent samples explain any of them. Of an order that
HD-PBSID points at, both models' errors say how many these are. And each model's errors are counted
by degree of freedom, of its own that are independent: states that are there leave white errors, of
which few are spent; those that imitate a vibration mostly leave errors of its kind.

A gain that falls while a battery sags, or a dead time that grows because two clocks run apart, is
imitated by states: slow ones, or as many as the input has frequencies. So a smaller model with
inputs that drift (`drifting.py`) is asked, too: what it explains better needs no states.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ctsid_core.likelihood.modal_model import ModalModel
from ctsid_core.likelihood.mode_columns import ROUNDING
from ctsid_core.likelihood.output_error import STEPS, Fit, Free, climb, climb_roughly, fit_at
from ctsid_core.likelihood.residuals import (
    autoregression,
    by_output,
    coloured_power,
    independent,
    residuals,
)
from ctsid_core.likelihood.samples import Residuals, Samples
from ctsid_core.linear.types import Array, ComplexArray, Mask

ENOUGH = 0.005        # of an output's motion: states that explain less are not taken
_CLEANER = 4.0        # power of errors before over after, with which states matter all the same,
LEAST = 1e-4          # if the errors were more than this part of the motion
AKAIKE = 2.0          # price of a parameter
SEARCH = 0.6          # of a budget that the search may take, ...
POINT = 0.4           # ... and a look at where to begin
_NEGLIGIBLE = 0.01    # share of the Akaike weights
UNEXPLAINED = 0.04    # error that is not noise, over the motion, with which more may be told


@dataclass(frozen=True, eq=False)
class Tried:
    """The best model of one order."""

    samples: Samples    # that it is of
    fit: Fit
    power: Array        # (ny,): mean square of the errors of each output, over all records
    parameters: int
    # Whether HD-PBSID pointed at its order, far from those that are tried one after another: its
    # own errors say, too, how much there is to know
    pointed: bool = False
    drifting: Tried | None = None   # the same order with inputs that drift, where it was seen
    found: Tried | None = None      # what it was then, of fewer samples

    @cached_property
    def errors(self) -> Residuals:
        """Measured less simulated outputs."""
        return residuals(self.samples, self.fit)

    @cached_property
    def independent(self) -> Array:
        """Number of independent samples among the errors of each output, (ny,)."""
        return independent(self.errors)

    @property
    def spent(self) -> Array:
        """By how much errors would be larger, had none of them told the model's numbers, (ny,)."""
        each = self.parameters / len(self.power)
        return np.asarray(1.0 + each / np.maximum(self.independent - each, 1.0))

    @cached_property
    def coloured(self) -> Array:
        """-2 log likelihood of each output's errors, an autoregression of each record, (ny,)."""
        return np.array([sum(autoregression(e)[0] for e in parts)
                         for parts in by_output(self.errors)])

    @cached_property
    def unexplained(self) -> float:
        """Rms of errors that are not noise, over the motion."""
        return float(np.sqrt(np.max(coloured_power(self.errors))))

    @property
    def left(self) -> float:
        """The same, of what inputs that drift do not explain either."""
        return (self.drifting or self).unexplained

    @property
    def rms(self) -> float:
        """Rms error over the motion, of all outputs together."""
        return float(np.sqrt(np.mean(self.power)))


def tried(samples: Samples, fit: Fit, free: Free, pointed: bool = False) -> Tried:
    """Return a model of an order with what its errors say."""
    return Tried(samples, fit, samples.mean(fit.power), parameters(samples, fit, free), pointed)


def climbed(samples: Samples, one: Tried, free: Free, steps: int = STEPS,
            others: Iterable[tuple[ComplexArray, Array]] = ()) -> Tried:
    """
    Return a model at the maximum of the likelihood of other samples, or on the way there.

    From `others`, poles and dead times, if one of these is likelier, numbers paid.
    """
    start = fit_at(samples, *one.fit.model.nonlinear, free, one.fit)
    for other in others:
        with suppress(np.linalg.LinAlgError):
            start = min(start, fit_at(samples, *other, free), key=lambda fit: (
                fit.cost + price(samples) * parameters(samples, fit, free)))
    return replace(tried(samples, climb(samples, start, free, steps=steps), free, one.pointed),
                   drifting=one.drifting, found=one.found)


def roughly(samples: Samples, poles: ComplexArray, delay: Array, free: Free,
            near: Fit | None = None) -> Tried:
    """Return the best model near poles and dead times, as far as it takes to compare it."""
    start = fit_at(samples, poles, delay, free, near)
    return tried(samples, climb_roughly(samples, start, free), free)


def fitted(samples: Samples, model: ModalModel, free: Free, near: Fit | None = None) -> Tried:
    """Return the best model of other samples, or with D, at a model's poles and dead times."""
    return tried(samples, fit_at(samples, *model.nonlinear, free, near), free)


def smaller_models(samples: Samples, found: dict[int, Tried], best: Tried,
                   free: Free) -> tuple[tuple[ModalModel, Free], ...]:
    """Return the models of smaller orders, the dead times that are not free those of the best."""
    models = []
    for model in (one.fit.model for n, one in found.items() if n < best.fit.model.n):
        delay = np.where(free.delays, model.delay, best.fit.model.delay)
        if (delay != model.delay).any():
            with suppress(np.linalg.LinAlgError):
                model = climb_roughly(
                    samples, fit_at(samples, model.poles, delay, free), free).model
        models.append((model, free))
    return tuple(models)


def parameters(samples: Samples, fit: Fit, free: Free) -> int:
    """Return how many numbers a model has, its gauge apart."""
    # A pole with a residue of rank r has r (nu + ny - r) of these and one of its own.
    records, both = len(samples.records), samples.nu + samples.ny
    of_modes = sum((1 + (p.imag > 0.0)) * (rank * (both - rank) + 1)
                   for p, rank in Counter(fit.model.poles.tolist()).items())
    return int(of_modes + fit.model.n * records + samples.ny * samples.nu * free.feedthrough
               + samples.ny * records * free.trim + sum(free.delays))


def price(samples: Samples) -> float:
    """Return what a number costs by Schwarz's criterion, in -2 log likelihood."""
    return float(np.log(np.max(samples.counts.sum(axis=0))))


def choose(found: dict[int, Tried]) -> int:
    """Return the smallest order that no larger one beats, by independent samples."""
    orders = sorted(found)
    chosen = next(n for n in orders if not any(
        criterion(found[n], found[m]) > 0.0 and not imitates(found[m], found[n])
        for m in orders if m > n))
    return min(n for n in orders if n <= chosen and not explains(found[n], found[chosen]))


def explains(smaller: Tried, larger: Tried) -> bool:
    """Return whether what the larger one explains beyond the smaller one matters."""
    before, after = (np.maximum(t.power, ROUNDING) for t in (smaller, larger))
    return bool(np.max(before - after) > ENOUGH ** 2 or
                np.max((before / after)[before > LEAST ** 2], initial=0.0) > _CLEANER)


def criterion(smaller: Tried, larger: Tried, price: float = 0.0) -> float:
    """
    Return how much more likely the larger one is than its further parameters may cost.

    A parameter costs the logarithm of the number of independent samples, and a degree of freedom
    of the errors, unless `price` says what it costs.
    """
    n_eff, gain = np.maximum(smaller.independent, 2.0), gained(smaller, larger)
    further = larger.parameters - smaller.parameters
    if price:
        return float(np.sum(gain)) - price * further
    share = np.maximum(gain, 1e-6)
    # A smaller model of which hardly any error is independent is not the worse for that.
    spent = n_eff * np.log(np.maximum(larger.spent / smaller.spent, 1.0))
    return float(np.sum(gain - spent)) - float(share @ np.log(n_eff) / share.sum()) * further


def gained(smaller: Tried, larger: Tried) -> Array:
    """Return how much more likely the larger one is, whatever it costs, by outputs (ny,)."""
    power = [np.maximum(t.power, ROUNDING) for t in (smaller, larger)]
    n_eff = np.maximum(smaller.independent, 2.0)
    # Zellner's prior of unit information: numbers as many as samples explain anything.
    known = np.sqrt(n_eff.sum() * np.sum(larger.independent)) if larger.pointed else n_eff.sum()
    unit = 1.0 / max(float(known), 2.0)
    ratio = np.log((1.0 + unit) / (power[1] / power[0] + unit))
    # An output that fits a little worse for the sake of another is no evidence against it.
    return np.where(ratio > 0.0, n_eff, np.min(n_eff)) * ratio


def imitates(larger: Tried, smaller: Tried) -> bool:
    """Return whether a smaller model's inputs that drift are likelier than these states."""
    # By what a number costs: a step may be answered by either. Of the same samples, for of others
    # noise has another power.
    if smaller.drifting is None or (smaller.found is None) != (larger.found is None):
        return False
    return float(np.sum(gained(smaller.drifting, larger.found or larger))) < -price(
        smaller.drifting.samples)


def likelihood_gain(one: Tried, other: Tried, numbers: int = 0, *, both: bool = False,
                    most: float = np.inf) -> float:
    """
    Return by how much a model is likelier than one of other inputs, its further numbers paid.

    Its own errors say how many are independent, unless those of `both` are to. A number costs the
    logarithm of these, at `most` so much; so many `numbers` are of its inputs.
    """
    n_eff = np.maximum(np.minimum(one.independent, other.independent) if both else
                       one.independent, 2.0)
    ratio = np.log(np.maximum(other.power, ROUNDING) / np.maximum(one.power, ROUNDING))
    return float(n_eff @ ratio) + min(float(np.log(n_eff.max())), most) * (
        other.parameters - one.parameters - numbers)


def beats(one: Tried, other: Tried) -> bool:
    """Return whether a model is to be taken instead of another: with more numbers, if it gains."""
    if one.parameters <= other.parameters:
        return criterion(one, other) <= 0.0
    return criterion(other, one) > 0.0 and explains(other, one)


def advantage(one: Tried, other: Tried) -> float:
    """Return by how much Akaike's criterion prefers the other one, by independent samples."""
    if other.parameters >= one.parameters:
        return criterion(one, other, AKAIKE)
    return -criterion(other, one, AKAIKE)


def in_colour(one: Tried, matters: Mask, each: float = 0.0) -> float:
    """
    Return Schwarz's criterion with errors of any colour, of the outputs that matter.

    Unless `each` says what a parameter costs.
    """
    return float(one.coloured[matters].sum()) + (each or price(one.samples)) * one.parameters


def advantage_in_colour(one: Tried, other: Tried) -> float:
    """Return by how much Akaike's criterion prefers the other one."""
    # The less of what independent samples and errors of any colour say: few samples are
    # independent of what missing states leave, and a model without them would seem as right as one
    # that leaves nothing but noise. And the less of what it has over the first one, and over that
    # with a drift.
    matters = np.maximum(one.power, other.power) > LEAST ** 2
    gain = min(advantage(one, other),
               in_colour(one, matters, AKAIKE) - in_colour(other, matters, AKAIKE))
    if one.drifting is None or (one.found is None) != (other.found is None):
        return gain
    return min(gain, advantage_in_colour(one.drifting, other.found or other))


def shares_of(others: list[tuple[float, ModalModel]]) -> tuple[tuple[float, ModalModel], ...]:
    """Return the models that might be right, with their share of the Akaike weights."""
    gains = np.array([0.0, *(gain for gain, _ in others)])
    weights = np.exp(0.5 * (gains - gains.max()))
    shares = (weights / weights.sum()).tolist()[1:]
    return tuple((share, one) for share, (_, one) in zip(shares, others, strict=True)
                 if share > _NEGLIGIBLE)
