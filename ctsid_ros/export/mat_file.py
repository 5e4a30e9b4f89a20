# SPDX-License-Identifier: Apache-2.0
"""A model as .mat file, for MATLAB, Octave and scipy."""

from __future__ import annotations

from collections.abc import Sequence
import io
from typing import Any

import numpy as np

from ctsid_core.model.model_json import EQUATIONS
from ctsid_core.settings import Actuator
from ctsid_ros.export.content import Content, named


def mat_bytes(content: Content) -> bytes:
    """
    Return the contents of the file, level 5.

    Variables: A, B, C, D, K, delay, timeout, dead_zone, limit, backlash, rate_limit, x_trim,
    y_trim, noise, poles, pole_std, names and units of inputs and outputs (cells), covariance (of
    the entries of A, B, C, D, row by row, and the dead times), fit, verdict, reason, equations.
    What is not known is empty.
    """
    from scipy.io import savemat

    model, estimate = content.model, content.estimate
    root = estimate.covariance.root if estimate.covariance else np.empty((0, 0))
    variables: dict[str, Any] = {
        **{name: getattr(model, name) for name in ('A', 'B', 'C', 'D', 'K', 'x_trim', 'y_trim',
                                                   'poles')},
        'delay': np.array(model.delay), **{kind: np.array(
            [getattr(own, kind) for own in model.actuators]) for kind in Actuator._fields},
        'covariance': root.T @ root,
        'noise': np.empty((0, 0)) if model.noise is None else model.noise,
        'pole_std': estimate.pole_std, 'fit': estimate.fit,
        'input_names': _cell(named(model.input_names, 'u')),
        'input_units': _cell(model.input_units),
        'output_names': _cell(named(model.output_names, 'y')),
        'output_units': _cell(model.output_units),
        'verdict': content.grade, 'reason': estimate.verdict.reason, 'origin': content.origin,
        'equations': EQUATIONS}
    stream = io.BytesIO()
    savemat(stream, variables, oned_as='column')
    return stream.getvalue()


def _cell(texts: Sequence[str]) -> Any:
    cell = np.empty((len(texts), 1), dtype=object)
    cell[:, 0] = texts
    return cell
