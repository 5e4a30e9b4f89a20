# SPDX-License-Identifier: Apache-2.0
"""The published schema of model.json is that of the code; conftest.py applies it to all files."""

from __future__ import annotations

from dataclasses import fields
import json
from pathlib import Path

import pytest

pytest.importorskip('jsonschema', reason='jsonschema is not installed')
from schema import faults, faults_of_file, validator  # noqa: E402

from ctsid_core.model import model_json  # noqa: E402
from ctsid_core.model.estimate import Estimate, OrderTried, RecordShare, Status  # noqa: E402
from ctsid_core.model.storage import to_json  # noqa: E402
from ctsid_core.model.verdict import Agreement, Excitation, Grade, Verdict  # noqa: E402
from ctsid_core.settings import Actuator, Settings  # noqa: E402

ROOT = Path(__file__).resolve().parent.parent
WRITTEN = sorted((ROOT / 'bags').glob('*_truth.json'))


@pytest.mark.parametrize('path', WRITTEN, ids=lambda path: path.name)
def test_the_models_of_the_repository_validate(path):
    assert faults(json.loads(path.read_text())) == []


def test_an_estimate_without_a_model_validates():
    empty = Estimate(status=Status.TOO_SHORT, settings=Settings())
    assert faults(json.loads(to_json(empty, {'any': ['thing', {'at': 'all'}]}))) == []


def test_the_schema_names_what_the_code_writes():
    schema = validator().schema
    model, verdict = schema['$defs']['model'], schema['$defs']['verdict']
    top = schema['properties']
    assert set(top) == set(model_json.TOP)
    assert set(model['properties']) == {
        *model_json.SIZES, *model_json.WORDS, *model_json.MATRICES, 'noise', 'poles',
        *Actuator._fields}
    assert set(verdict['properties']) == {f.name for f in fields(Verdict)}
    assert set(verdict['properties']['excitation']['items']['properties']) == {
        'input', *(f.name for f in fields(Excitation))} - {'name'}
    assert set(verdict['properties']['agreement']['properties']) == {
        f.name for f in fields(Agreement)}
    assert set(top['records']['items']['properties']) == {
        f.name for f in fields(RecordShare)}
    assert set(top['orders']['items']['properties']) == {
        f.name for f in fields(OrderTried)}
    assert set(top['deviations']['properties']) == set(model_json.DEVIATIONS)
    assert set(top['covariance']['anyOf'][0]['properties']) == {
        *model_json.SIZES, 'root', 'rivals'}
    assert set(model['properties']['poles']['items']['properties']) == {
        're', 'im', 'natural_frequency', 'damping'}
    assert top['status']['enum'] == list(Status.__members__)
    assert verdict['properties']['grade']['enum'] == list(Grade.__members__)
    assert (top['format']['const'], top['version']['const']) == (
        model_json.FORMAT, model_json.VERSION)


@pytest.mark.parametrize(('key', 'value'), [
    ('format', 'other'), ('version', 3), ('status', 'FINE'), ('fit', [1.0, 'a']),
    ('model', {'n': 1}), ('start_ns', 1.5), ('surprise', 1), ('notes', 'one')])
def test_what_is_none_does_not_validate(key, value):
    document = json.loads(WRITTEN[0].read_text())
    assert faults({**document, key: value}) != []
    assert faults({k: v for k, v in document.items() if k != 'model'}) != []


def test_only_models_that_our_reader_accepts_are_asked(tmp_path):
    document = json.loads(WRITTEN[0].read_text())
    path = tmp_path / 'model.json'
    path.write_text(json.dumps({**document, 'surprise': 1}))
    assert faults_of_file(path) == []
    path.write_text(json.dumps({**document, 'model': {
        **document['model'], 'poles': [{'re': p['re'], 'im': p['im'], 'more': 1}
                                       for p in document['model']['poles']]}}))
    assert faults_of_file(path) != []
    path.unlink()  # else conftest.py finds it
