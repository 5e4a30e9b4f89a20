# SPDX-License-Identifier: Apache-2.0
"""What many tests share: plants, and where the real recordings are."""

from __future__ import annotations

import gc
from importlib.util import find_spec
import os
from pathlib import Path
import signal
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from plants import Plant

ROOT = Path(__file__).resolve().parent.parent
# A shell lets what it starts behind `&` ignore Ctrl-C, and so would the programs tested here.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_finish() -> None:
    """Leave modules and tests, which stay to the end, out of every search for what is unused."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def plants() -> dict[str, Plant]:
    """Test plants by name: hd51, hd52, flexible, unstable."""
    from plants import PLANTS  # SciPy: the process that only hands out tests needs none of it
    return PLANTS


@pytest.fixture
def data_folder() -> Path:
    """Folder of the real recordings; the test is skipped where they are absent."""
    folder = Path(os.environ.get('CTSID_DATA', ROOT.parent / 'shared' / 'data'))
    if not folder.is_dir():
        pytest.skip('real recordings are not here; name their folder in CTSID_DATA')
    return folder


@pytest.fixture(scope='session', autouse=True)
def _written_models_validate(tmp_path_factory):
    """Hold every model.json that the tests have written, by whatever program, to its schema."""
    yield
    if find_spec('jsonschema') is None:
        return
    from schema import faults_of_file
    wrong = {str(path): found for path in sorted(tmp_path_factory.getbasetemp().rglob('*.json'))
             if path.is_file() and (found := faults_of_file(path))}
    assert wrong == {}, 'these files do not follow ctsid_core/model/model.schema.json'
