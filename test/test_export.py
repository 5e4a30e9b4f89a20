# SPDX-License-Identifier: Apache-2.0
"""Exported models, read back by the tools they are for: the same responses to rounding."""

from __future__ import annotations

import ast
from dataclasses import replace
import os
from pathlib import Path
import shutil
import subprocess

import numpy as np
import pytest
import scipy.io
from ticks import response as ticked_response
from ticks import simulated
import yaml

from ctsid_core import Settings, StateSpace
from ctsid_core.model.covariance import Covariance
from ctsid_core.model.discrete import discretise
from ctsid_core.model.estimate import Estimate, Status
from ctsid_core.model.storage import save_model
from ctsid_core.model.verdict import Grade, Verdict
from ctsid_core.settings import Actuator
from ctsid_ros.cli import main
from ctsid_ros.export.content import comment
from ctsid_ros.verbs.export import SUFFIXES

CC, OCTAVE = shutil.which('cc'), shutil.which('octave-cli')
OMEGA = np.geomspace(0.05, 60, 40)
NASTY = ("it's */ \"a\" \\ ??/", '<script>alert(1)</script>\nexit(3);\n%{', '# -*- coding: rot13',
         "'); system('touch hacked'); ('", 'a: [b, *c] # !!python/object\r\x01\x7f\u2028°')


def model_of(nu=2, n=3, names=False, delay=0.013) -> StateSpace:
    rng = np.random.default_rng(n + nu)
    A = np.diag(-rng.uniform(0.5, 4, n)) + np.triu(rng.standard_normal((n, n)), 1)
    return StateSpace(
        A, rng.standard_normal((n, nu)), rng.standard_normal((3, n)),
        D=rng.standard_normal((3, nu)), K=rng.standard_normal((n, 3)),
        x_trim=rng.standard_normal(n), y_trim=rng.standard_normal(3),
        delay=tuple(delay * (1 + i) for i in range(nu)), noise=np.eye(3),
        input_names=NASTY[:nu] if names else (), output_names=NASTY[2:5] if names else (),
        input_units=NASTY[3:3 + nu] if names else (), output_units=NASTY[:3] if names else ())


def estimate_of(model: StateSpace, grade=Grade.GOOD) -> Estimate:
    count = Covariance.entry_count(model.n, model.nu, model.ny)
    root = np.random.default_rng(3).standard_normal((2, count))
    given = {'model': model, 'status': Status.OK} if grade is not Grade.REJECT else {
        'rejected_model': model, 'status': Status.CHANGED}
    return Estimate(settings=Settings(), covariance=Covariance(root, model.n, model.nu, model.ny),
                    pole_std=np.full(model.n, 0.25), verdict=Verdict(
                        grade=grade, reason=f'so {NASTY[1]}'), **given)


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def export(model: StateSpace, to: str, *words: object, grade=Grade.GOOD, code=0) -> Path:
    """Run the command; return the file."""
    save_model('model.json', estimate_of(model, grade), force=True)
    out = Path(f'out{SUFFIXES[to][0]}')
    assert main(['export', 'model.json', '--to', to, '-o', str(out), '--force',
                 *map(str, words)]) == code
    return out


def run(*command: object, **more: object) -> str:
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True, timeout=120,
                          check=False, **more)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def same(got, wanted) -> None:
    np.testing.assert_allclose(got, wanted, rtol=1e-12, atol=1e-12 * np.abs(wanted).max())


def response(A, B, C, D, s) -> np.ndarray:
    return np.array([C @ np.linalg.solve(z * np.eye(len(A)) - A, B) + D for z in s])


@pytest.mark.parametrize('model', [model_of(), model_of(1, 1, names=True), model_of(2, 0),
                                   model_of(0, 2)])
def test_a_mat_file_has_everything(folder, model):
    found = scipy.io.loadmat(export(model, 'matlab'))
    for name in 'ABCDK':
        np.testing.assert_array_equal(found[name], getattr(model, name))
    np.testing.assert_array_equal(found['delay'].ravel(), model.delay)
    np.testing.assert_array_equal(found['x_trim'].ravel(), model.x_trim)
    root = estimate_of(model).covariance.root
    np.testing.assert_array_equal(found['covariance'], root.T @ root)
    assert found['verdict'].item() == 'GOOD'
    for kind, letter in (('input', 'u'), ('output', 'y')):
        given = getattr(model, f'{kind}_names')
        assert [str(cell.item()) for cell in found[f'{kind}_names'].ravel()] == [
            name or f'{letter}{i}' for i, name in enumerate(given, 1)]
        assert [''.join(cell) for cell in found[f'{kind}_units'].ravel()] == list(
            getattr(model, f'{kind}_units'))


@pytest.mark.skipif(OCTAVE is None, reason='octave-cli is not installed')
def test_octave_reads_the_mat_file_and_runs_the_script(folder):
    """One start of Octave for all: it takes a second."""
    if subprocess.run([OCTAVE, '--norc', '--no-window-system', '--eval', 'pkg load control'],
                      capture_output=True, check=False).returncode:
        pytest.skip('the package control of Octave is not installed')
    models = [model_of(names=True), model_of(1, 0)]
    program = ['w = load("w.mat").w;']
    scipy.io.savemat('w.mat', {'w': OMEGA})
    for i, model in enumerate(models):
        export(model, 'matlab').rename(f'm{i}.mat')
        export(model, 'simulink-m').rename(f's{i}.m')
        program += [
            f'm = load("m{i}.mat"); assert(iscellstr(m.input_names));',
            'n = rows(m.A); [ny, nu] = size(m.D); G = zeros(ny, nu, numel(w));',
            'for k = 1:numel(w)',
            "G(:,:,k) = (m.C / (1i*w(k)*eye(n) - m.A) * m.B + m.D) .* exp(-1i*w(k)*m.delay.');",
            'end', f's{i}', 'H = zeros(ny, nu, numel(w)); n = rows(A);',
            'for k = 1:numel(w)',
            "H(:,:,k) = (C / (1i*w(k)*eye(n) - A) * B + D) .* exp(-1i*w(k)*delay.');",
            'end', 'T = []; names = output_names; units = input_units;',
            "if exist('sys'), T = freqresp(sys, w); end",
            f'save("-v7", "r{i}.mat", "G", "H", "T", "K", "x_trim", "names", "units");',
            'clear sys A B C D']
    Path('read.m').write_text('\n'.join(program))
    run(OCTAVE, '--norc', '--no-window-system', 'read.m')
    for i, model in enumerate(models):
        found = scipy.io.loadmat(f'r{i}.mat')
        wanted = np.moveaxis(model.frequency_response(OMEGA), 0, 2)
        same(found['G'].reshape(wanted.shape), wanted)
        same(found['H'].reshape(wanted.shape), wanted)
        still = replace(model, delay=(0.0,) * model.nu).frequency_response(OMEGA)
        same(found['T'].reshape(wanted.shape), np.moveaxis(still, 0, 2))
        np.testing.assert_array_equal(found['K'], model.K)
        np.testing.assert_array_equal(found['x_trim'].ravel(), model.x_trim)
    names = [str(cell.item()) for cell in scipy.io.loadmat('r0.mat')['names'].ravel()]
    assert names[:2] == list(NASTY[2:4])
    assert names[2].startswith('a: [b, *c] # !!python/object\r\x01\x7f')
    assert not Path('hacked').exists()


SS = """function s = ss(A, B, C, D, varargin)
  s = struct('A', A, 'B', B, 'C', C, 'D', D);
  for k = 1:2:numel(varargin), s.(varargin{k}) = varargin{k + 1}; end
end
"""


@pytest.mark.skipif(OCTAVE is None, reason='octave-cli is not installed')
def test_the_branch_of_matlab_gives_ss_its_properties(folder):
    """MATLAB cannot be had; Octave reads its lines, with an ss that keeps what it is given."""
    model = model_of(names=True)
    text = export(model, 'simulink-m').read_text()
    Path('script.m').write_text(text.replace("exist('OCTAVE_VERSION', 'builtin')", 'false'))
    Path('ss.m').write_text(SS)
    Path('go.m').write_text('script; save("-v7", "r.mat", "sys");')
    run(OCTAVE, '--norc', '--no-window-system', 'go.m')
    sys_ = scipy.io.loadmat('r.mat')['sys'][0, 0]
    assert set(sys_.dtype.names) == {'A', 'B', 'C', 'D', 'InputDelay', 'InputName', 'InputUnit',
                                     'OutputName', 'OutputUnit', 'TimeUnit'}
    np.testing.assert_array_equal(sys_['InputDelay'].ravel(), model.delay)
    np.testing.assert_array_equal(sys_['A'], model.A)


MAIN = """
#include "out.h"
#include <stdio.h>
int main(void)
{
  out_state state;
  double u[OUT_INPUTS + 1], y[OUT_OUTPUTS + 1];
  int i, k = 0;
  for (;; ++k) {
    for (i = 0; i < OUT_INPUTS; ++i) if (scanf("%lf", u + i) != 1) return 0;
    if (k == 0) out_reset(&state, u);
    if (k == 500) return 0;
    out_step(&state, u, y);
    for (i = 0; i < OUT_OUTPUTS; ++i) printf("%.17g ", y[i]);
    printf("\\n");
  }
}
"""


@pytest.mark.skipif(CC is None, reason='there is no C compiler cc')
@pytest.mark.parametrize(('model', 'rate'), [
    (model_of(names=True), 200.0), (model_of(2, 0), 1e4),
    (model_of(0, 2), 10.0)])
def test_the_c_code_computes_what_the_model_simulates(folder, model, rate):
    source = export(model, 'c', '--rate', rate)
    Path('main.c').write_text(MAIN)
    run(CC, '-std=c99', '-pedantic', '-Wall', '-Wextra', '-Wno-type-limits', '-Werror', '-O1',
        'main.c', source, '-o', 'main')
    assert 'alloc' not in source.read_text() + Path('out.h').read_text()
    u = np.random.default_rng(0).standard_normal((500, model.nu))
    out = run('./main', input='\n'.join(' '.join(map(repr, row)) for row in u.tolist()))
    got = np.array([line.split() for line in out.splitlines()], dtype=float)
    same(got, simulated(discretise(model, rate), u))


@pytest.mark.skipif(shutil.which('c++') is None, reason='there is no C++ compiler c++')
def test_the_header_is_one_of_cpp_too(folder):
    export(model_of(names=True), 'c', '--rate', 100)
    Path('main.cpp').write_text('#include "out.h"\nout_state state;\n')
    run('c++', '-Wall', '-Werror', '-fsyntax-only', 'main.cpp')


def executed(path: Path) -> dict:
    found: dict = {}
    exec(compile(path.read_bytes(), str(path), 'exec'), found)
    return found


@pytest.mark.parametrize('names', [False, True])
def test_python_control_has_the_pade_model(folder, names):
    pytest.importorskip('control', reason='python-control is not installed')
    model = model_of(names=names)
    found = executed(export(model, 'python-control', '--pade', 2))['sys']
    assert found.dt == 0
    same(np.moveaxis(found(1j * OMEGA), 2, 0), model.pade(2).frequency_response(OMEGA))
    if names:
        assert found.input_labels == [name.replace('.', '_') for name in NASTY[:2]]


def test_python_control_without_dead_time_is_the_model(folder):
    pytest.importorskip('control', reason='python-control is not installed')
    model = model_of(delay=0.0)
    found = executed(export(model, 'python-control'))['sys']
    assert found.nstates == model.n
    same(np.moveaxis(found(1j * OMEGA), 2, 0), model.frequency_response(OMEGA))


def test_python_control_has_the_discrete_model(folder):
    pytest.importorskip('control', reason='python-control is not installed')
    model = model_of()
    found = executed(export(model, 'python-control', '--rate', 100))['sys']
    assert found.dt == 0.01
    same(np.moveaxis(found(np.exp(1j * OMEGA / 100)), 2, 0),
         ticked_response(discretise(model, 100), OMEGA))


@pytest.mark.parametrize('model', [model_of(), model_of(names=True), model_of(2, 0)])
def test_yaml_is_the_model(folder, model):
    found = yaml.safe_load(export(model, 'yaml').read_text())
    A, B, C, D = (np.array(found[name]).reshape(getattr(model, name).shape) for name in 'ABCD')
    delay = np.array([channel['delay'] for channel in found['inputs']])
    got = response(A, B, C, D, 1j * OMEGA) * np.exp(-1j * OMEGA[:, None, None] * delay)
    same(got, model.frequency_response(OMEGA))
    assert [channel['name'] for channel in found['outputs']] == [
        name or f'y{i}' for i, name in enumerate(model.output_names, 1)]
    assert found['verdict'] == 'GOOD'


@pytest.mark.parametrize('to', SUFFIXES)
def test_a_timeout_is_told_in_every_format(folder, to):
    model = replace(model_of(), actuators=(Actuator(0.5), Actuator(0.0)))
    made = export(model, to, *(('--rate', 100) if to == 'c' else ()))
    if to == 'matlab':
        assert scipy.io.loadmat(made)['timeout'].ravel().tolist() == [0.5, 0.0]
    elif to == 'yaml':
        inputs = yaml.safe_load(made.read_text())['inputs']
        assert [channel.get('timeout') for channel in inputs] == [0.5, None]
    else:
        text = ' '.join(made.read_text().split())
        assert 'counts as 0 from 0.5 s after a message on' in text
        assert 'this is not in the equations' in text


@pytest.mark.parametrize('to', SUFFIXES)
def test_a_rejected_model_only_if_it_is_wanted(folder, to, capsys):
    words = ('--rate', 100) if to == 'c' else ()
    export(model_of(), to, *words, grade=Grade.REJECT, code=1)
    assert 'Add --rejected to export the rejected one' in capsys.readouterr().err
    assert not list(Path().glob('out*'))
    path = export(model_of(), to, *words, '--rejected', grade=Grade.REJECT, code=3)
    assert 'rejected' in capsys.readouterr().err
    assert b'REJECT' in path.read_bytes() or to == 'matlab'


def test_a_weak_model_is_said_to_be_weak(folder, capsys):
    export(model_of(), 'yaml', grade=Grade.WEAK)
    assert 'WEAK' in capsys.readouterr().err


@pytest.mark.parametrize(('words', 'message'), [
    (['--to', 'c', '-o', 'roll.c'], '--rate'),
    (['--to', 'c', '-o', 'roll', '--rate', '10'], r'suffix \.c'),
    (['--to', 'c', '-o', '1-roll.c', '--rate', '10'], 'letters'),
    (['--to', 'yaml', '-o', 'a.yaml', '--rate', '10'], 'leave --rate away'),
    (['--to', 'matlab', '-o', 'a.mat', '--pade', '1'], 'leave it away'),
    (['--to', 'yaml', '-o', 'model.json'], 'suffix'),
    (['--to', 'yaml', '-o', 'there.yaml'], '--force'),
    (['--to', 'c', '-o', 'old.c', '--rate', '10'], 'old.h exists already'),
    (['--to', 'yaml', '-o', 'nowhere/a.yaml'], 'folder')])
def test_what_cannot_be_done_is_refused_with_a_cure(folder, words, message, capsys):
    save_model('model.json', estimate_of(model_of()))
    Path('there.yaml').touch()
    Path('old.h').touch()
    assert main(['export', 'model.json', *words]) == 1
    with pytest.raises(AssertionError, match=message):
        raise AssertionError(capsys.readouterr().err)
    assert not Path('old.c').exists()


@pytest.mark.parametrize('rate', ['0', '-1', 'nan', 'fast'])
def test_a_rate_that_is_none_is_wrong_usage(folder, rate):
    assert main(['export', 'model.json', '--to', 'c', '-o', 'a.c', '--rate', rate]) == 2


@pytest.mark.parametrize('text', [*NASTY, '\x00*/', '/*/', '**//'])
def test_a_comment_is_one_line_of_ascii(text):
    found = comment(text)
    assert found.isascii()
    assert found.isprintable()
    assert '*/' not in found
    assert '/*' not in found


def test_the_python_file_is_not_decoded_as_a_name_says(folder):
    save_model('coding: rot13.json', estimate_of(model_of()))
    assert main(['export', 'coding: rot13.json', '--to', 'python-control', '-o', 'a.py']) == 0
    compile(Path('a.py').read_bytes(), 'a.py', 'exec')


@pytest.mark.parametrize('to', SUFFIXES)
def test_a_model_stored_by_itself_under_any_name(folder, to):
    name = os.fsdecode(b'm\xff*/.json')
    Path('m\udcff*').mkdir()
    save_model(name, model_of(names=True))
    words = ['--rate', '100'] if to == 'c' else []
    assert main(['export', name, '--to', to, '-o', f'out{SUFFIXES[to][0]}', *words]) == 0


def test_the_python_file_needs_numpy_and_control_only(folder):
    tree = ast.parse(export(model_of(names=True), 'python-control').read_bytes())
    assert [ast.unparse(node) for node in ast.walk(tree)
            if isinstance(node, ast.Import | ast.ImportFrom)] == [
        'import control', 'import numpy as np']
