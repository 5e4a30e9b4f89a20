# SPDX-License-Identifier: Apache-2.0
"""The one entry: check, project, regress, refine, judge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ctsid_core.bases.records import Unusable, check_alike, join_records
from ctsid_core.judge.conclusion import conclude
from ctsid_core.judge.conclusion_on_samples import conclude_on_samples
from ctsid_core.judge.cross_check import cross_checked
from ctsid_core.judge.rules import failed_estimate, unusable_estimate
from ctsid_core.model.estimate import Estimate, Status
from ctsid_core.model.statespace import StateSpace
from ctsid_core.search.bends_passes import bends, explains_as_well, with_bends
from ctsid_core.search.dead_time_choice import choose_dead_time
from ctsid_core.search.lines import choose_noise_model, confirm_order, estimate, without_outliers
from ctsid_core.search.order import FIRST
from ctsid_core.search.samples import solve_bursty_samples, solve_if_distorted
from ctsid_core.search.unrefined import identify_by
from ctsid_core.settings import Settings
from ctsid_core.signals.record import Record
from ctsid_core.subspace.methods import METHODS

_NO_SEARCH = ('dead time is not looked for in outputs that come in bursts, and counts as 0; give '
              'it if there is one')


def identify(record: Record | Sequence[Record], settings: Settings | None = None, *,
             like: StateSpace | None = None) -> Estimate:
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
        A model of data alike, of the window before for example: the search for the order begins
        with its order. That saves time; the model is the same, bit by bit, unless another order
        explains the data about as well.

    Returns
    -------
    Estimate
        With a model if its status is `Status.OK`; else its status says what to do.

    Raises
    ------
    SettingsError
        If `settings.delay` does not fit the number of inputs.
    DataError
        If several records differ in the number, names or units of their channels.

    Notes
    -----
    Pure: the same record and settings give the same bits.

    Of several records: the trim and the noise of the model are those of the record that ends last
    (of several, the last given), those of all are in `Estimate.records`. The order does not matter
    otherwise. What is held out is the last part of every record; of four and more, whole ones.

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
    result = _identify(records, settings, like.n if like else FIRST)
    result = replace(result, start_ns=min(r.epoch_ns + round(r.start * 1e9) for r in records),
                     end_ns=max(r.epoch_ns + round(r.end * 1e9) for r in records))
    return cross_checked(result, settings, lambda other: _identify(records, other, FIRST))


def _identify(records: tuple[Record, ...], settings: Settings, first: int) -> Estimate:
    known = settings.with_known_delays()
    part = join_records(records, known)
    if isinstance(part, Unusable):
        return unusable_estimate(part.status, records[0], settings, part.notes)
    too_short = unusable_estimate(Status.TOO_SHORT, records[0], settings, part.notes)
    method = METHODS[settings.method]
    try:
        if not method.refines:
            tried = identify_by(method, part, settings)
            return conclude(*tried) if tried else too_short
        if on_samples := solve_bursty_samples(part, known):
            result = conclude_on_samples(on_samples)
            unknown = any(settings.unknown_delays(records[0].nu))
            return replace(result, notes=(*result.notes, _NO_SEARCH)) if unknown else result
        solution = estimate(part, known, first)
        if solution is None:
            return too_short
        plain = part, solution
        part, solution = with_bends(part, solution, known)
        clean, solution = without_outliers(part, solution, known)
        if clean is not part:
            part, solution = with_bends(clean, solution, known)
        if bends(part) and (on_samples := solve_if_distorted(*plain)):
            result = conclude_on_samples(on_samples)
            if explains_as_well(result, part, solution):
                return result
        solution = choose_noise_model(part, solution, known, first)
        part, solution = choose_dead_time(records, plain, (part, solution), settings)
        if on_samples := solve_if_distorted(part, solution):
            return conclude_on_samples(on_samples)
        return conclude(part, *confirm_order(part, solution, settings))
    except np.linalg.LinAlgError as error:       # of the data's making: no caller must die of it
        return failed_estimate(error, settings, part.notes)
