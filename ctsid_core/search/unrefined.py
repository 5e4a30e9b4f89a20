# SPDX-License-Identifier: Apache-2.0
"""
The estimate by a method other than HD-PBSID.

A method offers models of several orders and tunings. They are judged where HD-PBSID's are, on the
Hermite lines of the same records: the likeliest by Schwarz's criterion of simulations is taken;
states at the ends and trim are fitted to it; fits, verdict, covariance and the test on data held
out follow as for any other model. A, B, C and D stay as the method made them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ctsid_core.bases.projection import Projection, as_real
from ctsid_core.bases.records import Joint
from ctsid_core.likelihood.prediction_errors import (
    innovation_cost,
    jacobian,
    line_fit,
    output_error_cost,
    predict,
    unseen,
)
from ctsid_core.likelihood.refine import by_parameter
from ctsid_core.linear.free_entries import FreeEntries
from ctsid_core.linear.least_squares import least_norm
from ctsid_core.linear.matrices import Matrices
from ctsid_core.linear.resolvent import resolvent
from ctsid_core.model.estimate import Choice, OrderTried
from ctsid_core.search.held_out import HeldOut, nothing_held_out
from ctsid_core.search.order import NOTHING_LEFT, Search
from ctsid_core.search.selection import measurement_noise_gain
from ctsid_core.search.solution import Solution, own_delays
from ctsid_core.search.starts import UNSTABLE, several, worth
from ctsid_core.settings import Settings
from ctsid_core.subspace.interface import Method, MethodModel

_SURE = 1e-9          # relative singular value of what the ends and the trim can do
_LOOKED_AT = 3        # models of an order, those with the best poles


def identify_by(method: Method, part: Joint,
                settings: Settings) -> tuple[Joint, Solution, HeldOut] | None:
    """
    Return records, their model by one method, and how it does on data held out.

    Parameters
    ----------
    method : Method
    part : Joint
    settings : Settings
        `refine` does not count, nor do dead times that are to be found: they are 0.

    Returns
    -------
    part : Joint
        With remarks on the method.
    found : Solution
    tested : HeldOut
        None of the three if the records are too short.
    """
    if not method.looks_for_dead_time and any(settings.unknown_delays(part.parts[0].whole.nu)):
        part = replace(part, remarks=(
            *part.remarks, f'{settings.method} does not look for dead times: those not given '
            'count as 0'))
    part = replace(part, remarks=(
        *part.remarks, 'deviations are the least that the data allow with such a model; a '
        'subspace estimate scatters more'))
    settings = settings.with_known_delays().replace(refine=False)
    layout, why = part.layout(settings)
    own = own_delays(part.parts[0], settings)
    projection = part.project(own.replace(parts=max(layout.sizes)[1]), layout)
    search = Search(projection, own)
    orders = [settings.order] if settings.order else list(range(1, settings.max_order + 1))
    offered = _finite(method.models(part, own, orders))
    if not offered:
        return None
    made, choices, tried = _likeliest(search, offered, settings.feedthrough)
    matrices, process_noise = _on_lines(projection, made.matrices, settings.feedthrough)
    used = made.settings.replace(delay=settings.delay)
    if why:
        choices.append(Choice('hermite.nmax', max(layout.sizes)[0],
                              f'only to judge the model: {why}'))
    found = Solution(
        used.replace(nmax=max(layout.sizes)[0], parts=max(layout.sizes)[1]), projection, search,
        matrices, made.singular_values, made.condition, process_noise, tuple(choices), layout,
        tried)
    return part, found, _held_out(method, part, found, settings)


def _likeliest(search: Search, offered: Sequence[MethodModel], feedthrough: bool,
               ) -> tuple[MethodModel, list[Choice], tuple[OrderTried, ...]]:
    """
    Return the best by Schwarz's criterion of simulations.

    How well simulations with their poles can do tells which few of an order are worth a closer
    look: at their own simulations, which for several inputs and outputs are another matter.
    """
    if len(offered) == 1:
        return offered[0], [], ()
    seen = _looked_at(search, offered, feedthrough)
    best, least = min(seen, key=lambda one: one[1].criterion)
    by_order = [min((tried for _, tried in seen if tried.order == n), key=lambda t: t.criterion)
                for n in sorted({tried.order for _, tried in seen})]
    rows = tuple(replace(t, criterion=t.criterion - least.criterion) for t in by_order)
    choices = []
    if len(rows) > 1:
        table = ', '.join(f'{row.order}: {row.criterion:.0f}' for row in rows)
        choices.append(Choice('order', least.order, "Schwarz's criterion (BIC) of simulations, "
                              f'above its smallest value, by order: {table}'))
    return best, choices + _differences(offered, best), rows if len(rows) > 1 else ()


def _looked_at(search: Search, offered: Sequence[MethodModel],
               feedthrough: bool) -> list[tuple[MethodModel, OrderTried]]:
    """Return the most promising models of each order, with their criteria."""
    found: list[tuple[MethodModel, OrderTried]] = []
    for n in sorted({len(one.matrices.A) for one in offered}):
        group = [one for one in offered if len(one.matrices.A) == n]
        costs = search.output_error.costs(
            [np.linalg.eigvals(one.matrices.A).astype(complex) for one in group])
        found += [(group[i], _tried(search, group[i].matrices, feedthrough))
                  for i in np.argsort(costs, kind='stable')[:_LOOKED_AT]]
        if max(tried.fit for _, tried in found) >= 100.0 * (1.0 - np.sqrt(NOTHING_LEFT)):
            break                       # no further state is needed
    return found


def _tried(search: Search, m: Matrices, feedthrough: bool) -> OrderTried:
    """Return Schwarz's criterion of a model's simulation, and how well it fits."""
    p, n, ny = search.projection, len(m.A), len(m.C)
    poles = np.linalg.eigvals(m.A).astype(complex)
    if several(p):
        m = still(p, m, feedthrough)
        cost, fit = output_error_cost(p, m), float(np.min(line_fit(p, m)))
        count = n * (len(p.u) + len(p.tail) + ny) + ny * (len(p.u) * feedthrough + len(p.ones))
    else:                               # residues have rank one: the poles tell it all
        free = search.output_error.fit(poles)
        cost, count = free.cost, free.parameters
        fit = 100.0 * (1.0 - float(np.sqrt(free.residual)))
    # An unstable pole always explains a little more: it has to explain much more.
    grows = bool(np.max(poles.real) > search.resolution)
    return OrderTried(n, cost + count * search.charge + worth(p, UNSTABLE) * grows, fit)


def _differences(offered: Sequence[MethodModel], best: MethodModel) -> list[Choice]:
    """Return a choice for each parameter in which the models that were offered differ."""
    shown = {name: value for name, value in best.settings.to_dict().items() if name != 'order'}
    others = [one.settings.to_dict() for one in offered]
    return [Choice(name, value, 'its model simulates best')
            for name, value in shown.items() if any(other[name] != value for other in others)]


def _on_lines(projection: Projection, m: Matrices, feedthrough: bool) -> tuple[Matrices, bool]:
    """Return a model with ends and trim, and whether it is likelier with its K than without."""
    noisy = bool(np.isfinite(m.K).all() and np.any(m.K))
    simulated = still(projection, m, feedthrough)
    price = m.K.size * np.log(2.0 * len(projection.s) * len(projection.y))
    if noisy:
        m = with_ends(projection, m, feedthrough)
        if innovation_cost(projection, m) + price < output_error_cost(projection, simulated):
            return m, True
    return replace(simulated, K=measurement_noise_gain(projection, simulated)), False


def still(projection: Projection, m: Matrices, feedthrough: bool) -> Matrices:
    """Return the same as `with_ends`, of the model without its K."""
    return with_ends(projection, replace(m, K=np.zeros_like(m.K)), feedthrough)


def with_ends(projection: Projection, m: Matrices, feedthrough: bool) -> Matrices:
    """
    Return a model with the states at the ends and the trim that suit the lines best.

    Parameters
    ----------
    projection : Projection
    m : Matrices
        Of which A, C and K stay as they are, and B and D unless D is to be zero and is not.
    feedthrough : bool
    """
    n, ny = len(m.A), len(m.C)
    tails, ones = len(projection.tail), len(projection.ones)
    without_D = not feedthrough and bool(np.any(m.D))
    m = replace(m, tail=np.zeros((n, tails)), x_trim=np.zeros((n, ones)),
                y_trim=np.zeros((ny, ones)), D=np.zeros_like(m.D) if without_D else m.D)
    prediction = predict(projection, m, resolvent(m.A - m.K @ m.C, projection.s))
    error = as_real(prediction.error)
    size = np.sqrt(np.mean(error ** 2, axis=1)) + 1e-150
    rows = by_parameter(jacobian(projection, m, False, with_noise=False,
                                 whiten=np.diag(1.0 / size), prediction=prediction))
    entries = FreeEntries.of(m, False)
    free = entries.mask('tail', 'x_trim', 'y_trim', *(['B'] if without_D else []))
    step = np.zeros(len(free))
    step[free] = least_norm(rows[free], (error / size[:, np.newaxis]).reshape(1, -1), _SURE)[0]
    return entries.moved(m, step)


def _held_out(method: Method, part: Joint, found: Solution, given: Settings) -> HeldOut:
    """Return how a model of the first parts does on the last parts; likewise made if it can be."""
    settings = found.settings
    if settings.held_out == 0.0 or settings.edges == 'paper':
        return nothing_held_out(len(found.matrices.C))
    own, free = own_delays(part.parts[0], settings), own_delays(part.parts[0], given)
    early, _ = part.early_and_late(own)
    offered = _finite(method.models(early, own, [settings.order])) or \
        _finite(method.models(early, free, [settings.order]))
    if not offered:
        return nothing_held_out(len(found.matrices.C))
    first, last = part.divided(own, found.layout)
    model = _likeliest(Search(first, own), offered, settings.feedthrough)[0].matrices
    model = still(first, model, settings.feedthrough)
    return HeldOut(*unseen(last, model, trimmed=not part.many))


def _finite(offered: Sequence[MethodModel]) -> list[MethodModel]:
    """Return the models that are finite in all entries that matter to a simulation."""
    return [one for one in offered if all(
        np.isfinite(entries).all() for entries in
        (one.matrices.A, one.matrices.B, one.matrices.C, one.matrices.D))]
