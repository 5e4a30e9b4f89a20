# SPDX-License-Identifier: Apache-2.0
"""
B and D from filtered signals, [TM] eq. 15, as the paper has them.

`identify` fits them to simulations instead: by eq. 15 an error of the observability matrix goes
straight to B, multiplied with the states.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_continuous_lyapunov

from ctsid_core.bases.takenaka_malmquist import Chain
from ctsid_core.linear.least_squares import solve, triangle
from ctsid_core.linear.types import Array, Matrices, plain_matrices
from ctsid_core.subspace.gobf import Filtered, dynamics, observe


def realised(filtered: Filtered, n: int, *, feedthrough: bool, rank_tolerance: float) -> Matrices:
    """Return a model of order n < N ny ([TM] eq. 10 to 15, as corrected in `gobf`)."""
    left, size = observe(filtered, rank_tolerance).left, filtered.scale[:, np.newaxis]
    A, C = dynamics(filtered.chain, left[:, :n])
    B, D = _input_matrices(filtered, left, n, feedthrough, rank_tolerance)
    return plain_matrices(A, B, size * C, size * D)


def commuting(chain: Chain) -> Array:
    """
    Return the Z_k for which (s - L)^-1 e_k = Z_k w(s), shape (N, N, N), k first.

    The rows of Z_k are the coefficients of functions of the same space in an orthonormal basis:
    integrals of products, of a Lyapunov equation. They are bounded, however close the poles are,
    unlike partial fractions.
    """
    unit = np.eye(chain.size)
    return np.array([solve_continuous_lyapunov(chain.L, -np.outer(e, chain.b)) for e in unit])


def _input_matrices(filtered: Filtered, left: Array, n: int, feedthrough: bool,
                    rank_tolerance: float) -> tuple[Array, Array]:
    """
    Return B and D, of scaled outputs.

    [TM] eq. 15: with free states, what is left of (6) beside the columns of Theta_1 is linear in
    them: Theta_2^T w_y = -Theta_2^T sum_k (O B - b D)_k Z_k w_u.
    """
    chain, theta, other, ny = filtered.chain, left[:, :n], left[:, n:], len(filtered.scale)
    nu, impulses, ones, kinks = filtered.counts
    inputs = nu + impulses + ones                  # drive the states
    direct = [*range(nu * feedthrough), *range(nu + impulses, inputs + kinks)]  # act at once
    # Z_k w: what the k-th block row of O B - b D is multiplied with
    moved = np.einsum('kij,jml->kiml', commuting(chain), filtered.inputs)
    rows = other.reshape(chain.size, ny, -1)
    state = -np.einsum('kpn,ipr,kiml->nmrl', theta.reshape(chain.size, ny, n), rows,
                       moved[:, :, :inputs], optimize=True)
    feed = np.einsum('ipr,iml->pmrl', rows, filtered.inputs[:, direct], optimize=True)
    cells = other.shape[1] * filtered.y.shape[2]
    regressors = np.concatenate((state.reshape(n * inputs, cells),
                                 feed.reshape(ny * len(direct), cells)))
    y = (filtered.y / filtered.scale[:, np.newaxis]).reshape(chain.size * ny, -1)
    both = triangle(np.vstack((regressors, (other.T @ y).reshape(1, -1))).T).T  # of many columns
    unknown, _ = solve(both[:-1], both[-1:], rank_tolerance)
    B = unknown[0, :n * inputs].reshape(n, inputs)
    D = np.zeros((ny, filtered.inputs.shape[1]))
    D[:, direct] = unknown[0, n * inputs:].reshape(ny, len(direct))
    return B[:, :nu], D[:, :nu]
