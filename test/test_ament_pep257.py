# SPDX-License-Identifier: Apache-2.0
"""ament_pep257 on what is installed."""

from pathlib import Path

import pytest

main = pytest.importorskip('ament_pep257.main', reason='ament_pep257 comes with ROS 2')
ROOT = Path(__file__).resolve().parent.parent


@pytest.mark.linter
def test_docstrings():
    folders = ('ctsid_core', 'ctsid_ros', 'launch')
    assert main.main(argv=[str(ROOT / name) for name in folders]) == 0
