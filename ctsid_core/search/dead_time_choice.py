# SPDX-License-Identifier: Apache-2.0
"""A model with the dead times that the data show, at the joint maximum over both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ctsid_core.bases.projection import Projection
from ctsid_core.bases.records import Joint, Unusable, join_records
from ctsid_core.likelihood.dead_time_climb import climb_jointly
from ctsid_core.likelihood.refine import affordable, refine_innovation
from ctsid_core.linear.types import Array
from ctsid_core.model.estimate import Choice
from ctsid_core.search.bends_passes import bends, bent_further, on_samples, with_bends
from ctsid_core.search.dead_time import LONGEST, DeadTimeFit, DeadTimeSearch, delayed
from ctsid_core.search.lines import estimate, without_outliers
from ctsid_core.search.order import Search
from ctsid_core.search.selection import model_criterion, most_likely
from ctsid_core.search.solution import Solution, own_delays
from ctsid_core.settings import Settings
from ctsid_core.signals.record import Record

_ROUNDS = 4           # of climbing with outputs that bend as late inputs have it


def choose_dead_time(records: Sequence[Record], plain: tuple[Joint, Solution],
                     bent: tuple[Joint, Solution],
                     settings: Settings) -> tuple[Joint, Solution]:
    """
    Return records and their model with the dead times that they show.

    Parameters
    ----------
    records : sequence of Record
        As they were given.
    plain : (Joint, Solution)
        What can be used of them without dead time, and the model of interpolated outputs.
    bent : (Joint, Solution)
        The same of outputs that bend, if they do: a model without dead time bends them at the
        wrong times if there is one, and the other one knows the dead time better then.
    settings : Settings
    """
    if not bends(bent[0]):
        return with_dead_time(records, *bent, settings)
    late = with_dead_time(records, *plain, settings)
    if late[1] is not plain[1] and on_samples(*late) < on_samples(*bent):
        return late
    return with_dead_time(records, *bent, settings)


def with_dead_time(records: Sequence[Record], part: Joint, found: Solution,
                   settings: Settings) -> tuple[Joint, Solution]:
    """
    Return what can be used of records, and the model with the dead times that they show.

    Parameters
    ----------
    records : sequence of Record
        As they were given.
    part : Joint
        What can be used of them without dead time.
    found : Solution
        The model without.
    settings : Settings
        Of which the unknown dead times are looked for.

    Returns
    -------
    part : Joint
    found : Solution
        Both as they are if there is no dead time.
    """
    late = np.array(settings.unknown_delays(records[0].nu))[list(part.parts[0].u)]
    order = len(found.matrices.A)
    if found.by_prediction or not (late.any() and settings.refine and settings.edges == 'exact'
                                   and affordable(found.projection, order)):
        return part, found
    hunt = DeadTimeSearch(part, found.layout, found.search, late)
    rough = hunt.best(order, alone=bool(settings.order),
                      poles=np.linalg.eigvals(found.matrices.A).astype(complex))
    if rough is None or not _more_likely(hunt, rough, found):
        return part, found
    known = _known(part, settings, rough.delays).replace(feedthrough=rough.direct)
    if not found.process_noise:         # else some states may stand for that
        known = known.replace(order=len(rough.poles))
    shorter = join_records(records, known)
    if isinstance(shorter, Unusable):
        return part, found
    other = estimate(shorter, known, len(rough.poles))
    if other is None:
        return part, found
    shorter, other = with_bends(shorter, other, known.replace(order=settings.order))
    shorter, other = without_outliers(shorter, other, known)
    climbed = _climbed(shorter, other, rough.late, rough.why(order))
    for _ in range(_ROUNDS):
        further = bent_further(shorter, climbed)
        if further is None:
            break
        shorter, projection = further
        climbed = _climbed(shorter, replace(climbed, projection=projection,
                                            choices=other.choices), rough.late, rough.why(order))
    return shorter, climbed


def _more_likely(hunt: DeadTimeSearch, rough: DeadTimeFit, found: Solution) -> bool:
    """Return whether dead times are more likely than none if the errors are not white, too."""
    if not found.process_noise:
        return True
    projection = hunt.projection(rough.delays)
    settings = found.settings.replace(feedthrough=rough.direct)
    search = Search(projection, settings.replace(beta=0.0, gamma=0.0, past=0, future=0))
    rival = model_criterion(found.search, found.matrices, True)
    for n in (len(rough.poles), len(rough.poles) + 1):       # gusts may ask for a state more
        pair = None if n > len(found.matrices.A) else search.pair(n)
        if pair is not None and model_criterion(
                search, *most_likely(projection, pair, settings)) \
                + float(rough.late.sum()) * search.charge < rival:
            return True
    return False


def _known(part: Joint, settings: Settings, delays: Array) -> Settings:
    """Return the settings with the dead times of the moving inputs filled in."""
    first = part.parts[0]
    each = list(settings.delays(first.whole.nu))
    for j, delay in zip(first.u, delays.tolist(), strict=True):
        each[j] = delay
    return settings.replace(delay=each[0] if len(each) == 1 else tuple(each))


def _climbed(part: Joint, found: Solution, late: NDArray[np.bool_], why: str) -> Solution:
    """Return a model at the joint maximum over its entries and its dead times."""
    own, feed = own_delays(part.parts[0], found.settings), found.settings.feedthrough
    start = np.array(own.delays(part.parts[0].record.nu))

    def at(delays: Array) -> Projection:
        return delayed(part, found.layout, own, found.projection, delays, late)

    joint = climb_jointly(at, found.matrices, start, feedthrough=feed,
                          process_noise=found.process_noise, longest=LONGEST * part.length)
    projection, matrices = at(joint.delays), joint.matrices
    if not found.process_noise and np.any(found.matrices.K):
        matrices = refine_innovation(projection, replace(matrices, K=found.matrices.K), feed,
                                     plant=False, steps=8)[0]
    choice = Choice('delay', tuple(float(d) for d in joint.delays), why)
    return replace(found, settings=_known(part, found.settings, joint.delays),
                   projection=projection, matrices=matrices, choices=(*found.choices, choice))
