# SPDX-License-Identifier: Apache-2.0
"""The package as ROS 2, colcon and pip see it."""

from __future__ import annotations

import ast
import os
from pathlib import Path
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET

from marks import slow
import pytest

from ctsid_ros.config.parameter_file import read_config
from ctsid_ros.config.parameter_text import dump_config
from ctsid_ros.errors import BAG_PACKAGES

ROOT = Path(__file__).resolve().parent.parent
NOT_SOURCE = shutil.ignore_patterns(
    '.*', 'build', 'install', 'log', 'results', '*.egg-info', '__pycache__', '*.so')
KERNEL = 'from ctsid_core.likelihood.kernel import built; raise SystemExit(0 if built() else 3)'
compiler = shutil.which('cc') is not None
# pip's names of what setup.py requires and the node needs, by the rosdep keys of package.xml.
ROSDEP = {'numpy': 'python3-numpy', 'scipy': 'python3-scipy', 'PyYAML': 'python3-yaml',
          'jinja2': 'python3-jinja2', 'matplotlib': 'python3-matplotlib'}
LINTERS = ('ament_copyright', 'ament_flake8', 'ament_pep257', 'ament_xmllint')


def setup_arguments() -> dict[str, ast.expr]:
    tree = ast.parse((ROOT / 'setup.py').read_text())
    call = next(n for n in ast.walk(tree) if isinstance(n, ast.Call)
                and ast.unparse(n.func) == 'setup')
    return {k.arg: k.value for k in call.keywords if k.arg}


@pytest.fixture(scope='module')
def manifest() -> ET.Element:
    return ET.parse(ROOT / 'package.xml').getroot()


@pytest.fixture(scope='module')
def copied(tmp_path_factory) -> Path:
    """A copy of the sources, for builds leave traces beside setup.py."""
    return Path(shutil.copytree(
        ROOT, tmp_path_factory.mktemp('workspace') / 'src' / 'ctsid', ignore=NOT_SOURCE))


def run(*command: object, **more: object) -> subprocess.CompletedProcess[str]:
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True, timeout=600,
                          check=False, **more)
    assert done.returncode == 0, f'{command}:\n{done.stdout}\n{done.stderr}'
    return done


def test_version_is_the_same_everywhere(manifest):
    version = ast.literal_eval(setup_arguments()['version'])
    assert manifest.findtext('version') == version
    changes = (ROOT / 'CHANGELOG.rst').read_text()
    assert 'Forthcoming\n---' in changes or f'\n{version} (' in changes


def test_package_xml_is_valid():
    package = pytest.importorskip('catkin_pkg.package', reason='comes with colcon-ros')
    warnings: list[str] = []
    parsed = package.parse_package(str(ROOT / 'package.xml'), warnings=warnings)
    parsed.validate(warnings=warnings)
    assert warnings == []
    assert (parsed.name, parsed.get_build_type()) == ('ctsid', 'ament_python')
    assert [str(text) for text in parsed.licenses] == ['Apache-2.0']


def test_package_xml_names_what_setup_requires(manifest):
    required = ast.literal_eval(setup_arguments()['install_requires'])
    names = {re.split('[>;]', r)[0] for r in required}
    keys = {e.text for e in manifest.iter('exec_depend')}
    comment = (ROOT / 'package.xml').read_text()
    assert {key for key in keys if key.startswith('python3-')} == set(ROSDEP.values())
    assert set(ROSDEP) < names
    assert names - set(ROSDEP) == {*BAG_PACKAGES, 'rich', 'plotly', 'isal',
                                      'threadpoolctl'}
    assert [n for n in names - set(ROSDEP) if f'`{n}`' not in comment] == []


def test_a_released_package_depends_on_no_key_for_pip(manifest):
    keys = [e.text for e in manifest.iter() if e.tag.endswith('depend')]
    assert [key for key in keys if key.endswith('-pip')] == []


def test_every_linter_has_a_test(manifest):
    keys = {e.text for e in manifest.iter('test_depend')}
    assert keys == {'python3-jsonschema', 'python3-pytest', *LINTERS}
    assert [name for name in LINTERS if not (ROOT / f'test/test_{name}.py').exists()] == []


def test_the_terms_of_contribution_are_those_of_ros_packages():
    """ament_copyright compares them with these sentences."""
    words = ' '.join((ROOT / 'CONTRIBUTING.md').read_text().split())
    for sentence in (
            'Any contribution that you make to this repository will be under the Apache 2 '
            'License, as dictated by that [license](http://www.apache.org/licenses/LICENSE-2.0'
            '.html): ~~~ 5. Submission of Contributions. Unless You explicitly state otherwise,',
            'Contributors must sign-off each commit by adding a `Signed-off-by: ...` line to '
            'commit messages to certify that they have the right to submit the code they are '
            'contributing to the project according to the [Developer Certificate of Origin '
            '(DCO)](https://developercertificate.org/).'):
        assert sentence in words


def test_every_package_folder_is_found_by_setup_and_typed():
    for package in ('ctsid_core', 'ctsid_ros'):
        folders = {f.parent for f in (ROOT / package).rglob('*.py')}
        assert [f for f in folders if not (f / '__init__.py').exists()] == []
        assert (ROOT / package / 'py.typed').exists()


def test_every_source_file_names_its_licence():
    assert 'Apache License' in (ROOT / 'LICENSE').read_text()[:200]
    files = [f for folder in ('ctsid_core', 'ctsid_ros', 'test', 'bags', 'benchmarks', 'launch')
             for f in (ROOT / folder).rglob('*.py')] + [ROOT / 'setup.py']
    first_lines = {f: f.read_text().partition('\n')[0] for f in files}
    assert {f: line for f, line in first_lines.items()
            if line != '# SPDX-License-Identifier: Apache-2.0'} == {}


def test_what_make_demo_needs_is_in_the_repository():
    recipe = (ROOT / 'Makefile').read_text().partition('\ndemo:')[2].partition('\n\n')[0]
    files = [w for w in recipe.split() if w.startswith(('bags/', 'config/'))]
    assert len(files) == 3
    assert [f for f in files if not (ROOT / f).exists()] == []


@pytest.mark.parametrize('path', sorted((ROOT / 'config').glob('*_roll.yaml')),
                         ids=lambda p: p.name)
def test_shipped_parameter_file_says_what_is_known_of_every_parameter(path):
    written = dump_config(read_config(path))
    text = path.read_text()
    start = text.index(written.partition('\n')[0])
    assert text[start:] == written, 'replace all from there on by dump_config(read_config(path))'
    assert 'particular' in text[:start]  # what a newcomer should know of this file comes first


@pytest.mark.slow
def test_pip_puts_the_command_into_bin(copied, tmp_path):
    pytest.importorskip('setuptools', reason='an offline build needs setuptools here')
    run(sys.executable, '-m', 'pip', 'install', '--no-deps', '--no-build-isolation',
        '--disable-pip-version-check', '--no-index', '--prefix', tmp_path, copied,
        '--ignore-installed')  # else pip would remove the one of this environment
    assert (tmp_path / 'bin/ctsid').exists()
    assert not (tmp_path / 'lib/ctsid').exists()
    (installed,) = tmp_path.glob('lib/python*/site-packages')
    for package in ('ctsid_core', 'ctsid_ros'):
        assert {f.relative_to(installed) for f in (installed / package).rglob('*.py*')
                if '__pycache__' not in f.parts} == {
            f.relative_to(ROOT) for f in (ROOT / package).rglob('*.py*')
            if '__pycache__' not in f.parts}
    assert (installed / 'ctsid_core/model/model.schema.json').exists()
    version = run(sys.executable, tmp_path / 'bin/ctsid', '--version',
                  env=os.environ | {'PYTHONPATH': str(installed)}, cwd=tmp_path)
    assert '0.1.0' in version.stdout
    assert bool([*installed.rglob('_kernel*')]) == compiler


@pytest.mark.colcon
@pytest.mark.parametrize('option', [[], *slow(['--symlink-install'])])
def test_colcon_builds_the_package(copied, tmp_path, option):
    pytest.importorskip('colcon_ros', reason='colcon-core and colcon-ros are not installed')
    environment = {k: v for k, v in os.environ.items() if k != 'PYTHONPATH'}
    environment['COLCON_HOME'] = str(tmp_path / 'colcon')
    colcon = 'import sys; from colcon_core.command import main; sys.exit(main())'
    run(sys.executable, '-c', colcon, 'build', '--base-paths', copied, *option,
        cwd=tmp_path, env=environment)
    share = tmp_path / 'install/ctsid/share'
    assert (share / 'ament_index/resource_index/packages/ctsid').exists()
    assert (share / 'ctsid/package.xml').read_text() == (ROOT / 'package.xml').read_text()
    assert sorted(f.name for f in (share / 'ctsid/config').iterdir()) == sorted(
        f.name for f in (ROOT / 'config').glob('*.*'))
    # As `ros2 run ctsid ctsid --version` does, from a shell that sourced the workspace.
    ran = run('sh', '-c', '. install/local_setup.sh && install/ctsid/lib/ctsid/ctsid --version',
              cwd=tmp_path, env=environment)
    assert '0.1.0' in ran.stdout
    if compiler:
        run('sh', '-c', f'. install/local_setup.sh && {sys.executable} -c "{KERNEL}"',
            cwd=tmp_path, env=environment)
