# SPDX-License-Identifier: Apache-2.0
"""
What is plotted along a flight: verdict, fits and poles, named and stamped.

A `diagnostic_msgs/DiagnosticArray`, the one message of common_interfaces with a header whose
values both PlotJuggler (`TOPIC/mode 1/re`) and Foxglove (`TOPIC.status[:]{name=="mode 1"}...`)
plot by name. It has the stamp of the end of the window. Names have no units, because a slash in
them would be a branch for PlotJuggler; the message of each status has.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import math
from typing import Any

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_core.model.verdict import Grade
from ctsid_core.sequence.tracking import Tracked
from ctsid_ros.messages.health import Health, Level, encode_diagnostics
from ctsid_ros.messages.making import Make, ros_message

GRADES = {Grade.GOOD: (2, Level.OK), Grade.WEAK: (1, Level.WARN), Grade.REJECT: (0, Level.ERROR)}


def encode_summary(tracked: Tracked, make: Make = ros_message) -> Any:
    """
    Return verdict, fits and poles as `diagnostic_msgs/DiagnosticArray`, stamped at the end.

    `decode_diagnostics` reads it. Statuses:

    - verdict: level and reason; grade (2 GOOD, 1 WEAK, 0 REJECT), status, order, realisation.
    - fit, held_out_fit, fresh_fit: that of the worst output, and of each by its name [%].
    - mode 1, mode 2, ... of an accepted model: re, im, std, natural_frequency [rad/s], damping.

    Parameters
    ----------
    tracked : Tracked
    make : Make
        What makes messages, see `messages.making`.
    """
    return encode_diagnostics(tracked.estimate.end_ns, [*_statuses(tracked)], make)


def _statuses(tracked: Tracked) -> Iterator[Health]:
    estimate = tracked.estimate
    grade, level = GRADES[estimate.verdict.grade]
    model = estimate.model or estimate.rejected_model
    yield Health('verdict', level, estimate.verdict.reason, {
        'grade': grade, 'status': estimate.status.name, 'realisation': tracked.realisation,
        'order': estimate.model.n if estimate.model else 0})
    names = model.output_names if model else ()
    for name, words, values in (('fit', 'on the window', estimate.fit),
                                ('held_out_fit', 'on what was held out', estimate.held_out_fit),
                                ('fresh_fit', 'of the model before, on new data',
                                 tracked.fresh_fit)):
        yield Health(name, level, f'[%] {words}', _fits(values, names))
    std = dict(enumerate(tracked.eigenvalue_std.tolist()))
    for i, (mode, value) in enumerate(zip(tracked.modes, tracked.eigenvalues.tolist(),
                                          strict=True)):
        yield Health(f'mode {mode}', level, '[rad/s]', _pole(value, std.get(i, math.nan)))


def _fits(values: Array, names: Sequence[str]) -> dict[str, object]:
    worst = min(values[~np.isnan(values)].tolist(), default=math.nan)
    return {**{(names[i] if i < len(names) else '') or f'y{i + 1}': repr(value)
               for i, value in enumerate(values.tolist())}, 'worst': repr(worst)}


def _pole(value: complex, std: float) -> dict[str, object]:
    size = abs(value)
    damping = -value.real / size if size > 0 else math.nan
    return {'re': repr(value.real), 'im': repr(value.imag), 'std': repr(std),
            'natural_frequency': repr(size), 'damping': repr(damping)}
