# SPDX-License-Identifier: Apache-2.0
"""From the parameters of a node to what it will do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from rclpy.node import Node

from ctsid_core.effort import work_rate
from ctsid_core.errors import SettingsError
from ctsid_ros.config.channels import Config
from ctsid_ros.decoding.message_types import MessageType, message_class, of_message_class
from ctsid_ros.ingest.feed import Feed
from ctsid_ros.node import parameters


@dataclass(frozen=True)
class Plan:
    """
    What was configured.

    Parameters
    ----------
    config : Config
    classes : mapping of str to class
        Message class of each topic.
    types : mapping of str to MessageType
        Of each topic.
    """

    config: Config
    classes: Mapping[str, Any]
    types: Mapping[str, MessageType]


def read_plan(node: Node) -> Plan:
    """
    Read the parameters of a node and find the message types that they name.

    Raises
    ------
    SettingsError
        With all faults of the parameters; or, if they have none, of types; or of fields; or of
        the rate of work in the environment.
    """
    work_rate()  # for its check
    config = parameters.read(node)
    faults: list[str] = []
    classes: dict[str, Any] = {}
    for channel in config.channels:
        try:
            classes[channel.topic] = message_class(channel.type)
        except ImportError as error:
            faults.append(f'`{channel.name}.type` is {channel.type!r}: {error}')
    if faults:
        raise SettingsError(faults)
    types = {topic: of_message_class(cls) for topic, cls in classes.items()}
    Feed(config, types, lambda _: 1)  # for its check of the fields
    return Plan(config, classes, types)
