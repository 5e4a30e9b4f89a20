# SPDX-License-Identifier: Apache-2.0
"""
Many models at once say what each says by itself.

To a thousandth of a unit of the likelihood: modes of condition 1e10 still count as sound.
"""

from dataclasses import replace

import numpy as np
from plants import PLANTS, random_plant, running
import pytest

from ctsid_core import Settings
from ctsid_core.bases.hermite import project_record
from ctsid_core.likelihood.many_models import innovation_costs, output_error_costs
from ctsid_core.likelihood.prediction_errors import innovation_cost, output_error_cost
from ctsid_core.search.order import Search


def lines_of(p, settings=None, *, seed=0, snr=20):
    record = running(np.random.default_rng(seed), p, snr, rate=200.0, band=5.0)
    return project_record(record, settings or Settings(), 120)


def models_of(projection, n):
    search = Search(projection, Settings())
    return [c.matrices for c in search.candidates(n, search.subspaces.tunings(n))]


@pytest.mark.parametrize('name', ['hd51', 'hd52', 'flexible'])
@pytest.mark.parametrize('trim', [True, False])
def test_costs_are_those_of_each_model(name, trim):
    projection = lines_of(PLANTS[name], Settings(trim=trim))
    for n in (1, 2, 5):
        models = models_of(projection, n)
        assert len(models) > 5
        np.testing.assert_allclose(innovation_costs(projection, models), [
            innovation_cost(projection, m) for m in models], rtol=0.0, atol=1e-3)
        np.testing.assert_allclose(output_error_costs(projection, models), [
            output_error_cost(projection, m) for m in models], rtol=0.0, atol=1e-3)


def test_inadmissible_and_defective_models_are_like_any_other():
    projection = lines_of(random_plant(np.random.default_rng(1), 2, 2, 2))
    good = models_of(projection, 2)
    wild = replace(good[0], A=good[0].A + 50.0 * np.eye(2))          # an unstable predictor
    chain = replace(good[0], A=np.array([[-3.0, 1.0], [0.0, -3.0]]), K=np.zeros_like(good[0].K))
    models = [good[0], wild, chain, good[1]]
    found = innovation_costs(projection, models)
    assert found[1] == np.inf
    for costs, one in ((found, innovation_cost),
                       (output_error_costs(projection, models), output_error_cost)):
        np.testing.assert_allclose(costs, [one(projection, m) for m in models],
                                   rtol=0.0, atol=1e-3)


def test_poles_alone_are_judged_as_by_a_fit():
    projection = lines_of(PLANTS['hd52'])
    search = Search(projection, Settings())
    for n in (1, 2, 3, 4):
        poles = [c.poles for c in search.candidates(n, search.subspaces.tunings(n))]
        slow = poles[0].copy()
        slow[np.argmin(np.abs(slow))] = -1e-4 if slow.imag[np.argmin(np.abs(slow))] == 0 \
            else slow[np.argmin(np.abs(slow))]
        np.testing.assert_allclose(search.output_error.costs([*poles, slow]), [
            search.output_error.fit(p).cost for p in [*poles, slow]], rtol=0.0, atol=1e-3)
