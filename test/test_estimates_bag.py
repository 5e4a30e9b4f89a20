# SPDX-License-Identifier: Apache-2.0
"""What the node publishes as a bag, and the layouts that plot it."""

from __future__ import annotations

from dataclasses import replace
import json
import math
from pathlib import Path
import re
import xml.etree.ElementTree as ET

from mcap.reader import make_reader
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from ctsid_core import Settings, StateSpace
from ctsid_core.model.estimate import Estimate, Status
from ctsid_core.model.storage import to_json
from ctsid_core.model.verdict import Grade, Verdict
from ctsid_core.sequence.tracking import Tracked
from ctsid_ros.export.estimates_bag import NODE, write_estimates
from ctsid_ros.messages import (
    decode_diagnostics,
    decode_eigenvalues,
    decode_matrix,
    decode_metadata,
    decode_model,
)
from ctsid_ros.messages.health import Level
from ctsid_ros.messages.publication import TOPICS, messages_of
from ctsid_ros.recordings.message_store import make_message, serialise
from ctsid_ros.verbs.params import example

CONFIG = Path(__file__).resolve().parent.parent / 'config'
S = 10**9
START = 1_700_000_000 * S


def tracked_of(number: int, grade: Grade = Grade.GOOD, n: int = 6) -> Tracked:
    poles = -np.arange(1.0, n + 1)
    model = StateSpace(np.diag(poles), np.ones((n, 1)), np.ones((2, n)),
                       output_names=('rate "x"', 'a/b'))
    end_ns = START + number * S
    known = {'status': Status.OK, 'model': model, 'pole_std': np.full(n, 0.25)} \
        if grade is not Grade.REJECT else {'status': Status.CHANGED, 'rejected_model': model}
    estimate = Estimate(settings=Settings(), fit=np.array([90.0, 1 / 3]),
                        held_out_fit=np.array([np.nan, np.nan]), start_ns=end_ns - 10 * S,
                        end_ns=end_ns, verdict=Verdict(grade=grade, reason='so'), **known)
    if estimate.model is None:
        return Tracked(estimate, 1, fresh_fit=np.array([80.0, np.nan]))
    return Tracked(estimate, 1, tuple(range(1, n + 1)), poles.astype(complex),
                   estimate.pole_std, np.array([80.0, np.nan]))


WINDOWS = (tracked_of(1), tracked_of(2, Grade.WEAK), tracked_of(3, Grade.REJECT), tracked_of(4))


@pytest.fixture(scope='module')
def bag(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp('estimates') / 'estimates.mcap'
    write_estimates(path, example(), WINDOWS)
    return path


def messages(path: Path) -> dict[str, list]:
    """Topic to (log time, message), as rosbags reads them."""
    found: dict[str, list] = {}
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        for connection, log_ns, raw in reader.messages():
            found.setdefault(connection.topic, []).append(
                (log_ns, reader.deserialize(raw, connection.msgtype)))
    return found


def test_rosbags_reads_every_topic_at_the_ends_of_the_windows(bag):
    found = messages(bag)
    assert set(found) == {f'{NODE}/{name}' for name in TOPICS}
    ends = [window.estimate.end_ns for window in WINDOWS]
    for name in ('model', 'summary'):
        assert [log_ns for log_ns, _ in found[f'{NODE}/{name}']] == ends
    for name in set(TOPICS) - {'model', 'summary'}:
        assert [log_ns for log_ns, _ in found[f'{NODE}/{name}']] == [ends[0], ends[3]]  # GOOD
    for (_, message), window in zip(found[f'{NODE}/model'], WINDOWS, strict=True):
        assert to_json(decode_model(message)) == to_json(window.estimate)
    assert [decode_metadata(m)['window'] for _, m in found[f'{NODE}/model']] == [1, 2, 3, 4]
    model = WINDOWS[0].estimate.model
    np.testing.assert_array_equal(decode_matrix(found[f'{NODE}/b'][0][1]), model.B)
    assert decode_eigenvalues(found[f'{NODE}/eigenvalues'][0][1]).modes == (1, 2, 3, 4, 5, 6)


def test_mcap_reads_it_as_a_recording_of_ros2(bag):
    with open(bag, 'rb') as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == 'ros2'
        summary = reader.get_summary()
        assert {channel.topic: summary.schemas[channel.schema_id].name
                for channel in summary.channels.values()} == {
            f'{NODE}/{name}': kind for name, kind in TOPICS.items()}
        assert {channel.message_encoding for channel in summary.channels.values()} == {'cdr'}
        assert {schema.encoding for schema in summary.schemas.values()} == {'ros2msg'}
        stamps = [(m.log_time, m.publish_time) for _, _, m in reader.iter_messages()]
    assert all(log == publish for log, publish in stamps)
    assert stamps == sorted(stamps)


def test_the_summary_says_verdict_fits_and_poles_by_name(bag):
    stamp, statuses = decode_diagnostics(messages(bag)[f'{NODE}/summary'][0][1])
    found = {status.name: status for status in statuses}
    assert stamp == WINDOWS[0].estimate.end_ns
    assert [*found] == ['verdict', 'fit', 'held_out_fit', 'fresh_fit',
                        *(f'mode {k}' for k in range(1, 7))]
    assert found['verdict'].level is Level.OK
    assert found['verdict'].message == 'so'
    assert found['verdict'].values['grade'] == '2'
    assert found['fit'].values == {'rate "x"': '90.0', 'a/b': repr(1 / 3), 'worst': repr(1 / 3)}
    assert math.isnan(float(found['held_out_fit'].values['worst']))
    assert found['fresh_fit'].values['worst'] == '80.0'
    assert float(found['mode 3'].values['re']) == -3.0
    assert found['mode 3'].values['std'] == '0.25'


def test_the_summary_of_a_rejected_window_has_no_poles(bag):
    _, statuses = decode_diagnostics(messages(bag)[f'{NODE}/summary'][2][1])
    assert [status.name for status in statuses] == ['verdict', 'fit', 'held_out_fit', 'fresh_fit']
    assert statuses[0].level is Level.ERROR


def test_ros_reads_the_same_messages_as_it_publishes():
    rclpy = pytest.importorskip('rclpy.serialization')
    for window in WINDOWS[:3]:
        of_ros = messages_of(window, {'window': 1})
        for name, message in messages_of(window, {'window': 1}, make_message).items():
            read = rclpy.deserialize_message(serialise(message), type(of_ros[name]))
            assert read == of_ros[name], name


def test_stamps_that_no_message_can_hold_break_nothing(tmp_path):
    for end_ns in (-5, 2**62):
        window = replace(WINDOWS[0], estimate=replace(WINDOWS[0].estimate, end_ns=end_ns))
        path = tmp_path / f'{end_ns}.mcap'
        write_estimates(path, example(), [window])
        assert len(messages(path)[f'{NODE}/summary']) == 1


def summary_values(bag: Path) -> dict[tuple[str, str], float]:
    _, statuses = decode_diagnostics(messages(bag)[f'{NODE}/summary'][0][1])
    found = {(status.name, key): value for status in statuses
             for key, value in status.values.items()}
    return {place: float(value) for place, value in found.items() if place[1] != 'status'}


PATH = re.compile(r'(/[\w/]+)\.status\[:\]\{name=="([^"]+)"\}'
                  r'(?:\.values\[:\]\{key=="([^"]+)"\}\.value)?')


def test_the_layout_of_foxglove_names_what_is_there(bag):
    layout = json.loads((CONFIG / 'foxglove.json').read_text())
    values, panels = summary_values(bag), layout['configById']
    used = re.findall(r'"(\w+!\w+)"', json.dumps(layout['layout']))
    assert sorted(used) == sorted(panels)
    paths = [path['value'] for panel in panels.values() for path in panel.get('paths', [])]
    assert len(paths) > 20
    for path in paths:
        topic, status, key = PATH.fullmatch(path).groups()
        assert topic.removeprefix(f'{NODE}/') in TOPICS
        assert (status, key) in values, path
    topic, status, key = PATH.fullmatch(panels['RawMessages!reason']['topicPath']).groups()
    assert (topic, status, key) == (f'{NODE}/summary', 'verdict', None)


def test_the_layout_of_plotjuggler_names_what_is_there(bag):
    root = ET.parse(CONFIG / 'plotjuggler.xml').getroot()
    series = {f'{NODE}/summary/{status}/{key}' for status, key in summary_values(bag)}
    curves = [curve.get('name') for curve in root.iter('curve')]
    assert len(curves) > 20
    assert set(curves) <= series
    (splitter,) = root.iter('DockSplitter')
    assert len(splitter.get('sizes').split(';')) == int(splitter.get('count')) == len(splitter)
