# SPDX-License-Identifier: Apache-2.0
"""Counts of messages and samples, and sentences on what is wrong with them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from ctsid_core.signals.samples import GroupCounts
from ctsid_ros.config.channels import Channel, Config

_ADJUSTABLE = 60.0  # s: the largest `window.max_delay`
_REASONS = {
    'late': 'came too late, up to {late} behind the newest of all channels; raise '
            '`window.max_delay` ({max_delay}), or use one `stamp` for all channels if clocks '
            'differ',
    'astray': 'have stamps far from all others, up to {astray}; if that is a clock that '
              'differs, set `stamp` to log',
    'bad_stamp': 'have a stamp of zero or less, or beyond the year 2116; correct the '
                 'publisher, or set `stamp` to log',
    'duplicate': 'have the stamp of another; the first of them is kept; check the clock of '
                 'the publisher if there are many',
    'non_finite': 'are not finite; check the sensor',
    'wrong_width': 'could not be decoded, or their arrays are too short; check `field`',
}
_OTHER_CLOCK = ('have stamps up to {late} behind the newest of all channels: their clock is '
                'another; set `stamp` to log for all channels, or correct the clock')
# Where there is nothing else: no window comes of such a channel.
_ALL = {
    'late': 'comes in time: they are up to {late} behind the newest of all channels; set `stamp` '
            'to log for all channels if clocks differ, else raise `window.max_delay` '
            '({max_delay})',
    'astray': 'can be used: their stamps are {astray} of all others, so the clocks are not one; '
              'set `stamp` to log for all channels, or correct the clock',
    'bad_stamp': 'has a stamp that can be one; correct the publisher, or set `{name}.stamp` to '
                 'log',
    'duplicate': 'has a stamp of its own, the stamps stand still; correct the publisher, or set '
                 '`{name}.stamp` to log',
    'non_finite': 'is a finite number in {field} of {topic}; check the sensor, or choose another '
                  '`{name}.field`',
    'wrong_width': 'could be decoded, or its arrays are too short; check `{name}.type` and '
                   '`{name}.field`',
}
SET = 'it is set so'  # why stamps come from where they do, if `stamp` is not auto
_NO_CLOCK = ('has a time, for simulated time is not known; check that /clock is published, or set '
             '`use_sim_time` to false')


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
    absent : int
        Messages that have no sample of it, for they lack its name.
    """

    source: str
    why: str
    samples: GroupCounts
    absent: int = 0

    @property
    def total(self) -> int:
        """How many samples have come, whatever became of them."""
        dropped: int = sum(getattr(self.samples, key) for key in _REASONS)
        return dropped + self.samples.accepted


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


def complaints(counts: IngestCounts, config: Config, when: str = '') -> list[str]:
    """
    Return a sentence on each fault, and its cure.

    Parameters
    ----------
    counts : IngestCounts
    config : Config
    when : str
        Which samples these are, as ' of the last 10 s'; of all if empty.
    """
    heard = {channel.topic for channel in config.channels
             if (own := counts.channels[channel.name]).absent or own.total}
    lines = [line for channel in config.channels for line in
             _of_channel(channel, counts.channels[channel.name], config, when, heard)]
    if counts.resets:
        lines.append(f'the time stamps jumped back {counts.resets} times (a clock set back, '
                     'or a bag played in a loop); each time the windows started again; check the '
                     'clocks unless that is intended')
    if counts.empty:
        lines.append(f'the time stamps jumped ahead over {counts.empty} windows, in which no '
                     'channel has a sample (a clock set ahead, or all topics silent); check the '
                     'clocks, and that all topics are published')
    return lines


def _of_channel(channel: Channel, counts: ChannelCounts, config: Config, when: str,
                heard: set[str]) -> Iterator[str]:
    """Yield a sentence on each kind of sample that a channel has lost."""
    samples, name, total = counts.samples, f'`{channel.name}`', counts.total
    if not total and channel.topic not in heard:  # else it is dropped with another of its topic
        yield f'{name}: no message has come on {channel.topic}'
    if counts.why.startswith('the stamps'):
        yield f'{name}: {counts.why}, so the time of recording is used'
    words = {'name': channel.name, 'topic': channel.topic, 'field': channel.field,
             'late': f'{abs(samples.worst_late):.3g} s',
             'astray': f'{abs(samples.worst_astray):.3g} s '
                       f'{"ahead" if samples.worst_astray > 0 else "behind"}',
             'max_delay': f'{config.settings.window_max_delay:g} s'}
    for key, text in _REASONS.items():
        count = getattr(samples, key)
        if count and count == total:
            yield f'{name}: not one of {total} samples{when} ' + _hopeless(key, counts).format(
                **words)
        elif count:
            text = _OTHER_CLOCK if key == 'late' and _foreign(samples) else text
            yield f'{name}: {count} of {total} samples{when} ' + text.format(**words)


def _hopeless(key: str, counts: ChannelCounts) -> str:
    """Return what is wrong with all samples of a channel."""
    if key == 'late' and _foreign(counts.samples):
        return ('can be used: their stamps are {late} behind those of other channels, so the '
                'clocks are not one; set `stamp` to log for all channels, or correct the clock')
    if key == 'bad_stamp' and counts.source == 'header':
        return 'has a stamp in its header' + (
            '; set `{name}.stamp` to auto or log' if counts.why == SET else
            ', though the first ones had; correct the publisher, or set `{name}.stamp` to log')
    return _NO_CLOCK if key == 'bad_stamp' and counts.source == 'log' else _ALL[key]


def _foreign(samples: GroupCounts) -> bool:
    """Whether samples are later than any delay: then it is none."""
    return abs(samples.worst_late) > _ADJUSTABLE
