# SPDX-License-Identifier: Apache-2.0
"""What many tests share: plants, and where the real recordings are."""

from __future__ import annotations

import os
from pathlib import Path

from plants import PLANTS, Plant
import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def plants() -> dict[str, Plant]:
    """Test plants by name: hd51, hd52, flexible, unstable."""
    return PLANTS


@pytest.fixture
def data_folder() -> Path:
    """Folder of the real recordings; the test is skipped where they are absent."""
    folder = Path(os.environ.get('CTSID_DATA', ROOT.parent / 'shared' / 'data'))
    if not folder.is_dir():
        pytest.skip('real recordings are not here; name their folder in CTSID_DATA')
    return folder
