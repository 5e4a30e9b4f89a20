# SPDX-License-Identifier: Apache-2.0
"""
Models of outputs that bend between their samples, under held inputs and inputs on straight lines.

The first model is made of interpolated outputs. Where the bends that interpolation misses
(`bases/bends.py`) are more than the noise hides, the next model is made of outputs with these
bends, of a span of modes that has those of the model in it; and so on until the lines stay.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ctsid_core.bases.base import Projection, as_real
from ctsid_core.bases.bends import SPARE, Bends, ComplexArray, bends
from ctsid_core.estimate import Choice
from ctsid_core.estimation import estimate
from ctsid_core.found import Found, own_delays
from ctsid_core.joint import Joint
from ctsid_core.pbsid import Matrices
from ctsid_core.prediction_errors import prediction_errors
from ctsid_core.settings import Settings
from ctsid_core.usable import Usable
from ctsid_core.validation import simulation
from ctsid_core.whole_model import moving_model

_MATTERS = 3.0        # of what bends do to the lines, in variances of the noise of one line
_STAYS = 0.03         # the same from one pass to the next
_ROUNDING = 1e-22     # of an output's power, that counts as noise
_PASSES = 8
_GROWTH = 5.0         # time constants for which an unstable pole may grow over a record
_BAND = 0.8           # of the Nyquist frequency, beyond which a mode is none of the plant's
_NO_WORSE = 1.05      # power that the last model leaves of the samples, over the first's
_QUIET = 1e-5         # errors over outputs below which the ends of the basis show
_MARGIN = 10.0        # and the margin with which they do not
LOG = None


def with_bends(part: Joint, found: Found, settings: Settings) -> tuple[Joint, Found]:
    """
    Return records whose outputs bend as their model has it between the samples, and that model.

    Parameters
    ----------
    part : Joint
    found : Found
        Made of interpolated outputs.
    settings : Settings
        That it was made with.

    Returns
    -------
    part : Joint
    found : Found
        Both as they are if it makes no difference, or none for the better.
    """
    if settings.edges != 'exact' or not any(map(_bending, part.parts)) or \
            not _matters(part, found):
        return part, found
    own, last = part, found
    for k in range(_PASSES):
        bent = _bent(own, last)
        new = bent.project(_projected(bent, last), last.layout)
        differ = _differ(new, last.projection, last)
        narrow = k and _quiet(last) and settings.edge_margin < _MARGIN
        if LOG is not None: LOG.append((k, len(last.matrices.A), last.process_noise, differ, settings.edge_margin))
        if narrow:
            settings = settings.replace(edge_margin=_MARGIN)
        elif k and differ < _STAYS:
            break
        again = estimate(bent, settings, last.settings.order) if narrow or differ > _MATTERS or not k \
            else _again(bent, last)
        if again is None:
            break
        own, last = bent, again
    if own is part or not _left(own, last) < _NO_WORSE * _left(part, found):
        return part, found
    why = 'a held input bends the outputs between their samples, by more than the noise hides'
    return own, replace(last, choices=(*last.choices, Choice('bends', 'model', why)))


def _matters(part: Joint, found: Found) -> bool:
    """Return whether the bends of a model's own response show beside the noise."""
    parts = []
    for p, m in zip(part.parts, found.matrices.of_records(found.projection), strict=True):
        model = moving_model(m, own_delays(p, found.settings).delays(p.record.nu))
        if not (np.isfinite(m.A).all() and np.max(model.poles.real) * p.record.duration < _GROWTH):
            return True
        seen = simulation(model, p.record)
        smooth = np.array([s.hold == 'smooth' for s in p.record.outputs for _ in range(s.width)])
        weights = np.hstack((m.C, m.D, model.y_trim[:, np.newaxis])) * smooth[:, np.newaxis]
        parts.append(replace(p, bends=Bends(
            model.A, model.B, model.x_trim, p.record.inputs, model.delay, seen.x0, weights,
            float(seen.times[0]), float(seen.times[-1]), rough=True)))
    bent = replace(part, parts=tuple(parts)).project(_projected(part, found), found.layout)
    return not _differ(bent, found.projection, found) < _MATTERS


def _again(part: Joint, found: Found) -> Found | None:
    """Return the model of the same order and tuning."""
    again = estimate(part, found.settings, found.settings.order, found.layout)
    return again and replace(again, choices=found.choices, orders=found.orders)


def _bending(p: Usable) -> bool:
    return any(s.hold != 'smooth' for s in p.record.inputs) and \
        any(s.hold == 'smooth' for s in p.record.outputs)


def _bent(part: Joint, found: Found) -> Joint:
    """Return records whose outputs bend as the modes of a model have it."""
    trim, feed = found.settings.trim, found.settings.feedthrough
    return replace(part, parts=tuple(p.bent(bends(
        p.record, _span(found.matrices, p), own_delays(p, found.settings).delays(p.record.nu),
        [spiky.mask for spiky in p.corrupt_y], trim=trim, feedthrough=feed)) for p in part.parts))


def _span(m: Matrices, p: Usable) -> ComplexArray:
    """Return the poles of a model, of those that can be the plant's, and real ones."""
    top = _BAND * np.pi / max(s.period for s in p.record.outputs)
    poles = np.linalg.eigvals(m.A).astype(complex)
    kept = (poles.imag >= 0.0) & (poles.imag < top) & (poles.real * p.record.duration < _GROWTH)
    own = poles[kept]
    spare = -np.geomspace(1.0 / p.record.duration, top, SPARE)
    return np.concatenate((own[np.argsort(np.abs(own))], spare))


def _left(part: Joint, found: Found) -> float:
    """Return what simulations leave of the samples: geometric mean over the outputs of power."""
    powers = []
    for p, m in zip(part.parts, found.matrices.of_records(found.projection), strict=True):
        delay = own_delays(p, found.settings).delays(p.record.nu)
        seen = simulation(moving_model(m, delay), p.record)
        powers.append(np.log(np.nanmean((seen.y - seen.y_hat) ** 2, axis=0) + 1e-300))
    return float(np.exp(np.mean(powers)))


def _projected(part: Joint, found: Found) -> Settings:
    return own_delays(part.parts[0], found.settings).replace(parts=max(found.layout.sizes)[1])


def _quiet(found: Found) -> bool:
    """Return whether a model leaves so little that the ends of the basis show."""
    error, y = as_real(prediction_errors(found.projection, found.matrices)), found.projection.y
    return bool((np.linalg.norm(error, axis=1) < _QUIET * np.linalg.norm(y, axis=1)).all())


def _differ(new: Projection, old: Projection, found: Found) -> float:
    """Return by how much lines differ, in variances of the noise of one line."""
    change = np.sum(as_real(new.y - old.y) ** 2, axis=1)
    error = as_real(prediction_errors(old, found.matrices))
    power = np.sum(as_real(old.y) ** 2, axis=1)
    noise = np.mean(error ** 2, axis=1) + _ROUNDING * power
    return float(np.max(change / noise))
