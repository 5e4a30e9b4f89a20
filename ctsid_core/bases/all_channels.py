# SPDX-License-Identifier: Apache-2.0
"""Models of the channels that move, and of all of them, from the matrices of an estimate."""

from __future__ import annotations

import numpy as np

from ctsid_core.bases.preparation import Usable
from ctsid_core.linear.matrices import Matrices
from ctsid_core.linear.types import Array
from ctsid_core.model.statespace import StateSpace


def moving_model(m: Matrices, delay: tuple[float, ...]) -> StateSpace:
    """Return the model of the channels that move, less their levels, without K."""
    return StateSpace(A=m.A, B=m.B, C=m.C, D=m.D, delay=delay,
                      x_trim=m.x_trim[:, 0] if m.x_trim.size else np.zeros(len(m.A)),
                      y_trim=m.y_trim[:, 0] if m.y_trim.size else np.zeros(len(m.C)))


def whole_trim(part: Usable, m: Matrices) -> tuple[Array, Array]:
    """Return the trim of the states and of all outputs of a record, given its own model."""
    whole, y = part.whole, list(part.y)
    level = np.zeros(whole.ny) if len(y) == whole.ny else \
        np.concatenate([s.values.mean(axis=0) for s in whole.outputs])
    level[y] = (m.y_trim[:, 0] if m.y_trim.size else 0.0) + part.y_level - m.D @ part.u_level
    drift = (m.x_trim[:, 0] if m.x_trim.size else np.zeros(len(m.A))) - m.B @ part.u_level
    return drift, level


def whole_model(part: Usable, m: Matrices, delay: tuple[float, ...],
                intensity: Array | None) -> StateSpace:
    """
    Return the model of all channels: constant ones have zero rows and columns.

    `m` is of the moving channels, `delay` of every input [s], `intensity` of the noise of the
    moving outputs, a square matrix [unit^2 s], or None if it is not known.
    """
    whole = part.whole
    n, nu, ny = len(m.A), whole.nu, whole.ny
    u, y = list(part.u), list(part.y)
    B, C, D, K = np.zeros((n, nu)), np.zeros((ny, n)), np.zeros((ny, nu)), np.zeros((n, ny))
    B[:, u], C[y], D[np.ix_(y, u)], K[:, y] = m.B, m.C, m.D, m.K
    drift, level = whole_trim(part, m)
    noise = None if intensity is None else np.zeros((ny, ny))
    if noise is not None:
        noise[np.ix_(y, y)] = intensity
    return StateSpace(
        A=m.A, B=B, C=C, D=D, K=K, delay=delay, x_trim=drift, y_trim=level, noise=noise,
        input_names=whole.input_names, output_names=whole.output_names,
        input_units=whole.input_units, output_units=whole.output_units)


def spread_out(values: Array, places: tuple[int, ...], count: int) -> Array:
    """Put the values of moving channels among all channels; NaN for the constant ones."""
    out = np.full(count, np.nan)
    out[list(places)] = values
    return out
