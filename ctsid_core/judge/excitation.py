# SPDX-License-Identifier: Apache-2.0
"""
Where each input excites the plant, and how well the response to it is known there.

The standard deviation of the frequency response is averaged with the spectrum of the differenced
response to an input, over omega: differenced, so that a single step, which is an edge, counts at
all frequencies up to the plant's bandwidth; over omega, so that every octave counts alike. Models
that might be right instead count by how far apart they simulate what each input moves: what all
inputs and the initial state move together they simulate alike.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from ctsid_core.bases.preparation import Usable
from ctsid_core.likelihood.modal_model import ModalModel
from ctsid_core.likelihood.mode_columns import columns_of
from ctsid_core.likelihood.samples import RecordSamples, Samples
from ctsid_core.linear.least_squares import orthonormal
from ctsid_core.linear.matrix_functions import change_of, phi
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.covariance import Covariance
from ctsid_core.model.modal import steps_of
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.verdict import Excitation
from ctsid_core.signals.actuators import unramped
from ctsid_core.signals.record import Signal

_TAIL = 0.01          # of the weight that lies below, and above, the excited band
_AT_ONCE = 2 ** 16     # numbers of a response that are looked at together
_ALONE = 1e-10        # of an input's power that others do not explain: less is none
_SAME = 1e-8          # relative singular value below which responses are alike
_POINTS = 2 ** 16      # of the uniform grid of time of a record, at most
_LINES = 200          # of the spectrum of the inputs of a record, the strongest
_FINER = 8            # times as near as lines are frequencies at which sines are looked for
_LEFT = 0.03          # of the motion of an input: its sines are alike that have less


def excitations(samples: Samples, part: Usable, covariance: Covariance | None, model: StateSpace,
                ahead: float, apart: Array) -> tuple[tuple[Excitation, ...], Array, float]:
    """
    Return the excitation of each moving input, how unsure each output's response is, and when.

    Of the channels of `part`: what further inputs `samples` has does not count. Model and
    covariance, of all channels, are asked for what the model does in a time [s]: of a simulation
    the record, and `ahead` is infinite; of predictions as far `ahead` as they go, and at least one
    over the mean frequency of what inputs move. Sooner a plant does what is of frequencies that
    nothing moves: that would hinge on how fast outputs are sampled. `apart`, (nu,): how far
    `rivals_apart` are.
    """
    omega, lines, sent, acting = _input_spectra(samples, np.array(model.delay)[list(part.u)])
    weight = np.abs(lines.T) ** 2

    def seen_over(width: float) -> tuple[StateSpace, ComplexArray]:
        mean = replace(model, A=_further(model.A, width))
        return mean, _moving(mean.frequency_response(omega), part) / samples.size[:, np.newaxis]

    width = 1.0 / samples.length
    mean, response = seen_over(width)
    if ahead < samples.length:
        power = np.sum(weight * np.sum(np.abs(response) ** 2, axis=1), axis=1)
        ahead = float(np.clip(power.sum() / max(float(power @ omega), 1e-300), ahead,
                              samples.length))
        width = 1.0 / ahead
        mean, response = seen_over(width)
    if covariance is not None:
        covariance = replace(covariance, root=covariance.entries._replace(A=_further(
            model.A, width, covariance.entries.A)).rows())
    variance, moved = _uncertain(samples, part, covariance, mean, omega, lines)
    own, answer = _uncorrelated(sent), np.sum(np.abs(response) ** 2, axis=1)
    found = []
    for j, place in enumerate(part.u):
        samples.effort.check()
        name, seen = part.whole.input_names[place], weight[:, j] * answer[:, j]
        most = max(acting, key=lambda one: float(np.sum(np.abs(one.differences[j]))))
        total = float(seen.sum())
        if not total > 0.0 or not np.isfinite(total):
            found.append(Excitation(name, frequencies=most.count(j), own=float(own[j])))
            continue
        below = np.cumsum(seen) / total
        low, high = (float(omega[min(int(np.searchsorted(below, share)), len(omega) - 1)])
                     for share in (_TAIL, 1.0 - _TAIL))
        unsure = float(np.hypot(np.sqrt(weight[:, j] @ variance[:, j] / total), apart[j])) \
            if own[j] > _ALONE else np.inf
        found.append(Excitation(name, low, high, most.count(j, high), float(own[j]), unsure))
    seen = np.einsum('fij,jf->fi', response, lines)
    with np.errstate(invalid='ignore', divide='ignore'):
        by_output = np.sqrt(moved / np.sum(np.abs(seen) ** 2, axis=0))
    return tuple(found), np.nan_to_num(by_output, nan=np.inf), ahead


def _further(A: Array, width: float, changes: Array | None = None) -> Array:
    """
    Return A, or how changes of it change that, with modes further from the axis by a width.

    The response is then a mean over that width: what is seen within one over it [s]. Modes that
    grow by e in that time grow faster, so far into the past; all others decay faster, those that
    grow by less beside as much as they do.
    """
    # By the spectral projector of what grows: integrators may be alike.
    T, Z, count = scipy.linalg.schur(A, sort=lambda re, _: re <= width)
    slow = width + np.max(np.linalg.eigvals(T[:count, :count]).real, initial=0.0)
    if changes is not None:
        return changes if count == len(A) else change_of(
            A, changes, lambda z: z + np.where(z.real > width, width, -slow), np.ones_like)
    Y = scipy.linalg.solve_sylvester(T[:count, :count], -T[count:, count:], -T[:count, count:]) \
        if 0 < count < len(A) else np.zeros((count, len(A) - count))
    grows = (Z[:, :count] @ Y + Z[:, count:]) @ Z[:, count:].T
    return np.asarray(A - slow * np.eye(len(A)) + (width + slow) * grows)


def rivals_apart(samples: Samples, model: ModalModel,
                 rivals: Sequence[tuple[float, ModalModel]]) -> Array:
    """Return how far apart models that might be right simulate what each input moves, (nu,)."""
    # Rms over that motion, each with its share. Lines and decays of both models do not count: trim
    # and initial state stand for these.
    if not rivals:
        return np.zeros(samples.nu)
    # From rest before any input is known to move: else a jump is within a dead time of some alone.
    samples = replace(samples, records=tuple(
        replace(r, start=min(r.start, *(float(s.time[0]) for s in r.inputs)))
        for r in samples.records))
    own, found = list(_moved_by_inputs(samples, model)), np.zeros(samples.nu)
    motion = np.sum([np.var(y, axis=0).sum(axis=0) * weight for weight, _, y in own], axis=0)
    for share, other in rivals:
        samples.effort.check()
        both = np.concatenate((model.poles, other.poles))
        for (weight, t, y), (_, _, rival) in zip(own, _moved_by_inputs(samples, other),
                                                 strict=True):
            decays = np.exp(np.outer(t - t[0], both[both.imag == 0.0].real))
            known = np.hstack((np.vander((t - t[0]) / samples.length, 2), decays))
            known = known @ orthonormal(known, _SAME)
            left = (rival - y).reshape(len(t), -1)
            left -= known @ (known.T @ left)
            found += share * weight * np.mean(left.reshape(y.shape) ** 2, axis=0).sum(axis=0)
    return np.asarray(np.sqrt(found / np.maximum(motion, 1e-300)))


def _moved_by_inputs(samples: Samples, model: ModalModel) -> Iterator[tuple[float, Array, Array]]:
    """Yield the stamps of each stream, and what each input moves there, (N, channels, nu)."""
    # As it moves from what it is where states begin. Before them the share of the stream in all
    # samples of its outputs.
    total = samples.counts.sum(axis=0)
    columns = columns_of(samples, *model.nonlinear, direct=True, turned=False, slopes=False)
    for record, triangles, u in zip(samples.records, columns.triangles, columns.first,
                                    strict=True):
        for s, t in zip(record.streams, triangles, strict=True):
            if not len(s.times):
                continue
            since = s.times[:, np.newaxis] - record.start
            held = since * phi(since * model.poles, 1)[1]
            driven = (t.z[:, :, :-1] - held[:, :, np.newaxis] * u) * model.b
            moved = np.einsum('kmj,im->kij', driven, model.c[s.channels]).real \
                + (t.u - u)[:, np.newaxis] * model.D[s.channels]
            yield len(s.times) / float(total[s.channels][0]), s.times, moved


def _uncertain(samples: Samples, part: Usable, covariance: Covariance | None, model: StateSpace,
               omega: Array, lines: ComplexArray) -> tuple[Array, Array]:
    """Return the variance of responses to each input, (M, nu), and of outputs' motion, (ny,)."""
    # Outputs over their size; infinite where nothing is known.
    shape, size = (len(omega), len(lines)), samples.size
    nothing = np.full(shape, np.inf), np.full(samples.ny, np.inf)
    if covariance is None:
        return nothing
    found, total = np.empty(shape), np.zeros(samples.ny)
    # Of many inputs and outputs all at once do not fit into the cache.
    few = max(_AT_ONCE // max(len(covariance.root) * model.nu * model.ny, 1), 1)
    for start in range(0, len(omega), few):
        samples.effort.check()
        some = slice(start, start + few)
        try:
            changes = _moving(covariance.response_changes(model, omega[some]), part)
        except np.linalg.LinAlgError:
            return nothing
        changes /= size[:, np.newaxis]
        found[some] = np.sum(np.abs(changes) ** 2, axis=(0, 2))
        total += np.sum(np.abs(np.einsum('rfij,jf->rfi', changes, lines[:, some])) ** 2,
                        axis=(0, 1))
    return found, total


def _moving(values: ComplexArray, part: Usable) -> ComplexArray:
    """Return what belongs to moving outputs and inputs, the last axes of values of all."""
    return values[..., list(part.y), :][..., list(part.u)]


def _uncorrelated(u: Array) -> Array:
    """Return the share of each input's power that no other input explains, (nu,)."""
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
    """Differences of the inputs as they act, (nu, M), how far apart [s], and half rates (nu,)."""

    differences: Array
    step: float
    half_rate: Array

    def count(self, j: int, answered: float = 0.0) -> float:
        """Return the effective number of frequencies of an input."""
        # As many as have, with equal shares, the entropy of the shares of sines that are taken
        # from it one after the other, the largest first, every octave alike; the rest is of such
        # as are just not taken. The edges of its hold count as far as the plant answers to them
        # [rad/s].
        count, largest = self.differences.shape[1], np.max(np.abs(self.differences[j]))
        left = self.differences[j] / (largest or 1.0)
        omega = 2.0 * np.pi * np.fft.rfftfreq(_FINER * count, self.step)[:-1]
        end = int(np.searchsorted(omega, max(self.half_rate[j], answered)))
        seen, times = slice(_FINER, max(end, _FINER + 1)), self.step * np.arange(count)
        shares: list[float] = []
        while True:
            power = np.abs(np.fft.rfft(left, _FINER * count)[seen]) ** 2 / omega[seen]
            rest, best = float(power.sum()) / _FINER, float(omega[seen][np.argmax(power)])
            waves = np.column_stack((np.cos(best * times), np.sin(best * times)))
            sine = waves @ np.linalg.solve(waves.T @ waves, waves.T @ left)
            share = 0.5 * count * float(sine @ sine) / best
            total = max(sum(shares) + rest, 1e-300)
            if not share > _LEFT * total:
                sizes = np.array(shares) / total
                return float(np.exp(-sizes @ np.log(sizes) - rest / total * np.log(_LEFT)))
            shares.append(share)
            left -= sine


def _half_rates(signal: Signal) -> list[float]:
    """Return half the rate of each channel [rad/s]: beyond it are the edges of its hold."""
    # Infinite where changes turn around at least as often as they go on, as those of levels,
    # pulses and noise, in however few messages: these are no samples of a motion that is smooth
    # between. A slow plant does not answer to the edges of a staircase that is sent when it
    # changes: it may be at too few frequencies, where the same one sent fifty times a second is
    # not.
    found = []
    for steps in np.diff(signal.values, axis=0).T:
        steps = steps[steps != 0.0]     # a value that is sent again is no change
        turns = np.count_nonzero(steps[1:] * steps[:-1] < 0.0)
        found.append(np.inf if 2 * turns >= len(steps) - 1 else np.pi / signal.period)
    return found


def _input_spectra(samples: Samples, delay: Array
                   ) -> tuple[Array, ComplexArray, Array, list[_Acting]]:
    """Return the strongest lines of differenced inputs, every octave alike, and what was sent."""
    # As they act, of all records: frequencies (M,), ascending, lines (nu, M); sent (nu, N), at
    # uniform instants, centred, for inputs that move together are not told apart by their dead
    # times; and the differences of each record.
    found = [_of_record(r, delay) for r in samples.records if r.end > r.start]
    omega, lines, sent = (np.concatenate([one[k] for one in found], axis=-1) for k in range(3))
    order = np.argsort(omega, kind='stable')
    return omega[order], lines[:, order], sent, [one[3] for one in found]


def _of_record(record: RecordSamples, delay: Array) -> tuple[Array, ComplexArray, Array, _Acting]:
    """Return the strongest lines of a record, what was sent, and how differences act."""
    length = record.end - record.start
    finest = min(s.period for s in record.streams)
    count = int(np.clip(length / finest, 32, _POINTS))
    t = np.linspace(record.start, record.end, count)
    ends = np.cumsum([s.width for s in record.inputs])
    inputs = record.inputs[:int(np.searchsorted(ends, len(delay))) + 1]
    u = steps_of(inputs, delay, record.start, t).inputs
    since = record.start - float(np.max(delay))
    sent = steps_of(inputs, 0.0 * delay, since, np.linspace(
        since, record.end - float(np.min(delay)), count)).inputs
    omega = 2.0 * np.pi * np.fft.rfftfreq(count - 1, t[1] - t[0])[1:]
    # Over the root of the length, so that lines of records of any lengths add up.
    lines = np.fft.rfft(np.diff(u, axis=1), axis=1)[:, 1:] / np.sqrt(omega * length)
    power = np.abs(lines) ** 2
    strength = np.sum(power / (power.sum(axis=1, keepdims=True) + 1e-300), axis=0)
    places = np.argsort(-strength, kind='stable')[:_LINES]
    held = unramped(inputs, record.commands)
    half_rates = np.array([rate for s in held for rate in _half_rates(
        s.between(since, record.end))])
    acting = np.diff(steps_of(held, delay, record.start, t).inputs, axis=1)
    sent = (sent - sent.mean(axis=1, keepdims=True)) * np.sqrt(t[1] - t[0])
    return (omega[places], lines[:, places], sent, _Acting(acting, t[1] - t[0], half_rates))
