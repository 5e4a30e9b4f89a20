# SPDX-License-Identifier: Apache-2.0
"""
Where each input excites the plant, and how well the response to it is known there.

The standard deviation of the frequency response is averaged with the spectrum of the differenced
response to an input, over omega: differenced, so that a single step, which is an edge, counts at
all frequencies up to the plant's bandwidth; over omega, so that every octave counts alike. Rival
models do not count: one with a resonance of its own, that noise alone supports, would outweigh all
other frequencies in the mean.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ctsid_core.likelihood.samples import RecordSamples, Samples
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.covariance import Covariance
from ctsid_core.model.modal import steps_of
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.verdict import Excitation
from ctsid_core.signals.record import Signal

_TAIL = 0.01          # of the weight that lies below, and above, the excited band
_AT_ONCE = 2 ** 16     # numbers of a response that are looked at together
_ALONE = 1e-10        # of an input's power that others do not explain: less is none
_POINTS = 4096        # of the uniform grid of time, at most
_LINES = 200          # of the spectrum of the inputs, the strongest
_TAPERED = 0.4        # of a record, at each of its ends
_LOBE = 1.93          # lines that one sine has after the taper


def excitations(samples: Samples, delay: Array, covariance: Covariance | None, moving: StateSpace,
                names: tuple[str, ...], ahead: float) -> tuple[tuple[Excitation, ...], Array]:
    """
    Return the excitation of each moving input, and how unsure the response of each output is.

    Of inputs with delays (nu,) [s]: what further ones `samples` has does not count. The covariance
    is that of the model of the moving channels, which is asked for what it does in a time `ahead`
    [s]: of a simulation that is the record, of predictions how far they go.
    """
    omega, weight, lines, sent, acting = _input_spectra(samples, delay)
    # That tells a mean over a width of 1 / ahead, of modes that do not decay beside their growth.
    width = 1.0 / ahead + np.max(moving.poles.real, initial=0.0)
    response = replace(moving, A=moving.A - width * np.eye(moving.n)).frequency_response(
        omega) / samples.size[:, np.newaxis]
    variance, moved = _uncertain(samples, covariance, moving, omega, lines, width)
    own = _uncorrelated(sent)
    found = []
    for j, name in enumerate(names):
        seen = weight[:, j] * np.sum(np.abs(response[:, :, j]) ** 2, axis=1)
        total = float(seen.sum())
        if not total > 0.0 or not np.isfinite(total):
            found.append(Excitation(name, frequencies=acting.count(j), own=float(own[j])))
            continue
        part = np.cumsum(seen) / total
        low, high = (float(omega[min(int(np.searchsorted(part, share)), len(omega) - 1)])
                     for share in (_TAIL, 1.0 - _TAIL))
        unsure = float(np.sqrt((weight[:, j, np.newaxis] * variance[:, :, j]).sum() / total)) \
            if own[j] > _ALONE else np.inf
        found.append(Excitation(name, low, high, acting.count(j, high), float(own[j]), unsure))
    seen = np.einsum('fij,jf->fi', response, lines)
    with np.errstate(invalid='ignore', divide='ignore'):
        by_output = np.sqrt(moved / np.sum(np.abs(seen) ** 2, axis=0))
    return tuple(found), np.nan_to_num(by_output, nan=np.inf)


def _uncertain(samples: Samples, covariance: Covariance | None, moving: StateSpace, omega: Array,
               lines: ComplexArray, width: float) -> tuple[Array, Array]:
    """
    Return the variance of the response, (M, ny, nu), and that of each output's motion, (ny,).

    Outputs over their size; infinite where nothing is known.
    """
    variance = np.full((len(omega), samples.ny, len(lines)), np.inf)
    moved, size = np.full(samples.ny, np.inf), samples.size
    if covariance is None:
        return variance, moved
    found, total = np.empty_like(variance), np.zeros(samples.ny)
    # Of many inputs and outputs all at once do not fit into the cache.
    few = max(_AT_ONCE // max(len(covariance.entries.A) * variance[0].size, 1), 1)
    for start in range(0, len(omega), few):
        samples.effort.check()
        part = slice(start, start + few)
        try:
            changes = covariance.response_changes(moving, omega[part], width)
        except np.linalg.LinAlgError:
            return variance, moved
        found[part] = np.sum(np.abs(changes) ** 2, axis=0) / size[:, np.newaxis] ** 2
        total += np.sum(np.abs(np.einsum('rfij,jf->rfi', changes, lines[:, part])) ** 2,
                        axis=(0, 1)) / size ** 2
    return found, total


def _uncorrelated(u: Array) -> Array:
    """Return the share of each input's power that no other input explains, (nu,)."""
    u = u - u.mean(axis=1, keepdims=True)
    power = np.sum(u ** 2, axis=1)
    own = np.zeros(len(u))
    for j in range(len(u)):
        others = np.delete(u, j, axis=0)
        left = u[j]
        if len(others):
            left = left - np.linalg.lstsq(others.T, left, rcond=1e-10)[0] @ others
        own[j] = float(left @ left / power[j]) if power[j] > 0.0 else 0.0
    return own


@dataclass(frozen=True)
class _Acting:
    """Spectra of the inputs as they act: omega (M,), power (nu, M), half rates (nu,)."""

    omega: Array
    power: Array
    half_rate: Array

    def count(self, j: int, answered: float = 0.0) -> float:
        """
        Return the effective number of frequencies of an input.

        The edges of its hold count as far as the plant answers to them [rad/s].
        """
        power = self.power[j, self.omega < max(self.half_rate[j], answered)]
        return float(power.sum() ** 2 / max(np.sum(power ** 2), 1e-300) / _LOBE)


def _half_rates(signal: Signal) -> list[float]:
    """
    Return half the rate of each channel [rad/s]: beyond it are the edges of its hold.

    Infinite where changes turn around at least as often as they go on, as those of levels, pulses
    and noise, in however few messages: these are no samples of a motion that is smooth between.
    """
    found = []
    for steps in np.diff(signal.values, axis=0).T:
        steps = steps[steps != 0.0]     # a value that is sent again is no change
        turns = np.count_nonzero(steps[1:] * steps[:-1] < 0.0)
        found.append(np.inf if 2 * turns >= len(steps) - 1 else np.pi / signal.period)
    return found


def _input_spectra(samples: Samples, delay: Array
                   ) -> tuple[Array, Array, ComplexArray, Array, _Acting]:
    """
    Return frequencies, weights (M, nu) and lines (nu, M) of the inputs there, and more.

    As they act, later by their dead times, on the record in which they change most; the strongest
    lines only. Further what was sent of that, at uniform instants, for inputs that move together
    are not told apart by their dead times; and the spectra of the differences.
    """
    record = max(samples.records, key=_motion)
    finest = min(s.period for s in record.streams)
    count = int(np.clip((record.end - record.start) / finest, 32, _POINTS))
    t = np.linspace(record.start, record.end, count)
    ends = np.cumsum([s.width for s in record.inputs])
    inputs = record.inputs[:int(np.searchsorted(ends, len(delay))) + 1]
    u = steps_of(inputs, delay, record.start, t).inputs
    since = record.start - float(np.max(delay))
    sent = steps_of(inputs, 0.0 * delay, since, np.linspace(
        since, record.end - float(np.min(delay)), count)).inputs
    lines = np.fft.rfft(np.diff(u, axis=1), axis=1)[:, 1:]
    omega = 2.0 * np.pi * np.fft.rfftfreq(count - 1, t[1] - t[0])[1:]
    power = np.abs(lines) ** 2 / omega
    strength = np.sum(power / (power.sum(axis=1, keepdims=True) + 1e-300), axis=0)
    places = np.sort(np.argsort(-strength, kind='stable')[:_LINES])
    # If the taper were as long as the record, only the middle of a sweep would count.
    inside = np.minimum(np.arange(count - 1), np.arange(count - 1)[::-1]) / (_TAPERED * count)
    taper = 0.5 - 0.5 * np.cos(np.pi * np.minimum(inside, 1.0))
    tapered = np.abs(np.fft.rfft(np.diff(u, axis=1) * taper, axis=1))[:, 1:] ** 2 / omega
    half_rates = np.array([rate for s in inputs for rate in _half_rates(
        s.between(since, record.end))])
    return (omega[places], power[:, places].T, lines[:, places] / np.sqrt(omega[places]), sent,
            _Acting(omega, tapered, half_rates))


def _motion(record: RecordSamples) -> float:
    """Return by how much the inputs of a record change in all."""
    return float(sum(np.abs(np.diff(s.values[s.rows(record.start, record.end)], axis=0)).sum()
                     for s in record.inputs))
