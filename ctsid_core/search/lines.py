# SPDX-License-Identifier: Apache-2.0
"""From records to a model of the moving channels: project, regress, refine, clean, confirm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ctsid_core.bases.all_channels import moving_model
from ctsid_core.bases.projection import as_real, of_records
from ctsid_core.bases.records import Joint, Layout
from ctsid_core.likelihood.prediction_errors import prediction_errors
from ctsid_core.likelihood.record_weights import balanced
from ctsid_core.likelihood.refine import affordable
from ctsid_core.model.estimate import Choice, with_fit
from ctsid_core.search.closed_loop import by_prediction
from ctsid_core.search.held_out import HeldOut, held_out
from ctsid_core.search.order import Search
from ctsid_core.search.selection import OrderChoice, choose_order, most_likely
from ctsid_core.search.solution import Solution, own_delays
from ctsid_core.settings import Settings

_ROUNDS = 2             # of removing corrupt samples by the model found without them
_REWEIGHTED = 2         # rounds of weighting records by the noise that a model finds in them
_CLOSE = 20.0           # of Schwarz's criterion: orders about as likely
_BETTER = 0.8           # errors on data held out, over those of the likelier order, that win
LITTLE = 1.1           # errors' power over that without outliers that changes no choice


def estimate(part: Joint, settings: Settings, first: int,
             layout: Layout | None = None, *, lenient: bool = True) -> Solution | None:
    """
    Return the model of records, or None if they are too short for any.

    Several are weighted by the noise that their model finds in them.
    """
    choices: list[Choice] = []
    if layout is None:
        layout, why = part.layout(settings)
        choices += [Choice('hermite.nmax', max(layout.sizes)[0], why)] if why else []
    solution = _estimate_on(layout, part, settings, list(choices), first, lenient)
    for _ in range(_REWEIGHTED * part.several):
        if solution is None:
            break
        better = balanced(solution.projection, solution.matrices, solution.layout)
        if better is solution.layout:
            break
        weighted = ', '.join(f'{w:.2g}' for w in better.weights)
        solution = _estimate_on(better, part, settings, [*choices, Choice(
            'weights', weighted, 'the noise of the records differs')], first, lenient)
    return solution


def _estimate_on(layout: Layout, part: Joint, settings: Settings,
                 choices: list[Choice], first: int, lenient: bool) -> Solution | None:
    nmax, parts = max(layout.sizes)
    own = own_delays(part.parts[0], settings.replace(parts=parts))
    projection = part.project(own, layout)
    search = Search(projection, own, lenient=lenient)
    chosen = None if settings.order else _best_order(search, choices, first)
    pair = chosen.trial.pair if chosen else search.pair(settings.order) if settings.order else None
    if pair is None:
        return None
    order = len(pair.best.poles)
    matrices, process_noise = most_likely(search.projection, pair, own,
                                          chosen.noisy if chosen else None)
    predictor = by_prediction(part.parts[0].record, search, matrices) \
        if settings.refine and process_noise and not part.several else None
    if predictor is not None:
        matrices, order = predictor, len(predictor.A)
        pair, chosen = search.pair(order) or pair, None
        choices[:] = [c for c in choices if c.name != 'order']
        choices.append(Choice('order', order, 'the plant is unstable, with process noise: chosen '
                              'by one-step predictions of the samples'))
    tuning = pair.best.subspace.tuning
    if pair.tried > 1:
        choices.append(Choice('pbsid', f'beta {tuning.beta:.3g} rad/s, p {tuning.past}',
                              f'the most likely of {pair.tried} subspace models'))
    if settings.refine and not affordable(projection, order):
        choices.append(Choice('refine', False, 'with so many states and signals the maximum of '
                              'the likelihood takes too long; this is the subspace estimate'))
    elif settings.refine:
        choices.append(Choice(
            'noise', 'process' if process_noise else 'measurement',
            'the more likely of process noise (innovation form) and measurement noise alone'))
    used = settings.replace(nmax=nmax, parts=parts, order=order, beta=tuning.beta,
                            gamma=tuning.gamma, past=tuning.past, future=tuning.future)
    subspace = pair.best.subspace
    uncertain = predictor is None and process_noise and pair.noise_model_uncertain(matrices)
    return Solution(used, projection, search, matrices, subspace.singular_values,
                    subspace.condition, process_noise, tuple(choices), layout,
                    chosen.tried if chosen else (), predictor is not None, uncertain)


def without_outliers(part: Joint, solution: Solution,
                     settings: Settings) -> tuple[Joint, Solution]:
    """
    Return record and model without the corrupt samples that only a model can show.

    Those that were taken out without one are put back if the model explains them. What was chosen
    from the data stays as it is, unless the samples made a large difference.
    """
    for _ in range(_ROUNDS):
        own, matrices = solution.projection, of_records(solution.matrices, solution.projection)
        errors = [as_real(prediction_errors(p, m))
                  for p, m in zip(own.records, matrices, strict=True)]
        densities = [own.unit * np.mean(error ** 2, axis=1) / weight ** 2
                     for error, weight in zip(errors, solution.layout.weights, strict=True)]
        if not (np.isfinite(solution.matrices.A).all() and part.may_hide_outliers(densities)):
            break
        cleaned, gain = part.cleaned([
            moving_model(m, own_delays(usable, solution.settings).delays(usable.record.nu))
            for usable, m in zip(part.parts, matrices, strict=True)])
        large = gain > LITTLE
        order = solution.settings.order
        again = None if cleaned is part else estimate(cleaned, settings, order) if large else \
            estimate(cleaned, solution.settings, order, solution.layout)
        if again is None:
            break
        part, solution = cleaned, again if large else replace(
            again, choices=solution.choices, orders=solution.orders)
        if not large:
            break
    return part, solution


def _best_order(search: Search, choices: list[Choice], first: int) -> OrderChoice | None:
    """Return the best order; None if the data are too short for any model."""
    trials = search.orders(first)
    if not trials:
        return None
    chosen = choose_order(search, trials)
    table = ', '.join(f'{one.order}: {one.criterion:.0f}' for one in chosen.tried)
    choices.append(Choice('order', chosen.trial.order, "Schwarz's criterion (BIC), above its "
                          f'smallest value, by order: {table}'))
    return chosen


def choose_noise_model(part: Joint, solution: Solution, settings: Settings,
                       first: int) -> Solution:
    """
    Return the model without process noise, if that is uncertain and held-out data prefer it.

    Strong gusts make simulations with the right poles worse than those with others, and so do
    dynamics that K has taken up instead of the plant. Held-out data distinguish the two: gusts
    that some poles happened to explain do not come again.
    """
    if not solution.noise_model_uncertain:
        return solution
    tested = held_out(part, solution)
    other = estimate(part, settings, first, solution.layout, lenient=False) \
        if np.isfinite(tested.fit).all() else None
    if other is None or not held_out(part, other).left < _BETTER * tested.left:
        return solution
    before = [c for c in solution.choices if c.name in ('hermite.nmax', 'weights')]
    return replace(other, choices=(*before, *other.choices))


def confirm_order(part: Joint, solution: Solution,
                  settings: Settings) -> tuple[Solution, HeldOut]:
    """
    Return the model that held-out data confirm, and its fit there.

    Where errors of simulations are white, the criterion is sure. Where they are coloured by
    process noise, or what seems to be such, the runner-up is tested on held-out data, too,
    if it is close.
    """
    tested = held_out(part, solution)
    rows = [one for one in solution.orders if one.order != solution.settings.order
            and one.criterion < _CLOSE]
    settled = solution.projection.slopes is not None or solution.by_prediction
    if settled or not (solution.process_noise and rows and np.isfinite(tested.fit).all()):
        return solution, tested
    order = min(rows, key=lambda one: one.criterion).order
    other = estimate(part, settings.with_known_delays().replace(order=order), order,
                     solution.layout)
    if other is None:
        return solution, tested
    rival = held_out(part, other)
    orders = with_fit(solution.orders, {solution.settings.order: tested.fit, order: rival.fit})
    if not rival.left < _BETTER * tested.left:
        return replace(solution, orders=orders), tested
    before = [c for c in solution.choices if c.name in ('hermite.nmax', 'weights')]
    return replace(other, orders=orders, choices=(*before, Choice(
        'order', order, f'it fits held-out data better than order '
        f"{solution.settings.order}, whose Schwarz's criterion is about the same"),
        *other.choices)), rival
