# SPDX-License-Identifier: Apache-2.0
"""Counts of messages and samples, and sentences on what is wrong with them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from ctsid_core.signals.samples import GroupCounts
from ctsid_ros.config.channels import Channel, Config

_REASONS = {
    'late': 'came too late, up to {offset} behind the newest of all channels; raise '
            '`window.max_delay` ({max_delay}), or use one `stamp` for all channels if clocks '
            'differ',
    'astray': 'have stamps far from all others, up to {offset} away; if that is a clock that '
              'differs, set `stamp` to log',
    'bad_stamp': 'have a stamp of zero or less, or beyond the year 2116; correct the '
                 'publisher, or set `stamp` to log',
    'duplicate': 'have the stamp of another; the first of them is kept; check the clock of '
                 'the publisher if there are many',
    'non_finite': 'are not finite; check the sensor',
    'wrong_width': 'could not be decoded, or their arrays are too short; check `field`',
}


@dataclass(frozen=True)
class ChannelCounts:
    """
    Counts of the samples of one channel.

    Parameters
    ----------
    source : str
        Where its stamps come from: header, publish or log; '' while that is not known.
    why : str
        Why 'auto' chose so.
    samples : GroupCounts
        Those of the channels that are handled together with it; `non_finite` is its own.
    """

    source: str
    why: str
    samples: GroupCounts


@dataclass(frozen=True)
class IngestCounts:
    """
    Counts of messages and windows so far.

    Parameters
    ----------
    channels : mapping of str to ChannelCounts
    windows : int
        Windows handed out.
    empty : int
        Windows skipped because no channel had any sample in them.
    resets : int
        How often the stamps jumped back for good.
    """

    channels: Mapping[str, ChannelCounts]
    windows: int
    empty: int
    resets: int


def complaints(counts: IngestCounts, config: Config) -> list[str]:
    """Return a sentence on each fault, and its cure."""
    lines = [line for channel in config.channels for line in
             _of_channel(channel, counts.channels[channel.name], config)]
    if counts.resets:
        lines.append(f'the time stamps jumped back {counts.resets} times (a clock set back, '
                     'or a bag played in a loop); each time the windows started again; check the '
                     'clocks unless that is intended')
    if counts.empty:
        lines.append(f'{counts.empty} windows were skipped because no channel had any sample '
                     'in them; check that all topics are published')
    return lines


def _of_channel(channel: Channel, counts: ChannelCounts, config: Config) -> Iterator[str]:
    """Yield a sentence on each kind of sample that a channel has lost."""
    samples, name, offset = counts.samples, f'`{channel.name}`', abs(counts.samples.worst_offset)
    total = sum(getattr(samples, key) for key in _REASONS) + samples.accepted
    if not total:
        yield f'{name}: no message has come on {channel.topic}'
    if counts.why.startswith('the stamps'):
        yield f'{name}: {counts.why}, so the time of recording is used'
    if counts.source == 'header' and samples.bad_stamp == total > 0:
        yield (f'{name}: not one of {total} messages has a stamp in its header; set '
               f'`{channel.name}.stamp` to auto or log')
        return
    for key, text in _REASONS.items():
        if count := getattr(samples, key):
            yield f'{name}: {count} of {total} samples ' + text.format(
                offset=f'{offset:.3g} s', max_delay=f'{config.settings.window_max_delay:g} s')
