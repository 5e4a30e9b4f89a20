# SPDX-License-Identifier: Apache-2.0
"""
Did the plant change? What one model misses of the motion, and two do not.

A record is divided at a few instants; each side gets a model of its own, of the same order or of
a smaller one: further states of one model can imitate a plant that changes, and then two models
with fewer parameters explain as much. The states and the trim at the start of a side are free in
both, so that disturbances are no change of the plant. Two models are always a little better, of
drag, friction or gusts as well, but of a plant that changes they leave noise only: how much
independent evidence there is for two is counted in *their* errors, and nearly all that one model
leaves, noise apart, has to be gone, as far as the noise lets see. And they have to be the best
explanation: of a plant that drifts, or is not linear, a drift or curves explain as much, and of
one that is pushed a load that comes and goes. Of several records each may be of another plant as a
whole: then it has a model of its own. Of a model that was found by its predictions these tell, too
(in a loop they alone), for their errors are white where gusts stay in those of simulations: first
of a gain that jumps, which is one number, then of two predictors; how much it matters is what the
plant, simulated, misses beside two.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from ctsid_core.judge.slopes import (
    INSTANTS,
    NOTHING,
    SEARCHED,
    Own,
    jumps_of,
    moved_by,
    only,
    recordings,
    slopes_of,
    under_loads,
)
from ctsid_core.likelihood.output_error import Fit, Fitted, Free, climb_roughly, fit_at, fit_states
from ctsid_core.likelihood.residuals import (
    coloured_power,
    independent,
    mean_square,
    residuals,
    white_part,
)
from ctsid_core.likelihood.samples import Residuals, Samples
from ctsid_core.linear.least_squares import basis_of
from ctsid_core.linear.types import Array

_INSTANTS = tuple(np.linspace(0.1, 0.9, 33).tolist())       # parts at which it is divided
_LIKELY = 2           # of these that are looked at
_FURTHER = 2.0        # power that two models may leave to first order, or beside the instant, over
                      # what they may at the end: a pole that jumps is no small change, and climbs
                      # reach further
_CLOSER = (0.02, 0.01)                     # steps from the best of them, one after another
_LOOK = 1e7           # work of looking for them, beside the basis
_NOTHING = 1e-9       # of a direction: less of it is rounding
_EDGE = 0.08          # of a record, within which it is not divided
_STEPS = 5            # of a side's model from that of the whole: more, and it fits noise
_FEWEST = 3           # samples of a side for each number of a model
_ASKED = 'whether the plant changed within the window'
_LEFT = 0.1           # power of errors, noise apart, that two models may leave of those of one
_MOVES = 0.12         # of a response, rms about its mean, that a gain that jumps changes
NOTED = 1.0           # per cent of the motion that one model has to miss, to be worth a word


@dataclass(frozen=True)
class Change:
    """The division of a record at which two models gain most."""

    record: int = -1           # its place; -1 if none was divided
    share: float = 0.5         # where, as a part of it; 0: all of it is of another plant
    # Rms of what one model misses and two do not, on the side and the output where it is most,
    # noise and what two gain by chance apart, over the motion [%]
    cost: float = 0.0
    gain: float = 0.0          # of -2 log likelihood of independent samples, beyond its price
    left: float = 1.0          # power of the errors of two over that of one, white noise apart
    one: tuple[float, float] = (float('nan'), float('nan'))     # fit, before and after [%]
    two: tuple[float, float] = (float('nan'), float('nan'))     # the same of two models [%]
    pushed: bool = False       # whether a load that comes and goes explains as much


def most_likely_change(samples: Samples, fit: Fit, free: Free,
                       smaller: tuple[Own, ...] = (),
                       predictor: Fitted | None = None, simulates: bool = True) -> Change:
    """
    Return where the plant changes, if two models explain what one does not.

    Smaller models are the best ones of smaller orders, and what was free in them. Of a model that
    was found by its predictions its predictor tells, too, or alone unless it `simulates`.
    """
    # All of it may be of a short side. Predictions of a plant that grows err by little anyway.
    if simulates and np.max(fit.power) < (0.01 * NOTED) ** 2 * _EDGE:
        return Change()
    # Of a record shorter than a dead time nothing is left.
    each, whole = recordings(samples), (fit.model, free)
    # What is, as a whole, of another plant than the others are is not divided. Of one that grows
    # predictions know the weather of each record, too.
    grows = predictor is not None and predictor[0] is samples
    others = (_explained(samples, whole, _divided(samples, whole, whole, place, 0.0))
              for place in each if len(each) > 1 and not grows)
    other = max((Change(), *others), key=lambda change: change.cost)
    if other.cost > 0.0:
        return other
    found = Change()
    if simulates:
        found = max(found, *(_explained(samples, one, _divisions(samples, one, whole, place))
                             for place in each for one in (whole, *smaller)),
                    key=lambda change: change.cost)
    if predictor is not None and found.cost <= NOTED:
        simulated = None if grows else samples
        found = max(found, *(_as_predicted(simulated, whole, place, predictor) for place in each),
                    key=lambda change: (change.cost, change.gain))
    return found


def _as_predicted(samples: Samples | None, plant: Own, place: int, predictor: Fitted) -> Change:
    """
    Return what two models explain where predictions say that the plant, or a gain, changes.

    Without `samples` of a simulation, of a plant that grows, gains alone are asked: of two of its
    predictors each knows its own gusts and loads.
    """
    joint, fit, free = predictor
    one, whole = only(joint, place), (fit.model, free)
    if len(recordings(joint)) > 1:
        # What disturbs a record is its own, and so is its predictor.
        with suppress(np.linalg.LinAlgError):
            whole = climb_roughly(one, fit_at(one, *fit.model.nonlinear, free), free,
                                  steps=_STEPS).model, free
    found = _gain_that_jumps(one, whole, place)
    if samples is None:
        return found
    if not found.gain:
        divided = _divisions(one, whole, whole, 0)
        best = _best(one, whole, divided) if divided.gain > 0.0 else Change()
        found = Change(place, divided.share, gain=divided.gain) if best.gain > 0.0 else found
        if not found.gain or best.pushed:
            return found
    size = _divided(samples, plant, plant, place, found.share, certain=True)
    return size if size.left < _LEFT else found


def _gain_that_jumps(samples: Samples, own: Own, place: int) -> Change:
    """Return when the gain of an input, or of all alike, jumps, if its predictor tells that."""
    # To first order. A gain is one number, and errors of predictions are white: they tell of it
    # where two models, each with all its numbers, are not likelier.
    nu, found = samples.nu - samples.ny, Change()
    if samples.effort.leaves_out(_ASKED):
        return found
    slopes = slopes_of(samples.thinned(2 * SEARCHED), own)
    samples.effort.spend(float(slopes.rows.size * INSTANTS))
    gains = moved_by(slopes, [np.zeros(nu) for _ in samples.records])
    none = slopes.in_records(slopes.without(slopes.rows[:, :0])[1])
    each = dict.fromkeys((*((j,) for j in range(nu)), tuple(range(nu))))
    for moved in (gains[:, :, inputs].sum(axis=2) for inputs in each):
        for ((_, _, at),), errors in jumps_of(slopes, moved[:, :, np.newaxis], 1):
            share, column = at / INSTANTS, moved[at][:, np.newaxis]
            jump = float(np.linalg.lstsq(*slopes.without(column), rcond=NOTHING)[0][0])
            left = slopes.in_records(errors)
            n_eff = independent(left)
            gain = float(n_eff @ np.log(mean_square(none) / mean_square(left))) - 2.0 * float(
                np.log(max(float(np.max(n_eff)), 2.0) * len(each)))
            if gain > found.gain and abs(jump) * np.sqrt(share * (1.0 - share)) > _MOVES:
                found, best = Change(place, share, gain=gain), column
    if not found.gain:
        return found
    likeliest = min(slopes.curved().cost, under_loads(slopes, 1, slopes.rows[:, :0]).cost)
    return found if slopes.beside(best).cost < likeliest else Change()


def _explained(samples: Samples, own: Own, found: Change) -> Change:
    """Return a division if it leaves hardly more than noise, and explains most; else none."""
    explained = found.cost > 0.0 and found.left < _LEFT
    return _best(samples, own, found) if explained else Change()


def _divisions(samples: Samples, own: Own, whole: Own, place: int) -> Change:
    """Return the most likely division of a record."""
    if samples.effort.leaves_out(_ASKED):
        return Change()
    found = max((_divided(samples, own, whole, place, share)
                 for share in _likely(only(samples, place), own, whole)),
                key=_clean, default=Change())
    for step in _CLOSER if found.gain > 0.0 and found.left < _FURTHER * _LEFT else ():
        found = max(found, *(_divided(samples, own, whole, place, share)
                             for share in (found.share - step, found.share + step)
                             if _EDGE <= share <= 1.0 - _EDGE), key=_clean)
    return found


def _clean(change: Change) -> tuple[float, float]:
    """Return less the more is left: beside the instant errors are coloured, and count little."""
    return -change.left if change.gain > 0.0 else -np.inf, change.gain


def _likely(samples: Samples, own: Own, whole: Own) -> list[float]:
    """Return the instants where models of each side's own leave least, if they promise enough."""
    # Two models may leave hardly more than noise of one output, and than the whole's model does.
    # With Q an orthonormal basis of what may change the simulation, and of its errors, Q'Q of the
    # samples before an instant says all of that side, and Q'Q of the others all of the other one.
    samples = samples.thinned(SEARCHED)
    fewest, counts = _FEWEST * (3 * own[0].n + 2), samples.counts.sum(axis=0)
    slopes = slopes_of(samples, own)
    states, shares, each = slopes.states, slopes.shares, float(np.min(counts))
    rival = slopes.fit if own is whole else fit_states(samples, *whole)
    noise = white_part(slopes.in_records(slopes.error)) ** 2
    most = each * min(float(np.sum(samples.mean(rival.power / slopes.fit.power))),
                      samples.ny - (1.0 - _LEFT) * float(np.max(1.0 - noise)))
    # As many samples count of each output as there are of the one that has fewest.
    weight = np.repeat(np.tile(np.sqrt(each / counts), len(samples.records)),
                       samples.counts.ravel().astype(int))
    rows, error = slopes.rows * weight[:, np.newaxis], slopes.error * weight
    order = np.argsort(shares, kind='stable')
    if len(rows) <= rows.shape[1]:              # samples enough for one model only
        return []
    samples.effort.spend(_LOOK + 2.0 * len(rows) * rows.shape[1] ** 2)
    # What a side's own states and trims explain is no change: they come first.
    basis = basis_of(rows[:, states][order])
    nuisance = basis.shape[1]
    basis = np.hstack((basis, basis_of(rows[:, ~states][order], basis)))
    told = basis.T @ error[order]
    rest = error[order] - basis @ told
    told = np.append(told, np.linalg.norm(rest))
    basis = np.column_stack((basis, rest / max(told[-1], 1e-300)))
    parts = np.split(basis, np.searchsorted(shares[order], _INSTANTS, side='right'))
    sums = np.cumsum([part.T @ part for part in parts], axis=0)
    start, end = samples.records[0].span
    span = (min((np.concatenate([s.times for s in same]) for same in zip(
        *(r.streams for r in samples.records), strict=True)), key=len) - start) / (end - start)
    early = np.searchsorted(span, _INSTANTS, side='right')
    promise, left = np.zeros(len(_INSTANTS)), np.zeros(len(_INSTANTS))
    for side, count in ((sums[:-1], early), (sums[-1] - sums[:-1], len(span) - early)):
        samples.effort.check()
        seen = side @ told
        root = np.linalg.cholesky(side[:, :-1, :-1] + _NOTHING * np.eye(len(told) - 1))
        by = np.linalg.solve(root, seen[:, :-1, np.newaxis])[:, :, 0] ** 2
        own_states, all_of_it = (np.maximum(seen @ told - by[:, :k].sum(axis=1), 1e-300)
                                 for k in (nuisance, by.shape[1]))
        left += all_of_it
        # Be it of all outputs, or of one whose errors are one of ny shares of the sum.
        gain = samples.ny * count * np.log(own_states / all_of_it)
        promise += np.where(count >= fewest, gain, 0.0)
    price = numbers_of(samples, own) * float(np.log(np.max(counts)))
    likely = np.flatnonzero((promise > price) & (left < _FURTHER * most) & (early >= fewest)
                            & (len(span) - early >= fewest))
    return [_INSTANTS[k] for k in likely[np.argsort(left[likely], kind='stable')][:_LIKELY]]


def _best(samples: Samples, own: Own, change: Change) -> Change:
    """Return a division if it explains more than a drift, curves, and loads that come and go."""
    # All to first order, from the same model, less what their numbers gain by chance; else none.
    # Where a load explains as much it may be `pushed`. A record of another plant is compared with
    # curves of all records.
    samples = (only(samples, change.record) if change.share else samples).thinned(SEARCHED)
    slopes = slopes_of(samples, own)
    rest, after = slopes.rest, (slopes.shares > change.share)[:, np.newaxis]
    states = slopes.rows[:, slopes.states]
    common = states * after if change.share else states[:, :0]
    if not change.share:
        of = np.array([r.recording for r in samples.records])
        after = np.repeat(of == of[change.record], samples.counts.sum(axis=1).astype(int))[
            :, np.newaxis]

    def cost(more: Array) -> float:
        return slopes.beside(np.hstack((common, more))).cost
    divided = cost(rest * after)
    curved = slopes.curved(common).cost
    if not divided < np.inf or divided > curved or change.share and divided > cost(slopes.drift):
        return Change()
    jumps = (numbers_of(samples, own) + 1) // 2          # each has a size and an instant
    if change.share and divided > under_loads(slopes, jumps, common).cost:
        return replace(change, pushed=True)
    return change


def _side(samples: Samples, start: float, end: float) -> Samples:
    """Return what there is of a recording from one time to another, thinned."""
    side = samples.between([(start, end)] * len(samples.records))
    return replace(side, records=tuple(r for r in side.records if any(
        len(s.times) for s in r.streams))).thinned(SEARCHED // 2)


def numbers_of(samples: Samples, own: Own) -> int:
    """Return how many numbers another model of a side costs, its instant among them."""
    model, free = own
    return (model.n * (samples.nu + samples.ny) + samples.nu * samples.ny * free.feedthrough
            + sum(free.delays) + 1)


def _divided(samples: Samples, own: Own, whole: Own, place: int, share: float,
             certain: bool = False) -> Change:
    """Return what two models of a model's order miss, if they are likelier than the whole's."""
    # Of a record that begins with the division, one of its own, beside that of all. Of a recording
    # with pauses a side has the parts before the division, or those after it.
    if samples.effort.leaves_out(_ASKED):
        return Change()
    alone, samples, (model, free) = len(recordings(samples)) == 1, only(samples, place), own
    first, last = samples.records[0].span
    at = first + share * (last - first)
    one: list[Residuals] = []
    two: list[Residuals] = []
    larger: list[Residuals] = []
    bounds = ((first, at), (at, last)) if share else ((at, last),)
    sides = [_side(samples, start, end) for start, end in bounds]
    for side in sides:
        if not side.records or np.min(side.counts.sum(axis=0)) < _FEWEST * (3 * model.n + 2):
            return Change()
        try:
            same = fit_states(side, model, free)
            starts = [fit_at(side, *model.nonlinear, free, near)
                      for near in ((same, None) if samples.rank > 1 else (None,))]
            other = climb_roughly(side, min(starts, key=lambda fit: fit.cost), free, steps=_STEPS)
        except np.linalg.LinAlgError:
            return Change()
        one.append(residuals(side, same))
        larger.append(one[-1] if whole is own else residuals(side, fit_states(side, *whole)))
        two.append(residuals(side, min(same, other, key=lambda fit: fit.cost)))
    known = np.array([sum(max(min(r.end, end) - max(r.start, start), 0.0)
                          for r in samples.records) for start, end in bounds])
    parts = known / np.sum(known)
    before, after, rival = (np.array([mean_square(side) for side in both])
                            for both in (one, two, larger))
    power, rest, of_one, of_two = parts @ rival, parts @ after, sum(one, ()), sum(two, ())
    n_eff = independent(of_two)
    count, of_whole = (numbers_of(samples, m) for m in (own, whole))
    fitted = (len(sides) * count + len(of_two) * (model.n + samples.ny)) / samples.ny
    # Numbers that two models are fitted with are no evidence for them; against them all is.
    telling = np.where(rest < power, np.maximum(n_eff - fitted, 0.0), n_eff)
    # The model of all stays the other records'.
    gain = float(telling @ np.log(power / rest)) - (
        len(sides) * count - alone * of_whole) * float(np.log(max(float(np.max(n_eff)), 2.0)))
    if gain <= 0.0 and not certain:
        return Change()
    where = int(np.argmax(parts @ before - rest))
    sizes = np.array([side.counts.sum(axis=0) for side in sides])
    # No more is left than is known to be: less the deviation of a mean square.
    chance = np.sqrt(2.0 / sizes.sum(axis=0)) * mean_square(of_two)
    left = max(float((coloured_power(of_two) - chance)[where]), 0.0) / max(
        float(coloured_power(of_one)[where]), 1e-300)
    # Of noise alone two models miss less, too: by what their numbers are fitted to it.
    by_chance = after * sizes / np.maximum(sizes - fitted / len(sides), 1.0)
    missed = 100.0 * np.sqrt(np.maximum(before - by_chance, 0.0))
    own_fit, two_fits = (
        (100.0 * (1.0 - float(np.sqrt(np.max(side[0])))),
         100.0 * (1.0 - float(np.sqrt(np.max(side[-1]))))) for side in (before, after))
    return Change(place, share, float(np.max(missed)), gain, left, own_fit, two_fits)
