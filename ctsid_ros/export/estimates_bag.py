# SPDX-License-Identifier: Apache-2.0
"""What the node would have published along a bag, as a bag: for Foxglove and PlotJuggler."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ctsid_core.sequence.tracking import Tracked
from ctsid_ros.config.channels import Config
from ctsid_ros.messages.models import provenance
from ctsid_ros.messages.publication import TOPICS, messages_of
from ctsid_ros.recordings.definitions import known_type
from ctsid_ros.recordings.message_store import make_message, serialise
from ctsid_ros.recordings.writer import BagWriter

NODE = '/identifier'  # the name that the node has unless it is remapped


def write_estimates(path: Path, config: Config, tracked: Sequence[Tracked]) -> None:
    """
    Write the topics of the node, stamped and logged at the ends of the windows.

    Where the ends jump back (a bag that was recorded in a loop) another file begins.

    Parameters
    ----------
    path : Path
        An MCAP file, which is not there yet.
    config : Config
    tracked : sequence of Tracked
        Of all windows.

    Raises
    ------
    StorageError
        If it cannot be written.
    """
    bag = BagWriter(path, {f'{NODE}/{name}': known_type(kind) for name, kind in TOPICS.items()})
    try:
        for number, window in enumerate(tracked, 1):
            end_ns = max(window.estimate.end_ns, 0)
            messages = messages_of(window, provenance(config, NODE, number), make_message)
            for name, message in messages.items():
                bag.write(f'{NODE}/{name}', end_ns, end_ns, number, serialise(message))
    finally:
        bag.close()
