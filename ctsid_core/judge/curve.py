# SPDX-License-Identifier: Apache-2.0
"""
Whether the output is a curve of what the linear model makes of the inputs.

A sensor that clips, an actuator that saturates, drag that grows with the square of speed: the
errors of the best linear model then follow its own output. A cubic of that is fitted to them.

References
----------
Ramsey 1969, J. Royal Statistical Society B 31 (RESET, here of the simulated output).
"""

from __future__ import annotations

import numpy as np

from ctsid_core.likelihood.output_error import Residuals
from ctsid_core.likelihood.samples import Samples
from ctsid_core.linear.types import Array


def curve_gains(samples: Samples, errors: Residuals, independent: Array) -> Array:
    """
    Return the points of fit that a curve gains after the model, (ny,) [%].

    Parameters
    ----------
    samples : Samples
    errors : Residuals
        That the model leaves.
    independent : ndarray, shape (ny,)
        Number of independent ones: a curve has to be worth its two numbers.
    """
    gains = np.zeros(samples.ny)
    for stream, s in enumerate(samples.records[0].streams):
        for k, i in enumerate(range(s.channels.start, s.channels.stop)):
            e = np.concatenate([own[stream][:, k] for own in errors])
            y = np.concatenate([r.streams[stream].y[:, k] - own[stream][:, k]
                                for r, own in zip(samples.records, errors, strict=True)])
            y = (y - y.mean()) / (y.std() + 1e-300)
            powers = np.stack([np.ones_like(y), y, y ** 2, y ** 3])
            line, curve = (float(np.mean((e - np.linalg.lstsq(p.T, e, rcond=1e-10)[0] @ p) ** 2))
                           for p in (powers[:2], powers))
            n_eff = max(float(independent[i]), 2.0)
            if curve > 0.0 and n_eff * np.log(line / curve) > 2.0 * np.log(n_eff):
                gains[i] = 100.0 * (np.sqrt(line) - np.sqrt(curve))
    return gains
