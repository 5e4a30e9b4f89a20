# SPDX-License-Identifier: Apache-2.0
"""First-order recursions over many steps, by LAPACK's solver for band matrices."""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dtbtrs, ztbtrs

from ctsid_core.linear.types import Array, ComplexArray


def chain(factor: Array | ComplexArray, push: Array | ComplexArray) -> ComplexArray:
    """
    Return z of z_0 = 0, z_(k+1) = factor_k z_k + push_k, (m, w, K + 1); real if both are.

    Of factors (m, K), or (m, 1) if they are the same at every step, and pushes (m, w, K).
    """
    m, width, count = push.shape
    kind = np.result_type(factor, push)
    solver = ztbtrs if kind.kind == 'c' else dtbtrs
    z: ComplexArray = np.zeros((m, width, count + 1), dtype=kind)
    if count:
        band = np.ones((2, count), dtype=kind, order='F')
        for own, factors, pushes in zip(z, factor, push, strict=True):
            band[1, :-1] = -factors[1:] if len(factors) > 1 else -factors[0]
            solved, _ = solver(band, pushes.T, uplo='L', diag='U')
            own[:, 1:] = solved.T
    return z
