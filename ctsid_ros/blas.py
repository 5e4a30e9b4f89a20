# SPDX-License-Identifier: Apache-2.0
"""How many threads the linear algebra may use."""

from __future__ import annotations

import os

from ctsid_core.effort import THREADS


def use_one_thread() -> None:
    """
    Let BLAS use one thread, unless the environment says otherwise; call before importing NumPy.

    The matrices of an identification are small: several threads only wait for each other, make
    it up to ten times slower on a busy machine, and take the cores that the robot needs.
    """
    for name in THREADS:
        os.environ.setdefault(name, '1')
