# SPDX-License-Identifier: Apache-2.0
"""Launch files name what is there; they are run where launch is installed."""

from __future__ import annotations

import ast
import importlib.util
import os
from pathlib import Path
import re
import subprocess

import pytest

from ctsid_ros.config.parameter_file import read_config
from ctsid_ros.config.parameter_text import dump_config

ROOT = Path(__file__).resolve().parent.parent
FILES = sorted((ROOT / 'launch').glob('*.launch.py'))


@pytest.mark.parametrize('path', FILES, ids=lambda p: p.name)
def test_launch_file_is_one(path):
    source = path.read_text(encoding='utf-8')
    compile(source, str(path), 'exec')
    tree = ast.parse(source)
    assert [f.name for f in tree.body if isinstance(f, ast.FunctionDef)] == [
        'generate_launch_description']
    modules = {n.module.partition('.')[0] for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)}
    assert modules == {'launch', 'launch_ros'}


@pytest.mark.parametrize('path', FILES, ids=lambda p: p.name)
def test_launch_file_starts_what_is_installed(path):
    scripts = re.findall(r"'(\w+) = ctsid_ros", (ROOT / 'setup.py').read_text(encoding='utf-8'))
    calls = [n for n in ast.walk(ast.parse(path.read_text(encoding='utf-8')))
             if isinstance(n, ast.Call) and ast.unparse(n.func).endswith('Node')]
    assert calls
    for call in calls:
        words = {k.arg: ast.literal_eval(k.value) for k in call.keywords
                 if k.arg in ('package', 'executable', 'name')}
        assert words['package'] == 'ctsid'
        assert words['executable'] == words['name']
        assert words['executable'] in scripts
    for name in re.findall(r"'(?:config|launch)', '([\w.]+)'", path.read_text(encoding='utf-8')):
        assert list(ROOT.glob(f'*/{name}')) != []


@pytest.mark.parametrize('path', FILES, ids=lambda p: p.name)
def test_launch_file_describes_something(path):
    pytest.importorskip('launch_ros')
    spec = importlib.util.spec_from_file_location(path.name.partition('.')[0], path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert len(module.generate_launch_description().entities) >= 3


def test_robot_and_tuner_of_the_demo_fit_its_parameter_file():
    pytest.importorskip('rclpy')
    from ctsid_ros.examples import robot_node, tuner_node
    source = (ROOT / 'launch/demo.launch.py').read_text(encoding='utf-8')
    assert "'change_after'" in source
    assert 'change_after' in robot_node._PARAMETERS
    config = read_config(ROOT / 'config/live_demo.yaml')
    for role in ('inputs', 'outputs'):
        assert tuner_node._PARAMETERS[role][0] == [c.name for c in getattr(config, role)]
    assert {c.topic for c in config.channels} == {
        f'/{robot_node.TORQUE_TOPIC}', f'/{robot_node.IMU_TOPIC}'}


def test_parameter_file_of_the_demo_says_what_is_known_of_every_parameter():
    path = ROOT / 'config/live_demo.yaml'
    text = path.read_text(encoding='utf-8')
    written = dump_config(read_config(path))
    start = text.index(written.partition('\n')[0])
    assert text[start:] == written, 'replace all from there on by dump_config(read_config(path))'
    assert 'particular' in text[:start]


@pytest.mark.parametrize(('ros', 'words'), [
    ('', "--editable '.[ros]'"), ('jazzy', '--system-site-packages .venv-jazzy')])
def test_make_demo_live_uses_the_ros_that_is_there(ros, words, tmp_path):
    for name in ('Makefile', 'setup.py', 'setup.cfg', 'pyproject.toml'):
        (tmp_path / name).write_text((ROOT / name).read_text(encoding='utf-8'), encoding='utf-8')
    own = {name: value for name, value in os.environ.items() if not name.startswith('M')}
    done = subprocess.run(['make', '-n', 'demo-live', f'ROS_DISTRO={ros}'], cwd=tmp_path,
                          capture_output=True, text=True, check=True, env=own)  # no MAKEFLAGS
    assert words in done.stdout
    assert ('.[ros]' in done.stdout) == (ros == '')
