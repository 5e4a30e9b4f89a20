# SPDX-License-Identifier: Apache-2.0
"""
HD-PBSID: predictor-based subspace identification on Hermite lines ([HD] section 4).

The model in the projected domain, with z = [u; tail; ones; y] ([HD] eq. 27, 35; the tail and the
ones are inputs like u, but for the feedthrough, which the tail has not):

    x s = A x + B u + B_t tail + B_1 ones + K e,      y = C x + D u + D_1 ones + e

The operator (s + beta) / gamma (eq. 37) is a number per line, and so is its inverse g. The
levels z g^(p+1) .. z g^0 are stacked and compressed once by a QR factorisation; all that follows
are small matrices.

Departures from the paper, each measured (standard deviation of the slow poles in Table 1's
experiment, 20 dB): eq. 54 is multiplied by g before it is solved, so that the noise of the
state's derivative is not amplified with frequency (0.019 to 0.011); C and D are estimated
jointly, eq. 52 keeps the D of eq. 46. What the paper leaves open, the shift beta and the past
window p, is a grid from the length and the band of the data.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np

from ctsid_core.bases.hermite import Projection, as_real
from ctsid_core.bases.records import Joint
from ctsid_core.linear.least_squares import least_norm, solve, svd, triangle
from ctsid_core.linear.types import Array, Matrices, plain_matrices
from ctsid_core.settings import Settings

SLOWEST = 10.0                # least pole to look for, times the length of the record
_NEGLIGIBLE = 1e-7            # of the outputs: innovations below it know nothing of K
_PASTS = (2, 3, 4, 6, 8, 12)
_LENGTHS = 4                  # values of p tried: the shortest that can hold the order
_SHIFTS = 5                   # values of beta tried
_GAMMA = 4.0                  # gamma over beta: the region reaches well beyond the shift


@dataclass(frozen=True, eq=False)
class MethodModel:
    """A continuous-time model of the moving channels, one of those that any method offers."""

    matrices: Matrices      # what belongs to single records does not count
    # with the order and whatever the method chose filled in: they give this model
    settings: Settings
    singular_values: Array  # whose drop shows the order
    condition: float        # condition number of the regression
    # B, C and D are then those of the best simulation with its poles
    poles_only: bool = False


@dataclass(frozen=True)
class Tuning:
    """Parameters of one regression."""

    beta: float   # shift of the operator ([HD] eq. 37) [rad/s]
    gamma: float  # its radius [rad/s]
    past: int     # window p
    future: int   # window f <= p


@dataclass(frozen=True)
class Levels:
    """Signals at the powers of the inverse operator, compressed: their products stay the same."""

    rows: Array                        # (p + 2 or more, nz, columns): z g^m at index m
    scale: Array                       # (nz,): what the rows of z were divided by
    counts: tuple[int, int, int, int]  # rows of u, tail, ones, y


@dataclass(frozen=True)
class Subspace:
    """A regression from which models of any order are realised."""

    levels: Levels
    left: Array             # (f ny, r): left singular vectors of Gamma^f K^p Z (eq. 50)
    singular_values: Array  # (r,)
    gamma_k: Array          # (f ny, p nz): Gamma^f K^p (eq. 48)
    condition: float        # of the scaled regressors of eq. 46, dependent directions left out
    tuning: Tuning
    feedthrough: bool
    rank_tolerance: float


def regress(levels: Levels, tuning: Tuning, *, feedthrough: bool,
            rank_tolerance: float) -> Subspace:
    """
    Estimate the extended observability times controllability matrix ([HD] eq. 43 to 50).

    From levels of the tuning's beta and gamma, to level p + 1 at least.
    """
    p, f = tuning.past, tuning.future
    nz, ny = len(levels.scale), levels.counts[3]
    Z = levels.rows[p:0:-1].reshape(p * nz, -1)                               # eq. 43
    y = levels.rows[0, nz - ny:]
    direct = _direct(levels.rows[0], levels.counts, feedthrough)
    theta, condition = solve(np.vstack((Z, direct)), y, rank_tolerance)       # eq. 46
    gamma_k = np.zeros((f * ny, p * nz))
    for i in range(f):                                                        # eq. 48
        gamma_k[i * ny:(i + 1) * ny, i * nz:] = theta[:, :(p - i) * nz]
    left, s, _ = svd(gamma_k @ Z)                                             # eq. 50
    return Subspace(levels, left, s, gamma_k, condition, tuning, feedthrough, rank_tolerance)


def stack_levels(projection: Projection, beta: float, gamma: float, top: int) -> Levels:
    """Return the levels z g^0 .. z g^top ([HD] eq. 37), compressed by one QR factorisation."""
    z = np.vstack((projection.u, projection.tail, projection.ones, projection.y))
    scale = np.sqrt(np.sum(as_real(z) ** 2, axis=1))
    scale[scale == 0.0] = 1.0
    g = gamma / (projection.s + beta)                                         # inverse of eq. 37
    stack = np.empty((top + 1, *z.shape), dtype=complex)
    np.divide(z, scale[:, np.newaxis], out=stack[0])
    for m in range(1, top + 1):
        np.multiply(stack[m - 1], g, out=stack[m])
    rows = as_real(stack[::-1].reshape(-1, z.shape[1]))
    compressed = triangle(rows.T).T
    levels = compressed.reshape(top + 1, len(z), -1)[::-1]
    counts = (len(projection.u), len(projection.tail), len(projection.ones), len(projection.y))
    return Levels(levels, scale, counts)


def _direct(level: Array, counts: tuple[int, int, int, int], feedthrough: bool) -> Array:
    """Return the rows of a level that act on y at once: u (if so wanted) and ones."""
    nu, tail, ones, _ = counts
    constant = level[nu + tail:nu + tail + ones]
    return np.vstack((level[:nu], constant)) if feedthrough else constant


def realise(subspace: Subspace, n: int) -> Matrices:
    """
    Realise a model of order n, at most the number of singular values.

    [HD] eq. 51 to 54; eq. 54 multiplied by the inverse operator.
    """
    p, tolerance = subspace.tuning.past, subspace.rank_tolerance
    levels, counts = subspace.levels.rows, subspace.levels.counts
    nz, ny = len(subspace.levels.scale), counts[3]
    root = np.sqrt(np.maximum(subspace.singular_values[:n], 1e-300))
    to_state = (subspace.left[:, :n] / root).T @ subspace.gamma_k             # eq. 51
    x = to_state @ levels[p:0:-1].reshape(p * nz, -1)
    x_g = to_state @ levels[p + 1:1:-1].reshape(p * nz, -1)
    direct = _direct(levels[0], counts, subspace.feedthrough)
    output = least_norm(np.vstack((x, direct)), levels[0, nz - ny:], tolerance)  # eq. 52
    e = levels[0, nz - ny:] - output @ np.vstack((x, direct))                 # eq. 53
    e_g = levels[1, nz - ny:] - output @ np.vstack(
        (x_g, _direct(levels[1], counts, subspace.feedthrough)))
    quiet = np.linalg.norm(e) <= _NEGLIGIBLE * np.linalg.norm(levels[0, nz - ny:])
    beta, gamma = subspace.tuning.beta, subspace.tuning.gamma
    regressors = [x_g, levels[1, :nz - ny]] + ([] if quiet else [e_g])
    state = least_norm(np.vstack(regressors), gamma * x - beta * x_g, tolerance)  # eq. 54 times g
    K = np.zeros((n, ny)) if quiet else state[:, n + nz - ny:]
    # The rows of z are scaled. What belongs to the tail and to the ones is each record's own.
    u, own = subspace.levels.scale[:counts[0]], subspace.levels.scale[nz - ny:, np.newaxis]
    D = output[:, n:n + len(u)] if subspace.feedthrough else np.zeros((ny, len(u)))
    return plain_matrices(state[:, :n], state[:, n:n + len(u)] / u, own * output[:, :n],
                          own * D / u, K / own.T)


class Subspaces:
    """
    The regressions of one projection, computed when asked for.

    Settings other than 0 of beta, gamma, past and future are kept as they are.
    """

    def __init__(self, projection: Projection, settings: Settings) -> None:
        self.projection = projection
        self.settings = settings
        self.of = lru_cache(maxsize=None)(self._regress)
        self._levels = lru_cache(maxsize=None)(partial(stack_levels, projection))

    def tunings(self, n: int) -> list[Tuning]:
        """Return the tunings that the data are long enough for and that can hold order n."""
        top, settings = float(np.abs(self.projection.s).max()), self.settings
        slow = SLOWEST / self.projection.length
        shifts = [settings.beta] if settings.beta else \
            list(np.geomspace(slow, max(0.7 * top, 2.0 * slow), _SHIFTS))
        nu, tail, ones, ny = (len(rows) for rows in (
            self.projection.u, self.projection.tail, self.projection.ones, self.projection.y))
        needed = n // ny + 2
        pasts = [settings.past] if settings.past else [
            p for p in (_PASTS if needed <= _PASTS[-1] else (needed, needed + 4)) if p * ny > n
            and len(self.projection.s) >= (p + 1) * (ny + nu + tail + max(ones, 1))][:_LENGTHS]
        return [Tuning(b, settings.gamma or _GAMMA * b, p, settings.future or p)
                for b in shifts for p in pasts]

    def some_tunings(self, n: int) -> list[Tuning]:
        """Return a part of the grid: one value of p, and every other beta."""
        tunings = self.tunings(n)
        pasts = sorted({t.past for t in tunings})
        return [t for t in tunings if t.past == pasts[len(pasts) // 2]][::2]

    def _regress(self, tuning: Tuning) -> Subspace:
        # One factorisation serves the past windows up to 6, which most searches stay within.
        top = max(tuning.past, 0 if self.settings.past else 6) + 1
        return regress(self._levels(tuning.beta, tuning.gamma, top), tuning,
                       feedthrough=self.settings.feedthrough,
                       rank_tolerance=self.settings.rank_tolerance)


def by_lines(part: Joint, settings: Settings, orders: Sequence[int],
             check: Callable[[], None]) -> Iterator[MethodModel]:
    """Yield models of all orders that the lines can hold, for every tuning left open."""
    subspaces = Subspaces(part.project(settings, check), settings)
    for n in orders:
        for tuning in subspaces.tunings(n):
            check()
            subspace = subspaces.of(tuning)
            if n < len(subspace.singular_values):
                yield MethodModel(
                    realise(subspace, n), settings.replace(
                        order=n, beta=tuning.beta, gamma=tuning.gamma, past=tuning.past,
                        future=tuning.future),
                    subspace.singular_values, subspace.condition)
