# SPDX-License-Identifier: Apache-2.0
"""The published schema of model.json, as the tests apply it."""

from __future__ import annotations

from functools import cache
from importlib.resources import files
import json
from pathlib import Path
from typing import Any

from ctsid_core.errors import StorageError
from ctsid_core.model.model_json import VERSION, from_json


@cache
def validator() -> Any:
    from jsonschema import Draft202012Validator

    schema = json.loads((files('ctsid_core.model') / 'model.schema.json').read_text())
    Draft202012Validator.check_schema(schema)
    return Draft202012Validator(schema)


def faults(document: Any) -> list[str]:
    """Return what is wrong with a document, with its place in it."""
    return [f'{error.json_path}: {error.message[:200]}'
            for error in validator().iter_errors(document)]


def faults_of_file(path: Path) -> list[str]:
    """Return what is wrong with a file, if it is a model of today that our own reader accepts."""
    try:
        text = path.read_text(encoding='utf-8')
        if '"ctsid-model"' not in text:
            return []
        from_json(text)
    except (StorageError, UnicodeDecodeError, OSError):
        return []
    document = json.loads(text)
    return faults(document) if document['version'] == VERSION else []
