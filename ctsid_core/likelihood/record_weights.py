# SPDX-License-Identifier: Apache-2.0
"""Weights of several records, by the noise that a model finds in each."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ctsid_core.bases.projection import Projection, as_real, of_records
from ctsid_core.bases.records import Layout
from ctsid_core.likelihood.prediction_errors import prediction_errors
from ctsid_core.linear.matrices import Matrices

_UNEVEN = 1.15        # ratio of noise amplitudes of two records from which on it is worth weights
_MOST = 1e3           # ratio of weights


def balanced(projection: Projection, m: Matrices, layout: Layout) -> Layout:
    """
    Return the layout with weights that make the noise of all records alike.

    Parameters
    ----------
    projection : Projection
        By the layout.
    m : Matrices
        Whose prediction errors tell the noise: its geometric mean over the outputs.
    layout : Layout

    Returns
    -------
    Layout
        Itself if noise is alike enough that weights gain nothing.
    """
    level = []
    for record, own in zip(projection.records, of_records(m, projection), strict=True):
        error = as_real(prediction_errors(record, own))
        level.append(0.5 * np.mean(np.log(np.mean(error ** 2, axis=1) + 1e-300)))
    off = np.exp(np.clip(np.mean(level) - np.array(level), -np.log(_MOST), np.log(_MOST)))
    if not (np.isfinite(off).all() and np.max(off) > _UNEVEN * np.min(off)):
        return layout
    return replace(layout, weights=tuple(float(w) for w in np.array(layout.weights) * off))
