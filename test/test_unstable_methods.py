# SPDX-License-Identifier: Apache-2.0
"""Subspace methods without likelihood: unstable only where the data show that a mode grows."""

from __future__ import annotations

from marks import slow
import numpy as np
from plants import flown, held, plant
import pytest

from ctsid_core import Settings, identify
from ctsid_core.model.verdict import Grade

# A rate integrated to an angle, and a slow sway: neither grows, and both are near the axis.
STEADY = {'integrator': plant([[0, 1], [0, -3]], [[0], [3]], [[1, 0]]),
          'sway': plant([[0, 1], [-0.02, -0.05]], [[0], [1]], [[1, 0]])}


@pytest.mark.parametrize(('name', 'method', 'seconds', 'seeds'), [
    *slow(('integrator', 'ct-pbsid', 4.0, (3, 4)), ('integrator', 'ct-pbsid', 10.0, range(12)),
          ('sway', 'ct-pbsid', 10.0, range(12)),
          ('integrator', 'gobf', 10.0, range(6)))])
def test_what_does_not_grow_is_no_good_unstable_model(name, method, seconds, seeds):
    for seed in seeds:
        record = held(np.random.default_rng(seed), STEADY[name], 50.0, 100.0, snr=15,
                      duration=seconds)
        found = identify(record, Settings(method=method))
        assert not found.good or np.max(found.model.poles.real) <= 0.0, seed


def test_it_is_said_with_the_way_out():
    record = held(np.random.default_rng(3), STEADY['integrator'], 50.0, 100.0, snr=15,
                  duration=4.0)
    found = identify(record, Settings(method='ct-pbsid'))
    assert found.verdict.grade is Grade.WEAK
    assert found.verdict.reason.startswith('The model is unstable')
    own = identify(record)
    assert own.good
    assert np.max(own.model.poles.real) <= 0.0


@pytest.mark.parametrize('method', ['ct-pbsid', *slow('gobf')])
def test_what_grows_stays_unstable_and_good(method):
    for seed in (13, 15):
        found = identify(flown(np.random.default_rng(seed)), Settings(
            method=method, order=2, feedthrough=False))
        assert np.max(found.model.poles.real) == pytest.approx(2.0, abs=0.01)
        assert 'The model is unstable' not in found.verdict.reason
