# SPDX-License-Identifier: Apache-2.0
"""The one entry: check, project, regress, refine, judge."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from ctsid_core.bases.preparation import computable
from ctsid_core.bases.records import Joint, Unusable, check_alike, join_records
from ctsid_core.effort import Effort, one_thread
from ctsid_core.judge.acting import explained_best
from ctsid_core.judge.conclusion import conclude
from ctsid_core.judge.cross_check import cross_checked
from ctsid_core.judge.rules import unusable_estimate
from ctsid_core.model.estimate import Estimate, Status
from ctsid_core.model.statespace import StateSpace
from ctsid_core.search.actuators import of_actuators, with_choices
from ctsid_core.search.corrupt import AGAIN, given_back, of_lost_inputs, reads_better
from ctsid_core.search.solution import Solution
from ctsid_core.search.solve import solve
from ctsid_core.search.task import own_delays
from ctsid_core.search.tried import SEARCH
from ctsid_core.search.unrefined import solve_by
from ctsid_core.settings import Actuator, Settings
from ctsid_core.signals.actuators import as_acting, settled
from ctsid_core.signals.as_measured import as_measured
from ctsid_core.signals.loop import in_loop
from ctsid_core.signals.record import Record
from ctsid_core.signals.spikes import within_range
from ctsid_core.subspace.methods import METHODS


def identify(record: Record | Sequence[Record], settings: Settings | None = None, *,
             like: StateSpace | None = None, cancelled: Callable[[], bool] | None = None,
             ) -> Estimate:
    """
    Identify a continuous-time state-space model from one record, or from several of one plant.

    Parameters
    ----------
    record : Record or sequence of Record
        Inputs and outputs, each with its own stamps. Several share the plant; each has a trim,
        states at its ends and a level of noise of its own, and may be of any duration and rates.
    settings : Settings, optional
        What is not to be found from the data; by default everything is.
    like : StateSpace, optional
        Of no effect since version 0.2: the search from order 1 upwards needs no start. Kept for
        callers of version 0.1.
    cancelled : callable, optional
        Asked again and again on the way; once it returns True, the identification is broken off.

    Returns
    -------
    Estimate
        With a model if its status is `Status.OK`; else its status says what to do.

    Raises
    ------
    SettingsError
        If `settings.delay`, or what lies before inputs, does not fit the number of inputs.
    DataError
        If several records differ in the number, names or units of their channels.
    Cancelled
        If `cancelled` said so.

    Notes
    -----
    Pure: the same record and settings give the same bits.

    Of several records: the trim and the noise of the model are those of the record that ends last
    (of several, the last given), those of all are in `Estimate.records`. The order does not matter
    otherwise. What is held out are parts of every record. A record with pauses is in parts, each
    with a trim of its own: the model's is that after the last one.

    References
    ----------
    [HD] section 4.

    Examples
    --------
    >>> import numpy as np
    >>> from ctsid_core import Record, identify
    >>> t = np.linspace(0.0, 10.0, 1001)
    >>> u = np.sign(np.sin(2.0 * t) + np.sin(5.1 * t))
    >>> y = np.zeros(1001)
    >>> for k in range(1000):                           # dy/dt = -3 y + 3 u, u held
    ...     y[k + 1] = u[k] + (y[k] - u[k]) * np.exp(-0.03)
    >>> estimate = identify(Record.from_arrays(t, u, t, y, input_hold='zoh'))
    >>> print(estimate.model.poles.real.round(2))
    [-3.]
    """
    records = (record,) if isinstance(record, Record) else tuple(record)
    check_alike(records)
    settings = settings or Settings()
    effort = Effort(settings.budget, cancelled)
    with one_thread():
        notes: list[str] = []
        for clean in (computable, as_measured):
            cleaned = [clean(r) for r in records]
            records, notes = tuple(r for r, _ in cleaned), notes + [
                note for _, own in cleaned for note in own]
        result = _identify(records, settings, effort)
        result = replace(result, notes=(*notes, *result.notes),
                         start_ns=min(r.epoch_ns + round(r.start * 1e9) for r in records),
                         end_ns=max(r.epoch_ns + round(r.end * 1e9) for r in records))
        return cross_checked(result, settings, lambda other: _identify(records, other, effort))


def _identify(records: tuple[Record, ...], settings: Settings, effort: Effort) -> Estimate:
    effort.check()
    part = _joined(records, settings, effort)
    if isinstance(part, Unusable):
        return unusable_estimate(part.status, records[0], settings, part.notes)
    try:
        with np.errstate(over='ignore', invalid='ignore', divide='ignore'):     # of absurd sizes
            return _solved(part, records, settings, effort)
    except np.linalg.LinAlgError as error:       # of the data's making: no caller must die of it
        return unusable_estimate(Status.UNRELIABLE, records[0], settings, part.notes, str(error))


def _joined(records: tuple[Record, ...], settings: Settings, effort: Effort,
            lost: bool = False) -> Joint | Unusable:
    """Return what can be used of records, their inputs as they act."""
    each = settings.actuators(records[0].nu)
    return join_records(
        [as_acting(settled(r, each), each) for r in records],
        settings.with_known_delays(), effort.check, lost=lost)


def _solved(part: Joint, records: tuple[Record, ...], settings: Settings,
            effort: Effort) -> Estimate:
    method = METHODS[settings.method]
    refined = method.refines and settings.refine

    def found(part: Joint | Unusable, settings: Settings) -> Solution | None:
        by = solve if refined else partial(solve_by, method)
        own = settings.with_actuators(settings.actuators(records[0].nu))
        return None if isinstance(part, Unusable) else given_back(
            part, lambda one: by(one, own, effort), effort)

    def again(settings: Settings, lost: bool) -> Solution | None:
        return None if effort.beyond(SEARCH) else found(
            _joined(records, settings, effort, lost), settings)

    solution, notes = found(part, settings), list[str]()
    within = [within_range(r) for r in records]
    if solution is not None and any(more for _, more in within) and not effort.beyond(AGAIN):
        inside = tuple(r for r, _ in within)
        other = found(_joined(inside, settings, effort), settings)
        if other is not None and reads_better(other, solution):
            part, solution, records = other.part, other, inside
            notes = [note for _, more in within for note in more]
    if solution is not None:
        nu = records[0].nu
        sent = _joined(records, settings.with_actuators((Actuator(),) * nu), effort) if any(
            map(any, settings.actuators(nu))) else part
        acted = of_actuators(
            solution, part if isinstance(sent, Unusable) else sent, settings, again,
            loop=not settings.feedthrough and in_loop([p.record for p in part.parts]))
        solution = acted if acted.part is solution.part else explained_best(solution, acted)
        solution = with_choices(of_lost_inputs(solution, settings, again), settings)
    if solution is None:
        return unusable_estimate(Status.TOO_SHORT, records[0], settings, part.notes,
                                 spent=effort.beyond(SEARCH))
    sought = own_delays(solution.part, settings).unknown_delays(len(solution.part.parts[0].u))
    result = conclude(solution, sought if refined else ())
    return replace(result, notes=(*notes, *result.notes))
