# SPDX-License-Identifier: Apache-2.0
"""
Estimates as JSON text, format 'ctsid-model', version 2.

Strict JSON that describes itself: matrices are lists of rows, numbers keep all of their bits (see
`json_values` for those that JSON does not know). `equations`, `message`, each model's `poles` and
`deviations` are for other readers; from_json() computes them itself, and refuses poles that are
not those of A. `covariance` is that of the entries of A, B, C, D (row by row) and the dead times:
root^T root.

A reader refuses what it does not know: another format, a newer version, missing and unknown keys.
Only parameters of identification that are missing take their defaults, so that files outlive the
arrival of new ones; and a model without a verdict is one that nobody has judged, which is WEAK.
Version 1 had other numbers in the verdict: those that are gone are left out, new ones not known.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from ctsid_core.errors import DataError, SettingsError, StorageError
from ctsid_core.model import json_values as read
from ctsid_core.model.covariance import Covariance, Rival
from ctsid_core.model.estimate import REMEDIES, Choice, Estimate, OrderTried, RecordShare, Status
from ctsid_core.model.json_values import Reader, from_text, to_text
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.verdict import Agreement, Excitation, Grade, Remedy, Verdict
from ctsid_core.settings import Actuator, Settings
from ctsid_core.signals.actuators import by_kind

FORMAT = 'ctsid-model'
VERSION = 2
EQUATIONS = ('dx/dt = A x + B u(t - delay) + x_trim + K e;  '
             'y = C x + D u(t - delay) + y_trim + e;  time in s, poles in rad/s')

SIZES = ('n', 'nu', 'ny')
MATRICES = {'A': ('n', 'n'), 'B': ('n', 'nu'), 'C': ('ny', 'n'), 'D': ('ny', 'nu'),
            'K': ('n', 'ny'), 'x_trim': ('n',), 'y_trim': ('ny',), 'delay': ('nu',)}
WORDS = ('input_names', 'input_units', 'output_names', 'output_units')
DEVIATIONS = ('natural_frequency_std', 'damping_std', 'dc_gain_std', 'delay_std')
EXCITATION = ('low', 'high', 'frequencies', 'own', 'uncertainty')  # beside the input's name
_SAME_POLE = 1e-3  # of the largest: other computers find multiple poles a little elsewhere
GONE = ('missing', 'missing_p_value', 'next_ratio', 'held_out_fit', 'moved')  # of version 1


def to_json(estimate: Estimate, metadata: Mapping[str, object] | None = None) -> str:
    """
    Return an estimate as JSON text; the same estimate gives the same text.

    Metadata are what else to keep: names to words, numbers, lists or mappings of them.
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
        'choices': [vars(c) for c in estimate.choices], 'notes': estimate.notes,
        'settings': estimate.settings.to_dict(), 'metadata': dict(metadata or {})}
    if estimate.records:
        document['records'] = [vars(r) for r in estimate.records]
    if estimate.orders:
        document['orders'] = [vars(o) for o in estimate.orders]
    return to_text(document) + '\n'


def describe(verdict: Verdict) -> dict[str, object]:
    """Return a verdict as words, numbers, and lists and mappings of them."""
    found = {**vars(verdict), 'grade': verdict.grade.name, 'remedy': verdict.remedy.name}
    agreement = found.pop('agreement')
    if agreement is not None:
        found['agreement'] = vars(agreement)
    found['excitation'] = [{'input': x.name, **{key: getattr(x, key) for key in EXCITATION}}
                           for x in verdict.excitation]
    return found


def _model(model: StateSpace | None) -> dict[str, object] | None:
    if model is None:
        return None
    poles = zip(model.poles.real, model.poles.imag, model.natural_frequency, model.damping,
                strict=True)
    return {**{key: getattr(model, key) for key in (*SIZES, *WORDS, *MATRICES, 'noise')},
            **by_kind(model.actuators),
            'poles': [dict(zip(('re', 'im', 'natural_frequency', 'damping'), pole, strict=True))
                      for pole in poles]}


def _covariance(covariance: Covariance | None) -> dict[str, object] | None:
    if covariance is None:
        return None
    return {**{key: getattr(covariance, key) for key in (*SIZES, 'root')},
            'rivals': [{'share': share, 'model': _model(model)}
                       for share, model in covariance.rivals]}


def from_json(text: str) -> Estimate:
    """
    Return the estimate that `to_json` has written, equal to the last bit.

    Raises `StorageError` if the text is none, or of a version that this ctsid cannot read.
    """
    return parse(text)[0]


def parse(text: str) -> tuple[Estimate, dict[str, object]]:
    """Return estimate and metadata; raises like `from_json`."""
    found = read.entries(_document(text), '', TOP, ('verdict', 'records', 'orders'))
    model, status, metadata = found['model'], found['status'], found.pop('metadata')
    _agreeing('status', status.name, status is Status.OK, model)
    if 'verdict' in found:      # else it is made so
        found['verdict'] = verdict = read_verdict(
            found['verdict'], Remedy.TEST if model else REMEDIES.get(status, Remedy.SIGNALS))
        _agreeing('verdict', verdict.grade.name, verdict.grade is not Grade.REJECT, model)
    if model is not None:
        for key, count in (('pole_std', model.n), ('fit', model.ny), ('held_out_fit', model.ny)):
            if len(found[key]) not in (0, count):
                raise StorageError(f'`{key}` has {len(found[key])} numbers, but the model '
                                   f'wants {count}')
    covariance = _read_covariance(found['covariance'], model or found['rejected_model'])
    kept = {f.name: found[f.name] for f in fields(Estimate) if f.name in found}
    return Estimate(**{**kept, 'covariance': covariance}), metadata


def _agreeing(key: str, name: str, accepted: bool, model: StateSpace | None) -> None:
    if accepted != (model is not None):
        raise StorageError(f'`{key}` is {name} but `model` is {"given" if model else "null"}; '
                           'they contradict each other, so the file was changed by hand: write '
                           'it again')


def _document(text: str) -> dict[str, Any]:
    document = from_text(text)
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
    return document


def _upgrade(document: dict[str, Any]) -> None:
    """Turn a document of version 1 into one of today."""
    verdict = document.get('verdict')
    changed: list[Any] = [verdict, *(document.get('orders') or [])]
    if isinstance(verdict, dict):
        verdict.update({f.name: None if f.type == 'float' else [] for f in fields(Verdict)
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


def _read_model(value: Any, where: str) -> StateSpace | None:
    if value is None:
        return None
    found = read.mapping(value, where)
    size = {key: read.whole(found.get(key), f'{where}.{key}') for key in SIZES}
    if min(size.values()) < 0:
        raise StorageError(f'`{where}` has negative dimensions {size}')
    ny, some = size['ny'], found.get('noise') is not None
    given = read.entries(found, where, {
        **dict.fromkeys((*SIZES, 'poles'), read.anything),
        **dict.fromkeys(WORDS, read.listed(read.word)),
        **{key: read.numbers(*(size[s] for s in shape)) for key, shape in MATRICES.items()},
        'noise': read.numbers(ny, ny) if some else read.anything,
        **dict.fromkeys(Actuator._fields, read.numbers(size['nu']))}, optional=Actuator._fields)
    poles = given.pop('poles')
    each = [given.pop(kind, (0.0,) * size['nu']) for kind in Actuator._fields]
    try:
        model = StateSpace(**{key: given[key] for key in given if key not in SIZES},
                           actuators=tuple(map(Actuator._make, zip(*each, strict=True))))
    except DataError as error:
        raise StorageError(f'`{where}`: {error}') from error
    _check_poles(poles, model, where)
    return model


def _check_poles(listed_poles: Any, model: StateSpace, where: str) -> None:
    """Raise unless the poles that are listed are those of A; `pole_std` is of these."""
    try:
        poles = np.array([complex(pole['re'], pole['im']) for pole in listed_poles])
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


def _read_covariance(value: Any, model: StateSpace | None) -> Covariance | None:
    if value is None:
        return None
    found = read.entries(value, 'covariance', {
        **dict.fromkeys(SIZES, read.whole), 'root': read.anything,
        'rivals': read.listed(_read_rival)},
        optional=('rivals',))
    size = {key: found[key] for key in SIZES}
    if model is None or size != {key: getattr(model, key) for key in SIZES}:
        raise StorageError(f'`covariance` is of {size}, and that is not the model; write the file '
                           'again')
    count = Covariance.entry_count(**size)
    rows = read.listed(read.numbers(count))(value['root'], 'covariance.root')
    try:
        return Covariance(**{**found, 'root': np.array(rows).reshape(-1, count)})
    except DataError as error:
        raise StorageError(f'`covariance`: {error}') from error


def _read_rival(value: Any, where: str) -> Rival:
    found = read.entries(value, where, {'share': read.finite, 'model': _read_model})
    if found['model'] is None:
        raise StorageError(f'`{where}.model` is null; write the file again')
    return Rival(**found)


def read_verdict(value: Any, default: Remedy = Remedy.TEST) -> Verdict:
    """Return the verdict that `describe` described, through JSON; else raise `StorageError`."""
    found = read.entries(value, 'verdict', read.readers_of(
        Verdict, grade=read.member(Grade), remedy=read.member(Remedy),
        excitation=read.listed(_read_excitation), agreement=read.made(Agreement)),
        optional=('agreement', 'remedy'))
    return Verdict(**{'remedy': default, **found})


def _read_excitation(value: Any, where: str) -> Excitation:
    found = read.entries(value, where, {'input': read.word,
                                        **dict.fromkeys(EXCITATION, read.number)})
    return Excitation(found.pop('input'), **found)


def _read_settings(value: Any, where: str) -> Settings:
    try:
        return Settings.from_dict(read.mapping(value, where))
    except SettingsError as error:
        raise StorageError(f'`settings`: {error}') from error


def _read_statistics(value: Any, where: str) -> dict[str, float]:
    return {key: read.number(v, f'{where}.{key}') for key, v in read.mapping(value, where).items()}


TOP: dict[str, Reader] = {
    **dict.fromkeys(('format', 'version', 'equations'), read.anything),
    **read.readers_of(
        Estimate, status=read.member(Status), settings=_read_settings, model=_read_model,
        rejected_model=_read_model, statistics=_read_statistics,
        choices=read.listed(read.made(Choice)), orders=read.listed(read.made(OrderTried)),
        records=read.listed(read.made(RecordShare, x_trim=read.numbers(), y_trim=read.numbers(),
                                      weight=read.finite)),
        **dict.fromkeys(('covariance', 'verdict'), read.anything)),
    **dict.fromkeys(('message', 'deviations'), read.anything), 'metadata': read.mapping}
