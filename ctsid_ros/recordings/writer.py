# SPDX-License-Identifier: Apache-2.0
"""Messages into an MCAP file, as they were taken."""

from __future__ import annotations

from collections.abc import Mapping
import os
from pathlib import Path

from mcap.writer import CompressionType, Writer

from ctsid_core.errors import StorageError
from ctsid_ros.decoding.message_types import MessageType, definition


class BagWriter:
    """
    A recording of the messages of some topics, in the order in which they are written.

    A bag like those of `ros2 bag record -s mcap`; without `close` it is cut off, but readable.
    Bags are read in the order of log time. Where that jumps back (a clock set back, a simulation
    that begins anew) another file is begun, so that the two do not mix.

    Parameters
    ----------
    path : path-like
        File to write; if it exists, a number is put before the suffix, so nothing is lost.
    types : mapping of str to MessageType
        Of each topic.

    Attributes
    ----------
    path : Path
        Where it is written now.

    Raises
    ------
    StorageError
        If the file cannot be made.
    """

    def __init__(self, path: str | os.PathLike[str], types: Mapping[str, MessageType]) -> None:
        self._wanted, self._types = Path(path).expanduser(), types
        self._open()

    def _open(self) -> None:
        self.path, number, self._last_ns = self._wanted, 2, 0
        while self.path.exists():
            self.path = self._wanted.with_stem(f'{self._wanted.stem}-{number}')
            number += 1
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._stream = open(self.path, 'xb')  # noqa: SIM115  # closed by close()
        except OSError as error:
            raise StorageError(f'{self.path} cannot be written ({error.strerror}); choose another '
                               'file') from error
        # Chunks are compressed at once while messages wait: the lightest way is right here.
        self._writer = Writer(self._stream, compression=CompressionType.LZ4)
        self._writer.start(profile='ros2', library='ctsid')
        self._channels = {topic: self._channel(topic, kind) for topic, kind in self._types.items()}

    def _channel(self, topic: str, kind: MessageType) -> int:
        schema = self._writer.register_schema(kind.name, 'ros2msg', definition(kind).encode())
        return self._writer.register_channel(topic, 'cdr', schema, {'offered_qos_profiles': ''})

    def write(self, topic: str, log_ns: int, publish_ns: int, sequence: int, raw: bytes) -> None:
        """
        Write one message.

        Raises
        ------
        StorageError
            If the disk is full, or alike.
        """
        if log_ns < self._last_ns:
            self.close()
            self._open()
        self._last_ns = log_ns
        try:
            self._writer.add_message(self._channels[topic], log_ns, raw, publish_ns, sequence)
        except (OSError, ValueError) as error:
            raise StorageError(f'{self.path} cannot be written on ({error})') from error

    def close(self) -> None:
        """
        Finish the file.

        Raises
        ------
        StorageError
            If the disk is full, or alike.
        """
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._stream.close()
        except (OSError, ValueError) as error:
            raise StorageError(f'{self.path} cannot be finished ({error})') from error
