# SPDX-License-Identifier: Apache-2.0
"""
What the node publishes, as messages and back.

Models are encoded to the last bit. The decoders take any object with the attributes of the
message, so that they also read bags; ROS is imported where a message is made, not before.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
import math
from operator import index
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsid_core.errors import StorageError
from ctsid_core.model.estimate import Estimate
from ctsid_core.model.model_json import from_json, parse, to_json
from ctsid_core.sequence.tracking import Tracked
from ctsid_ros.config.channels import Config
from ctsid_ros.config.origin import described, package_version
from ctsid_ros.messages.making import Make, ros_message
from ctsid_ros.messages.matrices import as_complex

_WORDS = {None: math.nan, 'Infinity': math.inf, '-Infinity': -math.inf}  # as in model_json


def provenance(config: Config, node: str, window: int, **more: object) -> dict[str, object]:
    """
    Return what the node says of a model beside what the model itself says.

    Parameters
    ----------
    config : Config
    node : str
        Full name of the node.
    window : int
        Number of the window.
    **more
        Words, numbers, and lists or mappings of them.
    """
    return {'ctsid': package_version(), 'node': node, 'window': window,
            'channels': described(config), **more}


def encode_model(tracked: Tracked, metadata: Mapping[str, object] | None = None,
                 make: Make = ros_message) -> Any:
    """
    Return an estimate as `std_msgs/String` that holds the JSON of `ctsid_core.model.model_json`.

    Parameters
    ----------
    tracked : Tracked
    metadata : mapping, optional
        What else to keep, see `provenance`. What tracking has found is added: see
        `decode_metadata`.
    make : Make
        What makes messages, see `messages.making`.
    """
    eigenvalues = [[value.real, value.imag] for value in tracked.eigenvalues]
    return make('std_msgs/msg/String', data=to_json(tracked.estimate, {
        **(metadata or {}), 'realisation': tracked.realisation, 'modes': tracked.modes,
        'eigenvalues': eigenvalues, 'eigenvalue_std': tracked.eigenvalue_std,
        'fresh_fit': tracked.fresh_fit, 'fresh_start_ns': tracked.fresh_start_ns,
        'fresh_end_ns': tracked.fresh_end_ns}))


def decode_model(msg: Any) -> Estimate:
    """
    Return the estimate in a message of the topic `~/model`, equal to the last bit.

    There is one for every window. Act on `estimate.model` only if `estimate.good`: else
    `estimate.verdict` says what is wrong with it, and what to do. Where
    `estimate.model.actuators` has numbers that are not 0, not all of an input acts.

    Raises
    ------
    StorageError
        If it is not such a message, or of a version that this ctsid cannot read.
    """
    try:
        return from_json(_text(msg))
    except StorageError as error:
        raise _no_model(error) from error


def decode_metadata(msg: Any) -> dict[str, Any]:
    """
    Return what a message of the topic `~/model` says beside the estimate.

    Returns
    -------
    dict
        What is not in the message is not in it either. From the node:

        - ctsid (version), node (its full name), window (number), channels (one dict per channel,
          as the parameter file describes it).
        - realisation : int. As long as it stays the same, the state coordinates of the models
          continue each other; filters and controllers may keep their state.
        - modes : tuple of int; eigenvalues : complex ndarray, shape (n,) [rad/s];
          eigenvalue_std : ndarray, shape (n,) [rad/s], NaN if unknown. Of the model, in an order
          in which the same mode keeps its row; `estimate.model.poles` is sorted by magnitude
          instead. All are empty if there is no model.
        - fresh_fit : ndarray, shape (ny,) [%]. How well the last accepted model BEFORE this one
          simulates the part fresh_start_ns to fresh_end_ns [ns] of this window, which it had not
          seen; NaN if that is not known.

        More about these: `ctsid_core.sequence.tracking.Tracked`.

    Raises
    ------
    StorageError
        As `decode_model`.
    """
    try:
        found: dict[str, Any] = parse(_text(msg))[1]
    except StorageError as error:
        raise _no_model(error) from error
    for key, read in _READERS.items():
        try:
            found |= {key: read(found[key])} if key in found else {}
        except (TypeError, ValueError, KeyError) as error:
            raise StorageError(f'`{key}` in the metadata of this message is {found[key]!r}, which '
                               'is not of ctsid; check who publishes on the topic') from error
    return found


def _row(value: Any) -> NDArray[np.float64]:
    """Return a list of JSON as numbers; null is NaN."""
    return np.array([float(_WORDS[x] if x is None or isinstance(x, str) else x)
                     for x in value], dtype=float)


def _pairs(value: Any) -> NDArray[np.complex128]:
    return as_complex(np.array([_row((re, im)) for re, im in value]).reshape(-1, 2))


def _whole(value: Any) -> tuple[int, ...]:
    return tuple(map(index, value))


_READERS: Mapping[str, Callable[[Any], object]] = {
    'modes': _whole, 'eigenvalues': _pairs, 'eigenvalue_std': _row, 'fresh_fit': _row}


def _text(msg: Any) -> str:
    text = getattr(msg, 'data', None)
    if not isinstance(text, str):
        raise StorageError(f'it is a {type(msg).__name__}, not a std_msgs/String')
    return text


def _no_model(error: StorageError) -> StorageError:
    return StorageError(f'this message is not a model of ctsid: {error} (The topic is `~/model` '
                        'of an identifier.)')
