# SPDX-License-Identifier: Apache-2.0
"""Parameters of the node alone: how it takes messages, and where it writes."""

from __future__ import annotations

from dataclasses import dataclass, fields

from ctsid_core.errors import SettingsError
from ctsid_core.settings import parameter, parameter_name, value_faults


@dataclass(frozen=True, kw_only=True)
class NodeSettings:
    """
    Parameters of the node beside those of the identification.

    They stand in the same file; the command line accepts and checks them, and has no use for
    them.

    Raises
    ------
    SettingsError
        If any value is of wrong type or out of range; all faults are listed at once.
    """

    autostart: bool = parameter(
        True, 'Whether the node configures and activates itself when it starts.',
        structural=True,
        when='Set it to false if a lifecycle manager or a launch file does that.')
    ingest_rate: float = parameter(
        100.0, 'How often the queues are emptied.', name='ingest.rate', unit='Hz', low=1.0,
        high=1000.0, structural=True,
        when='Raise it for models that appear some milliseconds earlier; lower it to save '
        'computing time.')
    ingest_depth: int = parameter(
        5000, 'Messages that the queue of each subscription holds.', name='ingest.depth',
        unit='messages', low=1, high=100_000, structural=True,
        when='Raise it if losses are reported; a second of the fastest topic is plenty.')
    ingest_reliability: str = parameter(
        'best_effort', 'Reliability that the subscriptions ask for; best_effort suits every '
        'publisher, reliable asks for lost messages again.', name='ingest.reliability',
        choices=('best_effort', 'reliable'), structural=True,
        when='Set it to reliable if losses are reported on a poor network and all publishers '
        'are reliable.')
    ingest_timeout: float = parameter(
        2.0, 'A topic without messages for this time is reported as silent.',
        name='ingest.timeout', unit='s', low=0.01, high=3600.0,
        when='Raise it for slow topics.')
    ingest_record: str = parameter(
        '', 'MCAP file into which the messages are written as they were taken; none if empty.',
        name='ingest.record', structural=True,
        when='Set it to be able to repeat offline what the node has seen.')
    save_folder: str = parameter(
        'models', 'Folder into which the service ~/save writes.', name='save.folder')

    def __post_init__(self) -> None:
        faults = [f for declared in fields(self)
                  for f in value_faults(declared, getattr(self, declared.name))]
        if faults:
            raise SettingsError(faults)


NODE_KEYS = {parameter_name(declared): declared for declared in fields(NodeSettings)}
