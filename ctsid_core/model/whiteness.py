# SPDX-License-Identifier: Apache-2.0
"""
Residual tests: whiteness, and independence of past inputs.

Both tests hold their level at any stamps. P-values are uniform between 0 and 1 where there is
nothing left to explain; a small one (below 0.01, say) speaks against the model.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.special import chdtrc

from ctsid_core.linear.types import Array

LAGS = 20
FEWEST = 50    # samples
_CELLS = 10.0  # for each residual, at most


def whiteness(e: Array) -> float:
    """
    Return the p-value of 'these residuals (N,) are independent of each other' (Ljung-Box).

    Lags 1 to 20 are counted in samples, not in seconds: independent residuals are uncorrelated at
    any spacing, so uneven stamps and gaps leave the level of the test as it is; they only blur in
    time what it would find. NaN for fewer than 50 samples or constant residuals.

    G. M. Ljung, G. E. P. Box, "On a measure of lack of fit in time series models", Biometrika 65,
    1978. No degrees of freedom are taken off for estimated parameters: of a model's own record,
    the p-value is a little too large.
    """
    count, e = len(e), e - e.mean() if len(e) else e
    power = float(e @ e)
    if count < FEWEST or not power > 0:
        return float('nan')
    lags = np.arange(1, LAGS + 1)
    r = np.array([e[:-k] @ e[k:] for k in lags]) / power
    return float(chdtrc(LAGS, count * (count + 2) * np.sum(r ** 2 / (count - lags))))


def cell(times: Array) -> float:
    """
    Return the median interval of stamps (N,), N > 1 [s].

    More for those that came in bursts: there are a few times as many cells, not all that fit.
    """
    return float(max(np.median(np.diff(times)), np.ptp(times) / (_CELLS * len(times))))


def independence(times: Array, e: Array, inputs_at: Callable[[Array], Array],
                 memory: float) -> Array:
    """
    Return the p-value, per input, of 'these residuals are independent of the input's past'.

    The statistic is the sum of the squared cross-correlations at lags from 0 to about `memory`
    [s], at least 20 cells and at most a tenth of the record. It is ranked among the values it
    takes when the input is shifted against the residuals in time, circularly and by more than
    these lags: shifted by a whole different time, the two have nothing to do with each other but
    keep their own spectra. Coloured residuals and coloured inputs are thereby allowed for without
    being modelled. Residuals e (N,) at increasing times (N,) [s] go into cells of one median
    interval, or more if there were many (lags are right to half a cell), empty cells do not
    count, and the inputs are known everywhere by their holds: `inputs_at` stamps (G,) gives
    (G, nu), after their dead time.

    NaN for fewer than 50 samples, constant residuals, or an input that does not move. Conservative
    for the model's own record. Under feedback, residuals also act on *later* inputs; the test
    looks at earlier ones only, but a slow loop smears one into the other.
    """
    if len(times) < FEWEST or not np.ptp(e) > 0:
        return np.full(inputs_at(times[:1]).shape[-1] if len(times) else 0, np.nan)
    step = cell(times)
    cells = np.rint((times - times[0]) / step).astype(int)
    count = int(cells[-1]) + 1
    binned = np.bincount(cells, e - e.mean(), count)
    u = inputs_at(times[0] + step * np.arange(count))
    moves = np.ptp(u, axis=0) > 0
    spectra = np.fft.rfft(binned)[:, np.newaxis] * np.fft.rfft(u - u.mean(axis=0), axis=0).conj()
    correlation = np.fft.irfft(spectra, count, axis=0)  # (lag, input), circular
    lags = int(np.clip(min(memory, times[-1] - times[0]) / step, LAGS, max(count // 10, 1)))
    sums = np.cumsum(np.concatenate([np.zeros_like(u[:1]), correlation ** 2]), axis=0)
    statistic = sums[lags:] - sums[:-lags]  # at shifts 0 ... count - lags
    higher = (statistic[lags:] >= statistic[0]).sum(axis=0)
    p: Array = (1 + higher) / (1 + len(statistic) - lags)
    return np.where(moves, p, np.nan)
