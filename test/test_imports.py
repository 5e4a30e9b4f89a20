# SPDX-License-Identifier: Apache-2.0
"""
The import law.

Packages stand one above the other: a module imports from its own package and from those below.
Nothing is imported in a circle, the core knows nothing of ROS, messages and files of others, and
each foreign library is known to a few modules only.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from fnmatch import fnmatch
from functools import cache
from graphlib import TopologicalSorter
import os
from pathlib import Path
import re
import subprocess
import sys

from marks import slow
import pytest

import ctsid_core
from ctsid_ros.cli import VERBS

ROOT = Path(__file__).resolve().parent.parent
# From the bottom; a module may import from its own package and from those before it.
PACKAGES = {
    'ctsid_core': ['errors', 'effort', 'linear', 'settings', 'signals', 'model', 'bases',
                   'subspace', 'likelihood', 'search', 'judge', 'advice', 'identify',
                   'sequence'],
    'ctsid_ros': ['errors', 'blas', 'workers', 'interrupts', 'progress', 'decoding', 'config',
                  'ingest', 'recordings', 'replay', 'messages', 'report', 'export', 'batch',
                  'node', 'studies', 'examples', 'verbs', 'cli'],
}
ROS = ('rosgraph_msgs', 'builtin_interfaces', 'diagnostic_msgs', 'geometry_msgs',
       'rcl_interfaces', 'sensor_msgs', 'std_msgs', 'std_srvs')
# Which modules may know a library. Those of the core may import it inside a function only.
USERS = {
    'rclpy': ['ctsid_ros.node.*', 'ctsid_ros.examples.*'],
    **dict.fromkeys(ROS, ['ctsid_ros.node.*', 'ctsid_ros.examples.*',
                          'ctsid_ros.messages.*']),  # inside functions, where one is made
    'lz4': ['ctsid_ros.recordings.*'],
    'isal': ['ctsid_ros.recordings.mcap_chunks'],
    'threadpoolctl': ['ctsid_core.effort'],
    'mcap': ['ctsid_ros.recordings.*'],
    'pyulog': ['ctsid_ros.recordings.ulog_file'],
    'pymavlink': ['ctsid_ros.recordings.ardupilot_file'],
    'pyarrow': ['ctsid_ros.recordings.parquet_file', 'ctsid_ros.batch.rows'],
    'fsspec': ['ctsid_ros.recordings.remote'],
    'rich': ['ctsid_ros.progress', 'ctsid_ros.report.watching', 'ctsid_ros.verbs.watch'],
    'rosbags': ['ctsid_ros.recordings.*'],
    'jinja2': ['ctsid_ros.report.page'],
    'markupsafe': ['ctsid_ros.report.page'],
    'matplotlib': ['ctsid_ros.report.static', 'ctsid_ros.studies.network'],
    'plotly': ['ctsid_ros.report.interactive'],
    **dict.fromkeys(('dask', 'distributed'), ['ctsid_ros.batch.scheduling']),
    'yaml': ['ctsid_ros.config.parameter_file', 'ctsid_ros.recordings.*', 'ctsid_ros.export.*'],
    'zstandard': ['ctsid_ros.recordings.*'],
    'numpy': ['ctsid_core*', 'ctsid_ros*'],
    'scipy': ['ctsid_core*', 'ctsid_ros.examples.*', 'ctsid_ros.studies.*', 'ctsid_ros.export.*',
              'ctsid_ros.recordings.coherence', 'ctsid_ros.report.spectra',
              'ctsid_ros.report.headline'],
}


@cache
def modules() -> dict[str, Path]:
    """Dotted name of every module, and its file."""
    files = [f for package in PACKAGES for f in (ROOT / package).rglob('*.py')]
    return {'.'.join(f.relative_to(ROOT).with_suffix('').parts).removesuffix('.__init__'): f
            for f in files}


@cache
def imported(name: str) -> tuple[tuple[str, bool], ...]:
    """Return each dotted name that a module imports, and whether only inside a function."""
    return tuple(_imported(name))


def _imported(name: str) -> Iterator[tuple[str, bool]]:
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


def package_of(name: str) -> tuple[str, str]:
    """Return 'ctsid_core', 'model' of 'ctsid_core.model.estimate'."""
    top, _, rest = name.partition('.')
    return top, rest.partition('.')[0]


def test_nothing_is_imported_in_a_circle():
    list(TopologicalSorter({name: own(name) for name in modules()}).static_order())


@pytest.mark.parametrize('top', PACKAGES)
def test_packages_import_from_those_below_only(top):
    place = {name: level for level, name in enumerate(PACKAGES[top])}
    arrows = [(name, target) for name in modules() if package_of(name)[0] == top
              for target in own(name) if package_of(target)[0] == top]
    assert len(arrows) > 100
    wrong = [f'{name} imports {target}' for name, target in arrows
             if place[package_of(target)[1]] > place[package_of(name)[1]]]
    assert wrong == []


def test_modules_do_not_use_the_lists_of_public_names():
    """They exist for users, and for examples to copy from; else, one imports from the maker."""
    lists = {name for name, path in modules().items() if path.name == '__init__.py'}
    wrong = {name: own(name) & lists for name in modules()
             if own(name) & lists and '.examples.' not in name}
    assert wrong == {}


def test_the_core_does_not_know_ros():
    wrong = [name for name in modules() if name.startswith('ctsid_core')
             and any(target.startswith('ctsid_ros') for target, _ in imported(name))]
    assert wrong == []


def loaded(code: str) -> set[str]:
    """Return the names of all modules that are loaded when a program has run."""
    code += '\nimport sys; print("\\n".join(["", "loaded:", *sys.modules]))'
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                          check=True, env=os.environ | {'PYTHONPATH': str(ROOT)})
    return set(done.stdout.rpartition('loaded:')[2].split())


def of_command(*words: object) -> set[str]:
    return loaded(f'from ctsid_ros.cli import main; main({[*map(str, words)]})')


# One after the other in one process: what one of them loads stays for those that follow.
NO_USE_OF_DATA = [
    ['--version'], ['--help'], [], ['nonsense'], ['params'], ['info'], ['info', '--nonsense'],
    *([name, '--help'] for name in VERBS), ['identify'], ['identify', 'bag', '--start', '-1'],
    ['identify', 'bag', '--interval', '2:1']]


def test_what_is_no_use_of_data_loads_no_library():
    """NumPy alone would take longer than all the rest."""
    libraries = ('numpy', 'scipy', 'rosbags', 'mcap', 'rich', 'yaml', 'zstandard', 'lz4',
                 'ctsid_core.identify')
    found = loaded(f"""
import sys
from ctsid_ros.cli import main
for words in {NO_USE_OF_DATA}:
    main(words)
    found = [name for name in {libraries} if name in sys.modules]
    assert not found, f'{{words}} loads {{found}}'
""")
    assert not among(found, *libraries)


def test_info_loads_neither_solvers_nor_all_message_types():
    found = of_command('info', ROOT / 'bags/quadrotor_roll')
    assert 'ctsid_ros.recordings.survey' in found
    assert not among(found, 'scipy', 'rich', 'ctsid_core.identify', 'ctsid_core.model',
                         'ctsid_core.search', 'ctsid_core.likelihood',
                         'rosbags.typesys.stores.ros2_jazzy')


def test_the_core_loads_what_is_asked_for():
    assert not among(loaded('import ctsid_core'), 'numpy', 'scipy')
    assert not among(loaded('from ctsid_core import Record, Settings'), 'scipy')


def test_identification_loads_nothing_that_it_seldom_needs():
    """scipy.signal brings scipy.stats: every command and node would start 0.7 s later."""
    assert not among(loaded('from ctsid_core import identify'), 'scipy.signal', 'scipy.stats',
                         'ctsid_ros', 'rosbags', 'control')


def among(found: set[str], *packages: str) -> list[str]:
    """Return the modules among `found` that are these, or in them."""
    return sorted(name for name in found
                  if any(f'{name}.'.startswith(f'{package}.') for package in packages))


@pytest.mark.parametrize('before', [
    'import ctsid_core.identify', *slow(
        'from ctsid_core import identify', 'import ctsid_core',
        'from ctsid_core.identify import identify',
        'from ctsid_core import *')])
def test_identify_is_the_function_whatever_was_imported_before(before):
    loaded(f"""
{before}
import ctsid_core
assert callable(ctsid_core.identify)
from ctsid_core import identify
assert identify is ctsid_core.identify
import ctsid_core.identify
assert identify is ctsid_core.identify
from ctsid_core.identify import identify as same
assert identify is same
""")


def test_the_core_lists_its_public_names():
    assert set(ctsid_core.__all__) <= set(dir(ctsid_core))
    for name in ctsid_core.__all__:
        assert getattr(ctsid_core, name).__name__ == name
    with pytest.raises(AttributeError, match='nonsense'):
        ctsid_core.nonsense  # noqa: B018


def test_libraries_are_known_where_they_may_be():
    wrong = []
    for name in modules():
        for target, lazy in imported(name):
            library = target.partition('.')[0]
            if library in {*sys.stdlib_module_names, '__future__', *PACKAGES}:
                continue
            allowed = any(fnmatch(name, pattern) for pattern in USERS.get(library, ()))
            extra = name.startswith('ctsid_core') and library not in ('numpy', 'scipy')
            if not allowed or (extra and not lazy):
                wrong.append(f'{name} imports {target}')
    assert wrong == []


def test_the_list_names_every_package():
    found = {top: {package_of(name)[1] for name in modules() if name.startswith(f'{top}.')}
             for top in PACKAGES}
    assert found == {top: set(names) for top, names in PACKAGES.items()}


def test_every_module_of_verbs_is_a_verb():
    files = {path.stem for path in (ROOT / 'ctsid_ros/verbs').glob('[a-z]*.py')}
    assert files - {'arguments'} == set(VERBS)


def test_the_page_shows_the_packages_in_this_order():
    page = (ROOT / 'docs/architecture.md').read_text().partition('## Why so')[0]
    cells = [row.split('|')[1] for row in page.splitlines() if row.startswith('| `')]
    shown = [name.removesuffix('.py').removesuffix('/')
             for cell in cells for name in re.findall(r'`([\w.]+/?)`', cell)]
    assert sorted(shown) == sorted(name for names in PACKAGES.values() for name in names)
    for names in PACKAGES.values():
        inner = [name for name in names if name not in ('errors', 'settings')]
        assert [name for name in shown if name in inner] == inner


def test_one_place_grades():
    """What is read from a file, or judged by nobody, has its grade from there."""
    grading = {name for name, path in modules().items() if name.startswith('ctsid_core')
               and re.search(r'grade=', path.read_text(encoding='utf-8'))}
    assert grading == {'ctsid_core.judge.rules', 'ctsid_core.model.estimate',
                       'ctsid_core.model.model_json', 'ctsid_core.model.verdict'}
