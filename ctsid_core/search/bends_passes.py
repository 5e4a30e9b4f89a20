# SPDX-License-Identifier: Apache-2.0
"""
Models of outputs that bend between their samples, under held inputs and inputs on straight lines.

The first model is made of interpolated outputs. Where the bends that interpolation misses
(`bases/bends.py`) show beside the noise, the next model is made of outputs with the bends of a
sum of responses in which the modes of the first one are; and so on until the lines stay, or
their change no longer shrinks: then more than a response of these modes bends the outputs.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ctsid_core.bases.all_channels import moving_model
from ctsid_core.bases.bends import SPARE, Bends, nearest_bends
from ctsid_core.bases.preparation import Usable
from ctsid_core.bases.projection import Projection, as_real, of_records
from ctsid_core.bases.records import Joint
from ctsid_core.likelihood.prediction_errors import prediction_errors
from ctsid_core.likelihood.samples_output_error import MOST_GROWTH
from ctsid_core.linear.matrices import Matrices
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.estimate import Choice, Estimate
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.validation import simulation
from ctsid_core.search.lines import estimate
from ctsid_core.search.solution import Solution, own_delays
from ctsid_core.settings import Settings
from ctsid_core.signals.record import Record

_MATTERS = 10.0       # of what bends do to all lines, in variances of the noise of one
_STAYS = 0.03         # the same from one pass to the next
_SHRINKS = 0.5        # of the power by which lines change: at most this from pass to pass
_ROUNDING = 1e-22     # of an output's power, that counts as noise
_PASSES = 8           # two or three are usual
_BAND = 0.8           # of the Nyquist frequency, beyond which a mode is none of the plant's
_LITTLE = 1e-3        # power of an output, that stable modes may leave unexplained
_NO_WORSE = np.log(1.05)      # of the power of the samples that the last model leaves more
_FAR_BETTER = np.log(2.0)     # of the power, if bends were all that was wrong
_QUIET = 1e-5         # errors over outputs below which the ends of the basis show
_MARGIN = 10.0        # and the edge margin with which they do not
_WHY = 'held inputs bend the outputs between their samples, by more than the noise hides'


def with_bends(part: Joint, found: Solution, settings: Settings) -> tuple[Joint, Solution]:
    """
    Return records whose outputs bend as their model has it between the samples, and that model.

    Parameters
    ----------
    part : Joint
    found : Solution
        The model of these records.
    settings : Settings
        That it was made with.

    Returns
    -------
    part : Joint
    found : Solution
        Both as they are if it makes no difference, or none for the better.
    """
    if settings.edges != 'exact' or not any(map(_bending, part.parts)) \
            or not _matters(part, found):
        return part, found
    own, last, first, before = part, found, True, np.array(np.inf)
    for _ in range(_PASSES):
        bent = _bent(own, last)
        differ, change = _differ(bent, last)
        narrow = not first and settings.edge_margin < _MARGIN and _low_noise(last)
        if narrow:
            settings = settings.replace(edge_margin=_MARGIN)
        elif not first and ((differ < _STAYS) | (change > _SHRINKS * before)).all():
            break
        before = np.array(np.inf) if narrow else change          # of another basis
        again = estimate(bent, settings, last.settings.order) \
            if first or narrow or (differ > _MATTERS).any() else _again(bent, last)
        if again is None:
            break
        own, last, first = bent, again, False
    if not _left(own, last) < _NO_WORSE + _left(part, found):
        return part, found
    choices = [c for c in last.choices if c.name != 'bends']
    return own, replace(last, choices=(*choices, Choice('bends', 'response', _WHY)))


def bends(part: Joint) -> bool:
    """Return whether any record has outputs that bend."""
    return any(p.bends is not None for p in part.parts)


def explains_as_well(other: Estimate, part: Joint, found: Solution) -> bool:
    """Return whether bent lines do not explain the samples far better than another estimate."""
    model, p = other.model, part.parts[0]
    if model is None or (model.nu, model.ny) != (p.record.nu, p.record.ny):
        return False                           # rejected, or channels that rest
    free = model.n * (model.nu + model.ny) + model.D.size * bool(np.any(model.D))
    power = float(np.mean(_powers(model, p.record)))
    return _criterion(part, power - _FAR_BETTER, free) < on_samples(part, found)


def on_samples(part: Joint, found: Solution) -> float:
    """Return Schwarz's criterion of a simulation on the samples themselves, as if uniform."""
    m = found.matrices
    free = len(m.A) * (m.B.shape[1] + len(m.C)) + m.D.size * found.settings.feedthrough
    return _criterion(part, _left(part, found), free)


def _criterion(part: Joint, power: float, free: int) -> float:
    count = sum(len(s.time) * s.width for p in part.parts for s in p.whole.outputs)
    return float(count * power + free * np.log(count))


def bent_further(part: Joint, found: Solution) -> tuple[Joint, Projection] | None:
    """Return records that bend as another model has it; None if they do not bend, or alike."""
    if not bends(part):
        return None
    bent = _bent(part, found)
    if (_differ(bent, found)[0] < _STAYS).all():
        return None
    return bent, bent.project(_projected(found), found.layout)


def _bending(p: Usable) -> bool:
    return any(s.hold != 'smooth' for s in p.record.inputs) and \
        any(s.hold == 'smooth' for s in p.record.outputs)


def _matters(part: Joint, found: Solution) -> bool:
    """Return whether bends show beside the noise: of a model's own response unless it explodes."""
    parts = []
    for p, m in zip(part.parts, of_records(found.matrices, found.projection), strict=True):
        model = moving_model(m, own_delays(p, found.settings).delays(p.record.nu))
        if not (np.isfinite(m.A).all()
                and np.max(model.poles.real) * p.record.duration < MOST_GROWTH):
            return _explained(_bent(part, found))
        seen = simulation(model, p.record)
        smooth = np.array([s.hold == 'smooth' for s in p.record.outputs for _ in range(s.width)])
        weights = np.hstack((m.C, m.D, model.y_trim[:, np.newaxis])) * smooth[:, np.newaxis]
        parts.append(replace(p, bends=Bends(
            model.A, model.B, model.x_trim, p.record.inputs, model.delay, seen.x0, weights,
            float(seen.times[0]), float(seen.times[-1]), rough=True)))
    return not (_differ(replace(part, parts=tuple(parts)), found)[0] < _MATTERS).all()


def _explained(part: Joint) -> bool:
    """Return whether bends leave little of the samples: what explodes was no plant."""
    for p in part.parts:
        left = p.bends.left_of(p.record.outputs) if p.bends else p.record.outputs
        for signal, rest in zip(p.record.outputs, left, strict=True):
            power, kept = (np.mean(s.values ** 2, axis=0) for s in (signal, rest))
            if signal.hold == 'smooth' and (kept > _LITTLE * power).any():
                return False
    return True


def _bent(part: Joint, found: Solution) -> Joint:
    """Return records whose outputs bend as responses of a model's modes do."""
    trim, feed = found.settings.trim, found.settings.feedthrough
    return replace(part, parts=tuple(p.bent(nearest_bends(
        p.record, _modes(found.matrices, p), own_delays(p, found.settings).delays(p.record.nu),
        [spiky.mask for spiky in p.corrupt_y], trim=trim, feedthrough=feed)) for p in part.parts))


def _modes(m: Matrices, p: Usable) -> ComplexArray:
    """Return the poles of a model that can be the plant's, slow ones first, and spare ones."""
    top = _BAND * np.pi / max(s.period for s in p.record.outputs)
    poles = np.linalg.eigvals(m.A).astype(complex) if np.isfinite(m.A).all() else \
        np.empty(0, dtype=complex)
    own = poles[(poles.imag >= 0.0) & (poles.imag < top)
                & (poles.real * p.record.duration < MOST_GROWTH)]
    spare = -np.geomspace(1.0 / p.record.duration, top, SPARE)
    return np.concatenate((own[np.argsort(np.abs(own), kind='stable')], spare))


def _projected(found: Solution) -> Settings:
    """Return the settings that the records of a model were projected with."""
    return found.search.settings


def _differ(part: Joint, found: Solution) -> tuple[Array, Array]:
    """Return by how much each output's lines differ: in variances of the noise; of the power."""
    old = found.projection
    new = part.project(_projected(found), found.layout)
    change = np.sum(as_real(new.y - old.y) ** 2, axis=1)
    error, y = as_real(prediction_errors(old, found.matrices)), as_real(old.y)
    power = np.sum(y ** 2, axis=1) + 1e-300
    noise = np.mean(error ** 2, axis=1) + _ROUNDING * power
    return np.asarray(change / noise), np.asarray(change / power)


def _low_noise(found: Solution) -> bool:
    """Return whether a model leaves so little that the ends of the basis show."""
    error, y = prediction_errors(found.projection, found.matrices), found.projection.y
    return bool((np.linalg.norm(error, axis=1) < _QUIET * np.linalg.norm(y, axis=1)).all())


def _again(part: Joint, found: Solution) -> Solution | None:
    """Return the model of other lines of the same order and tuning."""
    again = estimate(part, found.settings, found.settings.order, found.layout)
    return again and replace(again, choices=found.choices, orders=found.orders)


def _left(part: Joint, found: Solution) -> float:
    """Return what simulations leave of the samples: mean logarithm of power over the outputs."""
    return float(np.mean([
        _powers(moving_model(m, own_delays(p, found.settings).delays(p.record.nu)), p.record)
        for p, m in zip(part.parts, of_records(found.matrices, found.projection), strict=True)]))


def _powers(model: StateSpace, record: Record) -> Array:
    """Return logarithms of the power that a simulation leaves of each output's samples."""
    seen = simulation(model, record)
    with np.errstate(over='ignore'):                       # of a model that explodes: infinite
        return np.asarray(np.log(np.nanmean((seen.y - seen.y_hat) ** 2, axis=0) + 1e-300))
