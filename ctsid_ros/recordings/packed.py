# SPDX-License-Identifier: Apache-2.0
"""Decoders that bags need beside those of fields: raw messages, and messages packed one by one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import zstandard

from ctsid_ros.decoding.block import Decode, Decoded, Located

ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'


def raw(parts: Sequence[Located]) -> Decoded:
    """Return the messages as they are, as bytes: what they were read into is used again."""
    count = sum(len(part.offsets) for part in parts)
    messages = (bytes(part.content[start:start + length]) for part in parts
                for start, length in zip(part.offsets.tolist(), part.lengths.tolist(),
                                         strict=True))
    return Decoded(None, np.fromiter(messages, object, count), np.ones(count, bool))


def unpacking(decode: Decode) -> Decode:
    """Return a decoder that unpacks messages first, where rosbag2 has packed them."""
    def decoded(parts: Sequence[Located]) -> Decoded:
        return decode([_unpacked(part) if _is_packed(part) else part for part in parts])

    return decoded


def _is_packed(part: Located) -> bool:
    # rosbag2 compresses all messages of a file, or none.
    start = int(part.offsets[0]) if len(part.offsets) else 0
    return bool(len(part.offsets)) and part.content[start:start + 4] == ZSTD_MAGIC


def _unpacked(part: Located) -> Located:
    messages = [_unpack(message) for message in raw([part]).values]
    lengths = np.array([len(message) for message in messages])
    return part._replace(content=b''.join(messages), offsets=np.cumsum(lengths) - lengths,
                         lengths=lengths)


def _unpack(message: bytes) -> bytes:
    try:
        return zstandard.ZstdDecompressor().decompressobj().decompress(message)
    except zstandard.ZstdError:
        return message  # it will not decode either, and is counted then
