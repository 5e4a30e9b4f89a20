# SPDX-License-Identifier: Apache-2.0
"""Methods, orders and stored models beside each other, with the same numbers everywhere."""

from __future__ import annotations

import csv
from dataclasses import replace
import json
from pathlib import Path
import re

from bag_fixtures import imu, write_rosbag2
from flights import PARAMS, TRUTH, flight, spoilt, stamp_of
import numpy as np
import pytest
from test_page import Tags, data_of

from ctsid_core.model.estimate import Choice, Estimate, Status
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.storage import load_estimate, save_model
from ctsid_core.model.validation import prediction, simulation
from ctsid_core.search.own_past import AHEAD, HORIZONS
from ctsid_core.settings import METHODS, Settings
from ctsid_core.signals.record import Record
from ctsid_ros.cli import main
from ctsid_ros.report.comparison import order_of
from ctsid_ros.report.tables import fit_words, percent


@pytest.fixture(scope='module')
def folder(tmp_path_factory) -> Path:
    """A flight, another one with spikes, and the methods compared on the first."""
    place = tmp_path_factory.mktemp('compared')
    write_rosbag2(place / 'bag', flight(9.0))
    spiky = spoilt('/imu', lambda k, one: replace(one, message=imu(stamp_of(one), 30.0))
                   if k in (200, 201, 500) else one, flight(9.0, seed=2))
    write_rosbag2(place / 'other', spiky)
    (place / 'params.yaml').write_text(PARAMS)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        assert main(['compare', 'bag', '--params', 'params.yaml', '--out', 'methods', '--quiet',
                     '--orders', '1:3']) == 0
        save_model('=1+1.json', replace(load_estimate('methods/gobf.json'), covariance=None))
    return place


@pytest.fixture
def run(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)

    def told(*words: str) -> tuple[int, str, str]:
        capsys.readouterr()
        code = main([*words, '--quiet'] if words[0] != 'plot' else [*words])
        return (code, *capsys.readouterr())

    return told


def words_of(path: str) -> str:
    return ' '.join(' '.join(Tags(Path(path).read_text(encoding='utf-8')).words).split())


def rows_of(path: str) -> list[dict[str, str]]:
    with Path(path).open(encoding='utf-8') as stream:
        return list(csv.DictReader(stream))


def test_a_comparison_of_methods_is_a_folder_with_one_number_for_one_quantity(run):
    assert {p.name for p in Path('methods').iterdir()} == {
        'comparison.csv', 'report.html', 'report.md', *(f'{m}.json' for m in METHODS)}
    page, report = words_of('methods/report.html'), Path('methods/report.md').read_text()
    rows = rows_of('methods/comparison.csv')
    assert [r['method'] for r in rows] == list(METHODS)
    for row in rows:
        estimate = load_estimate(f'methods/{row["method"]}.json')
        assert float(row['fit_rate [%]']) == estimate.fit[0]
        assert float(row['held_out_fit_rate [%]']) == estimate.held_out_fit[0]
        shown = percent(estimate.fit[0])
        assert f'{row["method"]}: fit {shown} %' in page     # below the curves
        assert re.search(rf'\| {row["method"]} \| GOOD \| 2 \| {shown} \|', report)
    code, out, _ = run('compare', 'bag', '--params', 'params.yaml', '--out', 'again', '--json',
                       '--orders', '2')
    assert code == 0
    assert [m['fit'][0] for m in json.loads(out)['methods']] == [
        float(r['fit_rate [%]']) for r in rows]


def test_orders_can_be_chosen_on_the_page_and_the_chosen_one_is_the_same_model(run):
    page = Path('methods/report.html').read_text(encoding='utf-8')
    if 'id="series"' not in page:
        pytest.skip('no plotly')
    series = data_of(page, 'series')
    estimate = load_estimate('methods/hd-pbsid.json')
    assert [w['title'] for w in series['windows']] == ['Order 1', 'Order 2 (chosen)', 'Order 3']
    assert [w['at'] for w in series['windows']] == [1, 2, 3]
    chosen = dict(series['windows'][1]['facts'])
    assert chosen['fit [%]'] == fit_words(estimate.fit)
    assert chosen['held-out fit [%]'] == fit_words(estimate.held_out_fit)
    figure, = (f for f in data_of(page, 'figures')
               if f['layout']['xaxis']['title']['text'] == 'order')
    own = next(t for t in figure['data'] if t['name'] == 'own')
    assert own['x'] == [1, 2, 3]
    assert own['y'][1] == pytest.approx(estimate.fit[0], rel=1e-5)
    assert own['y'][0] < own['y'][1] - 20.0
    assert 'data-first="1"' in page
    assert '‹ order before' in page


def test_orders_are_drawn_with_fits_of_the_kind_of_the_chosen_one():
    t = np.arange(0.0, 5.0, 0.02)
    rng = np.random.default_rng(3)
    record = Record.from_arrays(t, rng.standard_normal((250, 1)), t,
                                rng.standard_normal((250, 1)), input_hold='zoh')
    good = Estimate(status=Status.OK, settings=Settings(), fit=np.array([70.0]),
                    held_out_fit=np.array([60.0]), rejected_model=TRUTH)
    ahead = replace(good, choices=(Choice('domain', 'predictions', 'x'),))
    found = order_of(ahead, record, good)
    assert found.fit == pytest.approx(simulation(TRUTH, record).fit)
    assert np.isnan(found.held_out_fit).all()
    assert order_of(good, record, good).fit == order_of(ahead, record, ahead).fit == 70.0
    other = order_of(good, record, ahead)
    assert other.fit == pytest.approx(prediction(TRUTH, record, HORIZONS[AHEAD]).fit)
    assert np.isnan(other.held_out_fit).all()


@pytest.mark.parametrize('verb', ['compare', 'show'])
def test_stored_models_are_drawn_over_each_other_on_the_same_data(run, verb):
    models = ['methods/hd-pbsid.json', 'methods/ct-pbsid.json', '=1+1.json']
    data = ['other'] if verb == 'compare' else ['--bag', 'other']
    code, out, _ = run(verb, *models, *data, '--out', verb, '--json')
    assert code == 0
    told = json.loads(out)
    assert [m['name'] for m in told['models']] == ['hd-pbsid', 'ct-pbsid', '=1+1']
    rows, page = rows_of(f'{verb}/comparison.csv'), words_of(f'{verb}/report.html')
    assert rows[2]['model'] == "'=1+1"      # no formula
    for row, model in zip(rows, told['models'], strict=True):
        assert float(row['fit_on_these_data_rate [%]']) == model['fit_on_these_data'][0] > 90.0
        assert f'{model["name"]}: fit {percent(model["fit_on_these_data"][0])} %' in page
        assert model['agrees'] in (True, None)
    assert '3 corrupt samples of rate are left out of the fits' in page
    assert '3 models on other' in page
    figures = data_of(Path(f'{verb}/report.html').read_text(), 'figures')
    drawn = [{t['meta'] for t in f['data']} for f in figures]
    assert sum({'hd-pbsid', 'ct-pbsid', '=1+1'} <= names for names in drawn) >= 4
    assert rows_of(f'{verb}/comparison.csv') == rows_of('compare/comparison.csv')
    assert rows[2]['agrees'] == 'cannot tell'       # its deviations are not known
    assert told['models'][2]['agrees'] is None


def test_models_with_other_dead_times_are_compared_on_the_same_samples(run):
    own = load_estimate('methods/hd-pbsid.json')
    late = replace(own, model=replace(own.model, delay=(2.0,)), covariance=None)
    save_model('late.json', late)
    hd, fits = 'methods/hd-pbsid.json', []
    for models, more in (([hd, 'late.json'], []), ([hd, hd], ['--start', '2']), ([hd, hd], [])):
        _, out, _ = run('compare', *models, 'other', '--out', 'res', '--force', '--json', *more)
        fits.append(json.loads(out)['models'][0]['fit_on_these_data'][0])
    assert fits[0] == pytest.approx(fits[1], abs=0.02)
    assert abs(fits[0] - fits[2]) > 0.05
    save_model('never.json', replace(late, model=replace(own.model, delay=(20.0,))))
    code, _, said = run('compare', 'methods/hd-pbsid.json', 'never.json', 'other', '--out', 'no')
    assert code == 1
    assert 'acts 20 s later, after the end of these' in said


def test_vague_models_are_not_said_to_agree_and_table_page_and_json_say_so_alike(run):
    """Deviations fifty times as large: anything would lie within them."""
    for name in ('hd-pbsid', 'ct-pbsid'):
        found = load_estimate(f'methods/{name}.json')
        save_model(f'vague_{name}.json', replace(found, covariance=replace(
            found.covariance, root=50.0 * found.covariance.root)), force=True)
    for names, word, json_word in ((('methods/hd-pbsid', 'methods/ct-pbsid'), 'yes', True),
                                   (('vague_hd-pbsid', 'vague_ct-pbsid'), 'cannot tell', None)):
        models = [f'{name}.json' for name in names]
        code, out, _ = run('compare', *models, '--out', 'sure', '--force')
        table = next(line for line in out.splitlines() if 'ct-pbsid ' in line)
        _, told, _ = run('compare', *models, '--out', 'sure', '--force', '--json')
        model = json.loads(told)['models'][1]
        row, page = rows_of('sure/comparison.csv')[1], words_of('sure/report.html')
        report = Path('sure/report.md').read_text(encoding='utf-8')
        assert code == 0
        assert f' {word} ' in table
        assert (row['agrees'], model['agrees']) == (word, json_word)
        for key in ('difference', 'difference_std'):
            assert float(row[f'{key} [%]']) == 100.0 * model[key]
        both = ' ± '.join(percent(100.0 * model[k]) for k in ('difference', 'difference_std'))
        assert all(f'{both}' in text for text in (table, page, report))
        said = ('1 of 1' if json_word else '0 of 1, of 1 it cannot be told')
        assert f'models that agree with {Path(models[0]).stem} {said}' in page
        assert model['agreement'] in page


def test_models_without_data_say_how_far_they_are_apart(run):
    other = StateSpace(TRUTH.A * 1.5, TRUTH.B, TRUTH.C, input_names=TRUTH.input_names,
                       output_names=TRUTH.output_names, input_units=TRUTH.input_units,
                       output_units=TRUTH.output_units)
    Path('away').mkdir()
    save_model('away/model.json', other)
    code, out, _ = run('compare', 'methods/hd-pbsid.json', 'away', '--out', 'apart')
    assert code == 0
    assert re.search(r'away +\S+ +2 +- +- +no +\d', out)
    page = words_of('apart/report.html')
    assert 'away does not agree: it differs by' in page
    assert 'Measured and' not in page


@pytest.mark.slow
def test_models_of_the_same_signals_are_compared_whatever_they_are_called(run):
    Path('renamed.yaml').write_text(
        Path('params.yaml').read_text().replace('torque', 'u1').replace('rate', 'y1'))
    for name in ('params', 'renamed'):
        assert run('identify', 'bag', '--params', f'{name}.yaml', '--out', name)[0] == 0
    assert load_estimate('renamed/model.json').model.input_names == ('u1',)
    code, out, _ = run('compare', 'params', 'renamed', 'bag', '--out', 'alike')
    assert code == 0
    assert re.search(r'renamed\s+GOOD.*yes', out)


@pytest.mark.slow
def test_a_signal_with_two_names_is_named_with_what_to_do(run):
    t = np.arange(0.0, 20.0, 0.02)
    rng = np.random.default_rng(4)
    u = np.repeat(rng.choice([-1.0, 1.0], 40), 25)
    y = np.zeros(1000)
    for k in range(1, 1000):
        y[k] = 0.96 * y[k - 1] + 0.04 * u[k - 1]
    for name in ('torque', 'tau'):
        np.savetxt(f'{name}.csv', np.transpose([t, u, y + 0.01 * rng.normal(size=1000)]),
                   delimiter=',', comments='', header=f't,{name},rate')
        assert run('try', f'{name}.csv', '--out', f'of_{name}')[0] == 0
    for line in (('compare', 'of_torque', 'of_tau', 'tau.csv'), ('show', 'of_torque', 'of_tau')):
        code, _, err = run(*line)
        assert code == 1
        assert 'of_torque: torque to rate; of_tau: tau to rate; not in all of them: tau, torqu' \
            in err
        assert 'identify once more with a parameter file' in err
    own = Path('of_tau/params.yaml').read_text(encoding='utf-8')
    Path('alike.yaml').write_text(own.replace('inputs: [tau]', 'inputs: [torque]').replace(
        '    tau:', '    torque:'))
    for line in (('compare', 'of_torque', 'tau.csv', '--out', 'two_names'),
                 ('simulate', 'of_torque/model.json', 'tau.csv')):
        code, _, err = run(*line)
        assert (code, "has no column 'torque'" in err, 'give --params FILE' in err) == (1, True,
                                                                                       True)
        assert run(*line, '--params', 'alike.yaml')[0] == 0
    assert run('identify', 'tau.csv', '--params', 'alike.yaml', '--out', 'alike_tau')[0] == 0
    assert run('compare', 'of_torque', 'alike_tau', '--out', 'both')[0] == 0
    code, out, _ = run('show', 'of_torque', 'alike_tau', '--out', 'shown')
    assert (code, 'Try next' in out, 'Results: shown' in out) == (0, False, True)
    same = ['simulate', 'of_torque', 'torque.csv', '--json']     # a folder, as compare takes it
    assert run(*same)[1] == run('simulate', 'of_torque/model.json', *same[2:])[1] != ''


def test_models_that_cannot_be_compared_are_named(run):
    assert run('show', *['methods/gobf.json'] * 7)[2].count('these are 7 models') == 1
    save_model('named.json', replace(TRUTH, output_names=('angle',)), force=True)
    code, _, err = run('show', 'methods/gobf.json', 'named.json')
    assert (code, 'not in all of them: angle, rate' in err) == (1, True)
    assert 'methods/gobf.json is given more than once' in run(
        'compare', *['methods/gobf.json'] * 3)[2]
    code, _, err = run('compare', 'methods/gobf.json', '--orders', '1:2')
    assert (code, '--orders is for a bag' in err) == (1, True)
    assert run('compare', 'bag', '--orders', '0:2')[0] == 2
    assert run('compare', 'bag', '--orders', '3:2')[0] == 2
