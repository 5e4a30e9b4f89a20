# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from ctsid_core.linear.resolvent import resolvent

S = 1j * np.linspace(0.0, 40.0, 31)


def matrices(kind: str) -> np.ndarray:
    rng = np.random.default_rng(3)
    if kind == 'no state':
        return np.empty((0, 0))
    if kind == 'jordan':
        return np.diag(np.full(3, -2.0)) + np.diag(np.ones(2), 1)
    if kind == 'nearly jordan':
        return np.diag([-2.0, -2.0 - 1e-13, -3.0]) + np.diag(np.ones(2), 1)
    if kind == 'equal poles':
        return -2.0 * np.eye(3)
    if kind == 'stiff':
        return np.diag([-1e-3, -1.0, -1e4]) + np.triu(rng.standard_normal((3, 3)), 1)
    return rng.standard_normal((4, 4)) - 3.0 * np.eye(4)


@pytest.mark.parametrize('kind', ['any', 'stiff', 'jordan', 'nearly jordan', 'equal poles',
                                  'no state'])
def test_against_the_inverse_of_every_line(kind):
    rng, A = np.random.default_rng(4), matrices(kind)
    n = len(A)
    inverse = np.linalg.inv(S[:, np.newaxis, np.newaxis] * np.eye(n) - A)
    found, C = resolvent(A, S), rng.standard_normal((2, n))
    drive = rng.standard_normal((n, len(S))) + 1j * rng.standard_normal((n, len(S)))
    size = max(np.abs(inverse).max(initial=0.0), 1.0)
    np.testing.assert_allclose(found.states(drive), np.einsum('lij,jl->il', inverse, drive),
                               rtol=0.0, atol=1e-10 * size)
    np.testing.assert_allclose(found.outputs(C), np.einsum('ki,lij->jkl', C, inverse), rtol=0.0,
                               atol=1e-10 * size)
    weights = rng.uniform(1.0, 2.0, len(S))
    np.testing.assert_allclose(found.sum(weights), np.einsum('l,lij->ij', weights, inverse).real,
                               rtol=0.0, atol=1e-9 * size)
    np.testing.assert_allclose(np.sort(found.poles), np.sort(np.linalg.eigvals(A)))


def test_only_coinciding_poles_cost_an_inverse_per_line():
    assert resolvent(matrices('any'), S).modes is not None
    assert resolvent(matrices('equal poles'), S).modes is not None
    assert resolvent(matrices('jordan'), S).modes is None


def test_what_is_not_finite_raises():
    with pytest.raises(np.linalg.LinAlgError):
        resolvent(np.array([[np.nan]]), S)
