# SPDX-License-Identifier: Apache-2.0
"""
One set of states for the models of consecutive windows, and the same mode in the same row.

A state-space model is known up to a change of states z = T x, and each identification ends in
another one. Here T is chosen such that the model comes as near as it can to a reference (A_r, B_r,
C_r) that is held. It starts from the states of the reference whose free response is nearest to
that of x,

    T = Q_r^-1 Q,     A_r' Q_r + Q_r A_r + C_r' C_r = 0,     A_r' Q + Q A + C_r' C = 0        (1)

(observability and cross-Gramian), which does not depend on the states the model came with, and
stays regular where an input loses a mode. From there damped Gauss-Newton steps T <- e^X T lead to
the least change of all entries together,

    |T A T^-1 - A_r|^2 / |A_r|^2 + |T B - B_r|^2 / |B_r|^2 + |C T^-1 - C_r|^2 / |C_r|^2       (2)

The damping holds directions that (2) hardly knows. So T is a smooth function of the model: where
the model changes little, the aligned matrices change little, also where poles meet on the real
axis or modes swap places. (Modal and balanced forms jump there.) If the two systems are similar,
(1) is the similarity itself, and (2) zero.

Plants that are not stable have no Gramians: A and A_r are moved by the same -s I, which weighs
time by exp(-s t) and leaves T exact for similar systems. Each input and output counts in units of
the norm of its column of B_r or row of C_r, so that units of u and y play no role.

Cross-Gramians: A. C. Antoulas, "Approximation of Large-Scale Dynamical Systems", SIAM 2005,
section 4.3. Models as points near a reference, orthogonal to what only changes the states:
T. McKelvey, A. Helmersson, T. Ribarits, "Data driven local coordinates for multivariable linear
systems and their application to system identification", Automatica 40, 2004.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import count

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm, solve_continuous_lyapunov, solve_sylvester
from scipy.optimize import linear_sum_assignment

from ctsid_core.errors import DataError
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model import realisation
from ctsid_core.model.statespace import StateSpace

_System = tuple[Array, Array, Array]  # A - s I, and B and C in units of the reference's

_DAMPED = 0.2       # decay wanted of every mode, over the mean size of the reference's poles
_SMALLEST = 0.1     # poles smaller than this part of the largest count as that large
_UNLIKE = 5.0       # square root of (2) beyond which the states are better chosen anew
_DAMPING = 0.5      # of the Gauss-Newton steps
_STEPS = 10         # at most
_SETTLED = 1e-12    # |X|: no further step
NEAR = 0.5  # poles of neighbouring windows are the same if not further apart than this, over size


def aligning(model: StateSpace, reference: StateSpace) -> Array | None:
    """
    Return T such that the states z = T x are as near to those of the reference as they can be.

    With it the model is equal to the reference (to rounding) if the two are similar, and changes
    in proportion to the model, for a reference that is held. None if the orders differ, a state of
    either is not seen in the outputs, or entries would change by several times the size of their
    matrix: the two have too little in common. Raises `DataError` if the channels differ in number.

    Inputs and outputs that are constant in either (a column of B or row of C is zero) do not
    count. K, D, trim and dead time do not count either.
    """
    reference.check_width('input', model.nu, reference.nu)
    reference.check_width('output', model.ny, reference.ny)
    if model.n != reference.n:
        return None
    if not model.n:
        return np.empty((0, 0))
    inputs = _weights(reference.B, model.B)
    outputs = _weights(reference.C.T, model.C.T)
    shift = _shift(reference, model)
    target, system = (_weighted(m, shift, inputs, outputs) for m in (reference, model))
    try:
        T = _nearest(system, target, shift)
    except (DataError, np.linalg.LinAlgError):
        return None
    return T if T is not None and realisation.regular(T) else None


def referring(model: StateSpace) -> tuple[StateSpace, Array]:
    """
    Return the same system in well-conditioned states z = T x, to align others with, and T.

    Balanced in units in which all inputs and all outputs count alike, with time weighted by
    exp(-s t) for plants that are not stable. The states as they are, if one is not driven or not
    seen.
    """
    T = np.eye(model.n)
    if not model.n:
        return model, T
    found, shift = model, _shift(model, model)
    try:
        for _ in range(3):  # the units depend on the states a little
            step = realisation.balancing(*_weighted(
                found, shift, _weights(found.B, found.B), _weights(found.C.T, found.C.T)))
            found, T = found.transform(step), step @ T
        return found, T
    except (DataError, np.linalg.LinAlgError):
        return model, np.eye(model.n)


def _weights(reference: Array, model: Array) -> Array:
    # One per column: 1 / size in the reference; 0 for columns that are zero in either
    size = np.linalg.norm(reference, axis=0)
    used = (size > 0) & model.any(axis=0)
    return np.where(used, 1.0 / np.where(size > 0, size, 1.0), 0.0)


def _shift(reference: StateSpace, model: StateSpace) -> float:
    """Return s >= 0 such that all modes of both systems decay well under exp(-s t) [1/s]."""
    size = reference.natural_frequency
    floor = max(_SMALLEST * float(np.max(size)), 1e-300)
    mean = float(np.exp(np.mean(np.log(np.maximum(size, floor)))))
    slowest = max(float(np.max(m.poles.real)) for m in (reference, model))
    return max(0.0, slowest + _DAMPED * mean)


def _weighted(model: StateSpace, shift: float, inputs: Array, outputs: Array) -> _System:
    return model.A - shift * np.eye(model.n), model.B * inputs, (model.C.T * outputs).T


def _nearest(system: _System, target: _System, shift: float) -> Array | None:
    """Return T between (1) and the minimum of (2); None if the two systems are too unlike."""
    (A, _, C), (A_r, B_r, C_r) = system, target
    Q_r = solve_continuous_lyapunov(A_r.T, -C_r.T @ C_r)                        # (1)
    T = np.linalg.solve(Q_r, solve_sylvester(A_r.T, A, -C_r.T @ C))
    sizes = tuple(max(float(np.linalg.norm(of)), 1e-300)
                  for of in (A_r + shift * np.eye(len(A_r)), B_r, C_r))
    for _ in range(_STEPS):
        X = _step(_moved(system, T), target, sizes)
        T = np.asarray(expm(X)) @ T
        if np.linalg.norm(X) < _SETTLED:
            break
    parts = zip(_moved(system, T), target, sizes, strict=True)
    change = np.sqrt(sum(float(np.linalg.norm(m - r) / size) ** 2 for m, r, size in parts))
    return T if change < _UNLIKE else None


def _moved(system: _System, T: Array) -> _System:
    (A, B, C), inverse = system, np.linalg.inv(T)
    return T @ A @ inverse, T @ B, C @ inverse


def _step(system: _System, target: _System, sizes: tuple[float, ...]) -> Array:
    """Return X of a damped Gauss-Newton step on (2)."""
    slopes = realisation.state_changes(*system)
    M = np.vstack([slope / size for slope, size in zip(slopes, sizes, strict=True)])
    wanted = np.concatenate([(r - m).ravel() / size for m, r, size in zip(
        system, target, sizes, strict=True)])
    # Thanks to the damping the normal equations are as good as any, and they are the fastest.
    X = np.linalg.solve(M.T @ M + _DAMPING ** 2 * np.eye(M.shape[1]), M.T @ wanted)
    return np.asarray(X.reshape(system[0].shape))


def paired(old: ArrayLike, new: ArrayLike, floor: float = 0.0) -> dict[int, int]:
    """
    Pair poles that may be the same one in two models: index of the old one to that of the new.

    In the order of the old ones. Poles smaller than `floor`, the resolution of the data [rad/s],
    count as that large when their distance is judged. None is further off than NEAR times the
    larger of the two. Of all such pairings the one with the least sum of distances over size,
    where a pole without partner costs NEAR.
    """
    a, b = np.asarray(old, dtype=complex)[:, np.newaxis], np.asarray(new, dtype=complex)
    size = np.maximum(np.maximum(np.abs(a), np.abs(b)), max(floor, 1e-300))
    distance = np.abs(a - b) / size
    # What is too far costs the same however far it is, so that it does not bend the others.
    cost = np.minimum(distance, NEAR)
    rows, columns = linear_sum_assignment(cost)
    return {int(i): int(j) for i, j in zip(rows, columns, strict=True) if distance[i, j] <= NEAR}


@dataclass(frozen=True, eq=False)
class Rows:
    """The modes of a model, each in its row; conjugates have two rows and two identities."""

    # of two models' rows, those with the same identity are the same mode
    identities: tuple[int, ...] = ()
    eigenvalues: ComplexArray = field(default_factory=lambda: np.empty(0, dtype=complex))
    order: tuple[int, ...] = ()  # which of the model's `poles` stands in each row


def follow(rows: Rows, poles: ComplexArray, floor: float, first: int) -> Rows:
    """
    Return the rows of the next model.

    A mode keeps its identity and, unless rows above it vanish, its row. New modes take the rows of
    those that are gone, then further rows at the end; `first` is the first identity that is free.
    """
    same = _same(rows.eigenvalues, poles, floor)
    fresh = [k for k in range(len(poles)) if k not in same.values()]
    free = count(first)
    entries: list[tuple[int, int]] = []  # identity, index of the pole
    for row, identity in enumerate(rows.identities):
        if row in same:
            entries.append((identity, same[row]))
        elif fresh:
            entries.append((next(free), fresh.pop(0)))
    entries += [(next(free), k) for k in fresh]
    order = [k for _, k in entries]
    return Rows(tuple(identity for identity, _ in entries), poles[order], tuple(order))


def _same(old: ComplexArray, new: ComplexArray, floor: float) -> dict[int, int]:
    """Return which new pole continues each old one, by index."""
    # First pairs continue as pairs and real poles as real poles, so that conjugates stay together.
    # What then remains is matched one by one: a pair that has become two real poles, or the
    # reverse.
    before, after = _modes(old), _modes(new)
    same: dict[int, int] = {}
    for width in (1, 2):
        left, right = ([m for m in modes if len(m) == width] for modes in (before, after))
        for i, j in paired(_upper(old, left), _upper(new, right), floor).items():
            same |= zip(left[i], right[j], strict=True)
    left = [[k] for m in before for k in m if k not in same]
    right = [[k] for m in after for k in m if k not in same.values()]
    rest = paired(_upper(old, left), _upper(new, right), floor)
    changed = {left[i][0]: right[j][0] for i, j in rest.items()}
    # Which half of a pair is which: earlier rows continue in earlier poles.
    for mode in before:
        _sort(changed, [row for row in mode if row in changed])
    for mode in after:
        _sort(changed, [row for row, k in changed.items() if k in mode])
    return same | changed


def _modes(values: ComplexArray) -> list[list[int]]:
    """Return the indices of each mode: one of a real pole, two of a pair (negative part first)."""
    found = [[k] for k in np.flatnonzero(values.imag == 0).tolist()]
    upper = np.flatnonzero(values.imag > 0).tolist()
    for lower in np.flatnonzero(values.imag < 0).tolist():
        partner = min(upper, key=lambda k: abs(values[k] - values[lower].conj()))
        upper.remove(partner)
        found.append([lower, partner])
    return found


def _upper(values: ComplexArray, modes: Sequence[Sequence[int]]) -> ComplexArray:
    # both halves of a pair at its upper pole: they are equally far from any real one
    chosen = values[[m[0] for m in modes]]
    return np.asarray(chosen.real + 1j * np.abs(chosen.imag))


def _sort(changed: dict[int, int], rows: Sequence[int]) -> None:
    changed |= zip(sorted(rows), sorted(changed[row] for row in rows), strict=True)
