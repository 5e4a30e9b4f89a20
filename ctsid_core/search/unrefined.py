# SPDX-License-Identifier: Apache-2.0
"""
The estimate by a subspace method as it is, without maximum likelihood.

A method offers models of several orders and tunings. They are compared on the samples: with the
initial states and the trim that suit each best, the likeliest is taken by Schwarz's criterion of
simulations. A, B, C and D stay as the method made them; of `gobf` A does.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from ctsid_core.bases.records import Joint
from ctsid_core.effort import Effort
from ctsid_core.likelihood.output_error import Fit, Free, climb_roughly, fit_at, fit_states
from ctsid_core.likelihood.samples import Samples
from ctsid_core.likelihood.state_space import modal_of
from ctsid_core.linear.matrix_functions import SOUND
from ctsid_core.model.estimate import Choice
from ctsid_core.search.solution import Solution, table_of
from ctsid_core.search.task import free_of, own_delays, samples_of_part
from ctsid_core.search.tried import tried
from ctsid_core.settings import Settings
from ctsid_core.subspace.hd_pbsid import MethodModel
from ctsid_core.subspace.methods import Method


def solve_by(method: Method, part: Joint, settings: Settings, effort: Effort) -> Solution | None:
    """Return records' model by one method, or None if they are too short."""
    remarks = ['deviations are the least that the data allow with such a model; a subspace '
               'estimate scatters more']
    if any(settings.unknown_delays(part.parts[0].whole.nu)):
        remarks.insert(0, f'{settings.method} does not look for dead times: those not given count '
                       'as 0')
    settings = settings.with_known_delays().replace(refine=False)
    own = own_delays(part, settings)
    samples = samples_of_part(part, effort, max(own.delays(len(part.parts[0].u))))
    free = replace(free_of(samples, own), delays=(False,) * samples.nu, limit=np.inf)
    orders = [settings.order] if settings.order else list(range(1, settings.max_order + 1))
    best = _likeliest(method.models(part, own, orders, effort.check), samples, own, free)
    if best is None:
        return None
    fit, made, by_order = best
    choices = [Choice(name, value, 'its model simulates best')
               for name, value in made.settings.to_dict().items()
               if name != 'order' and value != own.to_dict()[name]]
    if len(by_order) > 1:
        choices.append(Choice('order', fit.model.n, "the best by Schwarz's criterion"))
    seen = {n: tried(samples, f, free) for n, f in by_order.items()}
    chosen = seen[fit.model.n]
    table = table_of(seen, chosen, settings) if len(seen) > 1 else ()

    def refit(early: Samples) -> Fit | None:
        records = part.early(own)
        for tuned in (replace(made.settings, delay=own.delay), own):
            found = _likeliest(method.models(records, tuned, [fit.model.n], effort.check), early,
                               own, free)
            if found is not None:
                return found[0]
        return None

    used = made.settings.replace(delay=settings.delay, order=fit.model.n)
    return Solution(used, part, samples, fit, free, chosen.independent, table, tuple(choices),
                    tuple(remarks), refit=refit, unproven=_unproven(samples, fit, free),
                    singular_values=made.singular_values, condition=made.condition)


def _likeliest(offered: Iterable[MethodModel], samples: Samples, own: Settings,
               free: Free) -> tuple[Fit, MethodModel, dict[int, Fit]] | None:
    """Return the likeliest model, and the best of each order."""
    best: tuple[float, Fit, MethodModel] | None = None
    by_order: dict[int, Fit] = {}
    price = float(np.log(samples.counts.sum()))
    for one in offered:
        samples.effort.check()
        fit = _fitted(one, samples, own, free)
        if fit is None or not np.isfinite(fit.cost):
            continue
        n = fit.model.n
        if n not in by_order or fit.cost < by_order[n].cost:
            by_order[n] = fit
        cost = fit.cost + price * n * (samples.nu + samples.ny)
        if best is None or cost < best[0]:
            best = cost, fit, one
    return None if best is None else (best[1], best[2], by_order)


def _unproven(samples: Samples, fit: Fit, free: Free) -> bool:
    """Return whether modes grow of which the samples do not show that they do."""
    # They do where the model is likelier than the best one near it of which none grows, by more
    # than the price of a number for each of these modes.
    poles = fit.model.poles
    growing = poles.real > 0.0
    if not growing.any():
        return False
    try:
        with np.errstate(over='ignore', invalid='ignore'):
            mirrored = fit_at(samples, np.where(growing, -poles.conj(), poles), fit.model.delay,
                              free)
            steady = climb_roughly(samples, mirrored, replace(free, limit=0.0))
    except np.linalg.LinAlgError:
        return True
    price = float(np.log(samples.counts.sum())) * int(np.sum(growing))
    return not steady.cost - fit.cost > price


def _fitted(one: MethodModel, samples: Samples, own: Settings, free: Free) -> Fit | None:
    m, delay = one.matrices, np.array(own.delays(samples.nu))
    if not all(np.isfinite(x).all() for x in (m.A, m.B, m.C, m.D)):
        return None
    model = modal_of(m if own.feedthrough else replace(m, D=np.zeros_like(m.D)), samples, delay,
                     SOUND)
    if model is None or np.max(model.poles.real, initial=0.0) * samples.length > 20.0:
        return None
    with np.errstate(over='ignore', invalid='ignore'):
        try:
            if not one.poles_only:
                return fit_states(samples, model, free)
            return fit_at(samples, model.poles, delay, free,
                          fit_at(samples, model.poles, delay, free))
        except np.linalg.LinAlgError:
            return None
