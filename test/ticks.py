# SPDX-License-Identifier: Apache-2.0
"""What a discrete model does, by its definition: what exports and further states have to do."""

from __future__ import annotations

import numpy as np

from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.discrete import Discrete


def simulated(model: Discrete, u: Array) -> Array:
    """Return outputs (M, ny) for held inputs (M, nu); the first input was there before."""
    ticks, channels = np.arange(len(u))[:, np.newaxis], np.arange(u.shape[1])

    def ago(count):
        return u[np.maximum(ticks - np.asarray(count, dtype=int), 0), channels]

    lag = np.array(model.lag, dtype=int)
    drive = ago(lag) @ model.now.T + ago(lag + 1) @ model.before.T + model.offset
    x = np.zeros((len(u), len(model.A)))
    for k in range(1, len(u)):
        x[k] = model.A @ x[k - 1] + drive[k - 1]
    return x @ model.C.T + ago(model.memory) @ model.D.T + model.y_trim


def response(model: Discrete, omega: Array) -> ComplexArray:
    """Return G(e^(j omega period)) from u to y, (M, ny, nu)."""
    z = np.exp(1j * omega * model.period)[:, np.newaxis, np.newaxis]
    lag = np.array(model.lag, dtype=int)
    drive = model.now * z ** -lag + model.before * z ** (-lag - 1)
    states = np.linalg.solve(z * np.eye(len(model.A)) - model.A, drive)
    return model.C @ states + model.D * z ** -model.memory
