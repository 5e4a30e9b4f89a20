# SPDX-License-Identifier: Apache-2.0
"""
The search for order, poles and dead times, from order 1 upwards, on the raw samples.

A model of order n starts from those of order n - 1 and n - 2 with the real pole, or the pair, that
promises most (`pole_grid.py`), at dead times kept, halved, zero or, of the first poles, where
inputs and outputs correlate most; with the resonance that the errors of order n - 2 point at; and
from the poles of HD-PBSID. Each finds what others do not. The most promising ones of different
kinds climb to the maximum of the likelihood, and the likeliest of these goes on where other dead
times of one input lead.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache

import numpy as np

from ctsid_core.likelihood.modal_model import ModalModel, bounded, canonical
from ctsid_core.likelihood.mode_columns import columns_of, evaluation_work
from ctsid_core.likelihood.noise_gain import gain_work
from ctsid_core.likelihood.output_error import (
    ROUGHLY,
    STEPS,
    Fit,
    Free,
    Guess,
    climb_roughly,
    errors_of,
    fit_at,
)
from ctsid_core.likelihood.samples import Samples
from ctsid_core.likelihood.state_space import covariance_work
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.search.drifting import drifting
from ctsid_core.search.pole_grid import Correlations, PoleGrid
from ctsid_core.search.tried import (
    AKAIKE,
    ENOUGH,
    SEARCH,
    UNEXPLAINED,
    Tried,
    beats,
    choose,
    climbed,
    parameters,
    price,
    tried,
)

SEARCHED = 1000       # samples of a stream that the search looks at
_PASSES = 4           # in which b and c of a start are found, one after the other
_FEWEST_SAMPLES = 300  # of a stream, that are always looked at
_LATER = 20           # evaluations of all samples that have to be after the search,
_STATES = 6           # of so many states, before it is known of how many
_SHORT = 0.05         # of a budget for each order: with more HD-PBSID is asked where to go on
_NEARLY = 1.5         # times the errors of a better start, that one is worth climbing from
MORE = 2              # orders beyond the chosen one that are tried
_CLEAN = 1e-9         # rms error over motion with which nothing is left to explain

SubspacePoles = Callable[[int, Array], Iterator[ComplexArray]]


def search_orders(samples: Samples, free: Free, subspace: SubspacePoles, *,
                  order: int, max_order: int, known_delay: Array,
                  near: Sequence[Array] = (),
                  finest: float = 0.0) -> tuple[Samples, dict[int, Tried]]:
    """
    Return the best model of each order that was tried: of one order, or any up to `max_order` (0).

    Before them the samples they are of: as many as the budget suffices for.

    `subspace` returns the poles of HD-PBSID's models for an order and dead times; `known_delay`,
    (nu,) [s], is 0 where dead times are free; `near` are further dead times to begin with. Inputs
    are looked at with the interval `finest` [s]; 0: that of the samples.
    """
    thin = samples.thinned(SEARCHED, scattered=True)
    grid = PoleGrid(thin, feedthrough=free.feedthrough, trim=free.trim,
                    longest=max(free.longest, float(np.max(known_delay, initial=0.0))),
                    fastest=free.fastest, finest=finest or samples.finest)
    found: dict[int, Tried] = {}
    looked: set[int] = set()
    best, far = 1, 0
    while True:
        short = samples.effort.beyond(SEARCH)
        if order in looked or short and best in found and not order:
            break
        # One after the other from 1 upwards, unless a start points further.
        n = nearest(range(1, max_order + 1), looked, best) if not order else \
            order if short else len(looked) + 1
        if not n and not far and found[best].unexplained > UNEXPLAINED:
            n = far = _pointed((known_delay, found[best].fit.model.delay), subspace, grid, free,
                               max_order, found[best])
            n = 0 if n in looked else n
        if not n:
            break
        looked.add(n)
        fit = _best_of(n, found, thin, grid, subspace, free, known_delay, near,
                       np.inf if order or not found else _rival(found, thin, free, n))
        if fit is None:
            continue
        found[n] = tried(thin, fit, free, n == far)
        best = choose(found)
        if not order and found[n].rms < _CLEAN:
            max_order = min(max_order, n - 1)           # larger ones explain nothing more
        if samples.rank > 1 and not (far or order or short) \
                and samples.effort.beyond(_SHORT * len(looked)):
            far = _pointed((known_delay, found[best].fit.model.delay), subspace, grid, free,
                           max_order)
            best = max(best, far)
    if found and not order:
        _without_modes(thin, found, free)
        _with_drift(thin, found, free)
    if not found or order not in (0, *found):
        return samples, found
    chosen = order or choose(found)
    samples = samples.thinned(affordable(samples, found[chosen].fit.model.n))
    if thin is samples:
        return samples, found
    if samples.effort.beyond(SEARCH):
        return samples, {chosen: replace(climbed(samples, found[chosen], free),
                                         found=found[chosen])}
    # HD-PBSID has seen all samples.
    delay = found[chosen].fit.model.delay
    seen = [(bounded(poles, np.inf, free.fastest), delay) for poles in subspace(chosen, delay)]
    return samples, {n: replace(climbed(
        samples, one, free, *((STEPS, seen) if n == chosen else (1,))), found=one)
        for n, one in found.items()}


def _without_modes(samples: Samples, found: dict[int, Tried], free: Free) -> None:
    """Improve smaller orders by what the chosen one is without one of its modes."""
    chosen = 0
    while chosen != (chosen := choose(found)) and not samples.effort.beyond(SEARCH):
        whole = found[chosen].fit
        for poles, near in _fewer(whole):
            with suppress(np.linalg.LinAlgError):
                fit = fit_at(samples, poles, whole.model.delay, free, near, slopes=False)
                n = fit.model.n
                if n in found and fit.cost < found[n].fit.cost - ROUGHLY:
                    found[n] = tried(samples, climb_roughly(samples, fit, free), free,
                                     found[n].pointed)


def _with_drift(samples: Samples, found: dict[int, Tried], free: Free) -> None:
    """Ask what orders up to the one beside the chosen one explain with inputs that drift."""
    chosen = choose(found)
    for n in sorted(n for n in found if n <= chosen + 1):
        if samples.effort.beyond(SEARCH):
            break
        found[n] = replace(found[n], drifting=drifting(
            samples, found[n], free, found[chosen].fit.cost))


def _fewer(fit: Fit) -> Iterator[tuple[ComplexArray, Guess | None]]:
    """Yield poles without one of them, and with a real one instead of one of the pairs."""
    m = fit.model
    for k, pole in enumerate(m.poles.tolist()):
        rest = replace(m, poles=np.delete(m.poles, k), b=np.delete(m.b, k, 0),
                       c=np.delete(m.c, k, 1), x0=np.delete(m.x0, k, 1))
        if len(rest.poles):
            yield rest.poles, Guess(rest, fit.power)
        if pole.imag > 0.0:
            yield np.append(rest.poles, -abs(pole)), None


def nearest(orders: Iterable[int], looked: Container[int], best: int) -> int:
    """Return the order nearest to the best, within `MORE`, that was not looked at; 0: none."""
    # Of two the larger one: time may end before the other, and a state too many does less harm.
    return min((n for n in orders if n not in looked and abs(n - best) <= MORE),
               key=lambda n: (abs(n - best), -n), default=0)


def _pointed(delays: Sequence[Array], subspace: SubspacePoles, grid: PoleGrid, free: Free,
             max_order: int, best: Tried | None = None) -> int:
    """Return the smallest order, 3 or more, whose start is nearly as good as any; halved for."""
    # 1 if even that of most states would not beat the `best` model found, at the price of few.
    samples = grid.samples

    @cache
    def by_subspace(n: int) -> Fit | None:
        start = min((s for d in delays for s in _by_subspace(n, subspace, grid, free, d)),
                    key=lambda s: s[0], default=None)
        with suppress(np.linalg.LinAlgError):
            if start is not None:
                fit = fit_at(samples, *start[2:], free, slopes=False)
                for _ in range(_PASSES if samples.rank > 1 else 0):
                    fit = fit_at(samples, *fit.model.nonlinear, free, fit, slopes=False)
                return fit
        return None

    while max_order > 3 and by_subspace(max_order) is None:    # so many it does not see
        max_order -= 1
    if best is not None and ((most := by_subspace(max_order)) is None or not beats(replace(
            tried(samples, most, free, True), parameters=best.parameters + (MORE + 1) * (
                samples.nu + samples.ny + len(samples.records))), best)):
        return 1
    near = 2.0 * float(np.sum(samples.counts)) * float(np.log(_NEARLY))
    costs: dict[int, float] = {}
    low, high, n = 3, max_order, max_order
    while low <= high and not (costs and samples.effort.beyond(SEARCH)):
        if (fit := by_subspace(n)) is not None:
            costs[n] = float(np.sum(samples.counts * np.log(np.maximum(fit.power, ENOUGH ** 2))))
        if n in costs and costs[n] > min(costs.values()) + near:
            low = n + 1
        else:
            high = n - 1
        n = (low + high) // 2
    return min((n for n in costs if costs[n] <= min(costs.values()) + near), default=1)


def _by_subspace(n: int, subspace: SubspacePoles, grid: PoleGrid, free: Free,
                 delay: Array) -> Iterator[tuple[float, str, ComplexArray, Array]]:
    """Yield starts by HD-PBSID."""
    for poles in subspace(n, delay):
        poles = bounded(poles, np.inf, free.fastest)
        yield grid.score(poles, delay), 'subspace', poles, delay


def affordable(samples: Samples, n: int = _STATES) -> int:
    """Return how many samples of a stream a budget suffices for; keep what n states need later."""
    most, effort = max(int(np.max(samples.counts.sum(axis=0))), 1), samples.effort
    if not effort.budget:
        return most
    while most > _FEWEST_SAMPLES and _later(
            samples.thinned(most), n) > (1.0 - SEARCH) * effort.worth(effort.budget):
        most = int(0.8 * most)
    effort.keep(_later(samples.thinned(most), n))
    return most


def _later(samples: Samples, n: int) -> float:
    """Return the work that a model of n states needs after the search."""
    # Of two covariances: which dead times are needless is asked before the end.
    return _LATER * evaluation_work(samples, (n + 1) // 2) + 2.0 * covariance_work(samples, n) \
        + gain_work(samples, n)


def _rival(found: dict[int, Tried], samples: Samples, free: Free, n: int) -> float:
    """Return what order n must reach, its price with it, to beat the best of those tried."""
    # A smaller one may have any: how many samples are independent, its errors tell.
    best = found[choose(found)].fit
    return best.cost + price(samples) * parameters(samples, best, free) \
        if n > best.model.n else np.inf


def _best_of(n: int, found: dict[int, Tried], samples: Samples, grid: PoleGrid,
             subspace: SubspacePoles, free: Free, known: Array, near: Sequence[Array],
             needed: float) -> Fit | None:
    """Return the best model of one order: of those that the best start of each kind leads to."""
    starts: dict[str, Fit] = {}
    for _, kind, poles, delay in sorted(
            _starts(n, found, grid, subspace, free, known, near), key=lambda s: s[0]):
        if kind in starts:
            continue
        if starts and samples.effort.beyond(SEARCH):
            break
        with suppress(np.linalg.LinAlgError):
            starts[kind] = fit_at(samples, poles, delay, free)
    ranked = list[Fit]()
    for model, pole in _of_more_ranks(n, found, samples.rank):
        with suppress(np.linalg.LinAlgError):
            ranked.append(fit_at(samples, np.append(model.poles, pole), model.delay, free))

    def cost(fit: Fit) -> float:
        return fit.cost
    if ranked:
        starts['rank'] = min(ranked, key=cost)

    def akaike(fit: Fit) -> float:
        return fit.cost + AKAIKE * parameters(samples, fit, free)
    reached: list[Fit] = []
    for start in sorted(starts.values(), key=cost):
        own = parameters(samples, start, free)
        best = min(map(akaike, reached), default=np.inf) - AKAIKE * own
        reached.append(climb_roughly(samples, start, free,
                                     min(needed - price(samples) * own, best)))
        if samples.effort.beyond(SEARCH):
            break
    likeliest = min(reached, key=akaike, default=None)
    return None if likeliest is None else shifted(samples, likeliest, free, grid.correlations)


def shifted(samples: Samples, fit: Fit, free: Free, correlations: Correlations) -> Fit:
    """Return the same, or where dead times of one input lead with which its modes explain more."""
    # A climb ends at the nearest maximum: where all steps of an input that is held come one too
    # late, or where the dead time of one that explains little began.
    late = [*_by_correlation(samples, fit.model, free, correlations)]
    while not samples.effort.beyond(SEARCH):
        others, old = [fit], fit.model.delay
        steps = ((j, old[j] + step) for j in np.flatnonzero(free.delays & (samples.held > 0.0))
                 for step in (-samples.held[j], samples.held[j]))
        for j, one in (*steps, *late):
            delay = np.where(np.arange(samples.nu) == j, np.clip(one, 0.0, free.longest), old)
            with suppress(np.linalg.LinAlgError):
                others.append(fit_at(samples, fit.model.poles, delay, free, fit, slopes=False))
        best = min(others, key=lambda other: other.cost)
        if not best.cost <= fit.cost - ROUGHLY:
            break
        fit = climb_roughly(samples, best, free)
    return fit


def _by_correlation(samples: Samples, model: ModalModel, free: Free,
                    correlations: Correlations) -> Iterator[tuple[int, float]]:
    """Yield inputs, and other dead times [s] that explain most of what the other inputs leave."""
    if not any(free.delays) or samples.effort.beyond(SEARCH):
        return
    poles = canonical(bounded(np.unique(model.poles), -1.0 / samples.length, np.inf))
    columns = columns_of(samples, *model.nonlinear, direct=bool(model.D.any()),
                         turned=False, slopes=False)
    for j in np.flatnonzero(free.delays).tolist():
        others = np.arange(samples.nu) != j
        rest = replace(model, b=model.b * others, D=model.D * others)
        explained = correlations.explained(j, poles, errors_of(samples, rest, columns))
        # By all modes together, and by the one that explains most.
        for one in {correlations.dead_time(some) for some in (explained[:1], explained[1:])}:
            if abs(one - model.delay[j]) > correlations.step:
                yield j, one


def _of_more_ranks(n: int, found: dict[int, Tried],
                   most: int) -> Iterator[tuple[ModalModel, complex]]:
    """Yield smaller models, and a pole whose residue may have one rank more: n states then."""
    for model in (found[m].fit.model for m in (n - 1, n - 2) if m in found):
        for pole, ranks in Counter(model.poles.tolist()).items():
            if ranks < most and model.n + 1 + (pole.imag > 0.0) == n:
                yield model, pole


def _starts(n: int, found: dict[int, Tried], grid: PoleGrid, subspace: SubspacePoles,
            free: Free, known: Array,
            near: Sequence[Array]) -> Iterator[tuple[float, str, ComplexArray, Array]]:
    """Yield promising starts of one order: score, kind, poles, dead times."""
    none = np.empty(0, dtype=complex)
    for before, real in ((n - 1, True), (n - 2, False)):
        if before == 0:
            late = [np.where(free.delays, np.minimum(grid.dead_times[real], free.longest), known)
                    ] if any(free.delays) else []
            options = [('', none, d) for d in (known, *late, *near)]
        elif before in found:
            model = found[before].fit.model
            options = [('', *model.nonlinear)]
            if np.any(model.delay != known):
                half = np.where(free.delays, 0.5 * model.delay, known)
                # It may stand for a lag: of one state each of these is a kind of its own.
                options += [(kind * (before == 1), model.poles, delay) for kind, delay in (
                    ('half as late, ', half), ('not late, ', known))]
        else:
            continue
        errors = found[before].errors if before else grid.correlations.outputs
        narrow = [] if real else [grid.correlations.resonance(errors, options[0][2])]
        for kind, poles, delay in options:
            kind += 'real' if real else 'pair'
            score, pole = grid.best(poles, delay, real)
            yield score, kind, np.append(poles, pole), delay
            for both in (np.append(poles, pole) for pole in narrow):
                yield grid.score(both, delay), kind, both, delay
    close = min(found, key=lambda m: abs(m - n + 1), default=0)
    delay = found[close].fit.model.delay if close else known
    yield from _by_subspace(n, subspace, grid, free, delay)
    if close and abs(n - close) > MORE:
        yield from _by_subspace(n, subspace, grid, free, known)
