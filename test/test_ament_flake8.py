# SPDX-License-Identifier: Apache-2.0
"""ament_flake8, with what setup.cfg says."""

from pathlib import Path

import pytest

main = pytest.importorskip('ament_flake8.main', reason='ament_flake8 comes with ROS 2')
ROOT = Path(__file__).resolve().parent.parent


@pytest.mark.linter
def test_flake8():
    folders = ('ctsid_core', 'ctsid_ros', 'launch', 'test', 'setup.py')
    code, errors = main.main_with_errors(
        argv=['--config', str(ROOT / 'setup.cfg'), *(str(ROOT / name) for name in folders)])
    assert code == 0, '\n'.join(errors)
