# SPDX-License-Identifier: Apache-2.0
"""
ament_copyright on the two documents that it knows.

It does not know SPDX lines: those of the sources are tested in test_package.py.
"""

from pathlib import Path

import pytest

main = pytest.importorskip('ament_copyright.main', reason='ament_copyright comes with ROS 2')
ROOT = Path(__file__).resolve().parent.parent


@pytest.mark.linter
def test_licence_and_terms_of_contribution_are_those_of_ros():
    files = [str(ROOT / name) for name in ('CONTRIBUTING.md', 'LICENSE')]
    assert main.main(argv=files) == 0
