# SPDX-License-Identifier: Apache-2.0
"""Channels: which fields of which topics are the inputs and outputs of a plant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from itertools import combinations
import math
import re
from typing import Any, Literal

from ctsid_core.errors import SettingsError
from ctsid_core.settings import HOLDS, Hold, Settings, parameter, parameter_name, value_faults
from ctsid_ros.config.node_settings import NODE_KEYS, NodeSettings
from ctsid_ros.decoding.field_path import FieldPath, ParseError, parse_field

Role = Literal['input', 'output']
ROLE_LISTS: Mapping[str, Role] = {'inputs': 'input', 'outputs': 'output'}
SETTINGS_KEYS = {parameter_name(declared): declared for declared in fields(Settings)}
RESERVED = {key.split('.')[0] for key in (*SETTINGS_KEYS, *NODE_KEYS)} | {
    *ROLE_LISTS, 'use_sim_time', 'qos_overrides', 'start_type_description_service'}
_NAME = re.compile(r'[A-Za-z_]\w*', re.ASCII)
_TYPE = re.compile(r'[A-Za-z]\w*(/msg)?/[A-Za-z]\w*', re.ASCII)


def _of_input(key: str) -> Any:
    """Return the declaration of what each input has of its own, from that of the settings."""
    found = {**SETTINGS_KEYS[key].metadata}
    found['doc'] = found['doc'].replace('a held input', 'this input').replace(
        ': one for all, or one per input; ', '; ')
    return field(default='auto', metadata=found)


@dataclass(frozen=True)
class Channel:
    """
    One signal, or several of one kind, as a parameter file describes it.

    Parameters
    ----------
    name, role, topic, type, field, unit, hold, stamp, delay, timeout, dead_zone, limit, backlash,
    rate_limit, turn
        See the sentences of the declaration. `hold='auto'` becomes 'zoh' for an input and
        'smooth' for an output.

    Raises
    ------
    SettingsError
        If any value cannot be; all faults are listed at once.
    """

    name: str = parameter(MISSING, 'Name of the channel in models and reports.')
    role: Role = parameter(MISSING, 'Input or output.', choices=('input', 'output'))
    topic: str = parameter(MISSING, 'Topic of its messages.', structural=True)
    type: str = parameter(
        MISSING, 'Type of its messages; bags contain it, the node needs it.',
        structural=True)
    field: str = parameter(
        MISSING, 'Field of the message: twist.linear.x, velocity[elbow] by the name of a joint, '
        'position[2], position[0:6] for several signals, or euler(pose.orientation).roll for an '
        'angle of a quaternion.',
        structural=True)
    unit: str = parameter('', 'Unit, for reports; nothing is converted.', structural=True)
    hold: Hold = parameter(
        'auto', 'How the signal runs between the samples: zoh (held until the next), linear '
        '(straight lines) or smooth (cubic spline); auto is zoh for an input and smooth for an '
        'output.',
        choices=('auto', *HOLDS), structural=True,
        when='Set an input to smooth if it is measured, not a command that is held.')
    stamp: str = parameter(
        'auto', 'Where its time stamps come from: the header of the message, its publishing, or '
        'its recording (log; in the node: its arrival); auto is the header where it has a stamp, '
        'else log.', choices=('auto', 'header', 'publish', 'log'), structural=True,
        when='Set it to log for all channels if the clocks of two computers differ.')
    delay: float | str = parameter(
        'auto', 'Dead time from this input to the outputs; auto: estimated from the data.',
        unit='s', low=0.0, high=60.0, words=('auto',), structural=True,
        when='Set it to 0.0 where commands act at once, or to a known value.')
    timeout: float | str = parameter(
        'auto', 'Time after a message from which on this input, if it is held, counts as 0 until '
        'the next one; 0.0: never; auto: found from the data. Inputs of one topic share it.',
        unit='s', low=0.0, high=60.0, words=('auto',), structural=True,
        when='Set it to the timeout of the driver (cmd_vel_timeout), or to 0.0 where the last '
        'command goes on.')
    dead_zone: float | str = _of_input('dead_zone')
    limit: float | str = _of_input('limit')
    backlash: float | str = _of_input('backlash')
    rate_limit: float | str = _of_input('rate_limit')
    turn: float = parameter(
        0.0, 'A full turn, of an angle that wraps: of two neighbours the second is moved by as '
        'many turns as bring it nearest to the first; 0.0 leaves the values as they are. Angles '
        'of a quaternion are unwrapped anyway.', low=0.0, high=1e12, structural=True,
        when='Set it to 360.0 for a heading in degrees, 6.283185307179586 for an angle in rad, '
        'or the number of ticks of an encoder.')

    def __post_init__(self) -> None:
        faults = [fault for declared in fields(self) for fault in
                  value_faults(declared, getattr(self, declared.name), f'{self.name}.')]
        faults = faults or _text_faults(self)
        if faults:
            raise SettingsError(faults)
        if str(self.hold) == 'auto':
            object.__setattr__(self, 'hold', 'zoh' if self.role == 'input' else 'smooth')

    @property
    def path(self) -> FieldPath:
        """The parsed field."""
        return parse_field(self.field)

    @property
    def turns(self) -> tuple[float, ...]:
        """A full turn of each of its scalars, in its unit; 0.0 for what is not unwrapped."""
        return tuple(math.tau if angle else self.turn for angle in self.path.angles)

    @property
    def width(self) -> int:
        """
        Number of its scalars.

        Raises
        ------
        SettingsError
            If it is known only from a message.
        """
        if self.path.is_open:
            raise SettingsError([f'`{self.name}.field` is {self.field!r}, whose length is known '
                                 'only from a message; give the end of the range'])
        return self.path.width

    @property
    def scalar_names(self) -> tuple[str, ...]:
        """
        Names of its scalars: rate; torque[0], torque[1]; attitude.roll, attitude.pitch, ....

        Raises
        ------
        SettingsError
            If their number is known only from a message.
        """
        width, euler = self.width, self.path.euler
        if width == 1:
            return (self.name,)
        if width == len(euler):
            return tuple(f'{self.name}.{part}' for part in euler)
        return tuple(f'{self.name}[{i}]' for i in range(width))


# Settings that each input has of its own
OF_INPUTS = {'delay': 'dead time belongs', 'timeout': 'timeouts belong',
             'dead_zone': 'dead zones belong', 'limit': 'limits belong',
             'backlash': 'backlash belongs', 'rate_limit': 'rate limits belong'}
CHANNEL_KEYS = {parameter_name(declared): declared for declared in fields(Channel)
                if declared.name not in ('name', 'role')}


@dataclass(frozen=True)
class Config:
    """
    What a parameter file says: channels, settings for the identification, and for the node.

    Parameters
    ----------
    channels : tuple of Channel
        At least one input and one output; names differ. Inputs are put first.
    settings : Settings
        Its `delay` and what lies before inputs are composed from those of the input channels;
        leave them at 'auto'.
    node : NodeSettings
        What only the node reads.

    Raises
    ------
    SettingsError
        If channels and settings cannot go together; all faults are listed at once.
    """

    channels: tuple[Channel, ...]
    settings: Settings = Settings()
    node: NodeSettings = NodeSettings()

    def __post_init__(self) -> None:
        faults = list_faults([(channel.name, channel.role) for channel in self.channels])
        faults += [f'`{i.name}` and `{o.name}` are one signal ({i.topic} {i.field}), as input and '
                   'as output; give the output the signal that the input moves'
                   for i in self.inputs for o in self.outputs
                   if (i.topic, i.field) == (o.topic, o.field)]
        faults += [f'`{i.name}.timeout` is {i.timeout!r} and `{k.name}.timeout` {k.timeout!r}, '
                   f'but both are of {i.topic}; give them the same'
                   for i, k in combinations(self.inputs, 2)
                   if i.topic == k.topic and i.timeout != k.timeout]
        if faults:
            raise SettingsError(faults)
        object.__setattr__(self, 'channels', (*self.inputs, *self.outputs))
        object.__setattr__(self, 'settings', _with_own(self.inputs, self.settings))

    @property
    def inputs(self) -> tuple[Channel, ...]:
        """The input channels, in the order of the file."""
        return tuple(channel for channel in self.channels if channel.role == 'input')

    @property
    def outputs(self) -> tuple[Channel, ...]:
        """The output channels, in the order of the file."""
        return tuple(channel for channel in self.channels if channel.role == 'output')

    def longest_delay(self, length: float) -> float:
        """Return the longest dead time of the inputs in a record of some length [s]."""
        return self.settings.longest_delay(sum(c.width for c in self.inputs), length)

    def with_fields(self, texts: Mapping[str, str]) -> Config:
        """
        Return a copy in which the channels named have other fields.

        For closing open ranges (`effort[:]`) once a message has shown their length.

        Raises
        ------
        SettingsError
            Like `Config` and `Channel`.
        """
        return self.with_channels([
            replace(channel, field=texts.get(channel.name, channel.field))
            for channel in self.channels])

    def with_channels(self, channels: Sequence[Channel]) -> Config:
        """Return a copy that has these channels; raises like `Config`."""
        return Config(tuple(channels), self.settings.replace(**dict.fromkeys(OF_INPUTS, 'auto')),
                      self.node)


def list_faults(listed: Sequence[tuple[str, Role]]) -> list[str]:
    """Return what is wrong with the names and roles of channels, as sentences."""
    names = [name for name, _ in listed]
    faults = []
    for name in dict.fromkeys(names):
        if not _NAME.fullmatch(name):
            faults.append(f'the channel name {name!r} does not consist of letters, digits and _')
        if name in RESERVED:
            faults.append(f'the channel name {name!r} is that of a parameter; choose another')
        if names.count(name) > 1:
            faults.append(f'the channel `{name}` is listed {names.count(name)} times; give each '
                          'channel its own name')
    roles = {role for _, role in listed}
    return faults + [f'there is no {role}; list at least one channel in `{key}`'
                     for key, role in ROLE_LISTS.items() if role not in roles]


def _text_faults(channel: Channel) -> list[str]:
    name, faults = channel.name, []
    if not channel.topic or re.search(r'\s', channel.topic):
        faults.append(f'`{name}.topic` is {channel.topic!r}; give the name of a topic')
    if channel.type and not _TYPE.fullmatch(channel.type):
        faults.append(f'`{name}.type` is {channel.type!r}; give it like sensor_msgs/msg/Imu')
    try:
        parse_field(channel.field)
    except ParseError as error:
        faults.append(f'`{name}.field`: {error}')
    return faults + [
        f'`{name}.{key}` is {getattr(channel, key)!r}, but {name} is an output; {what} to the '
        'inputs' for key, what in OF_INPUTS.items()
        if channel.role == 'output' and getattr(channel, key) not in ('auto', 0.0)]


def _with_own(inputs: Sequence[Channel], settings: Settings) -> Settings:
    """Compose what each input has of its own: one per scalar, or one for all if all are equal."""
    for key in OF_INPUTS:
        each = [getattr(channel, key) for channel in inputs]
        own: float | str | tuple[float | str, ...] = each[0]
        if any(one != each[0] for one in each):
            own = tuple(one for one, channel in zip(each, inputs, strict=True)
                        for _ in range(channel.width))
        if getattr(settings, key) not in ('auto', own):
            raise SettingsError([f'`{key}` is {getattr(settings, key)!r}, but the input channels '
                                 f'say {own!r}; set the {key}s of the channels'])
        settings = settings.replace(**{key: own})
    return settings
