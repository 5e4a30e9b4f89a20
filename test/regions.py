# SPDX-License-Identifier: Apache-2.0
"""Which 95 % regions of an estimate hold the truth."""

from __future__ import annotations

import numpy as np
from plants import Plant

from ctsid_core.model.estimate import Estimate
from ctsid_core.model.statespace import StateSpace

NORMAL, CHI_2 = 1.95996, 5.99146  # 95 % of a normal number, and of the sum of two squares


def regions(estimate: Estimate, p: Plant, omega) -> dict[str, float]:
    """
    Return errors of what an estimate says over the border of their 95 % region, by name.

    Poles are numbered from the slowest; a pair is one. At most 1 means that the region holds the
    truth. Responses are the first output's to the first input.
    """
    model = estimate.model or estimate.rejected_model
    truth = StateSpace(p.A, p.B, p.C, p.D)
    found = {}
    if model.n == truth.n and (np.sign(model.poles.imag) == np.sign(truth.poles.imag)).all():
        error, covariance = model.poles - truth.poles, estimate.pole_covariance
        for i in np.flatnonzero(truth.poles.imag >= 0):
            if truth.poles[i].imag == 0:
                size = np.abs(error[i].real) / np.sqrt(covariance[i, 0, 0]) / NORMAL
                found[f'real pole {i}'] = size
                continue
            parts = np.array([error[i].real, error[i].imag])
            found[f'pair {i}'] = np.sqrt(parts @ np.linalg.solve(covariance[i], parts) / CHI_2)
            for name in ('natural_frequency', 'damping'):
                away = getattr(model, name)[i] - getattr(truth, name)[i]
                found[f'{name} {i}'] = abs(away) / getattr(estimate, f'{name}_std')[i] / NORMAL
    ratio = (model.frequency_response(omega) / truth.frequency_response(omega))[:, 0, 0]
    std = estimate.frequency_response_std(omega)
    for k, w in enumerate(omega):
        size = np.abs(np.log(np.abs(ratio[k]))) / std.magnitude[k, 0, 0]
        found[f'magnitude {w:g}'] = size / NORMAL
        found[f'phase {w:g}'] = np.abs(np.angle(ratio[k])) / std.phase[k, 0, 0] / NORMAL
    away = (model.dc_gain - truth.dc_gain)[0, 0]
    found['gain'] = abs(away) / estimate.dc_gain_std[0, 0] / NORMAL
    return found
