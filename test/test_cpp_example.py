# SPDX-License-Identifier: Apache-2.0
"""The C++ consumer in docs/cpp: compiled, and of the same mind as the one in Python."""

from __future__ import annotations

from dataclasses import fields, replace
from importlib.util import find_spec
import os
from pathlib import Path
import re
import shutil
import subprocess

import numpy as np
import pytest
from test_gain_tuner import FRESH, GOOD, LIMITS, TRUTH, S

from ctsid_core.model.estimate import Status
from ctsid_core.model.storage import to_json
from ctsid_core.model.verdict import UNJUDGED
from ctsid_ros.examples.acceptance import Limits, objection
from ctsid_ros.messages.interface import OUTPUTS

SOURCES = Path(__file__).resolve().parent.parent / 'docs/cpp'
CXX, CMAKE = shutil.which('c++'), shutil.which('cmake')
ROS = [p for p in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
       if p and (Path(p) / 'share/rclcpp/cmake').is_dir()]


@pytest.fixture(scope='module')
def headers() -> list[Path]:
    """Where nlohmann/json.hpp is."""
    spec = find_spec('nlohmann_json')
    found = [Path(spec.origin).parent / 'include'] if spec else [Path('/usr/include')]
    if CXX is None or not (found[0] / 'nlohmann/json.hpp').is_file():
        pytest.skip("this needs a C++ compiler and nlohmann-json: pip install '.[test]'")
    return found


@pytest.fixture(scope='module')
def check_model(headers, tmp_path_factory) -> Path:
    program = tmp_path_factory.mktemp('cpp') / 'check_model'
    subprocess.run([CXX, '-std=c++17', '-Wall', '-Wextra', '-Wpedantic', '-Werror', '-isystem',
                    headers[0], SOURCES / 'check_model.cpp', '-o', program], check=True)
    return program


@pytest.mark.parametrize(('changes', 'fresh', 'age'), [
    ({}, FRESH, 1.0),
    ({'held_out_fit': np.array([np.nan])}, np.array([np.nan]), 0.0),
    ({}, np.empty(0), 4.9),
    ({'status': Status.TOO_SHORT, 'model': None}, FRESH, 1.0),
    ({'verdict': replace(UNJUDGED, reason='A reason.')}, FRESH, 1.0),
    ({'model': replace(TRUTH, input_names=('other',))}, FRESH, 1.0),
    ({}, FRESH, 29.0),
    ({}, FRESH, -11.0),
    ({'pole_std': np.array([0.02, 5.0, 0.3, 0.3])}, FRESH, 1.0),
    ({'pole_std': np.array([0.02, np.nan, 0.3, 0.3])}, FRESH, 1.0),
    ({'pole_std': np.empty(0)}, FRESH, 1.0),
    ({'fit': np.array([65.0])}, FRESH, 1.0),
    ({'held_out_fit': np.array([-20.0])}, FRESH, 1.0),
    ({}, np.array([30.0]), 1.0),
])
def test_it_accepts_what_the_python_example_accepts(check_model, tmp_path, changes, fresh, age):
    estimate = replace(GOOD, **changes)
    now = estimate.end_ns + int(age * S)
    wanted = objection(estimate, fresh, now, LIMITS)
    file = tmp_path / 'model.json'
    file.write_text(to_json(estimate, {'fresh_fit': fresh}), encoding='utf-8')
    ran = subprocess.run([check_model, file, 'torque', 'rate', str(age)], text=True,
                         capture_output=True, check=False)
    first, *rest = ran.stdout.splitlines()
    assert (ran.returncode, first.startswith('Refused: ')) == ((3, True) if wanted else (0, False))
    if wanted.startswith(('REJECT', 'WEAK')):
        assert first == f'Refused: {estimate.verdict.grade.name}: {estimate.verdict.reason}'
    if not wanted:
        poles = [complex(*map(float, line.split())) for line in rest]
        assert poles == TRUTH.poles.tolist()


@pytest.mark.parametrize('text', ['', '[]', '{"format": "ctsid-model", "version": 3}', 'null'])
def test_what_is_no_model_is_told(check_model, tmp_path, text):
    file = tmp_path / 'no_model.txt'
    file.write_text(text)
    ran = subprocess.run([check_model, file, 'torque', 'rate'], text=True, capture_output=True,
                         check=False)
    assert (ran.returncode, ran.stdout) == (1, '')
    assert 'it is not a model of ctsid' in ran.stderr


def test_the_node_asks_for_what_is_published():
    node = (SOURCES / 'model_consumer.cpp').read_text(encoding='utf-8')
    package, kind, name = OUTPUTS['model'].type.split('/')
    subscribed = re.search(r'create_subscription<([\w:]+)>\(\s*"identifier/(\w+)", (\w+)', node)
    assert subscribed.groups() == (f'{package}::{kind}::{name}', 'model', 'latched')
    assert f'#include <{package}/{kind}/{name.lower()}.hpp>' in node
    assert 'latched = rclcpp::QoS(1).reliable().transient_local();' in node
    header = (SOURCES / 'model_message.hpp').read_text(encoding='utf-8')
    limits = dict(re.findall(r'^  double (\w+) = ([\d.]+);', header, re.MULTILINE))
    wanted = {f.name: f.default for f in fields(Limits) if f.name not in ('inputs', 'outputs')}
    assert {key: float(value) for key, value in limits.items()} == wanted
    assert set(re.findall(r'declare_parameter(?:<\w+>)?\("(\w+)"', node)) == {
        f.name for f in fields(Limits)}


@pytest.mark.skipif(not find_spec('rclpy'), reason='this needs rclpy')
def test_the_identifier_is_reliable_and_latched():
    from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

    from ctsid_ros.node.identifier import LATCHED

    assert (LATCHED.depth, LATCHED.reliability, LATCHED.durability) == (
        1, ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL)


@pytest.mark.skipif(not ROS or CMAKE is None, reason='this needs rclcpp: source a ROS 2')
def test_the_node_compiles_where_ros_is(headers, tmp_path):
    subprocess.run([CMAKE, '-S', SOURCES, '-B', tmp_path,
                    f'-DCMAKE_INCLUDE_PATH={headers[0]}'], check=True)
    subprocess.run([CMAKE, '--build', tmp_path, '--target', 'model_consumer'], check=True)
    assert (tmp_path / 'model_consumer').is_file()
