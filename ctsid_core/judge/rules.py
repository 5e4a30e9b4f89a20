# SPDX-License-Identifier: Apache-2.0
"""
From numbers to a verdict.

What rejects a model comes first, and gives its status; what weakens it comes next, the gravest
first: the first that applies is the reason. Each threshold and where it was measured:
`docs/verdict.md`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ctsid_core.judge.evidence import Evidence
from ctsid_core.linear.types import Array
from ctsid_core.model.estimate import Estimate, Status
from ctsid_core.model.verdict import EXPLAINED, UNJUDGED, Grade, Verdict
from ctsid_core.settings import Settings
from ctsid_core.signals.record import Record

PREDICTED = 10.0        # fit [%] of one-step predictions below which an output is not explained
_UNRELATED = 10.0       # fit [%] below which nothing of an output is
_POLE_STD = 0.5         # standard deviation of a pole over its size: beyond, it is not known
_RESPONSE_STD = 0.05    # the same of the response to an input
_UNCORRELATED = 0.1     # part of an input's power that other inputs do not explain
_ONE_SINE = 1.5         # effective number of frequencies of an input
_UNMODELLED = 0.02      # unmodelled response, over the response
_SIGNIFICANT = 1e-5     # p-value of an unmodelled response that is believed ...
_ENOUGH = 0.01          # ... and where the errors are not white, too
_NOT_WHITE = 1e-6       # p-value of white errors, below which they are not
_CLEAR = 80.0           # fit [%] of a model that clearly explains its own data
_HELD_OUT_RATIO = 4.0   # power of the errors on held-out data over that on the model's own
_FRESH_RATIO = 1.5      # rms error of the previous model on new data over that on older data
_FRESH_FIT = 90.0       # fresh fit [%] above which that does not matter
_MOVED = 3.0            # standard deviations by which a pole moves between windows by chance

_UNEXAMINED = ('With samples that come in bursts, whether part of the response is not modelled '
               'cannot be tested; test the model on other data before using it.')
UNTESTED = ('The model has not been tested on held-out data: `validation.held_out` is 0, or the '
            'inputs move in one part of the window only; wait for the next window, or test it on '
            'other data.')


def judge(evidence: Evidence) -> tuple[Status, Verdict]:
    """Return status and verdict; the grade is REJECT if and only if the status is not OK."""
    for status, reason in _rejections(evidence):
        return status, replace(evidence.numbers, grade=Grade.REJECT, reason=reason)
    for reason in _weaknesses(evidence):
        return Status.OK, replace(evidence.numbers, grade=Grade.WEAK, reason=reason)
    return Status.OK, replace(evidence.numbers, grade=Grade.GOOD, reason=_summary(evidence))


def _rejections(e: Evidence) -> Iterator[tuple[Status, str]]:
    if not (np.isfinite(e.poles).all() and np.isfinite(np.delete(e.fit, e.fixed_outputs)).all()):
        yield Status.UNRELIABLE, Status.UNRELIABLE.value
    if e.change:
        yield Status.CHANGED, e.change
    if e.fixed_outputs:
        yield Status.NO_RESPONSE, (
            f'{_outputs(e, e.fixed_outputs)} not move within the window; check the sensor '
            'and that it is the right signal, or leave it out.')
    for one in e.stuck:
        yield Status.NO_RESPONSE, (
            f'Output {e.output_names[one.output]} keeps exactly the same value from '
            f'{one.start:.3g} to {one.end:.3g} s after the start of the window, although inputs '
            'move; the sensor is stuck or its last value is repeated: check it, or leave it '
            'out.')
    yield from _unexplained(e)
    ratio = _pole_ratio(e)
    if np.min(ratio) > _POLE_STD:
        best = int(np.argmin(ratio))
        yield Status.UNRELIABLE, (
            f'No pole is well determined: even {_number(e.poles[best])} rad/s has a standard '
            f'deviation of {e.deviation[best]:.2g} rad/s; excite more frequencies, take a '
            'longer window, or lower the order.')


def _unexplained(e: Evidence) -> Iterator[tuple[Status, str]]:
    tested = e.held_out[np.isfinite(e.held_out)]
    best = min(np.nanmax(e.fit), np.max(tested)) if len(tested) else np.nanmax(e.fit)
    if best < e.enough and not _right_but_slow(e):
        own, shown = float(np.nanmax(e.fit)), max(float(best), -999.0)
        what = f'The model fits its own data ({own:.0f} %), but not the part of the window that ' \
            f'was held out ({shown:.0f} %)' if own >= e.enough else \
            f'No linear model explains {_listed(e.output_names)} by {_listed(e.input_names)} ' \
            f'(the best fit is {shown:.0f} %)'
        yield Status.UNEXPLAINED, (
            f'{what}; check that these are the right signals, that nothing else drives the plant '
            'and that it is linear over the window, or take a longer window with more excitation.')
    # Slow outputs of a right model may fit badly on a short part, but not err more than noise.
    erring = (e.fit < e.enough) | (e.numbers.next_ratio > _HELD_OUT_RATIO)
    dead = np.flatnonzero((e.worst < _UNRELATED) & erring)
    if len(dead):
        least = int(dead[np.argmin(e.worst[dead])])
        yield Status.UNEXPLAINED, (
            f'Output {e.output_names[least]} does not follow the inputs (fit '
            f'{max(e.worst[least], -999.0):.0f} %) while others do; check its sensor and '
            'that it is the right signal, or leave it out.')


def _right_but_slow(e: Evidence) -> bool:
    """
    Return whether the held-out fit is low only because little moves in that part.

    After a step little moves: the residuals of a right model are then noise, and no smaller than
    the motion. With process noise that proves nothing: it may be all that moves.
    """
    erring = np.delete(e.numbers.next_ratio, e.fixed_outputs)
    # Where the response is uncertain, little motion is no excuse.
    known = all(x.uncertainty < _RESPONSE_STD for x in e.numbers.excitation)
    settles = np.max(e.poles.real) < -0.5 * e.resolution         # a vibration lasts
    clear = np.nanmin(e.fit) > _CLEAR and not e.process_noise
    return bool(known and settles and clear and np.all(erring < _HELD_OUT_RATIO))


def _weaknesses(e: Evidence) -> Iterator[str]:
    if e.unexamined:            # first: the numbers that other rules ask for are not known
        yield _UNEXAMINED
    yield from _of_inputs(e)
    for i in np.flatnonzero(e.worst < e.enough):
        yield (f'The inputs explain little of output {e.output_names[i]} (fit '
               f'{e.worst[i]:.0f} %); check its sensor, reduce its noise, or leave it out.')
    numbers, names = e.numbers, e.output_names
    certain = (numbers.missing_p_value < _SIGNIFICANT) & (numbers.missing > _UNMODELLED)
    if not e.process_noise:  # then errors not white and correlated with inputs are dynamics
        certain |= (numbers.missing_p_value < _ENOUGH) & (numbers.whiteness < _NOT_WHITE)
    for i in np.flatnonzero(certain):
        yield (f'About {100 * numbers.missing[i]:.2g} % of the response of output {names[i]} to '
               'the inputs is not modelled (its prediction errors depend on past inputs); raise '
               '`order` or `max_order`, check the dead time and the hold of the inputs; or the '
               'plant is not linear.')
    if numbers.pole_uncertainty > _POLE_STD:
        worst = int(np.argmax(_pole_ratio(e)))
        yield (f'The pole {_number(e.poles[worst])} rad/s has a standard deviation of '
               f'{e.deviation[worst]:.2g} rad/s; excite the plant around '
               f'{max(abs(e.poles[worst]), e.resolution):.2g} rad/s, take a longer window, or '
               'lower the order.')
    for i in np.flatnonzero(numbers.next_ratio > _HELD_OUT_RATIO):
        yield (f'On held-out data the error of output {names[i]} has '
               f'{numbers.next_ratio[i]:.2g} times the power of the noise; take a longer window, '
               'or lower the order.')
    if e.process_noise:
        for i in np.flatnonzero(numbers.whiteness < _NOT_WHITE):
            yield (f'The prediction errors of output {names[i]} are not white, although the '
                   'model has process noise, so that the standard deviations cannot be trusted; '
                   'raise `order`, or measure what else acts on the plant.')
    known = np.append(np.delete(numbers.missing, e.fixed_outputs), numbers.pole_uncertainty)
    if not np.isfinite(known).all():
        yield ('The uncertainty of the model could not be computed; check the signals, their '
               'sizes and units.')
    if not np.isfinite(e.held_out).any():
        yield UNTESTED


def _of_inputs(e: Evidence) -> Iterator[str]:
    for j in e.fixed_inputs:
        yield (f'Input {e.input_names[j]} does not move within the window, and its zero column of '
               'B and D is not measured; move it, or leave it out.')
    for one in e.numbers.excitation:
        if one.frequencies < _ONE_SINE:
            yield (f'Input {one.name} moves at a single frequency only, which fits many '
                   'models; excite more frequencies (a sweep, steps, or noise).')
        if one.uncertainty > _RESPONSE_STD:
            std = f'a standard deviation of {100 * one.uncertainty:.2g} %' \
                if one.uncertainty <= 1.0 else 'a standard deviation above 100 %'
            alone = 'move it independently of the other inputs (only ' \
                f'{100 * one.own:.2g} % of its power is not correlated with theirs)'
            cure = alone if one.own < _UNCORRELATED else \
                'move it more, or for longer, or leave it out'
            yield f'The response to input {one.name} has {std}; {cure}.'


def _pole_ratio(e: Evidence) -> Array:
    return np.asarray(e.deviation / np.maximum(np.abs(e.poles), e.resolution))


def pole_uncertainty(poles: NDArray[np.complex128], deviation: Array, resolution: float) -> float:
    """Return the largest deviation over size; see `Verdict.pole_uncertainty`."""
    return float(np.max(deviation / np.maximum(np.abs(poles), resolution), initial=0.0))


def _summary(e: Evidence) -> str:
    worst, std = float(np.nanmin(e.worst)), max(x.uncertainty for x in e.numbers.excitation)
    return (f'Every test is passed: the standard deviation is at most {100 * std:.2g} % of the '
            f'response to each input and {100 * e.numbers.pole_uncertainty:.2g} % of each pole; '
            f'the fit, also on held-out data, is at least {np.floor(worst):.0f} %.')


def _listed(names: tuple[str, ...]) -> str:
    return ', '.join(names) if len(names) < 5 else f'{len(names)} signals'


def _outputs(e: Evidence, places: tuple[int, ...]) -> str:
    listed = ', '.join(e.output_names[i] for i in places)
    return f'Outputs {listed} do' if len(places) > 1 else f'Output {listed} does'


def _number(pole: complex) -> str:
    pole = complex(pole)
    return f'{pole.real:.3g}' if pole.imag == 0 else f'{pole.real:.3g} +- {abs(pole.imag):.3g}j'


def unusable_estimate(status: Status, record: Record, settings: Settings,
                      notes: tuple[str, ...] = ()) -> Estimate:
    """Return the estimate that says why nothing of a record can be used."""
    return Estimate(status=status, settings=settings, notes=notes, verdict=replace(
        UNJUDGED, grade=Grade.REJECT, reason=_why_unusable(status, record)))


def failed_estimate(error: Exception, settings: Settings, notes: tuple[str, ...]) -> Estimate:
    """Return the estimate that says that the arithmetic failed: of the data's making."""
    return Estimate(status=Status.UNRELIABLE, settings=settings, notes=notes, verdict=replace(
        UNJUDGED, grade=Grade.REJECT, reason=f'The arithmetic failed ({error}); check the '
        'signals, their sizes and units.'))


def _why_unusable(status: Status, record: Record) -> str:
    """Return why nothing of a record can be used, with the names that matter."""
    if status is Status.NO_EXCITATION:
        return (f'No input moves within the window ({", ".join(record.input_names)}); excite the '
                'inputs, or choose a window in which they move.')
    if status is Status.NO_RESPONSE:
        return (f'No output moves within the window ({", ".join(record.output_names)}); check '
                'that the right signals are used.')
    return str(status.value)


def weakened(verdict: Verdict) -> Verdict:
    """Return a verdict, WEAK instead of GOOD if a second method does not agree."""
    seen = verdict.agreement
    if verdict.grade is not Grade.GOOD or seen is None or seen.agrees:
        return verdict
    return replace(verdict, grade=Grade.WEAK, reason=seen.weakness)


def rejected_over_change(estimate: Estimate, share: float) -> Estimate:
    """
    Return an estimate rejected, because an earlier window has shown a change within this one.

    Parameters
    ----------
    estimate : Estimate
        With a model.
    share : float
        Part of its window before the change.
    """
    words = f'an earlier window has shown a change of the plant at {100 * share:.0f} % of this one'
    return replace(
        estimate, status=Status.CHANGED, model=None, rejected_model=estimate.model,
        notes=(*estimate.notes, words), verdict=replace(
            estimate.verdict, grade=Grade.REJECT, reason=f'{words.capitalize()}; wait until the '
            'change has left the window.'))


def in_sequence(estimate: Estimate, fresh_fit: Array, fresh_ratio: Array, moved: float,
                before: int = 0) -> Estimate:
    """
    Return an estimate whose verdict takes the previous model into account.

    Parameters
    ----------
    estimate : Estimate
    fresh_fit, fresh_ratio : ndarray, shape (ny,)
        Of the previous model on the data that are new; NaN if not known.
    moved : float
        See `Verdict.moved`.
    before : int
        Order of the model before; 0 if there was none.
    """
    verdict = replace(estimate.verdict, fresh_ratio=fresh_ratio, moved=moved)
    model = estimate.model
    if model is None:
        return replace(estimate, verdict=verdict)
    if verdict.reason == UNTESTED and np.nanmin(fresh_fit, initial=np.inf) < np.inf:
        verdict = replace(verdict, grade=Grade.GOOD, reason='Every test is passed; the previous '
                          'model simulates the new data of this window well.')
        verdict = weakened(verdict)
    if verdict.grade is Grade.GOOD:
        reasons = [*_collapses(model.output_names, fresh_fit, fresh_ratio),
                   *_moves(model.n, before, moved)]
        if reasons:
            verdict = replace(verdict, grade=Grade.WEAK, reason=reasons[0])
    return replace(estimate, verdict=verdict)


def _collapses(names: tuple[str, ...], fit: Array, ratio: Array) -> Iterator[str]:
    collapsed = np.where(np.isfinite(ratio), (ratio > _FRESH_RATIO) & (fit < _FRESH_FIT),
                         fit < EXPLAINED)
    for i in np.flatnonzero(collapsed):
        yield (f'The previous model simulates the new data of output {names[i]} badly (fresh fit '
               f'{max(fit[i], -999.0):.0f} %), as after a change of the plant; wait until '
               'successive models agree again.')


def _moves(order: int, before: int, moved: float) -> Iterator[str]:
    if before not in (0, order):
        yield (f'The order has changed from {before} to {order} since the last accepted model; '
               'wait until successive models agree again, or set `order`.')
    if moved > _MOVED:
        yield (f'A pole has moved by {moved:.2g} standard deviations since the previous model; '
               'wait until successive models agree again, or set `order`.')
