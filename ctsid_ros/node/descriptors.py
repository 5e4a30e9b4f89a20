# SPDX-License-Identifier: Apache-2.0
"""What ROS shows of each parameter: its meaning, unit, range and choices, and when to set it."""

from __future__ import annotations

from dataclasses import MISSING, Field
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

from ctsid_ros.config.parameter_text import LISTS, describe, limits

_ONCE = ('autostart',)  # only looked at when the node starts


def default(declared: Field[Any]) -> Any:
    """Return the default of a parameter; '' where it has none."""
    return '' if declared.default is MISSING else declared.default


def descriptor(name: str, declared: Field[Any] | None) -> ParameterDescriptor:
    """Return the descriptor of a parameter, or of one of the lists of channels (None)."""
    fixed = 'Fixed while the node is configured.'
    if declared is None:
        return ParameterDescriptor(description=LISTS[name], additional_constraints=fixed)
    meta = declared.metadata
    constraints = [limits(declared) if meta['choices'] or meta['words'] or meta['auto'] else '',
                   fixed if meta['structural'] else '']
    # What may be a number or a word has no type of its own in ROS.
    parameter = ParameterDescriptor(
        description=describe(declared), read_only=name in _ONCE,
        dynamic_typing=bool(meta['words']),
        additional_constraints='; '.join(part for part in constraints if part))
    if meta['low'] is not None and meta['high'] is not None and not meta['words']:
        if isinstance(declared.default, float):  # step 0: any number between
            parameter.floating_point_range = [FloatingPointRange(
                from_value=float(meta['low']), to_value=float(meta['high']), step=0.0)]
        else:
            parameter.integer_range = [IntegerRange(
                from_value=int(meta['low']), to_value=int(meta['high']), step=1)]
    return parameter


def untyped(name: str, declared: Field[Any] | None) -> ParameterDescriptor:
    """Return a descriptor like `descriptor`, under which a value of any type is taken."""
    return ParameterDescriptor(
        description=descriptor(name, declared).description, dynamic_typing=True)
