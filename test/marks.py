# SPDX-License-Identifier: Apache-2.0
"""Parameters of tests that are slow, beside those that always run."""

from __future__ import annotations

import pytest


def slow(*cases):
    """Return parameter sets (a tuple is one of several arguments) that `make test-all` adds."""
    return [pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.slow)
            for case in cases]
