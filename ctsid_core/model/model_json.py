# SPDX-License-Identifier: Apache-2.0
"""
Estimates as JSON text, format 'ctsid-model', version 2.

Strict JSON that describes itself: matrices are lists of rows, numbers keep all of their bits, NaN
is null, infinities are the words "Infinity" and "-Infinity" (JSON has neither). `equations`,
`message`, each model's `poles` and `deviations` are for other readers; from_json() computes them
itself, and refuses poles that are not those of A. `covariance` is that of the entries of A, B, C,
D (row by row) and the dead times: root^T root.

A reader refuses what it does not know: another format, a newer version, missing and unknown keys.
Only parameters of identification that are missing take their defaults, so that files outlive the
arrival of new ones; and a model without a verdict is one that nobody has judged, which is WEAK.
Version 1 had other numbers in the verdict: those that are gone are left out, new ones not known.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from enum import Enum
import json
import math
from typing import Any

import numpy as np

from ctsid_core.errors import DataError, SettingsError, StorageError
from ctsid_core.linear.types import Array
from ctsid_core.model.covariance import Covariance, Rival
from ctsid_core.model.cross_check_result import Agreement
from ctsid_core.model.estimate import (
    REMEDIES,
    Choice,
    Estimate,
    OrderTried,
    RecordShare,
    Status,
)
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.verdict import UNJUDGED, Excitation, Grade, Remedy, Verdict
from ctsid_core.settings import Settings

FORMAT = 'ctsid-model'
VERSION = 2
EQUATIONS = ('dx/dt = A x + B u(t - delay) + x_trim + K e;  '
             'y = C x + D u(t - delay) + y_trim + e;  time in s, poles in rad/s')

TOP_KEYS = ('format', 'version', 'equations', 'status', 'message', 'verdict', 'start_ns', 'end_ns',
            'model', 'rejected_model', 'pole_std', 'deviations', 'covariance', 'fit',
            'held_out_fit', 'singular_values', 'condition', 'statistics', 'choices', 'notes',
            'settings', 'metadata')
RECORD_KEYS = ('number', 'start_ns', 'end_ns', 'x_trim', 'y_trim', 'fit', 'weight')  # of several
ORDER_KEYS = ('order', 'criterion', 'fit')  # if the order was chosen
AGREEMENT_KEYS = tuple(f.name for f in fields(Agreement))  # if a second method was asked
MATRICES = {'A': ('n', 'n'), 'B': ('n', 'nu'), 'C': ('ny', 'n'), 'D': ('ny', 'nu'),
            'K': ('n', 'ny'), 'x_trim': ('n',), 'y_trim': ('ny',), 'delay': ('nu',)}
WORDS = {'input_names': 'nu', 'input_units': 'nu', 'output_names': 'ny', 'output_units': 'ny'}
DEVIATIONS = ('natural_frequency_std', 'damping_std', 'dc_gain_std', 'delay_std')
COVARIANCE_KEYS = ('n', 'nu', 'ny', 'root')  # beside `rivals`
MODEL_KEYS = ('n', 'nu', 'ny', *WORDS, *MATRICES, 'noise', 'poles')
_SAME_POLE = 1e-3  # of the largest: other computers find multiple poles a little elsewhere
POLE_KEYS = ('re', 'im', 'natural_frequency', 'damping')
SCALARS = ('pole_uncertainty', 'change_cost', 'moved')  # of a verdict; the others are rows
GONE = ('missing', 'missing_p_value', 'next_ratio', 'held_out_fit')  # of version 1


def to_json(estimate: Estimate, metadata: Mapping[str, object] | None = None) -> str:
    """
    Return an estimate as JSON text; the same estimate gives the same text.

    Parameters
    ----------
    estimate : Estimate
    metadata : mapping, optional
        What else to keep: names to words, numbers, lists or mappings of them.
    """
    document = {
        'format': FORMAT, 'version': VERSION, 'equations': EQUATIONS,
        'status': estimate.status.name, 'message': estimate.status.value,
        'verdict': describe(estimate.verdict),
        'start_ns': int(estimate.start_ns), 'end_ns': int(estimate.end_ns),
        'model': _model(estimate.model), 'rejected_model': _model(estimate.rejected_model),
        'pole_std': estimate.pole_std,
        'deviations': {key: getattr(estimate, key) for key in DEVIATIONS},
        'covariance': _covariance(estimate.covariance), 'fit': estimate.fit,
        'held_out_fit': estimate.held_out_fit, 'singular_values': estimate.singular_values,
        'condition': estimate.condition, 'statistics': estimate.statistics,
        'choices': [{'name': c.name, 'value': c.value, 'why': c.why} for c in estimate.choices],
        'notes': estimate.notes, 'settings': estimate.settings.to_dict(),
        'metadata': dict(metadata or {})}
    if estimate.records:
        document['records'] = [{key: getattr(r, key) for key in RECORD_KEYS}
                               for r in estimate.records]
    if estimate.orders:
        document['orders'] = [{key: getattr(o, key) for key in ORDER_KEYS}
                              for o in estimate.orders]
    return _text(_plain(document)) + '\n'


def from_json(text: str) -> Estimate:
    """
    Return the estimate that `to_json` has written, equal to the last bit.

    Raises
    ------
    StorageError
        If the text is not such a document, or of a version that this ctsid cannot read.
    """
    return parse(text)[0]


def parse(text: str) -> tuple[Estimate, dict[str, object]]:
    """Return estimate and metadata; raises like `from_json`."""
    document = _document(text)
    status = _status(document['status'])
    model = _read_model(document['model'], 'model')
    if (model is not None) != (status is Status.OK):
        raise StorageError(f'`status` is {status.name} but `model` is '
                           f'{"given" if model else "null"}; they contradict each other, so the '
                           'file was changed by hand: write it again')
    remedy = Remedy.TEST if model else REMEDIES.get(status, Remedy.SIGNALS)
    unjudged = UNJUDGED if model else replace(UNJUDGED, grade=Grade.REJECT, reason=status.value,
                                              remedy=remedy)
    verdict = read_verdict(document['verdict'], remedy) if 'verdict' in document else unjudged
    if (verdict.grade is Grade.REJECT) != (model is None):
        raise StorageError(f'`verdict` is {verdict.grade.name} but `model` is '
                           f'{"given" if model else "null"}; they contradict each other, so the '
                           'file was changed by hand: write it again')
    vectors: dict[str, Any] = {key: _numbers(document[key], key, nan=True) for key in
               ('pole_std', 'fit', 'held_out_fit', 'singular_values')}
    if model is not None:
        for key, count in (('pole_std', model.n), ('fit', model.ny), ('held_out_fit', model.ny)):
            if len(vectors[key]) not in (0, count):
                raise StorageError(f'`{key}` has {len(vectors[key])} numbers, but the model '
                                   f'wants {count}')
    rejected = _read_model(document['rejected_model'], 'rejected_model')
    covariance = _read_covariance(document['covariance'], model or rejected)
    statistics = _object(document['statistics'], 'statistics')
    metadata = _object(document['metadata'], 'metadata')
    return Estimate(
        status=status, settings=_read_settings(document['settings']), model=model,
        rejected_model=rejected, covariance=covariance, **vectors,
        condition=_number(document['condition'], 'condition', nan=True),
        choices=tuple(_read_choice(c, i) for i, c in enumerate(_list(document, 'choices'))),
        notes=tuple(_word(w, f'notes[{i}]') for i, w in enumerate(_list(document, 'notes'))),
        start_ns=_integer(document, 'start_ns'), end_ns=_integer(document, 'end_ns'),
        statistics={k: _number(v, f'statistics.{k}', nan=True) for k, v in statistics.items()},
        verdict=verdict,
        records=tuple(_read_record(r, i) for i, r in enumerate(
            _list(document, 'records') if 'records' in document else [])),
        orders=tuple(_read_order(o, i) for i, o in enumerate(
            _list(document, 'orders') if 'orders' in document else [])),
    ), metadata


def describe(verdict: Verdict) -> dict[str, object]:
    """Return a verdict as words, numbers, and lists and mappings of them."""
    found: dict[str, object] = {f.name: getattr(verdict, f.name) for f in fields(Verdict)}
    found['grade'], found['remedy'] = verdict.grade.name, verdict.remedy.name
    agreement = found.pop('agreement')
    if agreement is not None:
        found['agreement'] = {key: getattr(agreement, key) for key in AGREEMENT_KEYS}
    found['excitation'] = [{'input': x.name, 'low': x.low, 'high': x.high,
                            'frequencies': x.frequencies, 'own': x.own,
                            'uncertainty': x.uncertainty}
                           for x in verdict.excitation]
    return found


def _model(model: StateSpace | None) -> dict[str, object] | None:
    if model is None:
        return None
    poles = zip(model.poles.real, model.poles.imag, model.natural_frequency, model.damping,
                strict=True)
    return {'n': model.n, 'nu': model.nu, 'ny': model.ny,
            **{key: getattr(model, key) for key in (*WORDS, *MATRICES, 'noise')},
            'poles': [dict(zip(POLE_KEYS, pole, strict=True)) for pole in poles]}


def _covariance(covariance: Covariance | None) -> dict[str, object] | None:
    if covariance is None:
        return None
    return {**{key: getattr(covariance, key) for key in COVARIANCE_KEYS},
            'rivals': [{'share': share, 'model': _model(model)}
                       for share, model in covariance.rivals]}


def _plain(value: Any) -> Any:
    # To what JSON has words for
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else 'Infinity' if value > 0 else '-Infinity'
    if isinstance(value, Enum):
        return value.name
    return value if value is None or isinstance(value, str | bool | int | float) else str(value)


def _text(value: Any, indent: str = '') -> str:
    # One line per entry, row or long sentence; short lists on one line
    if isinstance(value, dict) and value:
        lines = [f'{_line(k)}: {_text(v, indent + "  ")}' for k, v in value.items()]
    elif isinstance(value, list) and any(isinstance(v, dict | list | str) for v in value) and (
            len(_line(value)) > 70 or not isinstance(value[0], str)):
        lines = [_line(v) for v in value]
    else:
        return _line(value)
    ends = '{}' if isinstance(value, dict) else '[]'
    body = ',\n'.join(f'{indent}  {line}' for line in lines)
    return f'{ends[0]}\n{body}\n{indent}{ends[1]}'


def _line(value: Any) -> str:
    return json.dumps(value, allow_nan=False)


def _document(text: str) -> dict[str, Any]:
    try:
        document = json.loads(text, parse_constant=_refuse_constant,
                              object_pairs_hook=_without_twins)
    except StorageError:
        raise
    except (ValueError, RecursionError) as error:
        raise StorageError(f'not JSON, or cut off ({error}); copy or write the file again'
                           ) from error
    if not isinstance(document, dict) or document.get('format') != FORMAT:
        found = document.get('format') if isinstance(document, dict) else None
        raise StorageError(f'not a {FORMAT} file (`format` is {found!r}); choose a model.json '
                           'that ctsid has written')
    version = document.get('version')
    if not isinstance(version, int) or isinstance(version, bool) or version < 1:
        raise StorageError(f'`version` is {version!r}, wanted is {VERSION}; write the file again')
    if version > VERSION:
        raise StorageError(f'written by a newer ctsid (`version` {version}; this one reads up to '
                           f'{VERSION}); upgrade ctsid')
    if version == 1:
        _upgrade(document)
    optional = tuple(key for key in ('records', 'orders') if key in document)
    _check_keys({'verdict': None, **document}, (*TOP_KEYS, *optional), '')
    return document


def _upgrade(document: dict[str, Any]) -> None:
    """Turn a document of version 1 into one of today."""
    verdict = document.get('verdict')
    changed: list[Any] = [verdict, *(document.get('orders') or [])]
    if isinstance(verdict, dict):
        verdict.update({f.name: None if f.name in SCALARS else [] for f in fields(Verdict)
                        if f.name not in verdict and f.name != 'agreement'})
        seen = verdict.get('agreement')
        if isinstance(seen, dict):      # then every difference within its deviations agreed
            seen.update({'contradicts': not seen.get('agrees'), 'difference': None,
                         'difference_std': None})
            if seen.get('agrees') is True:
                seen['agrees'] = False  # today that is no agreement by itself
    for found in changed:
        for key in GONE:
            if isinstance(found, dict):
                found.pop(key, None)


def _refuse_constant(word: str) -> None:
    raise StorageError(f'holds {word}, which JSON does not know; write null for an unknown number')


def _without_twins(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [k for k, _ in pairs]
        twins = sorted({k for k in names if names.count(k) > 1})
        raise StorageError(f'the key {", ".join(map(repr, twins))} occurs twice; keep one')
    return found


def _check_keys(found: Mapping[str, Any], wanted: tuple[str, ...], where: str) -> None:
    place = f' in `{where}`' if where else ''
    faults = [f'{what}: {", ".join(keys)}' for what, keys in (
        ('missing', [k for k in wanted if k not in found]),
        ('unknown', [k for k in found if k not in wanted])) if keys]
    if faults:
        raise StorageError(f'keys{place} do not match version {VERSION} of the format '
                           f'({"; ".join(faults)}); write the file again')


def _object(value: Any, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise StorageError(f'`{where}` is {_shown(value)}, but an object is wanted')
    return value


def _list(document: Mapping[str, Any], key: str) -> list[Any]:
    if not isinstance(document[key], list):
        raise StorageError(f'`{key}` is {_shown(document[key])}, but a list is wanted')
    return list(document[key])


def _word(value: Any, where: str) -> str:
    if not isinstance(value, str):
        raise StorageError(f'`{where}` is {_shown(value)}, but a word is wanted')
    return value


def _integer(document: Mapping[str, Any], key: str) -> int:
    value = document[key]
    if not isinstance(value, int) or isinstance(value, bool):
        raise StorageError(f'`{key}` is {_shown(value)}, but a whole number is wanted')
    return value


def _number(value: Any, where: str, *, nan: bool) -> float:
    words = {None: math.nan, 'Infinity': math.inf, '-Infinity': -math.inf}
    if nan and (value is None or isinstance(value, str)) and value in words:
        return words[value]
    good = isinstance(value, int | float) and not isinstance(value, bool)
    try:
        number = float(value) if good else math.nan
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise StorageError(f'`{where}` is {_shown(value)}, but a finite number is wanted')
    return number


def _shown(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) < 40 else text[:36] + ' ...'


def _numbers(value: Any, where: str, shape: tuple[int, ...] | None = None, *,
             nan: bool = False) -> Array:
    if not isinstance(value, list):
        raise StorageError(f'`{where}` is {_shown(value)}, but a list of numbers is wanted')
    shape = (len(value),) if shape is None else shape
    if len(value) != shape[0]:
        raise StorageError(f'`{where}` has {len(value)} entries, but '
                           f'{" by ".join(map(str, shape))} numbers are wanted')
    entries: list[Any] = [
        _number(v, f'{where}[{i}]', nan=nan) if len(shape) == 1 else
        _numbers(v, f'{where}[{i}]', shape[1:], nan=nan) for i, v in enumerate(value)]
    return np.array(entries, dtype=float).reshape(shape)


def _read_model(found: Any, where: str) -> StateSpace | None:
    if found is None:
        return None
    found = _object(found, where)
    _check_keys(found, MODEL_KEYS, where)
    size = {key: _integer(found, key) for key in ('n', 'nu', 'ny')}
    if min(size.values()) < 0:
        raise StorageError(f'`{where}` has negative dimensions {size}')
    given: dict[str, Any] = {
        key: _numbers(found[key], f'{where}.{key}', tuple(size[s] for s in shape))
        for key, shape in MATRICES.items()}
    for key in WORDS:
        given[key] = tuple(_word(w, f'{where}.{key}[{i}]')
                           for i, w in enumerate(_list(found, key)))
    if found['noise'] is not None:
        given['noise'] = _numbers(found['noise'], f'{where}.noise', (size['ny'],) * 2)
    try:
        model = StateSpace(**given)
    except DataError as error:
        raise StorageError(f'`{where}`: {error}') from error
    _check_poles(_list(found, 'poles'), model, where)
    return model


def _check_poles(listed: list[Any], model: StateSpace, where: str) -> None:
    """Raise unless the poles that are listed are those of A; `pole_std` is of these."""
    try:
        poles = np.array([complex(pole['re'], pole['im']) for pole in listed])
    except (TypeError, KeyError) as error:
        raise StorageError(f'`{where}.poles` is not a list of poles with `re` and `im`; write the '
                           'file again') from error
    gaps = np.abs(poles[:, np.newaxis] - model.poles)
    near = _SAME_POLE * np.abs(model.poles).max(initial=0.0)
    same = len(poles) == model.n == 0 or (len(poles) == model.n and all(
        np.all(gaps.min(axis) <= near) for axis in (0, 1)))
    if not same:
        raise StorageError(f'`{where}.poles` are not the eigenvalues of `{where}.A`; they '
                           'contradict each other, so the file was changed by hand: write it '
                           'again')


def _read_covariance(found: Any, model: StateSpace | None) -> Covariance | None:
    if found is None:
        return None
    found = _object(found, 'covariance')
    _check_keys({'rivals': [], **found}, (*COVARIANCE_KEYS, 'rivals'), 'covariance')
    size = {key: _integer(found, key) for key in ('n', 'nu', 'ny')}
    if model is None or size != {'n': model.n, 'nu': model.nu, 'ny': model.ny}:
        raise StorageError(f'`covariance` is of {size}, and that is not the model; write the file '
                           'again')
    rows, entries = _list(found, 'root'), Covariance.entry_count(**size)
    rivals = _list(found, 'rivals') if 'rivals' in found else []
    try:
        return Covariance(_numbers(rows, 'covariance.root', (len(rows), entries)), **size,
                          rivals=tuple(_read_rival(r, i) for i, r in enumerate(rivals)))
    except DataError as error:
        raise StorageError(f'`covariance`: {error}') from error


def _read_rival(found: Any, index: int) -> Rival:
    where = f'covariance.rivals[{index}]'
    found = _object(found, where)
    _check_keys(found, ('share', 'model'), where)
    model = _read_model(found['model'], f'{where}.model')
    if model is None:
        raise StorageError(f'`{where}.model` is null; write the file again')
    return Rival(_number(found['share'], f'{where}.share', nan=False), model)


def _status(name: Any) -> Status:
    if not isinstance(name, str) or name not in Status.__members__:
        raise StorageError(f'`status` is {_shown(name)}; this ctsid knows '
                           f'{", ".join(Status.__members__)}: upgrade it')
    return Status[name]


def read_verdict(found: Any, default: Remedy = Remedy.TEST) -> Verdict:
    """
    Return the verdict that `describe` has described, after a way through JSON.

    Raises
    ------
    StorageError
        If it is none.
    """
    found = _object(found, 'verdict')
    _check_keys({'agreement': None, 'remedy': None, **found},
                tuple(f.name for f in fields(Verdict)), 'verdict')
    grade = found['grade']
    if not isinstance(grade, str) or grade not in Grade.__members__:
        raise StorageError(f'`verdict.grade` is {_shown(grade)}; this ctsid knows '
                           f'{", ".join(Grade.__members__)}: upgrade it')
    numbers: dict[str, Any] = {
        key: _number(value, f'verdict.{key}', nan=True) if key in SCALARS else
        _numbers(value, f'verdict.{key}', nan=True)
        for key, value in found.items()
        if key not in ('grade', 'reason', 'remedy', 'excitation', 'agreement')}
    remedy = found.get('remedy', default.name)
    if not isinstance(remedy, str) or remedy not in Remedy.__members__:
        raise StorageError(f'`verdict.remedy` is {_shown(remedy)}; this ctsid knows '
                           f'{", ".join(Remedy.__members__)}: upgrade it')
    return Verdict(
        grade=Grade[grade], reason=_word(found['reason'], 'verdict.reason'),
        remedy=Remedy[remedy],
        excitation=tuple(_read_excitation(x, f'verdict.excitation[{i}]')
                         for i, x in enumerate(_list(found, 'excitation'))),
        agreement=_read_agreement(found['agreement']) if 'agreement' in found else None,
        **numbers)


def _read_excitation(found: Any, where: str) -> Excitation:
    found = _object(found, where)
    names = ('low', 'high', 'frequencies', 'own', 'uncertainty')
    _check_keys(found, ('input', *names), where)
    return Excitation(_word(found['input'], f'{where}.input'),
                      **{key: _number(found[key], f'{where}.{key}', nan=True) for key in names})


def _read_agreement(found: Any) -> Agreement:
    where = 'verdict.agreement'
    found = _object(found, where)
    _check_keys(found, AGREEMENT_KEYS, where)
    answers, words = ('agrees', 'contradicts'), ('method', 'input', 'late', 'problem')
    for key in answers:
        if not isinstance(found[key], bool):
            raise StorageError(f'`{where}.{key}` is {_shown(found[key])}, but true or false is '
                               'wanted')
    known: dict[str, Any] = {
        key: value if key in answers else _word(value, f'{where}.{key}') if key in words else
        _number(value, f'{where}.{key}', nan=True) for key, value in found.items()}
    return Agreement(**known)


def _read_settings(found: Any) -> Settings:
    try:
        return Settings.from_dict(_object(found, 'settings'))
    except SettingsError as error:
        raise StorageError(f'`settings`: {error}') from error


def _read_choice(found: Any, index: int) -> Choice:
    where = f'choices[{index}]'
    found = _object(found, where)
    _check_keys(found, ('name', 'value', 'why'), where)
    return Choice(_word(found['name'], f'{where}.name'), _tuples(found['value']),
                  _word(found['why'], f'{where}.why'))


def _read_record(found: Any, index: int) -> RecordShare:
    where = f'records[{index}]'
    found = _object(found, where)
    _check_keys(found, RECORD_KEYS, where)
    whole = {key: _integer(found, key) for key in ('number', 'start_ns', 'end_ns')}
    rows = {key: _numbers(found[key], f'{where}.{key}', nan=key == 'fit')
            for key in ('x_trim', 'y_trim', 'fit')}
    return RecordShare(whole['number'], whole['start_ns'], whole['end_ns'], rows['x_trim'],
                       rows['y_trim'], rows['fit'],
                       _number(found['weight'], f'{where}.weight', nan=False))


def _read_order(found: Any, index: int) -> OrderTried:
    where = f'orders[{index}]'
    found = _object(found, where)
    _check_keys(found, ORDER_KEYS, where)
    return OrderTried(_integer(found, 'order'), *(
        _number(found[key], f'{where}.{key}', nan=True) for key in ORDER_KEYS[1:]))


def _tuples(value: Any) -> Any:
    return tuple(_tuples(v) for v in value) if isinstance(value, list) else value
