# SPDX-License-Identifier: Apache-2.0
"""
From numbers to a verdict.

What rejects a model comes first, and gives its status; what weakens it comes next, the gravest
first: the first that applies is the reason; of several channels it names the worst. A reason says
what was found, and at its end, after a semicolon, the one thing to try next. Each threshold and
where it was measured: `docs/verdict.md`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import chain

import numpy as np

from ctsid_core.bases.preparation import is_short, sparse
from ctsid_core.judge.changed import NOTED
from ctsid_core.judge.evidence import Evidence
from ctsid_core.linear.types import Array
from ctsid_core.model.estimate import REMEDIES, Estimate, Status
from ctsid_core.model.verdict import EXPLAINED, UNJUDGED, Excitation, Grade, Remedy, Verdict
from ctsid_core.search.held_out import HeldOut, allowed, unsure
from ctsid_core.search.solution import ANY_DELAY, DIRECT, DISTURBED, GIVEN, OTHER_HOLD
from ctsid_core.settings import Actuator, Settings
from ctsid_core.signals.gaps import FEWEST, after_start, silent_between
from ctsid_core.signals.record import Record, placed

KNOWN = 0.12            # standard deviation of the response to an input, over the response
NONE = 0.5              # the same, from which on it may be none: it is within two of them
_SURELY = 1.25          # times the motion that makes a response known: with less noise there may
                        # be more states
UNCORRELATED = 0.1      # part of an input's power that other inputs do not explain
_LEAKS = 0.6            # frequencies more than its sines that an input seems to have: one sine
                        # sent at 5 to 100 Hz has 1.2, two have 2.2 at most in 95 of 100
_SINES = 2              # that tell four numbers, and must be exceeded; as many as there are states
                        # suffice for fewer
_FOLLOWS = 0.4          # the same of an output's response to all inputs: it follows nothing
_CONTROLLER = 0.35      # of 1: what 1 + C G is of a model that is minus one over the controller C
_HINGES = 0.3           # of the response, that outputs an interval earlier change: more, and a
                        # model is of the stamps (0.35 at least; of loops that are right 0.17)
_DRIVEN = 0.5           # held-out error over what inputs explain: less, and it follows them
_UNEXPLAINED = 0.8      # error that is not white noise, over the motion: no model at all
_CURVED = 6.0           # points of fit that curves of inputs and outputs gain after the model
_DRIFTED = 15.0         # per cent of the motion that the mean of a plant that drifts misses
_CHANGED = 3.0          # per cent of the motion that one model misses, and two do not
_FRESH_RATIO = 2.0      # rms error of the previous model on new data over that on older data
_FRESH_FIT = 90.0       # fresh fit [%] above which that does not matter
_APART = 0.1            # of the motion, by which models of successive windows differ

_DOUBTED = (Status.OK, Status.UNEXPLAINED)      # ... whose cause may be a setting
_GUESSED = (Remedy.EXCITE, Remedy.SIGNALS)
_FAULTY = (*_DOUBTED, Status.CHANGED)           # ... or a fault of the samples that is known
_BY_LOG = 'in a bag: set `stamp: log` for all channels'
_LATE = ('outputs that are stamped late look so in a loop, where the model is minus one over the '
         'controller; take the stamps of the sensor (in a bag: `stamp: header`)')
_WAIT = 'wait until successive models agree again (in a recording: take longer windows)'


def judge(evidence: Evidence) -> tuple[Status, Verdict]:
    """Return status and verdict; the grade is REJECT if and only if the status is not OK."""
    weak = ((Status.OK, *one) for one in _weaknesses(evidence))
    for status, remedy, reason in chain(_rejections(evidence), weak):
        fault = next(_faults(evidence), None)
        if status in _FAULTY and (fault or evidence.jumped):
            remedy, reason = fault or (Remedy.PART, (
                f'{_begun(_jumps(evidence))}; take a part of the data without that.'))
        given = evidence.doubt is not None and evidence.doubt[1] in GIVEN
        # Noise that a controller adds to its command looks like another hold.
        noisy = fault and evidence.doubt and OTHER_HOLD in evidence.doubt[1]
        doubtful = status in _DOUBTED and (given or remedy in _GUESSED and not noisy)
        doubt = evidence.wrapped or (evidence.doubt if doubtful else None)
        if reason not in evidence.faults and doubt and doubt[1] not in reason:
            what, setting = doubt
            remedy, reason = Remedy.SETTING, (
                f'{_begun(what)}. If that is not so: {reason[0].lower()}{reason[1:]} '
                f'If it is so, set `{setting}`.')
        grade = Grade.WEAK if status is Status.OK else Grade.REJECT
        return status, replace(evidence.numbers, grade=grade, reason=reason, remedy=remedy)
    return Status.OK, replace(evidence.numbers, grade=Grade.GOOD, reason=_summary(evidence))


def _rejections(e: Evidence) -> Iterator[tuple[Status, Remedy, str]]:
    error = np.delete(e.numbers.error, e.fixed_outputs)
    if not (np.isfinite(e.poles).all() and np.isfinite(error).all()):
        yield Status.UNRELIABLE, Remedy.SIGNALS, Status.UNRELIABLE.value
    if count := len(e.fixed_outputs):
        fixed = ', '.join(e.output_names[i] for i in e.fixed_outputs)
        yield Status.NO_RESPONSE, Remedy.SIGNALS, (
            f'Output{"s" * (count > 1)} {fixed} do{"es" * (count == 1)} not move within the '
            'window; check that the sensor works.')
    for one in e.stuck:
        yield Status.NO_RESPONSE, Remedy.PART, (
            f'Output {e.output_names[one.output]} keeps exactly the same value '
            f'{after_start(one.start, one.end)}, although inputs move: the sensor is stuck, or '
            'its last value is repeated; take a part of the data in which it moves.')
    if e.change.cost > _CHANGED and not e.change.pushed:
        yield Status.CHANGED, Remedy.SPLIT, _changed(e)
    for i in _largest_first(e.numbers.coloured_error, _UNEXPLAINED):
        idle = _idle(e, i)
        yield Status.UNEXPLAINED, Remedy.EXCITE if idle else Remedy.SIGNALS, (
            f'No linear model explains {e.output_names[i]} by {_listed(e.input_names)}: what is '
            f'left, noise apart, is {_of_motion(e, i)}{e.worst}; '
            f'{idle or "check that these are the right signals"}.')
    # What follows nothing goes by itself.
    follows = (e.numbers.held_out_error < _DRIVEN * e.driven) & ~unsure(e.expected, e.fitted)
    for k in np.flatnonzero((e.numbers.response_uncertainty > _FOLLOWS) & ~follows).tolist():
        idle = _idle(e, k)
        yield Status.UNEXPLAINED, Remedy.EXCITE if idle else Remedy.SIGNALS, (
            f'Output {e.output_names[k]} does not follow the inputs ({_listed(e.input_names)})'
            f'{_within(e)}, as far as the noise lets see; ' + (
                idle or 'check that these are the right signals, that they move, and that the '
                'window is long enough') + '.')


def _idle(e: Evidence, i: int) -> str:
    """Return how to move the first input that does not move, or not by itself; if any."""
    wanted = f'if {e.output_names[i]} is to follow it'
    for j, one in enumerate(e.numbers.excitation):
        if j in e.fixed_inputs:
            return f'move input {one.name}, {wanted} (it does not move within the window)'
        if one.own < UNCORRELATED:
            return f'move input {one.name} independently of the others, {wanted} ({_shared(one)})'
    return ''


def _shared(one: Excitation) -> str:
    return f'only {round(100 * one.own, 2):g} % of its power is not correlated with theirs'


def _changed(e: Evidence) -> str:
    (a, b), (c, d) = e.change.one, e.change.two
    if not e.change.share:
        return (f'One model does not hold {e.where}: that of all fits it to {a:.0f} %, one of its '
                f'own to {c:.0f} %, and what the first misses and the other does not is '
                f'{e.change.cost:.0f} % of the motion; identify it by itself.')
    return (f'The plant changed {e.where}: one model fits {a:.0f} % before and {b:.0f} % after '
            f'that, two models {c:.0f} and {d:.0f} %, and what one misses and two do not is '
            f'{e.change.cost:.0f} % of the motion; identify each side by itself.')


def _drift(e: Evidence) -> str:
    """Return that the plant drifts, and how, in words."""
    if e.drift.jumps:
        gains = ', '.join(f'of {one.name} by {100.0 * one.gain:.0f} %' for one in e.drift.inputs)
        back = ' and come back' * bool(e.drift.span)
        return (f'gains change{e.drifting}{back} ({gains} around the mean, rms; {e.drift.jumps} '
                f'jumps explain it): constant ones miss {e.drift.cost:.1f} % of '
                'the motion; take windows in which they stay'
                + ', leaving that out if a command was lost there, or did not reach the robot'
                * bool(e.drift.span) + ' (if small commands are ignored, move the input more)')
    what, cure = ('the dead time drifts', f', or correct stamps by clocks that run apart '
                  f'({_BY_LOG})') if e.drift.late else ('the plant drifts', '')
    moves = ', '.join(f'the {name} of {one.name} by {value}' for one in e.drift.inputs
                      for name, value, size in (
                          ('gain', f'{100.0 * one.gain:+.0f} %', one.gain),
                          ('dead time', f'{one.late:+.2g} s', one.late)) if size)
    if moves and e.drift.moved ** 2 < 0.5 * e.drift.cost ** 2:
        moves += ', and an offset,'
    return (f'{what}{e.drifting}{f" ({moves} from start to end)" * bool(moves)}: constant numbers '
            f'miss {e.drift.cost:.1f} % of the motion that numbers on straight lines do not; the '
            f'model is of the mean: take shorter windows for what it is now{cure}')


def change_note(e: Evidence, reason: str) -> tuple[str, ...]:
    """Return sentences on what changes, drifts or jumps a little, if not the reason is one."""
    notes = []
    if e.change.cost > NOTED and not e.change.pushed:
        notes.append(f'perhaps the plant changed a little {e.where}: there one model misses '
                     f'{e.change.cost:.1f} % of the motion that two do not (up to {_CHANGED:.0f} '
                     'is accepted)')
    if e.drift.cost > NOTED and _drift(e)[1:] not in reason:
        notes.append(f'perhaps {_drift(e)}')
    if e.jumped and _jumps(e)[1:] not in reason:
        notes.append(_jumps(e))
    return tuple(notes)


def _faults(e: Evidence) -> Iterator[tuple[Remedy, str]]:
    """Yield what is wrong with the samples, whatever model they give."""
    for fault in e.faults:
        yield Remedy.RECORD, fault
    held = e.distance_to_controller < _CONTROLLER
    for j in _largest_first(np.where(held, 0.0, e.lead), 0.0):
        yield Remedy.SETTING, (
            f'{_begun(_leads(e, j))}: their clocks differ, or the input is stamped after it '
            f'acts; correct the stamps ({_BY_LOG}).')
    for j in np.flatnonzero(held).tolist():
        # Inputs that are computed from the outputs follow them as those do that are stamped late.
        late, first = (f', or {_leads(e, j)}, for it is stamped late',
                       'correct the stamps if there is no controller, else ') \
            if e.lead[j] else ('', '')
        yield Remedy.EXCITE, (
            f'The response to input {e.input_names[j]} is minus one over what computes it from '
            f'the outputs, to {100 * e.distance_to_controller[j]:.0f} %: a controller holds the '
            f'plant where it is, and hardly anything else moves the input{late}; {first}move the '
            'set point (in a recording: take a part in which it moves).')


def _jumps(e: Evidence) -> str:
    """Return that an output jumps by itself, in words."""
    return (f'{e.jumped}, and nothing else does: an offset of its sensor has jumped, or '
            'something struck the robot')


def _begun(text: str) -> str:
    return text[0].upper() + text[1:]


def _leads(e: Evidence, j: int) -> str:
    return f'outputs answer about {_about(e.lead[j])} s before input {e.input_names[j]} moves'


def _weaknesses(e: Evidence) -> Iterator[tuple[Remedy, str]]:
    yield from _faults(e)
    for j in np.flatnonzero(np.array(e.at_once) < _CONTROLLER).tolist():
        yield Remedy.SETTING, (
            f'Outputs tell at once how input {e.input_names[j]} moves, and the response to it is '
            f'minus one over that, to {100 * e.at_once[j]:.0f} %: it may be a controller that '
            'computes the input from outputs of the same instant; if outputs do not follow inputs '
            'at once, set `feedthrough: false`.')
    if e.stamp_sensitivity > _HINGES:
        yield Remedy.RECORD, (
            'The model hinges on the stamps: were outputs one interval earlier, the response '
            f'would change by {_percent(e.stamp_sensitivity)}; {_LATE}.')
    if e.unproven:
        yield Remedy.SETTING, (
            f'The model is unstable (a mode grows as exp({np.max(e.poles.real):.2g} t)), and a '
            'model that is not explains the data as well; set `method: hd-pbsid`.')
    if e.unheld:
        yield Remedy.SIGNALS, (
            f'A mode grows as exp({np.max(e.poles.real):.2g} t), and no input is seen to hold it: '
            'inputs rest for too long, or are not computed from the outputs; these may have been '
            'filtered forward and backward in time (filtfilt, a centred mean), or what holds the '
            'plant is not among the inputs; take what the sensor sent.')
    if e.drift.jumps and e.drift.moved > _CHANGED:
        yield Remedy.SPLIT, f'{_begun(_drift(e))}.'
    if e.change.gain > 0.0 == e.change.cost or e.change.pushed and e.change.cost > _CHANGED:
        yield Remedy.SPLIT, (
            f'It seems that the plant changed {e.where}, or for a while what moves it (a command '
            'that was lost, a push); simulations do not show which of them, or by how much: '
            'identify each side by itself.')
    if e.drift.moved > _DRIFTED:
        yield Remedy.SPLIT, f'{_begun(_drift(e))}.'
    for j in e.fixed_inputs:
        yield Remedy.SETTING, (
            f'Input {e.input_names[j]} does not move within the window, and its zero column of '
            'B and D is not measured; leave it out of `inputs`.')
    if e.doubt and e.doubt[1] == 'delay':
        yield Remedy.SETTING, (
            f'{_begun(e.doubt[0])}: it is a bound; set `delay`, or take a longer window.')
    if e.doubt and any(f'.{kind}: ' in e.doubt[1] for kind in Actuator._fields):
        # Before curves, which it makes, too
        yield Remedy.SETTING, f'{_begun(e.doubt[0])}; set `{e.doubt[1]}`.'
    # Before all that would advise to move more: what saturates has to move less.
    for i in _largest_first(e.numbers.curve_gain, _CURVED):
        yield Remedy.PART, (
            f'Output {e.output_names[i]} is not linear in the inputs: squares and cubes of these '
            'and of the outputs raise the fit within a tenth of the window by '
            f'{e.numbers.curve_gain[i]:.1f} %, so something saturates, sticks, strikes or is '
            'clipped; take a part of the data in which it moves less (more, if it sticks).')
    for one in e.numbers.excitation:
        if few_sines(one, len(e.poles)):
            count = min(round(one.frequencies), len(e.poles), _SINES)
            yield Remedy.EXCITE, (
                f'Nearly all of the motion of input {one.name} is at about {count} '
                f'{"frequency" if count == 1 else "frequencies"}, which fits many models; '
                'excite more frequencies (a sweep, steps, noise).')
        elif one.low == one.high:
            yield Remedy.EXCITE, (
                f'Nearly all of the response to input {one.name} is at '
                f'{one.low / (2.0 * np.pi):.2g} Hz, which fits many models; excite more '
                'frequencies (a sweep, steps, noise).')
    for one, apart in sorted(zip(e.numbers.excitation, e.apart, strict=False), key=lambda both:
                             np.nan_to_num(both[0].uncertainty, nan=np.inf), reverse=True):
        if not one.uncertainty <= KNOWN:
            alone = f'move it independently of the other inputs ({_shared(one)})'
            remedy, cure = (Remedy.EXCITE, alone) if one.own < UNCORRELATED else (
                Remedy.SIGNALS, 'a pole is as fast as any that is looked for: sample the outputs '
                'faster') if e.fastest else (Remedy.EXCITE, _more(
                    one.uncertainty, alone=len(e.input_names) == 1))
            otherwise = '' if one.uncertainty ** 2 - apart ** 2 > KNOWN ** 2 else (
                f', for models that may be as right are {_percent(apart)} away from it')
            yield remedy, (
                f'The response to input {one.name}{_within(e)} has a standard deviation of '
                f'{_percent(one.uncertainty)}{otherwise}; {cure}.')
    for i in _largest_first(e.numbers.coloured_error, DISTURBED):
        yield Remedy.SIGNALS, (
            f'The inputs explain little of output {e.output_names[i]}: what is left, noise '
            f'apart, is {_of_motion(e, i)}; find what else acts on it, and take it as an input.')
    if e.follows_at_once and e.doubt and e.doubt[1] == DIRECT:
        yield Remedy.SIGNALS, f'{_begun(_LATE)}.'
    if e.doubt and (e.doubt[1] == ANY_DELAY or OTHER_HOLD in e.doubt[1]):
        yield Remedy.SETTING, f'{_begun(e.doubt[0])}; set `{e.doubt[1]}`.'
    unseen = e.numbers.held_out_error
    for i in _largest_first(unseen / allowed(e.fitted), 1.0):
        yield Remedy.LONGER, (
            f'On the part of the window that was held out the error of output '
            f'{e.output_names[i]} is {_percent(unseen[i])} of its motion, on the rest '
            f'{_percent(e.fitted[i])}; take a longer window.')
    if e.wrapped:
        yield Remedy.SETTING, f'{_begun(e.wrapped[0])}; set `{e.wrapped[1]}`.'
    if e.spent:
        yield Remedy.SETTING, f'Not all is tested: {e.spent}.'
    # Last: new data lift this, and must not lift anything beside it (`in_sequence`).
    if not np.isfinite(e.expected).any():
        yield Remedy.TEST, (f'The model has not been tested on held-out data: {e.untested}; '
                            'test it on data that it has not seen.')


def few_sines(one: Excitation, states: int) -> bool:
    """Return whether an input is at no more frequencies than models of so many states fit."""
    return one.frequencies < min(states, _SINES) + _LEAKS


def _more(deviation: float, *, alone: bool) -> str:
    """Return how much more motion divides a deviation so often, and how much more time."""
    times = _SURELY * deviation / KNOWN
    cure = 'move it much more (as it moves: take a much longer window)'
    if times < 10.0:
        cure = f'move it {np.ceil(10.0 * times) / 10.0:.2g} times as much (as it moves: take a ' \
            f'window {np.ceil(10.0 * times ** 2) / 10.0:.3g} times as long)'
    return cure if alone or deviation < NONE else \
        f'if no output follows it, leave it out of `inputs`, else {cure}'


def _of_motion(e: Evidence, i: int) -> str:
    """Return how large what is left of an output is, noise apart, in words."""
    ahead = ' in the time that predictions are ahead' if e.by_prediction else ''
    return f'{100 * e.numbers.coloured_error[i]:.0f} % of its motion{ahead}'


def _largest_first(values: Array, limit: float) -> list[int]:
    """Return the places of values beyond a limit, the largest first: the reason names one."""
    order = np.argsort(-np.nan_to_num(values, nan=-np.inf), kind='stable')
    return [int(i) for i in order if values[i] > limit]


def tested(held_out: HeldOut, error: Array) -> Array:
    """Return the errors on the part held out; NaN where the rest cannot tell what to expect."""
    # A model that most of the motion leaves so uncertain has too many states, and is tested.
    return np.where(held_out.unseen & unsure(held_out.expected, error), np.nan, held_out.error)


def _about(value: float) -> str:
    """Return two digits of a number, and no power of ten of a hundred and more."""
    return f'{value:.2g}' if abs(value) < 99.5 else f'{value:.0f}'


def _percent(part: float) -> str:
    return f'{_about(100 * part)} %' if part <= 1.0 else 'more than 100 %'


def _summary(e: Evidence) -> str:
    deviation = max(x.uncertainty for x in e.numbers.excitation)
    held = np.nanmax(e.numbers.held_out_error, initial=-np.inf)
    ahead = ', 1 sample ahead,' if e.by_prediction else ''
    unseen = f'and the part held out{ahead} to {100 * (1 - float(held)):.1f} % ' \
        if held >= 0.0 else ''
    untested = '' if unseen else ' On the part held out a test could tell nothing.'
    does = 'predicts the window, 10 samples ahead,' if e.by_prediction else 'simulates the window'
    return (f'Every test is passed: the model {does} to '
            f'{100 * (1 - float(np.nanmax(e.numbers.error))):.1f} % {unseen}of the motion; the '
            f'response to each input{_within(e)} has a standard deviation of '
            f'{_percent(deviation)}{_of_poles(e.numbers.pole_uncertainty)}.{untested}')


def _of_poles(deviation: float) -> str:
    """Say how well poles are known, which a response that is known well need not tell."""
    if not np.isfinite(deviation):
        return ''
    alone = ': do not use that pole by itself' if deviation > KNOWN else ''
    return f', the least known pole one of {_percent(deviation)} of its size{alone}'


def _within(e: Evidence) -> str:
    return f' within {_about(e.within)} s' if e.within < np.inf else ''


def _listed(names: tuple[str, ...]) -> str:
    return ', '.join(names) if len(names) < 5 else f'{len(names)} signals'


def unusable_estimate(status: Status, record: Record, settings: Settings,
                      notes: tuple[str, ...] = (), failed: str = '',
                      spent: bool = False) -> Estimate:
    """
    Return the estimate that says why there is no model of a record.

    Nothing of it can be used, or something has `failed`, or the budget is `spent`.
    """
    remedy, reason = Remedy.SETTING, (
        f'The budget of {settings.budget:.3g} s is spent before there is a model'
        f'{f" of order {settings.order}" * (settings.order > 0)}; raise `budget`.')
    if not spent:
        remedy, reason = _why_unusable(status, record, failed, settings.order)
    return Estimate(status=status, settings=settings, notes=notes, verdict=replace(
        UNJUDGED, grade=Grade.REJECT, reason=reason, remedy=remedy))


def _why_unusable(status: Status, record: Record, failed: str, order: int) -> tuple[Remedy, str]:
    """Return why nothing of a record can be used, with the names that matter."""
    remedy, reason = REMEDIES.get(status, Remedy.SIGNALS), str(status.value)
    if failed:
        reason = (f'The arithmetic failed ({failed}); check the signals, their sizes and units, '
                  'and that the window is long enough.')
    elif status is Status.NO_EXCITATION:
        silent = next((record.input_names[k.start].partition('[')[0] for s, k in placed(
            record.inputs) if np.any(silent_between(
                s, record.start, record.end, np.zeros(s.width)))), '')
        cure = f'if a timeout stops the robot while {silent} is silent, set `{silent}.timeout`' \
            if silent else 'choose a part of the data in which they move'
        reason = f'No input moves within the window ({", ".join(record.input_names)}); {cure}.'
        remedy = Remedy.SETTING if silent else remedy
    elif status is Status.NO_RESPONSE:
        reason = (f'No output moves within the window ({", ".join(record.output_names)}); check '
                  'that the sensors work.')
    elif status is Status.TOO_SHORT and (few := sparse(record)):
        reason = (f'The window holds too few samples of {", ".join(few)} that can be used (less '
                  f'than {FEWEST}); ')
        if is_short(record):
            reason += 'take a longer window.'
        else:
            remedy, reason = Remedy.SIGNALS, f'{reason}check that they come, and are finite.'
    elif status is Status.TOO_SHORT and order:
        remedy, reason = Remedy.SETTING, (
            f'The window is too short for a model of order {order}; set `order: 0`, or take a '
            'longer window.')
    return remedy, reason


def weakened(verdict: Verdict) -> Verdict:
    """Return a verdict, WEAK instead of GOOD if a second method contradicts."""
    seen = verdict.agreement
    if verdict.grade is not Grade.GOOD or seen is None or not seen.contradicts:
        return verdict
    remedy = Remedy.SETTING if seen.late and not seen.problem else Remedy.COMPARE
    return replace(verdict, grade=Grade.WEAK, reason=seen.weakness, remedy=remedy)


def retested(estimate: Estimate, failed: str) -> Estimate:
    """Return an estimate, WEAK instead of GOOD if its model has failed on unseen data."""
    if not failed or not estimate.good:
        return estimate
    return replace(estimate, verdict=replace(
        estimate.verdict, grade=Grade.WEAK, remedy=Remedy.SPLIT,
        reason=f'{_begun(failed)}; make a model of each by itself.'))


def rejected_over_change(estimate: Estimate, share: float) -> Estimate:
    """
    Return an estimate rejected, because an earlier window has shown a change within this one.

    It has a model; `share` is the part of its window before the change.
    """
    at = after_start(share * 1e-9 * (estimate.end_ns - estimate.start_ns))
    words = f'an earlier window has shown a change of the plant about {at}'
    return replace(
        estimate, status=Status.CHANGED, model=None, rejected_model=estimate.model,
        notes=(*estimate.notes, words), verdict=replace(
            estimate.verdict, grade=Grade.REJECT, remedy=Remedy.WAIT,
            reason=f'{words.capitalize()}; wait until the change has left the window.'))


def in_sequence(estimate: Estimate, fresh_fit: Array, fresh_ratio: Array, apart: Array,
                silent: tuple[tuple[str, float], ...] = ()) -> Estimate:
    """
    Return an estimate whose verdict takes the previous model, and what is new, into account.

    Fresh fit and ratio, (ny,), are those of that model on the data that are new, NaN if not known;
    `apart`: see `Verdict`. `silent`: channels that end long before the window, and by how much
    [s].
    """
    verdict = replace(estimate.verdict, fresh_ratio=fresh_ratio, apart=apart)
    model = estimate.model
    if model is None:
        return replace(estimate, verdict=verdict)
    reasons = [*_silences(silent), *_collapses(model.output_names, fresh_fit, fresh_ratio),
               *_disagreements(model.output_names, apart)]
    untested = verdict.grade is Grade.WEAK and verdict.remedy is Remedy.TEST
    if untested and (reasons or _well(fresh_fit, fresh_ratio)):
        verdict = weakened(replace(
            verdict, grade=Grade.GOOD, remedy=Remedy.TEST, reason='Every test is passed; the '
            'previous model simulates the new data of this window well'
            f'{_of_poles(verdict.pole_uncertainty)}.'))
    if verdict.grade is Grade.GOOD and reasons:
        remedy, reason = reasons[0]
        verdict = replace(verdict, grade=Grade.WEAK, reason=reason, remedy=remedy)
    return replace(estimate, verdict=verdict)


def _silences(silent: tuple[tuple[str, float], ...]) -> Iterator[tuple[Remedy, str]]:
    for name, seconds in silent:
        yield Remedy.SIGNALS, (
            f'No sample of {name} has come in the last {seconds:.3g} s of the window, so that the '
            'model is of the time before; check the sensor.')


def _well(fit: Array, ratio: Array) -> bool:
    """Return whether the previous model simulates well what is new, of outputs with enough."""
    well = (ratio <= _FRESH_RATIO) & (fit >= EXPLAINED) | (fit >= _FRESH_FIT)
    known = np.isfinite(fit)
    return bool(known.any() and well[known].all())


def _collapses(names: tuple[str, ...], fit: Array, ratio: Array) -> Iterator[tuple[Remedy, str]]:
    collapsed = np.where(np.isfinite(ratio), (ratio > _FRESH_RATIO) & (fit < _FRESH_FIT),
                         fit < EXPLAINED)
    for i in np.flatnonzero(collapsed):
        yield Remedy.WAIT, (
            f'The previous model simulates the new data of output {names[i]} badly (its fit there '
            f'is {max(fit[i], -999.0):.0f} %{_times(ratio[i])}), as after a change of the plant; '
            f'{_WAIT}.')


def _times(ratio: float) -> str:
    return f', its error {ratio:.1f} times that on older data' if np.isfinite(ratio) else ''


def _disagreements(names: tuple[str, ...], apart: Array) -> Iterator[tuple[Remedy, str]]:
    for i in np.flatnonzero(apart > _APART):
        yield Remedy.WAIT, (
            f'This model and the previous one simulate output {names[i]} of this window '
            f'{_percent(float(apart[i]))} of its motion apart; {_WAIT}.')
