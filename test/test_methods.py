# SPDX-License-Identifier: Apache-2.0
"""Every row of the table of methods offers models of the same record."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from plants import PLANTS, match, running
import pytest

from ctsid_core import Settings, Status, identify
from ctsid_core.bases.records import join_records
from ctsid_core.subspace.methods import METHODS


@pytest.fixture(scope='module')
def record():
    return running(np.random.default_rng(3), PLANTS['hd51'], 60, rate=200.0)


@pytest.mark.parametrize('name', METHODS)
def test_a_method_offers_models_of_the_orders_that_are_wanted(name, record):
    settings = Settings(method=name, delay=0.0)
    offered = list(METHODS[name].models(join_records((record,), settings), settings, [1, 2],
                                        lambda: None))
    assert {len(one.matrices.A) for one in offered} == {1, 2}
    assert all(one.settings.order == len(one.matrices.A) for one in offered)
    assert all(np.isfinite(one.singular_values).all() for one in offered)
    true = PLANTS['hd51'].poles
    errors = [np.abs(match(np.linalg.eigvals(one.matrices.A), true) - true).max()
              for one in offered if len(one.matrices.A) == 2]
    assert min(errors) < 0.05


def test_hd_pbsid_that_does_not_refine_is_judged_like_the_other_methods(record, monkeypatch):
    monkeypatch.setitem(METHODS, 'hd-pbsid', replace(METHODS['hd-pbsid'], refines=False))
    found = identify(record, Settings(delay=0.0))
    assert found.status is Status.OK
    assert found.model.n == 2
    true = PLANTS['hd51'].poles
    assert np.abs(match(found.model.poles, true) - true).max() < 0.05
