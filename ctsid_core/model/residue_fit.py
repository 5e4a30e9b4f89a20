# SPDX-License-Identifier: Apache-2.0
"""
B, C and D of a system of known A, from simulations.

Each output is linear in the residues of its modes, and all responses are exact at the stamps of
the outputs, whatever these do in between. Residues of rank one are B and C; with several outputs
B and C are then fitted in turns.

[TM] takes C from the first filter alone (eq. 14), and B from the equations of filtered outputs
with free states (eq. 15). There an error of the observability matrix goes straight to B,
multiplied with the states: poles can be right to four digits and B to none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctsid_core.linear.least_squares import least_norm
from ctsid_core.linear.matrices import Matrices, plain_matrices
from ctsid_core.linear.matrix_functions import SOUND, Modes, modes, phi
from ctsid_core.linear.types import Array, ComplexArray
from ctsid_core.model.modal import mode_responses
from ctsid_core.signals.record import Record

_FURTHEST = 300.0     # exponent of an unstable mode's growth that floating point still holds
_TURNS = 2            # of fitting B and C; a third changes no digit of the fits


@dataclass(frozen=True, eq=False)
class _Output:
    """One output over all records, compressed by a QR factorisation."""

    # (rows, modes, S): of the modes to u, to an impulse at the start of each record, to 1 in each
    states: ComplexArray
    direct: Array  # (rows, d): u if the output follows it at once, and 1 in each record
    y: Array       # (rows, 1): over the output's size

    def fitted(self, states: ComplexArray, tolerance: float) -> tuple[ComplexArray, Array]:
        """Return the coefficients of states, (rows, k), and of what acts at once."""
        theta = least_norm(np.hstack((states.real, -states.imag, self.direct)).T, self.y.T,
                           tolerance)[0]
        k = states.shape[1]
        return theta[:k] + 1j * theta[k:2 * k], theta[2 * k:]


def simulated(records: Sequence[Record], A: Array, delay: tuple[float, ...], *, trim: bool,
              feedthrough: bool, tolerance: float) -> Matrices:
    """
    Return the model of given A whose simulations are near the samples of the outputs.

    Each output counts by its own power; initial states and trim of each record are free. NaN if
    the eigenvectors of A are dependent, or a mode grows beyond all bounds. Dead times are in s,
    and directions of regressors below the tolerance times the largest are left out.
    """
    found = modes(A, SOUND)
    length, nu, ny = max(r.duration for r in records), records[0].nu, records[0].ny
    if found is None or (found.values.real * length > _FURTHEST).any():
        return plain_matrices(*(np.full(shape, np.nan) for shape in (
            A.shape, (len(A), nu), (ny, len(A)), (ny, nu))))
    sizes, outputs = _outputs(records, found, delay, trim, feedthrough)
    c, b, direct = _rank_one(outputs, nu, tolerance)
    for _ in range(_TURNS * (len(outputs) > 1)):
        b = _fit_b(outputs, c, tolerance)
        c, direct = _fit_c(outputs, b, tolerance)
    D = direct[:, :nu] if feedthrough else np.zeros((len(outputs), nu))
    return plain_matrices(A, (found.right @ b[:, :nu]).real, sizes * (c @ found.left).real,
                          sizes * D)


def _outputs(records: Sequence[Record], found: Modes, delay: tuple[float, ...], trim: bool,
             feedthrough: bool) -> tuple[Array, list[_Output]]:
    """Return the size of each output, (ny, 1), and the outputs."""
    count, nu, modes_count = len(records), records[0].nu, len(found.values)
    total = nu + count * (1 + trim)
    blocks: dict[int, list[Array]] = {}
    for i, record in enumerate(records):
        channel = 0
        for signal in record.outputs:
            inside = signal.rows(record.start, record.end)
            own, u = _responses(record, found, delay, signal.time[inside], trim)
            made = np.zeros((len(u), modes_count, total), dtype=complex)
            made[:, :, [*range(nu), nu + i, *([nu + count + i] if trim else [])]] = own
            ones = np.zeros((len(u), count * trim))
            if trim:
                ones[:, i] = 1.0
            left = np.hstack((made.real.reshape(len(u), -1), made.imag.reshape(len(u), -1),
                              u if feedthrough else u[:, :0], ones))
            for j in range(signal.width):
                blocks.setdefault(channel, []).append(
                    np.hstack((left, signal.values[inside, j:j + 1])))
                channel += 1
    sizes = np.array([np.std(np.concatenate([b[:, -1] for b in blocks[k]])) + 1e-300
                      for k in sorted(blocks)])
    width, outputs = modes_count * total, []
    for k, size in enumerate(sizes):
        small = np.linalg.qr(np.vstack(blocks[k]), mode='r')
        states = (small[:, :width] + 1j * small[:, width:2 * width]).reshape(
            len(small), modes_count, total)
        outputs.append(_Output(states, small[:, 2 * width:-1], small[:, -1:] / size))
    return sizes[:, np.newaxis], outputs


def _rank_one(outputs: Sequence[_Output], nu: int,
              tolerance: float) -> tuple[ComplexArray, ComplexArray, Array]:
    """
    Return c, (ny, modes), b, (modes, nu), and what acts at once: residues made rank one.

    Those of u only: trim of states, trim of outputs and initial states can stand for each other.
    """
    residues, direct = zip(*(own.fitted(own.states.reshape(len(own.y), -1), tolerance)
                             for own in outputs), strict=True)
    first = outputs[0].states[:, :, :nu]
    reach = np.sqrt(np.sum(first.real ** 2 + first.imag ** 2, axis=0)) + 1e-300
    each = np.array(residues).reshape(-1, *outputs[0].states.shape[1:])[:, :, :nu]
    each = each.transpose(1, 0, 2) * reach[:, np.newaxis]
    left, s, right = np.linalg.svd(each, full_matrices=False)
    c, b = left[:, :, 0].T, s[:, :1] * right[:, 0] / reach
    return np.asarray(c, dtype=complex), np.asarray(b, dtype=complex), np.array(direct)


def _fit_b(outputs: Sequence[_Output], c: ComplexArray, tolerance: float) -> ComplexArray:
    """Return b, (modes, S), for given c."""
    shape = outputs[0].states.shape[1:]
    width, free = int(np.prod(shape)), outputs[0].direct.shape[1]
    stacked = []
    for k, own in enumerate(outputs):
        rows, weight, re, im = len(own.y), c[k][:, np.newaxis], own.states.real, own.states.imag
        apart = np.zeros((rows, free * len(outputs)))
        apart[:, free * k:free * (k + 1)] = own.direct
        stacked.append(np.hstack((
            (re * weight.real - im * weight.imag).reshape(rows, -1),
            -(re * weight.imag + im * weight.real).reshape(rows, -1), apart, own.y)))
    both = np.vstack(stacked)
    theta = least_norm(both[:, :-1].T, both[:, -1:].T, tolerance)[0]
    return np.asarray((theta[:width] + 1j * theta[width:2 * width]).reshape(shape))


def _fit_c(outputs: Sequence[_Output], b: ComplexArray,
           tolerance: float) -> tuple[ComplexArray, Array]:
    """Return c, (ny, modes), and what acts at once, for given b."""
    found, direct = zip(*(own.fitted(np.einsum('tkm,km->tk', own.states, b), tolerance)
                          for own in outputs), strict=True)
    return np.array(found), np.array(direct)


def _responses(record: Record, found: Modes, delay: tuple[float, ...], times: Array,
               trim: bool) -> tuple[ComplexArray, Array]:
    """Return 1 / (s - mode) of u, of an impulse at the start and of 1, (times, modes, signals)."""
    at = mode_responses(found.values, record.inputs, delay, record.start, times, slopes=False)
    since = times - record.start
    free = np.exp(found.values[:, np.newaxis] * since)[:, np.newaxis]
    parts = [at.responses, free]
    if trim:
        parts.append((since * phi(found.values[:, np.newaxis] * since, 1)[1])[:, np.newaxis])
    return np.concatenate(parts, axis=1).transpose(2, 0, 1), at.inputs.T
