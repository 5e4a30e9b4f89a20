# SPDX-License-Identifier: Apache-2.0
"""
The import law.

The staircase below names the modules of the architecture and their levels. One that can reach
another through imports, directly or through modules without a level of their own, lies higher.
Nothing is imported in a circle, the core knows nothing of ROS, messages and files of others, and
each foreign library is known to a few modules only.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from fnmatch import fnmatch
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path
import subprocess
import sys

import pytest

ROOT = Path(__file__).resolve().parent.parent
VERBS = [f'verbs.{verb}' for verb in (
    'advise', 'compare', 'identify', 'info', 'init', 'params', 'replay', 'show', 'simulate',
    'study')]
LEVELS = {
    'ctsid_core': [
        ['errors', 'agreement'], ['settings'], ['signals'],
        ['shapes', 'matrix_functions', 'frequency', 'residuals', 'mode_rows', 'spikes'],
        ['simulation', 'realisation'],
        ['statespace', 'verdict'], ['covariance'],
        ['estimate', 'samples', 'predictor', 'alignment'],
        ['windows', 'model_json'],
        ['bases.chirp_sums', 'bases.blocks'],
        ['bases.fourier_sums', 'bases.hermite_functions'], ['bases.hermite_sums'],
        ['bases.base', 'bases.quadrature', 'bases.takenaka_malmquist', 'bases.kinks',
         'bases.bends', 'bases.local_polynomials'], ['bases.hermite', 'storage', 'validation'],
        ['outliers'], ['tall_qr'],
        ['bases.instants', 'pbsid', 'resolvent', 'bandwidth', 'usable', 'colour', 'stuck'],
        ['window_ends', 'gobf_subspace'], ['pole_fit', 'prediction_errors', 'delay_columns'],
        ['levenberg_marquardt'],
        ['record_equations'], ['refine', 'many_models', 'whole_model'],
        ['time_responses'], ['time_refine'], ['time_search'], ['time_estimate'],
        ['steadiness', 'process_noise', 'candidates', 'excitation', 'joint_climb'],
        ['deviation', 'leftover', 'judgement'], ['examination', 'joint'], ['other_method'],
        ['driven'], ['ct_pbsid', 'gobf'], ['methods'],
        ['mode_sensitivity', 'sameness'], ['time_prediction'],
        ['order'], ['closed_loop', 'found', 'selection'], ['held_out', 'dead_time'],
        ['outcome', 'time_identify'], ['by_method', 'estimation', 'forecast'], ['bending'],
        ['lateness', 'advice', 'cross_check'],
        ['identify'], ['tracking']],
    'ctsid_ros': [
        ['angles', 'blas', 'svg', 'tables', 'progress'], ['field_grammar', 'document'],
        ['field_path'],
        ['node_settings'], ['channels'], ['config_file', 'cdr', 'health', 'origin'],
        ['bag', 'bag_writer', 'ingest', 'matrix_messages', 'sim_clock', 'sequence_numbers'],
        ['feed', 'messages'],
        ['survey_stats', 'playback', 'tracks', 'recordings'], ['survey', 'replay'],
        ['examples.quadrotor_roll', 'examples.lqr', 'examples.acceptance', 'examples.running',
         'studies.bounds', 'studies.experiments', 'studies.figure_files'],
        ['examples.flight', 'examples.tuner_node', 'examples.demo_table',
         'examples.demo_processes', 'studies.monte_carlo', 'studies.network', 'studies.page'],
        ['studies.kept_runs', 'studies.clouds'], ['studies.runner'],
        ['examples.robot_node', 'examples.demo_node', 'studies.table1', 'studies.windows',
         'studies.closed_loop', 'studies.takenaka_malmquist', 'studies.hd_basis',
         'studies.hd_robustness'],
        ['studies.hd_vs_ct', 'studies.hd_parameters'], ['studies.hd_unsaid'],
        ['examples.simulated_robot', 'examples.gain_tuner', 'examples.live_demo'],
        ['guess', 'figures', 'results', 'experiment'], ['report'],
        ['parameters', 'intake', 'worker'],
        ['session', 'plan'], ['diagnosis'], ['run'], ['identifier'], ['node'],
        ['verbs.arguments'], VERBS, ['cli']],
}
ROS = ('rclpy', 'rosgraph_msgs', 'builtin_interfaces', 'diagnostic_msgs', 'geometry_msgs',
       'rcl_interfaces', 'sensor_msgs', 'std_msgs', 'std_srvs')
# Which modules may know a library. Those of the core may import it inside a function only.
USERS = {
    **dict.fromkeys(ROS, ['ctsid_ros.examples.*', 'ctsid_ros.parameters', 'ctsid_ros.descriptors',
                          'ctsid_ros.intake', 'ctsid_ros.plan', 'ctsid_ros.run',
                          'ctsid_ros.identifier', 'ctsid_ros.node',
                          # inside functions, where a message is made:
                          'ctsid_ros.messages', 'ctsid_ros.matrix_messages', 'ctsid_ros.health']),
    'control': ['ctsid_core.statespace'],
    'lz4': ['ctsid_ros.bag*'],
    'mcap': ['ctsid_ros.bag*'],
    'rich': ['ctsid_ros.cli*', 'ctsid_ros.progress'],
    'rosbags': ['ctsid_ros.bag*'],
    'yaml': ['ctsid_ros.config_file', 'ctsid_ros.bag*'],
    'zstandard': ['ctsid_ros.bag*'],
    'numpy': ['ctsid_core*', 'ctsid_ros*'],
    'scipy': ['ctsid_core*', 'ctsid_ros.examples.*', 'ctsid_ros.studies.*'],
}


@cache
def modules() -> dict[str, Path]:
    """Dotted name of every module, and its file."""
    files = [f for package in LEVELS for f in (ROOT / package).rglob('*.py')]
    return {'.'.join(f.relative_to(ROOT).with_suffix('').parts).removesuffix('.__init__'): f
            for f in files}


def imported(name: str) -> Iterator[tuple[str, bool]]:
    """Yield each dotted name that a module imports, and whether only inside a function."""
    tree = ast.parse(modules()[name].read_text(encoding='utf-8'))
    lazy = {id(node) for function in ast.walk(tree) if isinstance(function, ast.FunctionDef)
            for node in ast.walk(function)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, id(node) in lazy) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{name}: imports are absolute'
            yield from ((f'{node.module}.{alias.name}', id(node) in lazy) for alias in node.names)


@cache
def own(name: str) -> frozenset[str]:
    """Our own modules that a module imports, beside the packages' lists of public names."""
    found = set()
    for target, _ in imported(name):
        while target and target not in modules():
            target = target.rpartition('.')[0]
        found.add(target)
    is_list = modules()[name].name == '__init__.py'
    return frozenset(found - {''} if not is_list else ())


@cache
def reached(name: str) -> frozenset[str]:
    return frozenset(own(name)).union(*(reached(target) for target in own(name)))


def levels(package: str) -> dict[str, int]:
    return {f'{package}.{name}': level for level, names in enumerate(LEVELS[package])
            for name in names if f'{package}.{name}' in modules()}


def test_nothing_is_imported_in_a_circle():
    list(TopologicalSorter({name: own(name) for name in modules()}).static_order())


@pytest.mark.parametrize('package', LEVELS)
def test_modules_reach_lower_levels_only(package):
    level = levels(package)
    assert len(level) > 4
    wrong = [f'{name} reaches {target}' for name in level for target in reached(name)
             if level.get(target, -1) >= level[name]]
    assert wrong == []


def test_modules_do_not_use_the_lists_of_public_names():
    """They exist for users; inside, one imports from where a name is made."""
    lists = {name for name, path in modules().items() if path.name == '__init__.py'}
    wrong = {name: own(name) & lists for name in modules() if own(name) & lists}
    assert wrong == {}


def test_the_core_does_not_know_ros():
    wrong = [name for name in modules() if name.startswith('ctsid_core')
             and any(target.startswith('ctsid_ros') for target, _ in imported(name))]
    assert wrong == []


def test_the_core_loads_nothing_heavy():
    """scipy.signal brings scipy.stats: every command and node would start 0.7 s later."""
    code = "import ctsid_core, sys; print({'scipy.signal', 'scipy.stats'} & set(sys.modules))"
    loaded = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                            check=True)
    assert loaded.stdout == 'set()\n'


def test_libraries_are_known_where_they_may_be():
    wrong = []
    for name in modules():
        for target, lazy in imported(name):
            library = target.partition('.')[0]
            if library in {*sys.stdlib_module_names, '__future__', *LEVELS}:
                continue
            allowed = any(fnmatch(name, pattern) for pattern in USERS.get(library, ()))
            extra = name.startswith('ctsid_core') and library not in ('numpy', 'scipy')
            if not allowed or (extra and not lazy):
                wrong.append(f'{name} imports {target}')
    assert wrong == []


def test_the_staircase_names_real_modules():
    named = {f'{package}.{name}' for package, steps in LEVELS.items()
             for names in steps for name in names}
    assert named - set(modules()) == set()
