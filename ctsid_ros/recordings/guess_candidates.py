# SPDX-License-Identifier: Apache-2.0
"""
Which scalars of a bag could be inputs or outputs of a plant, before they are compared.

Names and types of messages only say how likely that is: what the data say about pairs of them
(`guess_pairs.py`) counts more.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
import re

import numpy as np

from ctsid_core.linear.types import Array
from ctsid_core.signals.record import LARGEST
from ctsid_core.signals.wrapped import wraps
from ctsid_ros.decoding.field_path import FieldPath, parse_field, plain
from ctsid_ros.decoding.message_types import FieldType, MessageType
from ctsid_ros.recordings.bag import Bag
from ctsid_ros.recordings.excerpts import (
    Clock,
    Samples,
    averaged,
    clock_for,
    gather,
    held,
    lost_after,
)
from ctsid_ros.recordings.survey import Survey, TopicSurvey
from ctsid_ros.recordings.survey_stats import FieldStats

Key = tuple[str, str]  # topic and field
FEWEST = 30  # messages: fewer show no dynamics
_MOST_OF_TOPIC = 40  # fields: a longer list is of no use to anybody
_LEVELS, _SWITCHES = 3, 12  # an integer or bool with so few levels and changes is a switch, a mode
NEUTRAL = 0.65  # how likely a name that says nothing makes an input, and an output
_RAMP = 1e-4  # of its range: what leaves a straight line by less is a clock

COMMAND_NAME = re.compile(
    r'cmd|command|set_?point|target|goal|desired|reference|(^|[/_])(ref|des|sp)($|[/_])|'
    r'control(?!ler_state)|'
    r'effort|torque|wrench|thrust|throttle|joy|stick|(^|[/_])rc|pwm|servo|motor|actuator|input|'
    r'steer|voltage|drive|action|^u\d*$', re.IGNORECASE)
MEASURED_NAME = re.compile(
    r'imu|gyro|accel|odom|pose|position|state|meas|sensor|feedback|encoder|vel(?!.*cmd)|'
    r'attitude|mocap|vicon|optitrack|gps|fix|range|altitude|joint|tracking', re.IGNORECASE)
_COMMAND_TYPE = re.compile(
    r'.*(Twist|TwistStamped|Wrench|WrenchStamped|Ackermann\w*|Joy|JointTrajectory\w*|'
    r'AttitudeTarget|PositionTarget|\w*Setpoint|\w*Command|\w*Cmd|Actuator\w*|ManualControl\w*|'
    r'RCIn|RCOut|RcChannels|Thrust|MultiArray|JointJog|\w*Control)$')
_MEASURED_TYPE = re.compile(
    r'.*(Imu|Odometry|Pose\w*|Transform\w*|TwistWithCovariance\w*|JointState|\w*State|'
    r'VehicleOdometry|VehicleAttitude|VehicleAngularVelocity|VehicleLocalPosition|'
    r'SensorCombined|NavSatFix|Range|Accel\w*|Altitude|\w*Measurement)$')
_NO_MOTION = re.compile(
    r'.*(Battery\w*|Temperature|MagneticField|FluidPressure|Diagnostic\w*|\w*Health\w*|Cpu\w*|'
    r'Estimator\w*(Status|Innovation|Bias|Drift|Flags|Ratio)\w*|EkfGpsDrift|TimeReference|Power\w*|'
    r'Esc\w*)$')  # what motors say of themselves is not what they move
STICK = re.compile(r'joy|stick|(^|[/_])rc|manual|teleop', re.IGNORECASE)
_DERIVED_FIELD = re.compile(r'error|integral|(^|[._])(desired|reference|ref|set_?point|target|'
                            r'command|cmd)($|[._\[])|temperature|voltage|current')
_HOUSEKEEPING = re.compile(r'supply|temperature|(^|[/_.])temp($|[/_.])', re.IGNORECASE)
BATTERY = re.compile(r'batt|vbat|vbus|bus_volt', re.IGNORECASE)
FORCE_FIELD = re.compile(r'effort|torque|force|current|cmd|command|input|voltage|pwm|control')
WANTED = re.compile(
    r'set_?point|desired|target|goal|reference|(^|[/_])(ref|des|sp)($|[/_])', re.IGNORECASE)
_FORCE_NAME = re.compile(r'torque|thrust|force|wrench|moment(?!um)', re.IGNORECASE)


@dataclass(frozen=True, eq=False)
class Candidate:
    """
    A scalar that could be an input or an output.

    Parameters
    ----------
    topic : TopicSurvey
    field : FieldStats
    path : FieldPath
    acts, measures : float
        How likely name and type make it an input, an output: 0 to 1.
    held, smooth : ndarray
        Its values at the ticks of the common clock, held or averaged; NaN where not known.
    stopped : ndarray
        The held ones, 0 where no sample comes for long: so a driver's timeout lets them act.
    first, last : float
        Its first and last sample [s].
    rate : float
        Samples per second while they come [Hz].
    stays : bool
        Whether most samples equal the one before, as those of a command that is held do.
    unit : str
        As the title of a column says it.
    wraps : (float, int)
        A full turn of an angle that wraps, and by how many of these its samples jump; here it is
        unwrapped. (0.0, 0) if it is none.
    """

    topic: TopicSurvey
    field: FieldStats
    path: FieldPath
    acts: float
    measures: float
    held: Array
    smooth: Array
    stopped: Array
    first: float
    last: float
    rate: float
    stays: bool
    unit: str = ''
    wraps: tuple[float, int] = (0.0, 0)

    @property
    def key(self) -> Key:
        """Topic and field."""
        return self.topic.info.name, self.field.field

    @property
    def wanted(self) -> bool:
        """Whether its topic is named like a setpoint or a stick: what acts comes after."""
        name = _name(self.topic)
        return is_wanted(name) or bool(STICK.search(name))

    @property
    def set_point(self) -> bool:
        """Whether its topic or it is named like a setpoint."""
        return any(is_wanted(plain(word)) for word in (_name(self.topic), self.key[1]))


def _name(topic: TopicSurvey) -> str:
    """Return the name of a topic; of a table, whose is that of a file, none: columns differ."""
    return '' if topic.info.type.startswith('table/') else topic.info.name


def is_wanted(topic: str) -> bool:
    """Whether a topic is named like what a loop is to follow; a wanted force acts itself."""
    return bool(WANTED.search(topic)) and not _FORCE_NAME.search(topic)


def likely_roles(topic: TopicSurvey, field: str) -> tuple[float, float]:
    """Return how likely name and type alone make a field an input, and an output: 0 to 1."""
    name, kind, field = _name(topic), topic.info.type, plain(field)
    command = 1.5 * bool(COMMAND_NAME.search(name)) + bool(_COMMAND_TYPE.match(kind))
    command += 0.5 * bool(COMMAND_NAME.search(field))
    measured = bool(MEASURED_NAME.search(name)) + 1.5 * bool(_MEASURED_TYPE.match(kind))
    measured += 0.5 * bool(MEASURED_NAME.search(field))
    lean = float(np.clip((command - measured) / 1.5, -1.0, 1.0))
    acts, measures = NEUTRAL + 0.35 * lean, NEUTRAL - 0.35 * lean
    if lean < 0 and FORCE_FIELD.search(field):     # an effort that was measured: it moves things,
        acts, measures = max(acts, 0.5), min(measures, 0.5)    # or only repeats its command
    if STICK.search(name) or kind.endswith(('/Joy', '/ManualControl')):
        acts *= 0.9
    if is_wanted(name):
        acts *= 0.95
    if _NO_MOTION.match(kind) or _DERIVED_FIELD.search(field):
        measures *= 0.5
    if _NO_MOTION.match(kind) or _HOUSEKEEPING.search(field):
        acts *= 0.5
    if BATTERY.search(field):          # it sags with what all commands together draw
        acts, measures = 0.2 * acts, 0.2 * measures
    return acts, measures


def candidates(bag: Bag, survey: Survey, named: Collection[Key] = ()
               ) -> tuple[list[Candidate], Clock]:
    """
    Return the scalars that could be signals, on a common clock.

    Parameters
    ----------
    bag : Bag
    survey : Survey
    named : collection of (str, str), optional
        Topics and fields of those that are wanted, whatever they look like.

    Raises
    ------
    BagError
        If the bag cannot be read on.
    """
    wanted = {t.info.name: [f.field for f in t.fields if (t.info.name, f.field) in named]
              for t in survey.topics}
    usual = {t.info.name: [f.field for f in t.moving[:_MOST_OF_TOPIC]]
             for t in survey.topics if t.info.count >= _SWITCHES}
    topics = [t for t in survey.topics if wanted[t.info.name] or usual.get(t.info.name)]
    fields = {t.info.name: [parse_field(text) for text in dict.fromkeys(
        (*usual.get(t.info.name, ()), *wanted[t.info.name]))] for t in topics}
    read, parts = gather(bag, survey, fields)
    clock = clock_for([_rate(samples.time) for samples in read.values()], parts)
    if not len(clock.time):             # all is of one instant
        return [], clock
    found = [one for topic in topics
             for one in _of_topic(topic, bag.message_type(topic.info.name),
                                  fields[topic.info.name], read[topic.info.name], clock,
                                  wanted[topic.info.name])]
    return found, clock


def _rate(time: Array) -> float:
    step = np.diff(time)
    step = step[step > 0]
    return 1.0 / float(np.median(step)) if len(step) else np.nan


def _of_topic(topic: TopicSurvey, kind: MessageType, paths: Sequence[FieldPath], samples: Samples,
              clock: Clock, wanted: Collection[str]) -> list[Candidate]:
    stats: Mapping[str, FieldStats] = {f.field: f for f in topic.fields}
    found = []
    types = [_type(kind, path) for path in paths]
    whole = [i for i, one in enumerate(types) if not one.base.startswith('float')]
    for i, path in enumerate(paths):
        good = np.abs(samples.values[:, i]) <= LARGEST
        time, values = samples.time[good], samples.values[good, i]
        acts, measures = likely_roles(topic, str(path))
        # A command is held between its messages: a dozen of them are as many steps.
        few = len(time) < (_SWITCHES if acts > measures else FEWEST)
        if not len(time) or (str(path) not in wanted and (
                few or no_signal(time, values, counts=i in whole))):
            continue
        turn, _ = wrapped = wraps(values)
        if turn:
            values = np.unwrap(values, period=turn)
        found.append(Candidate(
            topic, stats[str(path)], path, acts, measures, held(time, values, clock),
            averaged(time, values, clock), held(time, values, clock, lost_after(time)),
            float(time[0]), float(time[-1]), _rate(time),
            bool(2 * np.count_nonzero(np.diff(values)) < len(values) - 1),
            '' if path.euler else types[i].unit, wrapped))
    return found


def _type(kind: MessageType, path: FieldPath) -> FieldType:
    """Return as what the field is declared that a path leads to."""
    found = FieldType(kind.name)
    for step in path.leaves[0]:
        if isinstance(step, str):
            found = kind.types[found.base][step]
    return found


def no_signal(time: Array, values: Array, *, counts: bool = False) -> bool:
    """
    Whether it is a constant, a clock or, of whole numbers by declaration, a switch or a mode.

    A command that steps between a few levels is a signal.
    """
    changes = np.count_nonzero(np.diff(values))
    if changes == 0:
        return True
    if counts and changes < _SWITCHES and len(np.unique(values)) <= _LEVELS:
        return True
    line = np.polynomial.Polynomial.fit(time, values, 1)
    return bool(np.abs(values - line(time)).max() < _RAMP * np.ptp(values))
