# SPDX-License-Identifier: Apache-2.0
"""ament_xmllint on package.xml."""

from pathlib import Path

import pytest

main = pytest.importorskip('ament_xmllint.main', reason='ament_xmllint comes with ROS 2')
ROOT = Path(__file__).resolve().parent.parent


@pytest.mark.linter
def test_package_xml():
    assert main.main(argv=[str(ROOT / 'package.xml')]) == 0
