# SPDX-License-Identifier: Apache-2.0
"""The command line on real bags: what it prints, writes and returns, and how it refuses."""

from __future__ import annotations

import argparse
from contextlib import redirect_stdout, suppress
from dataclasses import replace
import io
import json
import math
import os
from pathlib import Path
import re
import shutil
import signal
import subprocess
import sys
import time

from bag_fixtures import START, Sent, array, imu, make, write_mcap
from flights import PARAMS, TRUTH, S, at, flight, spoilt, stamp_of, write_flight, write_params
from marks import slow
import numpy as np
from plants import held_lag
import pytest
from recording_files import write_csv
from rosbags.highlevel import AnyReader

from ctsid_core.model.storage import (
    load_estimate,
    load_metadata,
    load_model,
    load_series,
    save_model,
)
from ctsid_core.settings import METHODS
from ctsid_ros.cli import VERBS, main
from ctsid_ros.config.parameter_file import read_config
from ctsid_ros.config.parameter_text import parameters_markdown
from ctsid_ros.replay import results
from ctsid_ros.report.tables import number, percent
from ctsid_ros.studies import hd_vs_ct
from ctsid_ros.verbs.arguments import run_of

ROOT = Path(__file__).resolve().parent.parent
PATIENCE = 300.0  # [s] for a process, on a machine that has much else to do
FILES = ['estimates.csv', 'estimates.npz', 'model.json', 'report.html', 'report.md']
REPLAYED = sorted([*FILES, 'estimates.mcap'])


@pytest.fixture(scope='module')
def shared(tmp_path_factory) -> Path:
    """A folder with a bag, its parameters and the truth; nobody writes to it."""
    folder = tmp_path_factory.mktemp('flight')
    write_flight(folder / 'bag')
    write_params(folder / 'params.yaml')
    save_model(folder / 'truth.json', TRUTH)
    return folder


def printed(*words: object) -> str:
    """Run a command line that accepts a model; return what it prints."""
    out = io.StringIO()
    with redirect_stdout(out):
        assert main([str(word) for word in words]) == 0
    return out.getvalue()


@pytest.fixture(scope='module')
def identified(shared) -> tuple[Path, str]:
    """The results of `ctsid identify` of the whole bag, which nobody changes, and its words."""
    folder = shared / 'identified'
    return folder, printed('identify', shared / 'bag', '--params', shared / 'params.yaml',
                           '--out', folder)


@pytest.fixture(scope='module')
def compared(shared) -> dict:
    """The document of `ctsid compare`."""
    return json.loads(printed('compare', shared / 'bag', '--params', shared / 'params.yaml',
                              '--duration', '6', '--json', '--quiet'))


@pytest.fixture
def ctsid(capsys, monkeypatch, tmp_path):
    """Run a command line in an empty folder; return code, stdout, stderr."""
    monkeypatch.chdir(tmp_path)

    def run(*words: object) -> tuple[int, str, str]:
        capsys.readouterr()
        code = main([str(word) for word in words])
        out, err = capsys.readouterr()
        assert 'Traceback' not in out + err
        return code, out, err

    return run


@pytest.fixture
def refusal(ctsid):
    """Run a command line that could not run; return the message."""
    def run(*words: object) -> str:
        code, out, err = ctsid(*words)
        assert (code, out) == (1, ''), err
        assert err.count('ctsid: error: ') == 1
        return err

    return run


def close(poles, tolerance: float) -> bool:
    return np.allclose(sorted(poles, key=np.imag), sorted(TRUTH.poles, key=np.imag),
                       atol=tolerance)


# --- what works


def test_identify_finds_the_plant_and_writes_all_files(ctsid, shared):
    code, out, err = ctsid('identify', shared / 'bag', '--params', shared / 'params.yaml',
                           '--out', 'res', '--test-from', 12)
    assert code == 0, err
    assert sorted(p.name for p in Path('res').iterdir()) == FILES
    estimate = load_estimate('res/model.json')
    assert close(estimate.model.poles, 0.15)
    assert abs(estimate.end_ns - START - 12 * S) < 0.1 * S
    assert '[N m]' in out
    assert 'data the model has not seen, 12.0 to 20.0 s' in out
    fit = float(re.search(r'simulation fit.*\n.*\n\s+rate\s+(\S+)', out)[1])
    assert fit > 90
    assert [c['topic'] for c in load_metadata('res/model.json')['channels']] == ['/cmd', '/imu']
    assert 'stamps from log, for its messages have no header' in out


def test_identify_of_an_interval_counts_from_the_start_of_the_bag(ctsid, shared):
    code, _, err = ctsid('identify', shared / 'bag', '--params', shared / 'params.yaml',
                         '--out', 'res', '--start', 4, '--duration', 7)
    assert code == 0, err
    estimate = load_estimate('res/model.json')
    # The input is known from its first message on, and for one more period after its last.
    assert estimate.start_ns - START == pytest.approx(4 * S, abs=0.1 * S)
    assert estimate.end_ns - START == pytest.approx(11 * S, abs=0.1 * S)


def test_reports_tell_deviations_and_the_experiment_that_helps(identified):
    folder, out = identified
    assert re.search(r'3\.3\d+ ± 0\.0\d+ .* 0\.4\d+ ± 0\.0\d+', out)    # frequency and damping
    assert re.search(r'rate \[rad/s\] +[12]\.\d+ ± 0\.0\d+', out)        # DC gain
    assert 'Which experiment would help' not in out
    report = (folder / 'report.md').read_text()
    assert 'Which experiment would help' in report
    low = load_estimate(folder / 'model.json').verdict.excitation[0].low / 10.0     # [rad/s]
    first = rf'\| {number(low)} \| {number(low / math.tau, 3)} \|'
    assert re.search(rf'{first} [56]\.\d+ ± 0\.\d+ \| -\d\.\d+ ± 0\.\d+', report)
    page = (folder / 'report.html').read_text()
    assert page.count('"fill": "toself"') >= 3    # bands: magnitude, phase, step response
    assert 'two standard deviations' in page


def test_identify_as_json_is_one_document(ctsid, shared):
    code, out, _ = ctsid('identify', shared / 'bag', '--params', shared / 'params.yaml', '--json',
                         '--test-from', 12)
    found = json.loads(out)
    assert (code, found['accepted'], found['status']) == (0, True, 'OK')
    assert found['test']['fit'][0] > 90
    assert found['estimate']['model']['n'] == 2
    folder = Path(found['results'])
    assert re.fullmatch(r'results/bag-hd-pbsid-\d{8}T\d{6}Z', str(folder))
    assert sorted(p.name for p in folder.iterdir()) == FILES
    assert json.loads((folder / 'model.json').read_text()) == found['estimate']


def test_two_runs_never_share_a_default_folder(ctsid, shared):
    for _ in range(2):
        ctsid('identify', shared / 'bag', '--params', shared / 'params.yaml', '--quiet',
              '--duration', 5)
    assert len(list(Path('results').iterdir())) == 2


def test_replay_identifies_every_window_and_tests_it_on_unseen_data(ctsid, shared):
    code, out, err = ctsid('replay', shared / 'bag', '--params', shared / 'params.yaml',
                           '--out', 'res', '--truth', shared / 'truth.json')
    assert code == 0, err
    series = load_series('res/estimates.npz')
    assert [round((e.start_ns - START) / S, 1) for e in series] == [0.0, 2.5, 5.0, 7.5, 10.0,
                                                                  12.5, 15.0][:len(series)]
    assert len(series) == 6  # 0, 2.5, ... 12.5: the last window has to lie within the data
    assert all(close(e.model.poles, 0.5) for e in series)
    table = np.genfromtxt('res/estimates.csv', delimiter=',', names=True, dtype=None,
                          encoding='utf-8')
    next_fit = table['next_fit_rate_']
    # Windows of 5 s every 2.5 s: the second after each one is the first that it shares nothing
    # with; the last two have none.
    assert (next_fit[:4] > 90).all()
    assert np.isnan(next_fit[4:]).all()
    assert np.isnan(table['fresh_fit_rate_'][0])  # of the model before: there is none
    assert (table['fresh_fit_rate_'][1:] > 80).all()
    assert (table['realisation'] == 1).all()
    with np.load('res/estimates.npz') as arrays:
        np.testing.assert_array_equal(arrays['fresh_fit_rate [%]'], table['fresh_fit_rate_'])
    assert 'All 1 true poles and pairs are identified' in out
    assert '-1.500 ± 3.000j' in out
    assert sorted(p.name for p in Path('res').iterdir()) == REPLAYED
    with AnyReader([Path('res/estimates.mcap')]) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
    assert counts['/identifier/model'] == counts['/identifier/summary'] == len(table)


def test_replay_as_json(ctsid, shared):
    code, out, _ = ctsid('replay', shared / 'bag', '--params', shared / 'params.yaml', '--json',
                         '--out', 'res', '--start', 2, '--duration', 13)
    found = json.loads(out)
    assert code == 0
    assert found['accepted'] == len(found['windows']) == 4
    first = found['windows'][0]
    assert first['from'] == pytest.approx(2.0, abs=0.1)
    assert first['to'] == pytest.approx(7.0, abs=0.1)
    assert close([complex(*p) for p in first['poles']], 0.5)
    for before, window in zip([None, *found['windows']], found['windows'], strict=False):
        assert (window['realisation'], window['modes']) == (1, [1, 2])
        assert window['eigenvalues'] == window['poles']
        assert window['fresh_fit'][0] is None if before is None else window['fresh_fit'][0] > 80
    assert load_estimate('res/model.json').start_ns == \
        found['windows'][found['best_window'] - 1]['start_ns']


def test_simulate_names_the_command_for_a_recording_of_another_plant(
        ctsid, identified, tmp_path):
    other = write_mcap(tmp_path / 'other.mcap', [replace(s, message=imu(
        stamp_of(s), -2.0 * s.message.angular_velocity.x)) if s.topic == '/imu' else s
        for s in flight(10.0, seed=3)])
    _, out, _ = ctsid('simulate', identified[0] / 'model.json', other, '--json')
    assert any(f'`ctsid identify {other} --params params.yaml` makes a model of this' in note
               for note in json.loads(out)['notes'])
    shutil.copytree(identified[0], tmp_path / 'tried')
    beside = tmp_path / 'tried' / 'params.yaml'
    beside.touch()
    _, out, _ = ctsid('simulate', tmp_path / 'tried' / 'model.json', other, '--json')
    assert any(f'`ctsid identify {other} --params {beside}` makes a model of this' in note
               for note in json.loads(out)['notes'])


def test_simulate_explains_another_bag_without_parameters(ctsid, shared, identified, tmp_path):
    model = identified[0] / 'model.json'
    other = write_flight(tmp_path / 'other', flight(10.0, seed=2))
    code, out, _ = ctsid('simulate', model, other, '--horizon', 1, 5)
    assert code == 0
    fits = re.search(r'rate((?:\s+\d+\.\d)+)', out)[1].split()
    assert len(fits) == 4
    assert min(map(float, fits)) > 90
    assert 'fitted to this bag' in out
    delay, = load_estimate(model).model.delay
    assert re.search(rf'input .* zoh +{re.escape(number(delay))} ', out)
    code, out, _ = ctsid('simulate', model, other, '--json', '--trim', 'model',
                         '--params', shared / 'params.yaml')
    found = json.loads(out)
    assert found['trim'] == 'model'
    assert found['fit'][0] > 90
    assert set(found['prediction']) == {'1', '10'}


def test_a_recording_in_which_nothing_moves_is_of_no_other_plant(ctsid, identified, tmp_path):
    rest = write_flight(tmp_path / 'rest', [
        replace(s, message=array(0.0, 0.5)) if s.topic == '/cmd' else s
        for s in flight(10.0, seed=2)])
    code, out, _ = ctsid('simulate', identified[0] / 'model.json', rest, '--json')
    notes = ' '.join(json.loads(out)['notes'])
    assert code == 0
    assert 'no input moves in this recording, which tells nothing of the model' in notes
    assert 'not the same' not in notes


def test_the_recording_that_a_model_is_of_is_no_test(ctsid, shared, identified):
    code, out, _ = ctsid('simulate', identified[0] / 'model.json', shared / 'bag', '--json')
    assert code == 0
    assert 'what the model was identified from: its fit there is no test' in ' '.join(
        json.loads(out)['notes'])


@pytest.mark.parametrize('of', ['a', *slow('ab')])
def test_of_a_clock_that_begins_with_0_the_file_tells_what_a_model_is_of(ctsid, tmp_path, of):
    rng = np.random.default_rng(0)
    for name in 'abc':
        columns = dict(zip('tuy', held_lag(rng, 0.02, 600), strict=True))
        write_csv(tmp_path / f'{name}.csv', columns)
    code, _, err = ctsid('identify', *(tmp_path / f'{name}.csv' for name in of),
                         '--out', tmp_path / 'res')
    assert code == 0, err
    model = next((tmp_path / 'res').rglob('model.json'))
    assert len(load_estimate(model).records) == (len(of) if len(of) > 1 else 0)
    for name in 'abc':
        own = name in of
        _, out, _ = ctsid('simulate', model, tmp_path / f'{name}.csv', '--json')
        notes = ' '.join(json.loads(out)['notes'])
        assert ('its fit there is no test' in notes) is own
        assert '24.0 s of' not in notes         # not counted once for each record


def test_of_large_files_without_dates_nothing_is_said(ctsid, tmp_path, monkeypatch):
    monkeypatch.setattr(results, '_HASHED', 0)
    rng = np.random.default_rng(0)
    for name in 'ab':
        columns = dict(zip('tuy', held_lag(rng, 0.02, 600), strict=True))
        write_csv(tmp_path / f'{name}.csv', columns)
    code, _, err = ctsid('identify', tmp_path / 'a.csv', tmp_path / 'b.csv', '--out',
                         tmp_path / 'res')
    assert code == 0, err
    _, out, _ = ctsid('simulate', tmp_path / 'res' / 'model.json', tmp_path / 'a.csv', '--json')
    assert 'its fit there is no test' not in ' '.join(json.loads(out)['notes'])


@pytest.mark.parametrize('gain', [1.0, 0.7])
def test_a_plant_that_is_not_the_same_is_told(ctsid, identified, tmp_path, gain):
    other = write_flight(tmp_path / 'other', spoilt(
        '/imu', lambda _, s: at(s, stamp_of(s), gain * s.message.angular_velocity.x),
        flight(10.0, seed=2)))
    code, out, _ = ctsid('simulate', identified[0] / 'model.json', other, '--json')
    found = json.loads(out)
    assert code == 0
    told = re.search(r'explains (\S+) % of rate here, (\S+) % of its own data: the plant is not',
                     ' '.join(found['notes']))
    assert (told is None) == (gain == 1.0)
    if told:
        assert float(told[1]) == pytest.approx(found['fit'][0], abs=0.06)
        assert float(told[1]) < float(told[2]) - 20.0


def test_trim_is_refitted_unless_told_otherwise(ctsid, identified, tmp_path):
    model = identified[0] / 'model.json'
    moved = write_flight(tmp_path / 'moved', spoilt(
        '/imu', lambda _, s: at(s, stamp_of(s), s.message.angular_velocity.x + 5.0)))
    fits, ahead = {}, {}
    for trim in ('refit', 'model'):
        found = json.loads(ctsid('simulate', model, moved, '--json', '--trim', trim)[1])
        fits[trim], ahead[trim] = found['fit'][0], found['prediction']['10']['fit'][0]
    assert fits['refit'] > 90 > 0 > fits['model']
    assert ahead['refit'] > 90 > ahead['model']


def test_show_prints_poles_and_frequency_response(ctsid, shared):
    code, out, _ = ctsid('show', shared / 'truth.json')
    assert code == 0
    assert '-1.500 ± 3.000j' in out
    assert re.search(r'rate \[rad/s\] +2\.000\n', out)  # the DC gain
    response = json.loads(ctsid('show', shared / 'truth.json', '--json')[1])['frequency_response']
    expected = TRUTH.frequency_response(response['omega'])[:, 0, 0]
    np.testing.assert_allclose(np.ravel(response['magnitude_db']), 20 * np.log10(abs(expected)))


@pytest.mark.slow
def test_study_prints_its_table(ctsid, tmp_path, monkeypatch):
    monkeypatch.setattr(hd_vs_ct, 'SNRS', (20,))
    code, out, err = ctsid('study', 'hd-vs-ct', '--seeds', '1', '--jobs', '1', '--out',
                           tmp_path)
    assert code == 0, err
    for method in ("paper's HD", 'ours', 'CT-PBSID'):
        assert len(re.findall(rf'dB +-\d.* {method} ', out)) == 2    # one SNR, two poles
    assert '0.0882' in out                                            # CT-PBSID as published
    page = (tmp_path / 'report.html').read_text(encoding='utf-8')
    assert page.count('<img ') == len([*tmp_path.glob('*.svg')]) > 0
    assert '0.0882' in page
    assert 'ctsid study hd-vs-ct --seeds 1' in re.sub(r'</?span>', '', page)
    assert 'plotly' not in page                                       # nothing that it would draw
    assert ctsid('study', 'nothing')[0] == 2
    assert ctsid('study', 'all', '--seeds', '0')[0] == 2


@pytest.mark.slow
@pytest.mark.usefixtures('interruptible')
def test_an_interrupted_study_says_so_and_goes_on(tmp_path):
    """A real process, a real Ctrl-C for it and all its children; no run is lost or run twice."""
    words = [sys.executable, '-m', 'ctsid_ros.cli', 'study', 'hd-vs-ct', '--seeds', '600',
             '--out', str(tmp_path)]
    kept = tmp_path / 'runs.csv'
    study = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                             start_new_session=True)
    for _ in range(round(PATIENCE / 0.1)):
        time.sleep(0.1)
        if study.poll() is not None or kept.exists() and kept.read_text().count('\n') > 20:
            break
    os.killpg(study.pid, signal.SIGINT)
    time.sleep(0.1)
    with suppress(ProcessLookupError):
        os.killpg(study.pid, signal.SIGINT)              # impatience does not make it hang
    _, err = study.communicate(timeout=PATIENCE)
    assert study.returncode == 130
    assert err.strip().endswith('ctsid: interrupted')
    assert 'Traceback' not in err
    first = kept.read_text()
    assert 20 < len(first.splitlines()) < 7000
    done = subprocess.run([*words, '--seeds', '3'], capture_output=True, text=True,
                          timeout=PATIENCE, check=True)
    assert '3 runs of each' in done.stdout
    assert kept.read_text().startswith(first[:first.rindex('\n')])


@pytest.mark.slow
def test_compare_sets_all_methods_side_by_side(ctsid, shared, compared):
    code, out, _ = ctsid('compare', shared / 'bag', '--params', shared / 'params.yaml',
                         '--duration', '6')
    assert code == 0
    for method in METHODS:
        row = re.search(rf'^ *{method} +(GOOD|WEAK|REJECT) +\d .*', out, flags=re.MULTILINE)
        assert (' yes ' in row[0] or ' no ' in row[0]) == (method != METHODS[0])
    assert compared['reference'] == METHODS[0]
    assert [m['method'] for m in compared['methods']] == list(METHODS)
    first, *others = compared['methods']
    assert (first['differs'], first['deviations'], first['agrees']) == (0.0, 0.0, None)
    assert close([complex(*p) for p in first['poles']], 0.3)
    assert any(m['agrees'] and m['differs'] < 0.1 for m in others)
    for m in compared['methods']:
        assert len(m['pole_std']) == len(m['poles']) == m['order']
        assert m['held_out_fit'][0] > 80
        assert m['delay'] == first['delay']
        assert m['seconds'] > 0.0


@pytest.mark.slow
def test_compare_is_of_methods_whatever_the_settings(ctsid, shared, compared):
    text = (shared / 'params.yaml').read_text().replace('method: hd-pbsid', 'method: gobf')
    Path('other.yaml').write_text(text + '    method: gobf\n' * ('method: gobf' not in text)
                                  + '    validation.cross_check: hd-pbsid\n')
    other = json.loads(ctsid('compare', shared / 'bag', '--params', 'other.yaml', '--duration',
                              '6', '--json', '--quiet')[1])
    own = ('methods', 'results')
    assert [m | {'seconds': 0.0} for m in other['methods']] == [
        m | {'seconds': 0.0} for m in compared['methods']]
    assert {k: v for k, v in other.items() if k not in own} == {
        k: v for k, v in compared.items() if k not in own}


@pytest.mark.slow
def test_compare_tells_what_cannot_be(ctsid, shared):
    words = 'compare', shared / 'bag', '--params', shared / 'params.yaml'
    for more, said in ((('--start', '1000'), 'nothing of the bag lies after 1000 s: the bag is'),
                       (('--start', 'x'), "'x' is not a number of seconds")):
        code, out, err = ctsid(*words, *more)
        assert (code, out) == (1 if said.startswith('nothing') else 2, '')
        assert said in err
    for other, said in (('nothere', 'nothere: no such file'),
                        (shared / 'params.yaml', 'not a bag')):
        code, out, err = ctsid('compare', other)
        assert (code, out) == (1, '')
        assert said in err
    Path('odd.yaml').write_text((shared / 'params.yaml').read_text()
                                + '    takenaka_malmquist.poles_real: [4.0, 5.0]\n'
                                '    takenaka_malmquist.poles_imag: [1.0, 2.0, 3.0]\n')
    code, out, err = ctsid('compare', shared / 'bag', '--params', 'odd.yaml', '--quiet')
    assert (code, out) == (1, '')
    assert 'poles_imag' in err
    code, out, err = ctsid(*words, '--duration', '0.1', '--json', '--quiet')
    assert code == 3
    document = json.loads(out)
    assert document['reference'] is None
    assert {m['status'] for m in document['methods']} == {'TOO_SHORT'}
    assert all(m['differs'] is None for m in document['methods'])
    code, out, _ = ctsid(*words, '--duration', '0.1', '--quiet')
    assert code == 3
    assert 'too few samples' in ' '.join(out.split())


def test_advise_tells_what_is_missing(ctsid, shared):
    words = 'advise', shared / 'bag', '--params', shared / 'params.yaml', '--duration', '4'
    code, out, _ = ctsid(*words, '--wanted', '0.1', '--more', '5')
    assert code == 0
    assert 'Accuracy of the poles, now and wanted' in out
    assert 'Standard deviations after 5 s more in one band' in out
    assert len(re.findall(r'^ *torque +[\d.]+ to', out, flags=re.MULTILINE)) == 6
    assert re.search(r'5 s more\s+of\s+torque\s+at', out)
    code, out, _ = ctsid(*words, '--wanted', '90')
    assert code == 0
    assert 'no further data are needed' in ' '.join(out.split())
    code, out, _ = ctsid(*words, '--json')
    document = json.loads(out)
    assert document['verb'] == 'advise'
    assert document['accepted']
    assert document['poles'][0]['std'] > 0
    assert len(document['poles'][0]['bands']) == 6
    assert ctsid(*words, '--wanted', '0')[0] == 2


def test_info_measures_rates_jitter_and_gaps(ctsid, tmp_path):
    bag = write_flight(tmp_path / 'bag', spoilt(
        '/imu', lambda k, s: None if 500 <= k < 550 else s))
    code, out, _ = ctsid('info', bag, '--json')
    found = json.loads(out)
    assert code == 0
    topics = {t['name']: t for t in found['topics']}
    imu_topic, cmd = topics['/imu'], topics['/cmd']
    assert (imu_topic['count'], cmd['count']) == (1950, 400)
    assert (imu_topic['stamp'], cmd['stamp']) == ('header', 'log')
    header = imu_topic['stamps'][0]
    assert header['period'] == pytest.approx(0.01, rel=0.03)
    # The difference of two uniform displacements of 0 to 3 ms
    assert header['jitter'] == pytest.approx(0.003 / np.sqrt(6), rel=0.1)
    assert header['gaps'] == 1
    assert header['longest'] == pytest.approx(0.51, abs=0.01)
    assert imu_topic['late'] == pytest.approx(0.002)
    fields = {f['field']: f for f in imu_topic['fields'] + cmd['fields']}
    assert fields['angular_velocity.x']['std'] > 0.2
    assert not fields['angular_velocity.y']['moves']
    assert fields['data[0]']['low'] == pytest.approx(-1, abs=0.02)
    assert not fields['data[1]']['moves']
    assert not any('covariance' in name for name in fields)
    code, out, _ = ctsid('info', bag)
    assert code == 0
    assert re.search(r'/imu\s+header\s+yes\s+10\.\d', out)


def test_info_does_not_read_pictures(ctsid, tmp_path):
    picture = make('sensor_msgs/msg/Image', data=np.zeros(10_000, np.uint8))
    sent = [*flight(2.0), *(Sent('/camera', 'sensor_msgs/msg/Image', START + k * S // 10, picture)
                            for k in range(20))]
    found = json.loads(ctsid('info', write_flight(tmp_path / 'bag', sent), '--json')[1])
    camera = next(t for t in found['topics'] if t['name'] == '/camera')
    assert (camera['count'], camera['fields']) == (20, [])
    assert 'not looked at' in camera['note']


def test_init_writes_what_identify_takes_unchanged(ctsid, shared):
    code, out, err = ctsid('init', shared / 'bag', '-o', 'params.yaml')
    assert code == 0
    assert re.search(r'1 \*\s+/cmd data\[0\]\s+/imu angular_velocity.x\s+9\d', out)
    assert '/cmd data[0] explains 9' in err
    config = read_config('params.yaml')
    assert [(c.topic, c.field, c.role) for c in config.channels] == [
        ('/cmd', 'data[0]', 'input'), ('/imu', 'angular_velocity.x', 'output')]
    code, _, err = ctsid('identify', shared / 'bag', '--params', 'params.yaml', '--out', 'res',
                         '--duration', 8)
    assert code == 0, err
    assert close(load_model('res/model.json').poles, 0.3)
    assert 'exists' in ctsid('init', shared / 'bag', '-o', 'params.yaml')[2]
    code, out, _ = ctsid('init', shared / 'bag')
    assert (code, out.replace('params.yaml', '')) == (
        0, Path('params.yaml').read_text().replace('params.yaml', ''))


@pytest.mark.parametrize('name', ['quadrotor_roll', *slow('quadrotor_roll.bag')])
def test_init_guesses_the_example_bag(ctsid, name):
    bag = ROOT / 'bags' / name
    assert ctsid('init', bag, '-o', 'params.yaml')[0] == 0
    fields = [(c.topic, c.field) for c in read_config('params.yaml').channels]
    assert fields == [('/command/torque', 'wrench.torque.x'), ('/imu', 'angular_velocity.x')]
    code, out, _ = ctsid('identify', bag, '--params', 'params.yaml', '--out', 'res',
                         '--duration', 8, '--truth', ROOT / 'bags/quadrotor_roll_truth.json')
    assert code == 0
    assert '3 true poles' in out


def test_identify_guesses_the_channels_without_parameters(ctsid, shared):
    code, _, err = ctsid('identify', shared / 'bag', '--out', 'res', '--duration', 5)
    assert code == 0
    assert 'the channels are guessed: /cmd data[0] acts' in err


def test_params_prints_defaults_and_reference(ctsid):
    code, out, _ = ctsid('params')
    assert code == 0
    Path('params.yaml').write_text(out)
    assert read_config('params.yaml').settings.window_length == 10.0
    assert ctsid('params', '--markdown')[1] == parameters_markdown()


def test_parts_of_a_split_bag_are_one(ctsid, shared, identified, tmp_path):
    sent = flight()
    parts = [write_mcap(tmp_path / f'{i}.mcap', [s for s in sent if (s.log_ns - START > 9 * S) == i
                                                 ]) for i in (0, 1)]
    assert ctsid('identify', *parts, '--params', shared / 'params.yaml', '--out', 'split')[0] == 0
    whole = load_estimate(identified[0] / 'model.json')
    assert load_estimate('split/model.json').model == whole.model


def moved(sent: list[Sent], seconds: float, rate: float = 0.0) -> list[Sent]:
    """Return a flight at another time, its output at another trim."""
    shift = round(seconds * S)
    return [replace(at(s, stamp_of(s) + shift, s.message.angular_velocity.x + rate)
                    if s.topic == '/imu' else s, log_ns=s.log_ns + shift) for s in sent]


@pytest.fixture(scope='module')
def days(tmp_path_factory) -> list[Path]:
    """Two flights on different days, the second in two parts, and its parts."""
    folder = tmp_path_factory.mktemp('days')
    second = moved(flight(8.0, seed=3), 86_400.0, rate=5.0)
    half = second[len(second) // 2].log_ns
    return [write_mcap(folder / 'monday.mcap', flight(10.0, seed=2)),
            write_mcap(folder / 'tuesday_0.mcap', [s for s in second if s.log_ns < half]),
            write_mcap(folder / 'tuesday_1.mcap', [s for s in second if s.log_ns >= half])]


def test_recordings_apart_in_time_are_several_records(ctsid, shared, days):
    code, out, err = ctsid('identify', *days[::-1], '--params', shared / 'params.yaml', '--out',
                           'res', '--truth', shared / 'truth.json', '--quiet')
    assert code == 0, err
    assert 'these are 2 recordings of their own' in err
    assert '`ctsid batch` makes models of each by itself' in err
    assert 'Model of 2 records' in out
    assert sorted(p.name for p in Path('res').iterdir()) == FILES
    estimate = load_estimate('res/model.json')
    assert close(estimate.model.poles, 0.15)
    first, second = estimate.records
    assert abs(estimate.start_ns - START) < 0.1 * S
    assert abs(estimate.end_ns - START - 86_408 * S) < 0.1 * S
    assert second.end_ns == estimate.end_ns
    level = [(m.y_trim - m.C @ np.linalg.solve(m.A, m.x_trim))[0] for m in (
        estimate.trimmed(estimate.model, r.number) for r in (first, second))]
    assert level[1] - level[0] == pytest.approx(5.0, abs=0.05)
    origin = load_metadata('res/model.json')
    assert origin['bag'] == [d.name for d in days[::-1]]
    assert [r['bag'] for r in origin['records']] == [
        ['monday.mcap'], ['tuesday_1.mcap', 'tuesday_0.mcap']]
    page = Path('res/report.html').read_text()
    assert 'Measured and simulated, record 2' in page
    assert re.search(r'(?m)^\s+2\s+\S*tuesday_1.mcap and 1 more\s+0.0\s+8.0', out)


@pytest.mark.slow
def test_the_recording_of_another_plant_is_named_whatever_was_typed_first(ctsid, shared, tmp_path):
    def day(name: str, seed: int, seconds: float, gain: float = 1.0) -> Path:
        return write_mcap(tmp_path / name, moved([replace(s, message=imu(
            stamp_of(s), gain * s.message.angular_velocity.x)) if s.topic == '/imu' else s
            for s in flight(10.0, seed=seed)], seconds))

    other = day('other.mcap', 3, 2 * 86_400.0, -2.0)
    healthy = [day('a.mcap', 1, 0.0), day('b.mcap', 2, 86_400.0)]
    code, out, _ = ctsid('identify', other, *healthy, '--params', shared / 'params.yaml',
                         '--json', '--quiet')
    found = json.loads(out)
    assert code == 3
    assert f'record 3 ({other})' in Path(found['results'], 'report.md').read_text()
    assert found['next'] == f'ctsid identify {other} --params {shared / "params.yaml"}'


def test_replay_of_a_folder_with_several_recordings_points_to_batch(ctsid, shared, days):
    code, _, err = ctsid('replay', days[0].parent, '--params', shared / 'params.yaml', '--out',
                         'res', '--duration', 6, '--quiet')
    assert code == 0
    assert 'these are 2 recordings, apart in time, replayed one after the other' in err
    assert '`ctsid batch` replays each by itself' in err


def test_several_records_as_json_with_a_test_of_each(ctsid, shared, days):
    code, out, err = ctsid('identify', *days, '--params', shared / 'params.yaml', '--json',
                           '--test-from', 6, '--quiet')
    assert code == 0, err
    found = json.loads(out)
    assert [t['record'] for t in found['tests']] == [1, 2]
    assert [round(t['from'], 1) for t in found['tests']] == [6.0, 6.0]
    assert min(t['fit'][0] for t in found['tests']) > 85
    assert [(round(r['from'], 1), round(r['to'], 1)) for r in found['records']] == [
        (0.0, 6.0), (0.0, 6.0)]
    assert len(found['estimate']['records']) == 2


@pytest.mark.slow
def test_a_record_too_short_to_be_tested_is_learnt_from(ctsid, shared, days, refusal):
    code, out, err = ctsid('identify', *days, '--params', shared / 'params.yaml', '--json',
                           '--test-from', 9, '--quiet')
    assert code == 0, err
    found = json.loads(out)
    assert [t['record'] for t in found['tests']] == [1]
    assert [round(r['to'], 1) for r in found['records']] == [9.0, 8.0]
    assert 'no recording is longer than 12 s' in refusal(
        'identify', *days, '--params', shared / 'params.yaml', '--test-from', 12)


def test_parts_of_one_bag_without_what_is_between(ctsid, shared, refusal):
    words = ('identify', shared / 'bag', '--params', shared / 'params.yaml', '--interval', '1:7',
             '--interval', '11:')
    code, out, err = ctsid(*words, '--out', 'res', '--quiet')
    assert code == 0, err
    estimate = load_estimate('res/model.json')
    assert close(estimate.model.poles, 0.15)
    spans = [((r.start_ns - START) / S, (r.end_ns - START) / S) for r in estimate.records]
    np.testing.assert_allclose(spans, [(1, 7), (11, 20)], atol=0.1)
    assert load_metadata('res/model.json')['interval']['intervals'][0] == [1.0, 7.0]
    assert '--interval says all' in refusal(*words, '--start', 2)
    assert ctsid('identify', 'bag', '--interval', '7:3')[0] == 2


@pytest.mark.slow
def test_flights_of_different_plants_are_not_joined(ctsid, shared, tmp_path, days):
    weak = [replace(s, message=imu(stamp_of(s), 0.4 + 0.5 * (s.message.angular_velocity.x - 0.4)))
            if s.topic == '/imu' else s for s in flight(10.0, seed=4)]
    other = write_mcap(tmp_path / 'other.mcap', moved(weak, 3_600.0))
    code, out, _ = ctsid('identify', days[0], other, '--params', shared / 'params.yaml', '--quiet')
    assert code == 3
    assert 'does not hold in all of record 1' in ' '.join(out.split())


def test_the_same_recording_twice_is_refused(refusal, shared, tmp_path, days):
    copy = tmp_path / 'copy.mcap'
    copy.write_bytes(days[0].read_bytes())
    message = refusal('identify', days[0], copy, '--params', shared / 'params.yaml')
    assert 'hold the same topics (/cmd, /imu) at the same time' in message


def test_topics_recorded_apart_at_the_same_time_are_one_recording(ctsid, shared, tmp_path):
    sent = flight(8.0)
    bags = [write_mcap(tmp_path / f'{topic[1:]}.mcap', [s for s in sent if s.topic == topic])
            for topic in ('/cmd', '/imu')]
    code, _, err = ctsid('identify', *bags, '--params', shared / 'params.yaml', '--out', 'res')
    assert (code, 'recordings' in err) == (0, False)
    assert load_estimate('res/model.json').records == ()


def test_a_recording_without_a_channel_is_named(refusal, shared, tmp_path, days):
    bare = write_mcap(tmp_path / 'bare.mcap', [
        s for s in moved(flight(5.0), 7_200.0) if s.topic == '/cmd'])
    assert f'{bare}: `rate`: no topic' in refusal(
        'identify', days[0], bare, '--params', shared / 'params.yaml')


# --- usage


@pytest.mark.parametrize('words', [
    [], ['fly'], ['identify'], ['identify', 'bag', '--start', '-1'],
    ['identify', 'bag', '--duration', '0'], ['identify', 'bag', '--start', 'noon'],
    ['simulate', 'm.json', 'bag', '--horizon', '0'],
    ['simulate', 'm.json', 'bag', '--trim', 'none']])
def test_wrong_usage_is_2(ctsid, words):
    code, out, err = ctsid(*words)
    assert (code, out) == (2, '')
    assert 'usage: ctsid' in err


@pytest.mark.parametrize(('word', 'hint'), [
    ('identfy', 'nearest: identify'), ('simulat', 'nearest: simulate'),
    ('qqq', 'the verbs are info, init, try, identify')])
def test_an_unknown_verb_gets_the_nearest(ctsid, word, hint):
    code, out, err = ctsid(word, 'bag')
    assert (code, out) == (2, '')
    assert f"'{word}' is no verb; {hint}" in err


def test_without_a_verb_all_verbs_are_told(capsys):
    assert main([]) == 2
    out, err = capsys.readouterr()
    assert not out
    assert all(f'    {verb} ' in err for verb in VERBS)


def test_a_start_behind_the_end_is_said_without_infinity(refusal, shared):
    for verb in ('identify', 'replay', 'advise'):
        err = refusal(verb, shared / 'bag', '--params', shared / 'params.yaml', '--start', 100)
        assert 'nothing of the bag lies after 100 s: the bag is 20.0 s long; choose an earlier' \
            in err
        assert 'inf' not in err


@pytest.mark.slow
def test_the_dead_time_that_was_looked_for_is_shown_and_not_asked_for(ctsid, shared, identified,
                                                                      tmp_path):
    folder, out = identified
    delay = load_model(folder / 'model.json').delay[0]
    shown = re.search(r'input +torque .* zoh +(\S+)( ± \S+ \(found\))? ', out)
    auto = read_config(shared / 'params.yaml').inputs[0].delay == 'auto'
    assert shown[1] == f'{delay:.3g}'
    assert bool(shown[2]) == auto
    for order in ('', '    method: ct-pbsid\n'):
        text = PARAMS.replace('delay: 0.0', 'delay: auto').rstrip() + f'\n{order}'
        params = write_params(tmp_path / 'p.yaml', text)
        code, out, _ = ctsid('identify', shared / 'bag', '--params', params, '--out', 'other',
                             '--force', '--duration', 8)
        advice = Path('other/report.md').read_text(encoding='utf-8')
        assert ('0 (not looked for)' in out) == bool(order), out
        assert (' (found)' in out) == (not order), out
        assert ('The model has no dead time' in advice) == bool(order)


def test_the_fit_and_the_deviations_are_the_same_wherever_they_stand(ctsid, shared, identified):
    params = shared / 'params.yaml'
    estimate = load_estimate(identified[0] / 'model.json')
    page = (identified[0] / 'report.html').read_text(encoding='utf-8')
    assert re.findall(r'simulated: fit (\S+) %', page) == [percent(estimate.fit[0])]
    _, out, _ = ctsid('advise', shared / 'bag', '--params', params, '--json')
    for pole in json.loads(out)['poles']:
        near = np.argmin(abs(estimate.model.poles - complex(*pole['pole'])))
        assert pole['std'] == pytest.approx(estimate.pole_std[near])
    ctsid('replay', shared / 'bag', '--params', params, '--out', 'windows', '--duration', 6)
    page = Path('windows/report.html').read_text(encoding='utf-8')
    assert re.findall(r'simulated: fit (\S+) %', page) == [
        percent(load_estimate('windows/model.json').fit[0])]


@pytest.mark.slow
def test_the_budget_of_the_command_line_is_that_of_the_model(ctsid, shared):
    words = (shared / 'bag', '--params', shared / 'params.yaml', '--out', 'res', '--force',
             '--duration', 6)
    for verb, more, budget in (('identify', (), 0.0), ('identify', ('--budget', '30'), 30.0),
                               ('replay', (), 2.0)):        # 0.8 of the stride
        assert ctsid(verb, *words, *more)[0] == 0
        assert load_estimate('res/model.json').settings.budget == budget
    code, _, err = ctsid('identify', *words, '--budget', '-1')
    assert code == 2
    assert '--budget' in err


def test_parameters_of_the_command_line_are_those_of_the_model(ctsid, shared):
    """What to try next has them, too, and so has the file that `ctsid try` writes."""
    words = (shared / 'bag', '--params', shared / 'params.yaml', '--out', 'res', '--force',
             '--duration', 6)
    code, out, _ = ctsid('identify', *words, '--set', 'order=1', '--set', 'max_order=3')
    assert code == 0
    settings = load_estimate('res/model.json').settings
    assert (settings.order, settings.max_order) == (1, 3)
    run = run_of(argparse.Namespace(command_line='', bag=['bag'], params='p.yaml',
                                    changes=['order=1']))
    assert run.command('replay') == 'ctsid replay bag --params p.yaml --set order=1'
    for verb in ('identify', 'replay', 'advise', 'compare'):
        code, _, err = ctsid(verb, *words[:3], '--set', 'ordr=1')
        assert code == 1
        assert '`ordr` is not a parameter; nearest: order' in err
    assert ctsid('try', shared / 'bag', '--set', 'order=2', '--out', 'tried')[0] == 0
    assert read_config('tried/params.yaml').settings.order == 2


def on_terminal(folder: Path, *words: object) -> tuple[str, str]:
    """Return what a process prints on stdout, and what it shows on the terminal of its stderr."""
    ours, theirs = os.openpty()
    with (folder / 'out').open('w') as out:
        process = subprocess.Popen(
            [sys.executable, '-m', 'ctsid_ros.cli', *map(str, words)], stdout=out, stderr=theirs,
            env=environment() | {'TERM': 'xterm', 'COLUMNS': '200'})
    os.close(theirs)
    shown = b''
    with suppress(OSError):  # the end of a terminal
        while part := os.read(ours, 4096):
            shown += part
    os.close(ours)
    assert process.wait(PATIENCE) == 0
    text = re.sub(rb'\x1b\[[0-9;?]*[A-Za-z]', b'', shown).decode()
    assert 'ctsid: error' not in text
    return (folder / 'out').read_text(), text


@pytest.mark.slow
def test_results_on_stdout_what_is_done_on_stderr(shared, tmp_path):
    out, shown = on_terminal(tmp_path, 'identify', shared / 'bag', '--json', '--out',
                             tmp_path / 'res', '--duration', 5)
    assert json.loads(out)['accepted']
    assert 'the channels are guessed' in shown
    pytest.importorskip('rich')
    assert re.search(r'identifying one model of 5 s of data, \d+ samples', shown)


@pytest.mark.slow
def test_a_terminal_shows_the_windows_of_a_replay(shared, tmp_path):
    pytest.importorskip('rich')
    out, shown = on_terminal(tmp_path, 'replay', shared / 'bag', '--params',
                             shared / 'params.yaml', '--duration', 6, '--out', tmp_path / 'res')
    assert 'Models along the bag' in out
    assert re.search(r'1 of [12] windows, fit', shown), shown


def test_help_and_version(ctsid):
    code, out, _ = ctsid('--version')
    assert code == 0
    assert out.startswith('ctsid ')
    code, out, _ = ctsid('replay', '--help')
    assert code == 0
    assert '--truth' in out


# --- bad input


def test_files_that_are_no_bags(refusal, tmp_path, shared):
    whole = write_mcap(tmp_path / 'whole.mcap', flight(2.0)).read_bytes()
    for name, content, words in (
            ('empty.mcap', b'', 'is empty'), ('text.mcap', b'hello\n', 'is not a bag'),
            ('short.mcap', whole[:40], 'short.mcap')):
        path = tmp_path / name
        path.write_bytes(content)
        for verb in ('info', 'identify'):
            assert words in refusal(verb, path)
    assert 'no such file' in refusal('replay', tmp_path / 'none.mcap')
    assert not Path('results').exists()


def test_a_truncated_bag_gives_what_is_left_and_says_so(ctsid, shared, tmp_path):
    whole = write_mcap(tmp_path / 'bag.mcap', flight(12.0)).read_bytes()
    (tmp_path / 'bag.mcap').write_bytes(whole[:int(0.7 * len(whole))])
    code, out, _ = ctsid('identify', tmp_path / 'bag.mcap', '--params', shared / 'params.yaml',
                         '--out', 'res')
    assert code == 0
    assert 'Notes on the data' in out
    estimate = load_estimate('res/model.json')
    assert 5 < (estimate.end_ns - estimate.start_ns) / S < 11


@pytest.mark.parametrize(('old', 'new', 'words'), [
    ('topic: /imu', 'topic: /imus', "no topic '/imus' in the bag; nearest: /imu"),
    ('angular_velocity.x', 'angular_velocity.roll', "has no field 'roll'"),
    ('sensor_msgs/msg/Imu', 'sensor_msgs/msg/Joy',
     'is of type sensor_msgs/msg/Imu in the bag, but `rate.type` says sensor_msgs/msg/Joy'),
    ("'data[0]'", "'data[7]'", 'too few usable samples in this interval of `torque`'),
    ("'data[0]'", "'data'", 'choose elements: data[0]')])
@pytest.mark.parametrize('verb', ['identify', 'replay'])
def test_what_the_bag_has_not(refusal, shared, verb, old, new, words):
    params = write_params(Path('params.yaml'), PARAMS.replace(old, new))
    assert words in refusal(verb, shared / 'bag', '--params', params, '--out', 'res')
    assert not Path('res').exists()


def test_all_that_the_bag_has_not_is_told_at_once(refusal, shared):
    text = PARAMS.replace('topic: /imu', 'topic: /imus').replace("'data[0]'", 'dat')
    err = refusal('identify', shared / 'bag', '--params', write_params(Path('p.yaml'), text))
    assert "no topic '/imus'" in err
    assert "no field 'dat'" in err


def test_all_faults_of_a_parameter_file_are_told_at_once(refusal, shared):
    text = PARAMS.replace('order: 2', 'order: many\n    ordr: 3').replace('length: 5.0',
                                                                        'length: -1.0')
    err = refusal('replay', shared / 'bag', '--params', write_params(Path('p.yaml'), text))
    for words in ("`order` is 'many'", '`ordr` is not a parameter', '`window.length` is -1.0'):
        assert words in err
    assert 'there is no file' in refusal('replay', shared / 'bag', '--params', 'none.yaml')


def test_samples_that_are_not_numbers_are_counted(ctsid, shared, tmp_path):
    bag = write_flight(tmp_path / 'bag', spoilt('/imu', lambda k, s: at(
        s, stamp_of(s), (np.nan, np.inf)[k % 2]) if k % 50 < 2 else s,
        flight(10.0)))
    code, out, _ = ctsid('identify', bag, '--params', shared / 'params.yaml', '--out', 'res')
    assert code == 0
    assert '`rate`: 40 of 1000 samples are not finite' in out
    assert close(load_model('res/model.json').poles, 0.3)


def test_duplicate_and_disordered_stamps(ctsid, shared, tmp_path):
    sent = flight(10.0)
    rates = [s for s in sent if s.topic == '/imu']

    def spoil(k: int, one: Sent) -> Sent:
        if k % 10 == 3:  # overtaken by the next one: put in order
            return at(one, stamp_of(rates[k + 1]), rates[k + 1].message.angular_velocity.x)
        if k % 10 == 4:
            return at(one, stamp_of(rates[k - 1]), rates[k - 1].message.angular_velocity.x)
        return at(one, stamp_of(rates[k - 1])) if k % 100 == 50 else one

    bag = write_flight(tmp_path / 'bag', spoilt('/imu', spoil, sent))
    code, out, _ = ctsid('identify', bag, '--params', shared / 'params.yaml', '--out', 'res')
    assert code == 0
    assert '`rate`: 10 of 1000 samples have the stamp of another' in out
    assert close(load_model('res/model.json').poles, 0.3)


def test_a_clock_that_is_set_back_begins_anew(ctsid, shared, tmp_path):
    bag = write_flight(tmp_path / 'bag', [
        replace(s, message=imu(stamp_of(s) - (8 * S if s.log_ns > START + 6 * S else 0),
                               s.message.angular_velocity.x)) if s.topic == '/imu' else s
        for s in flight(12.0)])
    params = write_params(tmp_path / 'p.yaml', PARAMS.replace(
        "'data[0]'", "'data[0]', stamp: log"))
    code, out, _ = ctsid('replay', bag, '--params', params, '--out', 'res')
    assert code in (0, 3)
    assert 'jumped back' in out


def test_stamps_that_are_all_zero_are_replaced_by_the_log(ctsid, shared, tmp_path):
    bag = write_flight(tmp_path / 'bag', spoilt('/imu', lambda _, s: at(s, 0), flight(8.0)))
    code, out, _ = ctsid('identify', bag, '--params', shared / 'params.yaml', '--out', 'res')
    assert code == 0
    assert 'the stamps in its headers are zero, so the time of recording is used' in out
    assert close(load_model('res/model.json').poles, 0.5)
    found = json.loads(ctsid('info', bag, '--json')[1])['topics']
    assert [s['usable'] for t in found for s in t['stamps'] if t['name'] == '/imu'] == [
        False, True]


def test_a_header_of_another_clock_is_told_with_its_cure(ctsid, refusal, shared, tmp_path):
    bag = write_flight(tmp_path / 'bag', spoilt(
        '/imu', lambda _, s: at(s, stamp_of(s) - START + S), flight(8.0)))  # as a simulator stamps
    for verb in ('identify', 'replay'):
        err = refusal(verb, bag, '--params', shared / 'params.yaml')
        assert 'so the clocks are not one; set `stamp` to log for all channels' in err
    params = write_params(tmp_path / 'p.yaml', PARAMS.replace('.x, unit', '.x, stamp: log, unit'))
    assert ctsid('identify', bag, '--params', params)[0] == 0
    ctsid('init', bag, '-o', 'guess.yaml')
    assert {c.stamp for c in read_config('guess.yaml').channels} == {'log'}


def test_times_of_another_clock_are_counted_from_the_first_window(ctsid, tmp_path):
    sent = [at(s, stamp_of(s) - START + S) for s in flight(6.0) if s.topic == '/imu']
    for one in sent:
        one.message.linear_acceleration.x = one.message.angular_velocity.x
    text = PARAMS.replace("/cmd, type: std_msgs/msg/Float64MultiArray, field: 'data[0]'",
                          '/imu, type: sensor_msgs/msg/Imu, field: linear_acceleration.x')
    code, out, err = ctsid('replay', write_flight(tmp_path / 'bag', sent), '--params',
                           write_params(tmp_path / 'p.yaml', text), '--json')
    assert code in (0, 3), err
    assert json.loads(out)['windows'][0]['from'] == pytest.approx(0.0)


def test_a_header_wanted_where_there_is_none(refusal, shared, tmp_path):
    bag = write_flight(tmp_path / 'bag', spoilt('/imu', lambda _, s: at(s, 0)))
    params = write_params(tmp_path / 'p.yaml', PARAMS.replace(
        '.x, unit', '.x, stamp: header, unit'))
    assert 'set `rate.stamp` to auto or log' in refusal('identify', bag, '--params', params)


def test_a_channel_without_message(refusal, shared, tmp_path):
    sent = [s for s in flight(4.0) if s.topic == '/imu']
    bag = write_flight(tmp_path / 'bag', sent)
    assert "no topic '/cmd'" in refusal('replay', bag, '--params', shared / 'params.yaml')
    bag = write_mcap(tmp_path / 'late.mcap', flight(8.0))
    assert 'too few usable samples in this interval of `torque` (/cmd): none' in refusal(
        'identify', bag, '--params', write_params(Path('p.yaml'), PARAMS.replace(
            "'data[0]'", "'data[5]'")))


@pytest.mark.parametrize(('verb', 'topic', 'name'), [
    ('identify', '/imu', 'rate'), ('replay', '/cmd', 'torque'), *slow(
        ('identify', '/cmd', 'torque'), ('replay', '/imu', 'rate'))])
def test_a_channel_with_one_message(refusal, shared, tmp_path, verb, topic, name):
    bag = write_flight(tmp_path / 'bag', spoilt(topic, lambda k, s: s if k == 20 else None))
    assert f'too few usable samples in this interval of `{name}` ({topic}): 1' in refusal(
        verb, bag, '--params', shared / 'params.yaml', '--out', 'res')


@pytest.mark.parametrize(('topic', 'words'), [
    ('/cmd', 'No input moves within the window'),
    *slow(('/imu', 'No output moves within the window'))])
def test_a_channel_that_is_constant(ctsid, shared, tmp_path, topic, words):
    bag = write_flight(tmp_path / 'bag', spoilt(topic, lambda _, s: replace(
        s, message=array(1.0, 2.0)) if topic == '/cmd' else at(s, stamp_of(s), 1.0)))
    for verb in ('identify', 'replay'):
        code, out, _ = ctsid(verb, bag, '--params', shared / 'params.yaml', '--out', verb)
        assert code == 3
        assert words in re.sub(r'\s+', ' ', out)
        assert words in Path(verb, 'report.md').read_text()
        assert load_estimate(f'{verb}/model.json').model is None


def test_data_that_no_model_explains_are_rejected_with_the_reason(ctsid, shared, tmp_path):
    rng = np.random.default_rng(3)
    bag = write_flight(tmp_path / 'bag', spoilt('/imu', lambda _, s: at(
        s, stamp_of(s), rng.standard_normal())))
    code, out, _ = ctsid('identify', bag, '--params', shared / 'params.yaml', '--out', 'res')
    assert code == 3
    assert 'REJECTED (UNEXPLAINED)' in out
    estimate = load_estimate('res/model.json')
    assert estimate.model is None
    for text in (out, Path('res/report.md').read_text(encoding='utf-8')):
        assert ' '.join(text.split()).count(estimate.verdict.reason) == 1
    assert 'no further data are needed' not in Path('res/report.md').read_text(encoding='utf-8')
    drawn = Path('res/report.html').read_text(encoding='utf-8')
    assert '<dl>' not in drawn          # numbers beside the verdict, large
    assert 'p-value' not in out         # nothing that is not judged
    for title in ('Measured and simulated', 'Frequency response'):
        assert f'{title}: rejected model' in drawn
    code, out, err = ctsid('simulate', 'res/model.json', bag)
    assert (code, out) == (1, '')
    assert f'no accepted model (UNEXPLAINED): {estimate.verdict.reason}' in err
    assert 'Add --rejected to simulate' in err
    code, out, _ = ctsid('simulate', 'res/model.json', bag, '--rejected')
    assert code == 3
    assert out.startswith('REJECTED (UNEXPLAINED)\n  ')
    assert estimate.verdict.reason in ' '.join(out.split())
    code, out, _ = ctsid('simulate', 'res/model.json', bag, '--rejected', '--json')
    found = json.loads(out)
    assert (code, found['accepted'], found['reason']) == (3, False, estimate.verdict.reason)
    code, out, _ = ctsid('advise', bag, '--params', shared / 'params.yaml')
    assert code == 3
    assert out.startswith('REJECTED (UNEXPLAINED)\n  ')
    assert ' '.join(out.split()).count(estimate.verdict.reason) == 1


def test_a_window_longer_than_the_bag(refusal, shared):
    params = write_params(Path('p.yaml'), PARAMS.replace('length: 5.0', 'length: 50.0'))
    err = refusal('replay', shared / 'bag', '--params', params, '--out', 'res')
    assert 'no window of 50 s fits into the data' in err
    assert 'lower `window.length`' in err
    assert not Path('res').exists()


def test_tables_of_one_folder_whose_units_are_guessed_apart(tmp_path, capsys):
    """Hours of a heater beside seconds of its temperature: what to say was not named."""
    time = np.arange(400.0)
    for name, step in (('heater', 1.0), ('temp', 2.0)):
        np.savetxt(tmp_path / f'{name}.csv', np.column_stack((1000.0 + step * time, np.sin(time))),
                   delimiter=',', comments='', header=f't,{name}_cmd' if step < 2 else 't,zone')
    assert main(['try', str(tmp_path), '--out', str(tmp_path / 'res')]) == 1
    err = capsys.readouterr().err
    assert 'too few usable samples in this interval of `zone`' in err
    assert 'temp.csv: the times of column t name no unit and are taken as ms' in err
    assert 'say --time t:s' in err


@pytest.mark.parametrize('verb', ['identify', 'replay'])
def test_inputs_and_outputs_that_do_not_overlap(refusal, shared, tmp_path, verb):
    bag = write_flight(tmp_path / 'bag', [
        s for s in flight() if (s.topic == '/cmd') == (s.log_ns - START < 8 * S)])
    err = refusal(verb, bag, '--params', shared / 'params.yaml')
    assert 'do not overlap in time' in err
    assert '`torque` (/cmd) 0.00 to 7.95 s, `rate` (/imu) 8.00 to 19.99 s' in err


def test_an_interval_outside_of_the_bag(refusal, shared):
    common = (shared / 'bag', '--params', shared / 'params.yaml')
    assert 'the bag is 20.0 s long' in refusal('identify', *common, '--start', 30)
    assert 'the bag is 20.0 s long' in refusal('replay', *common, '--start', 30)
    assert 'choose another time to split at' in refusal('identify', *common, '--test-from', 30)


def test_a_folder_that_exists_is_not_touched_without_force(ctsid, refusal, shared):
    common = ('identify', shared / 'bag', '--params', shared / 'params.yaml', '--out', 'res',
              '--duration', 5)
    Path('res').mkdir()
    Path('res/mine.txt').write_text('mine')
    Path('res/model.json').write_text('old')
    assert 'exists already' in refusal(*common)
    assert Path('res/model.json').read_text() == 'old'
    assert ctsid(*common, '--force')[0] == 0
    assert load_model('res/model.json').n == 2
    assert Path('res/mine.txt').read_text() == 'mine'


def test_a_folder_that_cannot_be_written(refusal, shared):
    Path('file').write_text('')
    common = ('replay', shared / 'bag', '--params', shared / 'params.yaml', '--out')
    assert 'choose another' in refusal(*common, 'file')
    assert 'cannot be written to' in refusal(*common, 'file/res')
    assert 'cannot be written to' in refusal(*common, '/proc/res')


def test_a_failed_run_keeps_earlier_results_and_leaves_no_empty_folder(refusal, shared):
    Path('res').mkdir()
    Path('res/model.json').write_text('old')
    params = write_params(Path('p.yaml'), PARAMS.replace('/imu', '/none'))
    refusal('replay', shared / 'bag', '--params', params, '--out', 'res', '--force')
    assert Path('res/model.json').read_text() == 'old'


def test_models_that_are_none(refusal, shared):
    Path('m.json').write_text('{')
    assert 'm.json' in refusal('show', 'm.json')
    assert 'cannot be read' in refusal('show', 'none.json')
    assert 'cannot be read' in refusal('simulate', 'none.json', shared / 'bag')
    assert 'give them with --params' in refusal('simulate', shared / 'truth.json', shared / 'bag')
    text = PARAMS.replace('torque', 'moment')
    assert 'but those of the channels are moment' in refusal(
        'simulate', shared / 'truth.json', shared / 'bag', '--params',
        write_params(Path('p.yaml'), text))


def test_a_bag_in_which_nothing_moves_cannot_be_guessed(refusal, ctsid, tmp_path):
    bag = write_flight(tmp_path / 'bag', [replace(s, message=array(1.0)) for s in flight(2.0)
                                          if s.topic == '/cmd'])
    assert 'nothing in this bag does' in refusal('init', bag, '-o', 'p.yaml')
    assert ctsid('info', bag)[0] == 0


# --- real processes


@pytest.fixture
def interruptible():
    """Let processes started here mind Ctrl-C, even if these tests run where it is ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def environment() -> dict[str, str]:
    return os.environ | {'PYTHONPATH': str(ROOT), 'PYTHONUNBUFFERED': '1'}


@pytest.mark.usefixtures('interruptible')
@pytest.mark.slow
def test_interrupted_replay_keeps_what_was_found(shared, tmp_path):
    params = write_params(tmp_path / 'p.yaml', PARAMS.replace('stride: 2.5', 'stride: 0.05'))
    process = subprocess.Popen(
        [sys.executable, '-m', 'ctsid_ros.cli', 'replay', shared / 'bag', '--params', params,
         '--out', tmp_path / 'res'], env=environment(), cwd=tmp_path, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        for line in process.stderr:
            if 'window' in line and 'no window' not in line:
                break
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=PATIENCE)
    finally:
        process.kill()
    assert process.returncode == 130, err
    assert 'Traceback' not in err
    assert 'the results are those of the first' in err
    series = load_series(tmp_path / 'res/estimates.npz')
    assert 1 <= len(series) < 280
    assert sorted(p.name for p in (tmp_path / 'res').iterdir()) == REPLAYED
    assert 'Models along the bag' in out


@pytest.mark.slow
@pytest.mark.usefixtures('interruptible')
def test_interrupted_before_anything_was_found(shared, tmp_path):
    process = subprocess.Popen(
        [sys.executable, '-c', 'import signal, sys; from ctsid_ros.replay import replay; '
         'replay.play = lambda *_, **__: signal.raise_signal(signal.SIGINT) or iter(()); '
         'from ctsid_ros.cli import main; sys.exit(main(sys.argv[1:]))', 'replay',
         shared / 'bag', '--params', shared / 'params.yaml', '--out', tmp_path / 'res'],
        env=environment(), cwd=tmp_path, text=True, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE)
    out, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130
    assert out == ''
    assert 'there are no results' in err
    assert not (tmp_path / 'res').exists()


def test_a_reader_that_has_enough_is_no_error(shared):
    done = subprocess.run(
        f'{sys.executable} -m ctsid_ros.cli params --markdown | head -n 1', shell=True,
        env=environment(), capture_output=True, text=True, check=False, timeout=PATIENCE)
    assert done.stdout.count('\n') == 1
    assert done.stderr == ''


def test_a_terminal_without_unicode_gets_what_it_can_show(shared):
    done = subprocess.run(
        [sys.executable, '-m', 'ctsid_ros.cli', 'show', shared / 'truth.json'],
        env=environment() | {'PYTHONIOENCODING': 'ascii'}, capture_output=True, check=False,
        timeout=PATIENCE)
    assert (done.returncode, done.stderr) == (0, b'')
    assert b'-1.500 ? 3.000j' in done.stdout


def test_blas_has_one_thread_before_numpy_comes(tmp_path):
    code = ('import sys; import ctsid_ros.cli; assert "numpy" not in sys.modules; import os; '
            'print(os.environ["OPENBLAS_NUM_THREADS"], os.environ["OMP_NUM_THREADS"])')
    clean = {k: v for k, v in environment().items() if not k.endswith('_NUM_THREADS')}
    for given, expected in (({}, '1 1'), ({'OMP_NUM_THREADS': '4'}, '1 4')):
        done = subprocess.run([sys.executable, '-c', code], env=clean | given,
                              capture_output=True, text=True, check=True, timeout=PATIENCE)
        assert done.stdout.split() == expected.split()


# --- real recordings


@pytest.mark.parametrize('more', [('--budget', '2'), *slow(((),))])
def test_aileron_stick_to_roll_angle_of_a_real_aircraft(ctsid, data_folder, more):
    """Order and dead time are given, and far too few for all that moves it."""
    bag = data_folder / 'cubs2/cub_stabilize_2025_11_13.mcap'
    code, out, err = ctsid('identify', bag, '--params', ROOT / 'config/cubs2_roll.yaml',
                           '--test-from', 118.8, '--out', 'res', '--json', *more)
    assert code == 0, err
    assert json.loads(out)['test']['fit'][0] > 77
