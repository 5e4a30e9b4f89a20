# SPDX-License-Identifier: Apache-2.0
"""
Tests of the prediction errors on their spectral lines: unmodelled response, and whiteness.

Unmodelled response: prediction errors of a right model do not depend on past inputs, open loop
or closed. They are regressed on the inputs, delayed by 0, h, 2 h, ...: what that explains beyond
chance is the part of the response that is not modelled (a model error model: Ljung 1999, System
Identification, 16.6; delays of 0 and more only, so that feedback does not count). Whiteness:
Bartlett's test of the cumulative periodogram (Bartlett 1954, Publ. Inst. Statist. Univ. Paris 3);
with gusts they are coloured, which is no fault.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import fdtrc, kolmogorov

from ctsid_core.bases.projection import as_real
from ctsid_core.judge.excitation import LinePrediction
from ctsid_core.linear.types import Array

_DELAYS = 48          # regressors, shared by the inputs
_LEAST = 6            # delays of each input
_RANK = 1e-5          # eigenvalue, over the largest, of delays that say something of their own


@dataclass(frozen=True)
class PredictionErrorTest:
    """
    Tests of the prediction errors of each output.

    Parameters
    ----------
    whiteness : ndarray, shape (ny,)
        P-value of 'the errors of this output are white'.
    missing : ndarray, shape (ny,)
        Unmodelled response: what past inputs explain of the errors, over the response to the
        inputs, rms.
    p_value : ndarray, shape (ny,)
        P-value of 'the errors do not depend on past inputs'.
    """

    whiteness: Array
    missing: Array
    p_value: Array


def prediction_error_test(prediction: LinePrediction, highest: float,
                          parameters: int) -> PredictionErrorTest:
    """
    Test the prediction errors of a model.

    Parameters
    ----------
    prediction : LinePrediction
    highest : float
        Frequency up to which inputs excite [rad/s]: the delays are half of its period apart.
    parameters : int
        Number of parameters of the model.
    """
    p = prediction.projection
    weight = 1.0 / np.sqrt(prediction.noise)
    count = max(_DELAYS // len(p.u), _LEAST)
    shifts = np.exp(-p.s * np.pi / highest * np.arange(count)[:, np.newaxis]) * weight
    rows = as_real((p.u[:, np.newaxis] * shifts).reshape(-1, len(p.s)))
    rows /= np.sqrt(np.mean(rows ** 2, axis=1, keepdims=True)) + 1e-300
    error = as_real(prediction.error * weight)
    values, vectors = np.linalg.eigh(rows @ rows.T)
    kept = values > _RANK * values[-1]
    pull = vectors[:, kept].T @ (rows @ error.T) / np.sqrt(values[kept])[:, np.newaxis]
    explained, power = np.sum(pull ** 2, axis=0), np.sum(error ** 2, axis=1)
    freedom = int(kept.sum())
    spare = max(p.count - freedom - parameters / len(p.y), 1.0)
    level = np.maximum(power - explained, 1e-300) / spare
    response = np.einsum('jil,jl->il', prediction.response, p.u * weight)
    size = np.sum(as_real(response) ** 2, axis=1) + 1e-300
    return PredictionErrorTest(
        _whiteness(prediction),
        np.sqrt(np.maximum(explained - freedom * level, 0.0) / size),
        np.asarray(fdtrc(freedom, spare, explained / freedom / level)))


def _whiteness(prediction: LinePrediction) -> Array:
    power = np.cumsum(np.abs(prediction.own) ** 2, axis=1)
    even = np.cumsum(prediction.projection.weights)
    away = np.abs(power / (power[:, -1:] + 1e-300) - even / even[-1]).max(axis=1)
    return np.asarray(kolmogorov(np.sqrt(power.shape[1]) * away))
