# SPDX-License-Identifier: Apache-2.0
"""Claims of simulations whose residuals are coloured; the rest is in test_refine.py."""

from dataclasses import replace

import numpy as np
from plants import PLANTS, match, running
import pytest

from ctsid_core import Settings
from ctsid_core.bases.hermite import project_record
from ctsid_core.likelihood import information as module
from ctsid_core.likelihood.information import pole_deviation
from ctsid_core.likelihood.refine import realise_poles, refine_output_error

TRUTH = PLANTS['hd51'].poles


def runs(colour: float, count: int):
    """Return errors and claims of -2 and -4: coloured noise (a pole at -colour) in all outputs."""
    clean = project_record(running(np.random.default_rng(0), PLANTS['hd51'], None, rate=200.0,
                                   band=5.0), Settings(), 150)
    size = 0.1 * np.sqrt(np.mean(np.abs(clean.y) ** 2, axis=1, keepdims=True))
    filtered = 3.0 / np.abs(clean.s + colour) if colour else np.ones(len(clean.s))
    start = realise_poles(clean, TRUTH.astype(complex), True)
    errors, claims = [], []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        e = rng.standard_normal(clean.y.shape) + 1j * rng.standard_normal(clean.y.shape)
        lines = replace(clean, y=clean.y + size * filtered * e)
        model, _ = refine_output_error(lines, start, True)
        poles = np.linalg.eigvals(model.A)
        found, claim = match(poles, TRUTH), pole_deviation(lines, model, True)
        errors.append(np.abs(found - TRUTH))
        claims.append([claim[np.argmin(np.abs(poles - p))] for p in found])
    return np.array(errors), np.array(claims)


@pytest.mark.parametrize('colour', [0.0, 1.0])
def test_the_claim_is_that_of_the_scatter_whatever_the_colour(colour):
    errors, claims = runs(colour, 60)
    ratio = np.sqrt(np.mean(errors ** 2, axis=0) / np.mean(claims ** 2, axis=0))
    print(f'colour {colour}: scatter over claim {ratio.round(3)}')
    assert (0.75 < ratio).all()
    assert (ratio < 1.3).all()


def test_a_claim_for_white_residuals_would_be_too_small(monkeypatch):
    """Smoothed over all lines, the residuals' power is that of white noise."""
    monkeypatch.setattr(module, '_WIDTHS', ())
    errors, claims = runs(1.0, 30)
    ratio = np.sqrt(np.mean(errors ** 2, axis=0) / np.mean(claims ** 2, axis=0))
    assert ratio.max() > 1.4


def test_a_gain_does_not_matter_to_the_claim_of_a_simulation():
    lines = project_record(running(np.random.default_rng(1), PLANTS['hd51'], 20, rate=200.0),
                           Settings(), 150)
    model, _ = refine_output_error(lines, realise_poles(lines, TRUTH.astype(complex), True), True)
    held = replace(model, K=np.ones_like(model.K), tail=3.0 * model.tail)
    np.testing.assert_allclose(pole_deviation(lines, held, True, process_noise=False),
                               pole_deviation(lines, model, True), rtol=0.02)
    assert (pole_deviation(lines, held, True) !=
            pole_deviation(lines, held, True, process_noise=False)).all()


def test_a_notch_that_no_window_resolves_makes_nothing_certain(monkeypatch):
    lines = project_record(running(np.random.default_rng(1), PLANTS['hd51'], 20, rate=200.0),
                           Settings(), 150)
    model = realise_poles(lines, TRUTH.astype(complex), True)
    A = np.array([[-0.1, 3.0], [-3.0, -0.1]])                    # of the predictor: a notch at 3
    K = (model.A - A) @ np.linalg.inv(model.C)
    notched = replace(model, K=K)
    claimed = pole_deviation(lines, notched, True)
    monkeypatch.setattr(module, '_RESOLVED', 0.0)
    assert (claimed > 1.05 * pole_deviation(lines, notched, True)).all()
