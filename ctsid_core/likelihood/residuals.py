# SPDX-License-Identifier: Apache-2.0
"""The errors of a simulation at the samples, how many are independent, and the motion beside."""

from __future__ import annotations

import numpy as np

from ctsid_core.likelihood.mode_columns import ROUNDING, columns_of
from ctsid_core.likelihood.output_error import Fit, errors_of
from ctsid_core.likelihood.samples import RecordSamples, Residuals, Samples
from ctsid_core.linear.types import Array

_SMALL = 0.05         # autocorrelation below which the sum over lags ends
_LAGS = 20            # of an autoregression of errors, at most, ...
_FEWEST = 10          # ... with so many samples for each
_MOTION = 10          # parts of each record, within which motion counts
_RUN = 8              # samples at least, that tell how much errors vary within a short time


def residuals(samples: Samples, fit: Fit) -> Residuals:
    """Return measured less simulated outputs over their size, (N, channels) of each stream."""
    return errors_of(samples, fit.model, columns_of(
        samples, *fit.model.nonlinear, direct=bool(fit.model.D.any()), turned=False, slopes=False))


def driven(samples: Samples, fit: Fit, errors: Residuals) -> Array:
    """Return the rms of what inputs alone explain, over the size of the outputs, (ny,)."""
    poles, found = fit.model.poles, []
    for k in range(len(samples.records[0].streams)):
        rows = []
        for r, own in zip(samples.records, errors, strict=True):
            since = (r.streams[k].times - r.start)[:, np.newaxis]
            free = np.exp(poles * since)
            known = np.hstack((free.real, free[:, poles.imag > 0.0].imag, np.ones_like(since)))
            moved = r.streams[k].y - own[k]
            # Of initial states and a trim that would imitate or outweigh it nothing is left.
            rows.append(moved - known @ np.linalg.lstsq(known, moved, rcond=None)[0])
        found.append(np.sqrt(np.mean(np.concatenate(rows) ** 2, axis=0)))
    return np.concatenate(found)


def by_output(errors: Residuals) -> list[list[Array]]:
    """Return the errors of each output, a part of each record."""
    return [[e[:, i] for e in rows] for rows in zip(*errors, strict=True)
            for i in range(rows[0].shape[1])]


def independent(errors: Residuals) -> Array:
    """
    Return the number of independent samples among the errors of each output, (ny,).

    The least of N / (1 + 2 sum_k rho_k), the autocorrelation summed over lags until it is small,
    and N / (1/2 + sum_k rho_k^2), up to half the record: of errors of a narrow band, a vibration
    or waves, the autocorrelation soon changes its sign, and its sum is small, but it lasts.
    """
    return np.array([sum(map(len, parts)) / _correlation(parts) for parts in by_output(errors)])


def autoregression(error: Array) -> tuple[float, Array]:
    """Return -2 log likelihood of errors as an autoregression (Burg), and its polynomial."""
    # The polynomial makes innovations of errors. Schwarz's criterion chooses its degree.
    count, polynomial = len(error), np.ones(1)
    if not count:
        return 0.0, polynomial
    ahead = behind = error - error.mean()
    power = max(float(np.mean(ahead ** 2)), ROUNDING)
    price, best = float(np.log(count)), (count * float(np.log(power)), polynomial)
    for degree in range(1, min(_LAGS, count // _FEWEST) + 1):
        ahead, behind = ahead[1:], behind[:-1]
        reflection = 2.0 * float(ahead @ behind) / max(
            float(ahead @ ahead + behind @ behind), ROUNDING)
        ahead, behind = ahead - reflection * behind, behind - reflection * ahead
        longer = np.append(polynomial, 0.0)
        polynomial = longer - reflection * longer[::-1]
        power = max(power * (1.0 - reflection ** 2), ROUNDING)
        best = min(best, (count * float(np.log(power)) + degree * price, polynomial),
                   key=lambda one: one[0])
    return best


def _correlation(parts: list[Array]) -> float:
    """Return for how many samples of a sequence in parts there is one that is independent."""
    longest = max(len(e) for e in parts)
    total = np.zeros(longest)
    for e in parts:
        if len(e) > 1:
            size = 1 << (2 * len(e) - 1).bit_length()
            spectrum = np.fft.rfft(e - e.mean(), size)
            total[:len(e)] += np.fft.irfft(np.abs(spectrum) ** 2, size)[:len(e)]
    if not total[0] > 0.0:
        return 1.0
    rho = total[1:] / total[0]
    below = np.flatnonzero(rho < _SMALL)
    end, half = int(below[0]) if len(below) else len(rho), rho[:len(rho) // 2]
    return float(max(1.0 + 2.0 * rho[:end].sum(), 0.5 + half @ half))


def white_part(errors: Residuals) -> Array:
    """Return the rms of the white part of the errors of each output, (ny,)."""
    # From what neighbours do not share: (e_(k+1) - 2 e_k + e_(k-1)) / sqrt(6). Noise that is
    # stronger the faster it is, as of differences, has less: no more than runs of samples vary.
    found = []
    for parts in by_output(errors):
        bent = np.concatenate([e[2:] - 2.0 * e[1:-1] + e[:-2] for e in parts])
        runs = [e[:len(e) // k * k].reshape(k, -1) for e in parts if len(e) > 1
                for k in [max(len(e) // _RUN, 1)]]
        within = sum(float(np.sum(np.var(one, axis=1, ddof=1))) * one.shape[1] for one in runs)
        found.append(min(float(bent @ bent) / 6.0 / max(len(bent), 1), within / sum(
            one.size for one in runs) if runs else np.inf))
    return np.sqrt(found)


def mean_square(errors: Residuals) -> Array:
    """Return the mean square of the errors of each output, (ny,); NaN of none."""
    return np.array([sum(e @ e for e in parts) / (sum(map(len, parts)) or np.nan) + 1e-300
                     for parts in by_output(errors)])


def coloured_power(errors: Residuals) -> Array:
    """Return the mean square of what is not white noise, (ny,)."""
    return np.asarray(np.maximum(mean_square(errors) - white_part(errors) ** 2, 0.0))


def motion_within(samples: Samples, errors: Residuals) -> Array:
    """Return the rms of what a model moves around its mean in a tenth of a record, (ny,)."""
    # One large step makes most of the standard deviation of a window, and errors of all that moves
    # besides look small over it.
    squares = np.zeros(samples.ny)
    for record, own in zip(samples.records, errors, strict=True):
        edges = np.linspace(*record.span, _MOTION + 1)[1:-1]
        for s, e in zip(record.streams, own, strict=True):
            for y in np.split(s.y - e, np.searchsorted(s.times, edges)):
                if len(y):
                    squares[s.channels] += len(y) * np.var(y, axis=0)
    return np.asarray(np.sqrt(squares / samples.counts.sum(axis=0)))


def motion_ahead(record: RecordSamples, errors: tuple[Array, ...], seconds: float) -> Array:
    """
    Return the rms of what a model moves by in so much time, over the motion, (ny,).

    A prediction of the next hundredth of a second is right to 90 % for what hardly moves in so
    short a time. Infinite where that cannot be told: in a shorter record, or of an output that
    does not move.
    """
    found = []
    for s, e in zip(record.streams, errors, strict=True):
        now = s.times <= record.end - seconds
        for y, measured in zip((s.y - e).T, s.y.T, strict=True):
            if not now.any() or not np.ptp(measured) > 0.0:
                found.append(np.inf)
                continue
            moved = np.interp(s.times[now] + seconds, s.times, y) - y[now]
            found.append(max(float(np.sqrt(np.mean(moved ** 2)) / np.std(measured)), 1e-300))
    return np.array(found)
