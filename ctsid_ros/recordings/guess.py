# SPDX-License-Identifier: Apache-2.0
"""
A first guess of channels, for people to correct.

What acts on a robot and what is measured of it is guessed by message types and by the words in
topic and field names; of those, only scalars that move are taken.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
import math
import re

from ctsid_core.settings import Settings
from ctsid_ros.config.channels import RESERVED, Channel, Config, Role
from ctsid_ros.errors import BagError
from ctsid_ros.recordings.survey import Survey, TopicSurvey
from ctsid_ros.recordings.survey_stats import FieldStats

MOST_INPUTS, MOST_OUTPUTS = 4, 3
_SMALL = 0.15  # of the largest movement of its group: below, a field is left out
_CLOCKS = 0.5  # header and log apart by more than this are two clocks [s]

_INPUT_NAME = re.compile(
    r'cmd|command|set_?point|target|desired|reference|(^|[/_])ref($|[/_])|control(?!ler_state)|'
    r'effort|torque|wrench|thrust|throttle|joy|stick|(^|[/_])rc|pwm|servo|motor|actuator|input|'
    r'steer|voltage|drive|action', re.IGNORECASE)
_OUTPUT_NAME = re.compile(
    r'imu|gyro|accel|odom|pose|position|state|measur|sensor|feedback|encoder|vel(?!.*cmd)|'
    r'attitude|mocap|vicon|optitrack|gps|fix|range|altitude|output|joint|tracking', re.IGNORECASE)
_INPUT_TYPE = re.compile(
    r'.*(Twist|TwistStamped|Wrench|WrenchStamped|Ackermann\w*|Joy|JointTrajectory\w*|'
    r'AttitudeTarget|PositionTarget|\w*Setpoint|\w*Command|\w*Cmd|Actuator\w*|ManualControl\w*|'
    r'RCIn|RCOut|RcChannels|Thrust|MultiArray|JointJog|MotorSpeed|\w*Control)$')
_OUTPUT_TYPE = re.compile(
    r'.*(Imu|Odometry|Pose\w*|Transform\w*|TwistWithCovariance\w*|JointState|\w*State|\w*Status|'
    r'VehicleOdometry|VehicleAttitude|VehicleAngularVelocity|SensorCombined|MagneticField|'
    r'NavSatFix|Range|FluidPressure|Accel\w*|Altitude|\w*Measurement)$')
# Groups of fields (all up to the last name or index), the most telling first.
_OUTPUT_FIELDS = (r'angular_velocity|gyro', r'twist|velocity|linear$|angular$', r'euler',
                  r'position', r'acceleration', r'')
_INPUT_FIELDS = (r'torque|moment|effort', r'force|thrust', r'angular|linear|twist|velocity',
                 r'axes|channels|data|control|position', r'')
_MEASURED_INPUT = re.compile(r'effort|torque|force|current|cmd|command|input|voltage|pwm|control|'
                             r'^u(_|\d|\[|$)|[ROPY]Out$')
_UNITS = (('angular_velocity', 'rad/s'), ('linear_acceleration', 'm/s^2'), ('torque', 'N m'),
          ('force', 'N'), (r'angular\.', 'rad/s'), (r'linear\.', 'm/s'), ('euler', 'rad'),
          (r'position\.[xyz]$', 'm'), (r'^velocity\[', 'rad/s'), (r'^position\[', 'rad'),
          (r'^effort\[', 'N m'), ('steering_angle', 'rad'), ('speed$', 'm/s'))
_Choice = tuple[TopicSurvey, list[FieldStats]]


@dataclass(frozen=True)
class Guess:
    """
    A first guess.

    Parameters
    ----------
    config : Config
    reasons : tuple of str
        A sentence on each thing that was decided, or is doubtful.
    others : tuple of (topic, field, standard deviation)
        What moves as well and was not chosen.
    """

    config: Config
    reasons: tuple[str, ...]
    others: tuple[tuple[str, str, float], ...]


def guess(survey: Survey) -> Guess:
    """
    Choose channels and windows for a bag.

    Raises
    ------
    BagError
        If fewer than two scalars move in it.
    """
    topics = [topic for topic in survey.topics if topic.moving]
    count = sum(len(topic.moving) for topic in topics)
    if count < 2:
        raise BagError('a model needs an input and an output that move, but '
                       + (f'only {topics[0].moving[0].field} of {topics[0].info.name} does'
                          if count else 'nothing in this bag does')
                       + '; `ctsid info` shows what is there')
    reasons: list[str] = []
    inputs, outputs = _choose(topics, reasons)
    taken: set[str] = set()
    chosen = [*_channels(inputs, 'input', taken), *_channels(outputs, 'output', taken)]
    if inputs[0] is outputs[0]:  # measured together: not a command that is held
        chosen = [replace(c, hold='smooth') if c.role == 'input' else c for c in chosen]
    if _clocks_differ(inputs, outputs):
        chosen = [replace(c, stamp='log') for c in chosen]
        reasons.append('the headers are of another clock than the recording, and not all '
                       'messages have one: all stamps are those of the recording')
    accelerations = any('acceleration' in c.field for c in chosen if c.role == 'output')
    config = Config(tuple(chosen), _settings(survey, accelerations))
    used = {(c.topic, c.field) for c in chosen}
    others = [(t.info.name, f.field, f.std) for t in topics for f in t.moving
              if (t.info.name, f.field) not in used]
    return Guess(config, tuple(reasons), tuple(others))


def _choose(topics: Sequence[TopicSurvey], reasons: list[str]) -> tuple[_Choice, _Choice]:
    """Return topic and fields of the inputs and of the outputs."""
    acting = max(topics, key=_acts)
    rest = [topic for topic in topics if topic is not acting]
    if not rest:
        return _split(acting, reasons)
    measured = max(rest, key=lambda topic: _measures(topic, acting))
    if _acts(acting) <= 0:
        both = max(topics, key=lambda topic: any(
            _MEASURED_INPUT.search(f.field) for f in topic.moving))
        if any(_MEASURED_INPUT.search(f.field) for f in both.moving) and len(both.moving) > 1:
            return _split(both, reasons)
        reasons.append(f'nothing is named like a command: whether {acting.info.name} acts on the '
                       'robot is only a guess: check it')
    inputs = acting, _fields(acting.moving, _INPUT_FIELDS, MOST_INPUTS)
    outputs = measured, _fields(measured.moving, _OUTPUT_FIELDS, MOST_OUTPUTS, noise=False)
    reasons.append(f'{acting.info.name} looks like a command, {measured.info.name} like a '
                   'measurement, by their names and types')
    return inputs, outputs


def _split(topic: TopicSurvey, reasons: list[str]) -> tuple[_Choice, _Choice]:
    """Choose inputs and outputs among the fields of one topic."""
    acting = [f for f in topic.moving if _MEASURED_INPUT.search(f.field)]
    if not acting or len(acting) == len(topic.moving):
        acting = [topic.moving[0]]
    rest = [f for f in topic.moving if f not in acting]
    reasons.append(f'inputs and outputs are both of {topic.info.name}: which of its fields act '
                   'on the robot is guessed by their names: check it')
    return ((topic, _fields(acting, _INPUT_FIELDS, MOST_INPUTS)),
            (topic, _fields(rest, _OUTPUT_FIELDS, MOST_OUTPUTS, noise=False)))


def _acts(topic: TopicSurvey) -> float:
    name, kind = topic.info.name, topic.info.type
    score = 3.0 * bool(_INPUT_NAME.search(name)) + 2.0 * bool(_INPUT_TYPE.match(kind))
    score -= 1.0 * bool(_OUTPUT_NAME.search(name)) + 1.5 * bool(_OUTPUT_TYPE.match(kind))
    score += 0.5 * ('torque' in name)  # that acts on the body itself
    return score + 1e-3 * min(len(topic.moving), 8) - 1e-9 * len(name)


def _measures(topic: TopicSurvey, acting: TopicSurvey) -> float:
    name, kind = topic.info.name, topic.info.type
    score = 3.0 * bool(_OUTPUT_TYPE.match(kind)) + 2.0 * bool(_OUTPUT_NAME.search(name))
    score -= 3.0 * bool(_INPUT_NAME.search(name)) + 1.0 * bool(_INPUT_TYPE.match(kind))
    likely = 'Odometry' if 'Twist' in acting.info.type or 'Ackermann' in acting.info.type \
        else 'Joint' if 'Joint' in acting.info.type else 'Imu'
    # A rate rather than nothing in particular; the common name space counts a little.
    score += 1.0 * (likely in kind or 'AngularVelocity' in kind)
    score += 0.5 * any('velocity' in f.field for f in topic.moving)
    same = topic.info.name.split('/')[1] == acting.info.name.split('/')[1] \
        if topic.info.name.count('/') > 1 and acting.info.name.count('/') > 1 else False
    return score + 0.25 * same + min(topic.rate, 1e3) * 1e-5 if topic.rate > 0 else score - 1.0


def _fields(moving: Iterable[FieldStats], groups: Sequence[str], most: int,
            noise: bool = True) -> list[FieldStats]:
    """Return the fields of the first group that moves, without what moves little in it."""
    moving = list(moving)
    lively = [f for f in moving if not f.white]
    candidates = moving if noise or not lively else lively
    for pattern in groups:
        found = [f for f in candidates if re.search(pattern, _group(f.field))]
        # An angle that winds up or a heading has no operating point to be linear about.
        found = [f for f in found if f.high - f.low < 2 * math.pi] or found \
            if pattern == 'euler' else found
        if found:
            largest = max(f.std for f in found)
            kept = [f for f in found if f.std >= _SMALL * largest]
            return kept[:most]
    return candidates[:most]


def _group(text: str) -> str:
    """Return a field without its last name or index; all of an angle."""
    return text if text.startswith('euler') else re.sub(r'(\.[xyzw]|\[\d+\])$', '', text)


def _channels(choice: _Choice, role: Role, taken: set[str]) -> list[Channel]:
    topic, fields = choice
    return [Channel(_name(topic, f.field, taken), role, topic.info.name, topic.info.type,
                    f.field, _unit(f.field)) for f in fields]


def _name(topic: TopicSurvey, text: str, taken: set[str]) -> str:
    """Return a short name for a field that is not taken yet."""
    last = re.sub(r'\W+', '_', topic.info.name.strip('/').rpartition('/')[2]) or 'channel'
    words = re.findall(r'[A-Za-z_]\w*|\d+', text.replace('euler', ''))
    plain = words[-1] if 'euler' in text else '_'.join(words[-2:])
    short = len(plain) < 3 and not topic.info.type.startswith('table/')
    if plain.startswith('data') or short:
        plain = f'{last}_{words[-1]}'
    name = re.sub(r'\W', '_', plain)
    name = f'_{name}' if name[0].isdigit() else name
    candidates = [name, f'{last}_{name}', *(f'{name}_{i}' for i in range(2, 1000))]
    name = next(c for c in candidates if c not in taken and c not in RESERVED)
    taken.add(name)
    return name


def _unit(text: str) -> str:
    return next((unit for pattern, unit in _UNITS if re.search(pattern, text)), '')


def _clocks_differ(*choices: _Choice) -> bool:
    sources = {topic.stamp for topic, _ in choices}
    return len(sources) > 1 and any(abs(topic.late) > _CLOCKS for topic, _ in choices)


def _settings(survey: Survey, accelerations: bool) -> Settings:
    """Return windows that a newcomer can start with: a tenth of the bag, 10 to 60 s."""
    length = min(max(survey.duration / 10.0, 10.0), 60.0)
    if survey.duration < 2 * length:
        length = survey.duration / 2.0
    length = max(float(f'{length:.2g}'), 0.01)
    return Settings(feedthrough=accelerations, window_length=length,
                    window_stride=float(f'{max(length / 10.0, 0.001):.2g}'))
