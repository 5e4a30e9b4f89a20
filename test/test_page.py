# SPDX-License-Identifier: Apache-2.0
"""Pages of reports: what is on them, that they need nothing else, and that names stay names."""

from __future__ import annotations

from argparse import Namespace
import csv
from dataclasses import replace
from html.parser import HTMLParser
import json
import math
from pathlib import Path
import re
import sys

from bag_fixtures import START, Sent, array, imu, write_rosbag2
from flights import PARAMS, TRUTH, flight
from markdown_it import MarkdownIt
from marks import slow
import numpy as np
import pytest
import yaml

from ctsid_core.identify import identify
from ctsid_core.model.covariance import Covariance, gain_deviation, pole_deviation
from ctsid_core.model.estimate import Estimate, Status
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.storage import load_estimate
from ctsid_core.model.verdict import Grade, Remedy, Verdict
from ctsid_core.settings import Settings
from ctsid_core.signals.record import Record, Signal
from ctsid_ros.cli import main
from ctsid_ros.replay.along import Windows, changes
from ctsid_ros.report.comparison import Contender, pole_section
from ctsid_ros.report.document import (
    Bullets,
    Command,
    Explorer,
    Figure,
    Gallery,
    Headline,
    Section,
    to_markdown,
    to_text,
)
from ctsid_ros.report.drawing import COLORS, MOST_MODELS, Axes, Curve, Drawing, over
from ctsid_ros.report.headline import Better, Run, headline
from ctsid_ros.report.interactive import figure
from ctsid_ros.report.page import to_html
from ctsid_ros.report.poles import pole_figure, region
from ctsid_ros.report.residual_figures import correlation, horizon_fits
from ctsid_ros.report.responses import bode_figures
from ctsid_ros.report.sections import gain_section, model_section
from ctsid_ros.report.spectra import spectra
from ctsid_ros.report.static import write_drawings
from ctsid_ros.report.tables import Table, percent, pole_text
from ctsid_ros.report.tracks import told
from ctsid_ros.report.window_figures import window_figure
from ctsid_ros.report.words import lines, markdown, printable
from ctsid_ros.studies.robots.families import experiment
from ctsid_ros.verbs.arguments import run_of, span

EVIL = '/<script>alert(1)</script>"\'><img src=x onerror=alert(1)>\x1b[31m`_*|$x\n# head\u202e=1+1'
TOPIC = '/imu' + ''.join(EVIL.split())     # no topic has blanks
MOST_BYTES = 7_000_000


class Tags(HTMLParser):
    """Elements and attributes of a page, less what scripts contain."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data):
        if not self.tags or self.tags[-1][0] not in ('script', 'style'):
            self.words.append(data)


def data_of(page: str, name: str):
    return json.loads(re.search(rf'id="{name}">(.*?)</script>', page, re.DOTALL)[1])


@pytest.fixture(scope='module')
def folder(tmp_path_factory) -> Path:
    """A flight whose topics and units are hostile, with the results of its identification."""
    place = tmp_path_factory.mktemp('page')
    sent = [replace(s, topic=TOPIC) if s.topic == '/imu' else s for s in flight(12.0)]
    write_rosbag2(place / 'bag', sent)
    params = yaml.safe_load(PARAMS)
    params['/**']['ros__parameters']['rate'] |= {'topic': TOPIC, 'unit': EVIL}
    (place / 'params.yaml').write_text(yaml.safe_dump(params))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        assert main(['identify', 'bag', '--params', 'params.yaml', '--out', 'res', '--quiet',
                     '--test-from', '9']) == 0
    return place


def test_page_stands_alone(folder):
    page = (folder / 'res/report.html').read_text(encoding='utf-8')
    assert len(page.encode()) < MOST_BYTES
    found = Tags(page)
    assert [t for t, a in found.tags if t in ('img', 'iframe', 'object') or 'src' in a] == []
    assert [a['href'] for t, a in found.tags if 'href' in a] == ['data:,']
    assert sum(t == 'script' for t, _ in found.tags) in (0, 4)
    assert not any(key.startswith('on') for _, a in found.tags for key in a)


def test_verdict_and_command_come_first(folder):
    page = (folder / 'res/report.html').read_text(encoding='utf-8')
    words = ' '.join(' '.join(Tags(page).words).split())
    assert words.index('GOOD') < words.index('Try next') < words.index('Measured and simulated')
    assert 'ctsid simulate res/model.json ANOTHER_BAG' in words
    for drawn in ('residual of rate', 'coherence', 'time after the step', 'Fit by horizon',
                  'correlation of the residuals', 'interval between samples',
                  'Samples that were used'):
        assert drawn in page, drawn
    assert 'ctsid identify bag --params params.yaml --out res' in words
    markdown_text = (folder / 'res/report.md').read_text(encoding='utf-8')
    assert markdown_text.index('**GOOD.**') < markdown_text.index('## ')


@pytest.mark.slow
def test_residuals_of_predictions_are_of_one_kind(tmp_path, capsys):
    """
    What is white by the table is white in the figure: both are of predictions one ahead.

    Of the angle of a cart-pole: it cannot be simulated.
    """
    record = experiment('cart-pole', 3, 3).record
    (u,), (y,) = record.inputs, record.outputs
    sent = [Sent('/cmd', 'std_msgs/msg/Float64MultiArray', START + round(t * 1e9), array(v, 0.5))
            for t, v in zip(u.time, u.values[:, 0], strict=True)]
    for t, v in zip(y.time, y.values[:, 1], strict=True):
        stamp = START + round(t * 1e9)
        sent.append(Sent('/imu', 'sensor_msgs/msg/Imu', stamp, imu(stamp, v)))
    write_rosbag2(tmp_path / 'bag', sorted(sent, key=lambda s: s.log_ns))
    params = PARAMS.replace('order: 2', 'feedthrough: false')
    (tmp_path / 'params.yaml').write_text(params)
    assert main(['identify', str(tmp_path / 'bag'), '--params', str(tmp_path / 'params.yaml'),
                 '--out', str(tmp_path / 'res'), '--quiet']) == 0
    assert 'its plant grows by itself' in capsys.readouterr().out
    page = (tmp_path / 'res/report.html').read_text(encoding='utf-8')
    words = ' '.join(Tags(page).words)
    assert 'Measured and predicted' in words
    assert words.count('less outputs predicted one sample ahead') == 1
    assert 'less simulated' not in words
    assert 'minus the simulated output' not in words
    own = [f for f in data_of(page, 'figures') for a in f['layout']['annotations']
           if 'correlation of the residuals' in a['text']]
    bars = [trace['y'] for trace in own[0]['data'] if trace['type'] == 'bar'][0]
    bound = max(shape['y0'] for shape in own[0]['layout']['shapes'])
    assert np.abs(bars).max() < 1.5 * bound       # bars of 0.5 were of the simulation
    assert np.mean(np.abs(bars) > bound) < 0.1
    tested = re.search(r'whiteness p-value.*?\n\| rate \| ([\d.]+)', (
        tmp_path / 'res/report.md').read_text(encoding='utf-8').split('## Residual tests')[1],
        re.DOTALL)
    assert float(tested[1]) > 0.05


def test_names_stay_names_in_every_file(folder, capsys):
    page = (folder / 'res/report.html').read_text(encoding='utf-8')
    assert '<script>alert' not in page
    assert '<img' not in page
    assert '\x1b' not in page
    assert '<script>alert(1)</script>' in ' '.join(Tags(page).words)
    titles = [a['text'] for f in data_of(page, 'figures') for a in f['layout']['annotations']]
    assert any('&lt;script&gt;' in t for t in titles)       # plotly has an HTML of its own
    text = (folder / 'res/report.md').read_text(encoding='utf-8')
    shown = MarkdownIt('commonmark', {'html': True}).enable('table').render(text)
    assert {t for t, _ in Tags(shown).tags} <= {
        'h1', 'h2', 'p', 'strong', 'code', 'pre', 'ul', 'li', 'table', 'thead', 'tbody', 'tr',
        'th', 'td'}
    assert '<script>alert(1)</script>' in ' '.join(Tags(shown).words)
    rows = list(csv.reader((folder / 'res/estimates.csv').open(encoding='utf-8')))
    assert not any(c[:1] in ('=', '@', '+') or '\n' in c for row in rows for c in row)
    assert load_estimate(folder / 'res/model.json').model.output_units == (EVIL,)
    assert main(['show', str(folder / 'res/model.json')]) == 0
    assert main(['info', str(folder / 'bag')]) == 0
    out = capsys.readouterr().out
    assert '\x1b' not in out
    assert '\u202e' not in out
    assert main(['init', str(folder / 'bag'), '-o', str(folder / 'guess.yaml'), '--force']) == 0
    guess = yaml.safe_load((folder / 'guess.yaml').read_text(encoding='utf-8'))
    assert list(guess) == ['/**']
    assert '\x1b' not in capsys.readouterr().err


def test_one_quantity_is_one_number(folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    main(['identify', 'bag', '--params', 'params.yaml', '--out', 'res', '--force', '--quiet',
          '--test-from', '9', '--json'])
    told = json.loads(capsys.readouterr().out)
    estimate = load_estimate('res/model.json')
    with Path('res/estimates.csv').open(encoding='utf-8') as stream:
        row, = csv.DictReader(stream)
    page = ' '.join(Tags(Path('res/report.html').read_text(encoding='utf-8')).words)
    report = Path('res/report.md').read_text(encoding='utf-8')
    for value, column, json_value in (
            (estimate.fit[0], 'fit_rate [%]', told['estimate']['fit'][0]),
            (estimate.held_out_fit[0], 'held_out_fit_rate [%]',
             told['estimate']['held_out_fit'][0])):
        assert float(row[column]) == json_value == value
    assert re.findall(r'identified from, simulated: fit (\S+) %', page) == [
        percent(estimate.fit[0])]
    assert re.findall(r'unseen data \[%\]\s+(\S+)', page) == [percent(told['test']['fit'][0])]
    assert re.search(r'\(shaded\), simulated: fit (\S+) %', page)[1].rstrip('.') == percent(
        told['test']['fit'][0])
    assert f'| rate | {percent(estimate.fit[0])} | {percent(estimate.held_out_fit[0])} |' in report


def test_page_without_plotly_is_drawn_and_says_so(monkeypatch):
    monkeypatch.setitem(sys.modules, 'plotly.offline', None)
    x = np.arange(5.0)
    figures = (Figure(Drawing((Axes([Curve(x, x, EVIL)], EVIL),)), EVIL, EVIL),
               Figure(Drawing((Axes([Curve(x, x)]),), wide=True)))
    page = to_html('t', [Section('Drawn', (Gallery(figures, 2),)),
                         Section('One window', (Explorer(),))])
    found = Tags(page)
    assert not any(t in ('script', 'img', 'b') for t, _ in found.tags)
    assert sum(t == 'svg' for t, _ in found.tags) == 3      # a wide one in two widths
    assert 'One window' not in page                         # nothing can be clicked
    assert 'pip install plotly' in page
    assert '\x1b' not in page


def test_windows_can_be_looked_at_one_by_one(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    assert main(['replay', 'bag', '--params', 'params.yaml', '--out', 'along', '--quiet']) == 0
    page = Path('along/report.html').read_text(encoding='utf-8')
    series = data_of(page, 'series') if 'id="series"' in page else pytest.skip('no plotly')
    with Path('along/estimates.csv').open(encoding='utf-8') as stream:
        rows = list(csv.DictReader(stream))
    report = Path('along/report.md').read_text(encoding='utf-8')
    assert len(series['windows']) == len(rows) == 3
    for number, (shown, row) in enumerate(zip(series['windows'], rows, strict=True), 1):
        told = dict(shown['facts'])
        assert told['fit [%]'] == percent(float(row['fit_rate [%]']))
        assert shown['grade'] == row['verdict']
        assert pole_text(complex(float(row['pole2_re [rad/s]']),
                                 float(row['pole2_im [rad/s]']))) in told['poles [rad/s]']
        assert re.search(rf'\| {number} \| .* \| {told["fit [%]"]} \|', report)
        for given in shown['figures']:
            frame = series['frames'][given['frame']]
            assert len(given['y']) == len(frame['data'])
            for trace, y in zip(frame['data'][1:], given['y'][1:], strict=True):
                assert 'x' in given or len(y) == len(trace['x'])
    assert re.findall(r'of which the model is, simulated: fit (\S+) %', page) == [
        percent(load_estimate('along/model.json').fit[0])]


def test_a_change_of_the_plant_is_told_once_with_its_fits():
    numbers = {'change_share': 0.4, 'change_fit_one_before': 45.2, 'change_fit_one_after': 69.7,
               'change_fit_two_before': 98.94, 'change_fit_two_after': 98.9}
    found = [Estimate(status=Status.CHANGED, settings=Settings(), statistics=numbers | {
        'change_share': share}, verdict=Verdict(grade=Grade.REJECT, reason='x', change_cost=cost))
        for share, cost in ((0.6, 20.0), (0.4, 53.7), (0.2, 30.0))]
    starts = np.array([2.0, 4.0, 6.0])
    windows = Windows(found, starts, starts + 10.0, np.full((3, 1), np.nan))
    change, = changes(windows)
    assert change.time == pytest.approx(8.0)
    assert change.words == (
        'The plant changed about 8.0 s after the start of the bag: one model fits 45.2 and '
        '69.7 % before and after, two models 98.9 and 98.9 %; one model of both misses 53.7 % '
        'of the motion that two do not.')
    strip, fits = window_figure(windows).drawing.panels[:2]        # words beside no words
    assert [[text for _, text in p.marks] for p in (strip, fits)] == [[''], ['change']]


@pytest.mark.parametrize(('status', 'command'), [
    (Status.CHANGED, "ctsid identify 'my bag' --params p.yaml --start 1.0 --duration 4.0"),
    (Status.NO_RESPONSE, "ctsid info 'my bag'"),
    (Status.UNEXPLAINED, "ctsid info 'my bag'"),
    (Status.TOO_SHORT, "ctsid identify 'my bag' --params p.yaml")])
def test_a_rejection_says_what_to_try_next(status, command):
    given = Estimate(status=status, settings=Settings(), statistics={'change_share': 0.4})
    run = Run('', ('my bag',), 'p.yaml', 'model.json', (1.0, 11.0), ('--start', '1'))
    assert headline(given, run).command == command
    assert headline(given, run).grade == 'REJECT'


def test_a_record_that_changes_is_divided_where_it_lies():
    """Times of a command count from the start of the recording, not of the record."""
    given = Estimate(status=Status.CHANGED, settings=Settings(),
                     statistics={'change_share': 0.4, 'change_record': 2.0})
    parts = tuple(Run('', ('bag',), 'p.yaml', '', (start, start + 5.0), (
        '--start', f'{start:g}', '--duration', '5')) for start in (1.0, 21.0))
    one = replace(parts[0], records=parts)
    # What was typed, in another order: `identify b a`, or a folder.
    bags = tuple(Run('', (bag,), 'p.yaml', '', (0.0, 5.0)) for bag in ('a', 'b'))
    several = Run('', ('b', 'a'), 'p.yaml', records=bags)
    assert headline(given, one).command == (
        'ctsid identify bag --params p.yaml --start 21.0 --duration 2.0')
    assert headline(given, several).command == (
        'ctsid identify b --params p.yaml --start 0.0 --duration 2.0')
    # All of it is of another plant.
    other = replace(given, statistics={'change_share': 0.0, 'change_record': 2.0})
    assert headline(other, one).command == (
        'ctsid identify bag --params p.yaml --start 21 --duration 5')
    assert headline(other, several).command == 'ctsid identify b --params p.yaml'


def test_a_time_in_which_gains_are_others_is_left_out():
    given = Estimate(status=Status.CHANGED, settings=Settings(), verdict=Verdict(
        grade=Grade.WEAK, reason='x', remedy=Remedy.SPLIT),
        statistics={'drift_from': 0.2, 'drift_to': 0.4, 'drift_record': 2.0, 'change_share': 0.3})
    one = Run('', ('bag',), 'p.yaml', '', (1.0, 11.0))
    several = replace(one, records=(replace(one, span=(0.0, 0.5)), one))
    assert headline(given, several).command == (
        'ctsid identify bag --params p.yaml --interval 1.0:3.0 --interval 5.0:11.0')


def test_advice_after_an_interval_is_on_that_interval(folder):
    found = load_estimate(folder / 'res/model.json')
    weak = replace(found, verdict=replace(found.verdict, grade=Grade.WEAK, remedy=Remedy.EXCITE))
    args = Namespace(command_line='', bag=['bag'], params='p.yaml', start=2.0, duration=0.5)
    assert headline(weak, run_of(args)).command == (
        'ctsid advise bag --params p.yaml --start 2 --duration 0.5')


def test_advice_after_intervals_is_on_what_they_span(folder):
    found = load_estimate(folder / 'res/model.json')
    args = Namespace(command_line='', bag=['bag'], params='p.yaml', start=0.0, duration=math.inf,
                     interval=[span('12345.6:12400.1')])
    for more, words, records in (
            ((), '--start 12345.6 --duration 54.5', '--start 12345.6 --duration 54.5'),
            ([span('2:9')], '--start 2 --duration 12398.1',
             '--interval 12345.6:12400.1 --interval 2:9')):
        args.interval += more
        for remedy, command in ((Remedy.EXCITE, f'advise bag --params p.yaml {words}'),
                                (Remedy.SETTING, f'identify bag --params p.yaml {records}'),
                                (Remedy.LONGER, 'identify bag --params p.yaml')):
            weak = replace(found, verdict=replace(found.verdict, grade=Grade.WEAK, remedy=remedy))
            assert headline(weak, run_of(args)).command == f'ctsid {command}'
    args.params = ''
    weak = replace(found, verdict=replace(found.verdict, grade=Grade.WEAK, remedy=Remedy.SETTING))
    assert headline(weak, run_of(args)).command == 'ctsid init bag -o params.yaml'


def test_a_gain_that_is_not_known_is_said_to_be_so(folder):
    found = load_estimate(folder / 'res/model.json')
    assert 'not even its sign' not in str(gain_section(found.model, found.covariance).parts)
    vague = replace(found.covariance, root=1e4 * found.covariance.root)
    assert 'not even its sign' in str(gain_section(found.model, vague).parts)


def test_a_gain_that_is_known_to_be_nothing_is_not_said_to_be_unknown():
    """From a torque to a rate there is none, beside what the rate does in between."""
    A = np.array([[-0.5, -5.0], [5.0, -0.5]])
    rate = StateSpace(A, np.array([[1.0], [0.0]]), np.array([[1.0, -0.1 + 1e-5]]))
    root = np.zeros((1, 10))
    root[0, 4:6] = 2e-3
    known = Covariance(root, 2, 1, 1)
    assert gain_deviation(known, rate)[0, 0] > abs(rate.dc_gain[0, 0])
    assert 'not even its sign' not in str(gain_section(rate, known).parts)


def test_a_pole_at_its_bound_is_told_as_an_integrator():
    """It was `-8.3e-08` rad/s, with a time constant of 139 days of a minute's record."""
    rng, h = np.random.default_rng(0), 0.02
    t = h * np.arange(3000)
    u = np.repeat(rng.choice([0.0, 1.0], len(t) // 50), 50)
    y = h * np.concatenate(([0.0], np.cumsum(u[:-1]))) + 0.02 * rng.standard_normal(len(t))
    found = identify(Record.from_arrays(t, u, t, y, input_hold='zoh'), Settings(order=1))
    assert -1e-5 / 59.0 < found.model.poles[0].real < 0.0             # as it was found
    table = next(p for p in model_section(found, '').parts if isinstance(p, Table))
    assert table.rows[0][0] == '0 (integrator)'
    frequency, hertz, _, constant = table.rows[0][2:]
    assert frequency.startswith('0 ± ')
    assert (hertz, constant) == ('0', '-')
    assert told(-1e-3 + 1e-8j, found) == -1e-3
    compared = pole_section([Contender('one', found)], 'model').parts[0]
    assert compared.rows[0][1] == '0 (integrator)'


def test_what_integrates_is_told_by_how_fast_it_moves():
    """From a torque to angle and rate: the angle has no gain, and the rate has one."""
    A = np.array([[-1e-6, 1.0], [0.0, -2.0]])
    plant = StateSpace(A, np.array([[0.0], [3.0]]), np.array([[1.0, 0.0], [0.0, 1.0]]),
                       input_names=('u',), output_names=('angle', 'rate'))
    root = np.zeros((1, Covariance.entry_count(2, 1, 2)))
    root[0, 0] = 1e-4
    table, said = gain_section(plant, Covariance(root, 2, 1, 2)).parts
    assert 'cannot be told from 0' in said
    assert [row[1].split()[0] for row in table.rows] == ['1.500', '1.500']
    assert [row[1].endswith(' /s') for row in table.rows] == [True, False]
    # Of two poles that stand for one neither is known, but what both do at rest.
    pair = StateSpace(np.diag([-3.3, -5.0]), np.array([[0.1], [9.9]]), np.array([[1.0, 1.0]]))
    own = np.zeros((1, Covariance.entry_count(2, 1, 1)))
    own[0, [0, 4]] = 2.6, -2.6 * 0.1 / 3.3
    found = Covariance(own, 2, 1, 1)
    assert pole_deviation(found, pair)[0] > 1.0
    assert gain_deviation(found, pair)[0, 0] < 1e-6
    assert len(gain_section(pair, found).parts) == 1
    root[0, 0] = 1e-7
    parts = gain_section(plant, Covariance(root, 2, 1, 2)).parts
    assert not any('cannot be told from 0' in str(part) for part in parts)


@pytest.mark.parametrize(('status', 'said'), [(Status.UNEXPLAINED, True),
                                              (Status.CHANGED, False)])
def test_better_signals_are_the_way_out_of_wrong_ones_only(status, said):
    run = Run('', ('bag',), 'p.yaml', '', (0.0, 10.0))
    found = headline(Estimate(status=status, settings=Settings()), run,
                     better=Better(('/cmd x -> /imu y (99 % explained)',)))
    assert ('/cmd x -> /imu y (99 % explained)' in found.purpose) is said
    assert ('move the inputs more' in found.purpose) is said
    assert (found.command == 'ctsid init bag -o other.yaml') is said
    kept = headline(Estimate(status=status, settings=Settings()), run, better=Better(
        ('/cmd x -> /imu y (99 % explained)',), ('--output', '/imu y')))
    assert 'move the inputs more' not in kept.purpose
    assert (kept.command == "ctsid init bag -o other.yaml --output '/imu y'") is said


def test_what_a_report_needs_is_asked_for_before_the_work(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    monkeypatch.setattr('ctsid_ros.replay.results.find_spec', lambda name: None)
    assert main(['identify', 'bag', '--params', 'params.yaml', '--out', 'none', '--quiet']) == 1
    assert 'pip install jinja2 matplotlib' in capsys.readouterr().err
    assert not Path('none').exists()


@pytest.mark.slow
def test_whole_page_without_plotly(folder, monkeypatch):
    monkeypatch.chdir(folder)
    monkeypatch.setitem(sys.modules, 'plotly.offline', None)
    code = main(['identify', 'bag', '--params', 'params.yaml', '--out', 'static', '--quiet'])
    assert code == 0
    page = Path('static/report.html').read_text(encoding='utf-8')
    found = Tags(page)
    assert not any(t in ('script', 'img') for t, _ in found.tags)
    assert sum(t == 'svg' for t, _ in found.tags) >= 9
    assert '\x1b' not in page


@pytest.mark.slow
def test_compare_and_simulate_write_pages_too(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    assert main(['compare', 'bag', '--params', 'params.yaml', '--out', 'compared',
                 '--quiet']) in (0, 3)
    page = Path('compared/report.html').read_text(encoding='utf-8')
    for method in ('hd-pbsid', 'ct-pbsid', 'gobf'):
        assert f'{method}: fit ' in page
    assert '3 methods on bag' in page
    assert '\x1b' not in capsys.readouterr().out


def test_simulate_writes_a_page_with_its_numbers(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    words = ['simulate', 'res/model.json', 'bag', '--horizon', '1', '10', '--out', 'simulated']
    assert main([*words, '--json', '--quiet', '--force']) == 0
    told = json.loads(capsys.readouterr().out)
    page = Path('simulated/report.html').read_text(encoding='utf-8')
    shown = ' '.join(Tags(page).words)
    assert re.search(r'These data, simulated: fit (\S+) %', shown)[1] == percent(told['fit'][0])
    assert re.search(r'simulation fit \[%\]\s+(\S+)', shown)[1] == percent(told['fit'][0])
    assert sorted(p.name for p in Path('simulated').iterdir()) == ['report.html', 'report.md']
    assert main([*words, '--quiet']) == 1
    assert 'add --force' in capsys.readouterr().err


@pytest.mark.parametrize('suffix', ['.svg', *slow('.pdf', '.png')])
def test_models_are_plotted_into_files(folder, suffix, capsys, tmp_path):
    path = tmp_path / f'models{suffix}'
    model = str(folder / 'res/model.json')
    assert main(['plot', model, model, '-o', str(path)]) == 0
    assert str(path) in capsys.readouterr().out
    head = path.read_bytes()[:5]
    assert head == {'.svg': b'<?xml', '.pdf': b'%PDF-', '.png': b'\x89PNG\r'}[suffix]
    assert main(['plot', model, '-o', str(path)]) == 1
    assert 'add --force' in capsys.readouterr().err
    assert main(['plot', model, '-o', str(tmp_path / 'models.gif')]) == 1
    assert '.pdf, .png, .svg' in capsys.readouterr().err


def test_a_megabyte_of_name_is_cut():
    long = 'x' * 10**6 + '<b>'
    sections = [Section(long, (long, Bullets((long,)), Command(long),
                               Table((long, 'b'), ((long, long),))))]
    first = Headline('GOOD', long, long, ((long, long),))
    assert len(to_text(sections)) < 10_000
    assert len(to_markdown(long, sections, first)) < 20_000
    page = to_html(long, sections, first)
    assert len(page.encode()) < MOST_BYTES
    assert 'x' * 2000 not in page[:page.find('<script')]


@pytest.mark.parametrize('text', [
    '<script>alert(1)</script>', '`<b>', '``<b>`', r'\`<b>`', '[a](javascript:b)', '![a](b)',
    '&lt;b&gt;', '# head', '- item', '*a* _b_ __c__', 'a | b', '`a` <i> `b`', '<http://a.b>',
    '[a]: b', '> quote'])
def test_markdown_shows_what_was_written(text):
    shown = Tags(MarkdownIt('commonmark', {'html': True}).render(markdown(text)))
    assert {t for t, _ in shown.tags} <= {'p', 'code'}
    assert ''.join(shown.words).strip().replace('`', '') == text.replace('`', '')


def test_control_characters_are_seen():
    assert printable('a\x1b[2Jb\n\tc\u202e\x85') == r'a\x1b[2Jb c\u202e\x85'
    assert lines('a\nb\x07') == 'a\nb\\x07'
    assert len(printable('é' * 10**6)) < 2000


# --- drawings


def sampled(count: int = 6000, delay: float = 0.0) -> Record:
    rng = np.random.default_rng(5)
    t = np.arange(count) * 0.02
    u = rng.standard_normal((count, 2))
    u[:, 1] += 0.5 * u[:, 0]
    plant = replace(TRUTH, B=np.hstack([TRUTH.B, -0.5 * TRUTH.B]), D=np.zeros((1, 2)),
                    delay=(delay, 0.0), x_trim=np.zeros(2), y_trim=np.zeros(1),
                    input_names=('a', 'b'), input_units=('', ''))
    held = Signal(t, u, 'zoh')
    y = plant.simulate((held,), t)
    return Record((held,), (Signal(t, y + 0.001 * rng.standard_normal(y.shape)),), 0.0, t[-1])


def test_spectra_tell_the_response_of_correlated_inputs_apart():
    found = spectra(sampled())
    assert found is not None
    near = (found.omega > 2.0) & (found.omega < 15.0)
    true = TRUTH.frequency_response(found.omega[near])[:, 0, 0]
    np.testing.assert_allclose(np.abs(found.response[near, 0, 0] / true), 1.0, atol=0.15)
    np.testing.assert_allclose(np.abs(found.response[near, 0, 1] / true), 0.5, atol=0.1)
    assert (found.coherence[near] > 0.9).all()
    assert spectra(sampled(100)) is None


def test_coherence_of_nothing_is_low():
    record = sampled()
    noise = np.random.default_rng(1).standard_normal((6000, 1))
    found = spectra(replace(record, outputs=(replace(record.outputs[0], values=noise),)))
    assert np.median(found.coherence) < 0.3


def test_dots_of_phase_lie_by_the_curve_however_late_the_input():
    record = sampled(delay=0.5)
    model = replace(TRUTH, B=np.hstack([TRUTH.B, -0.5 * TRUTH.B]), D=np.zeros((1, 2)),
                    delay=(0.5, 0.0), input_names=('a', 'b'), input_units=('', ''))
    phase = bode_figures({'model': (model, None)}, [(1.0, 10.0), None],
                         spectra(record))[0].drawing.panels[1]
    dots, line = phase.curves
    own = np.interp(dots.x, line.x, line.y)
    near = dots.x < 10.0
    assert np.max(np.abs(dots.y - own)[near]) < 60.0
    assert line.y[np.searchsorted(line.x, 10.0)] < -360.0
    low, high = phase.y_limits
    assert low % phase.step == high % phase.step == 0.0


def test_a_region_larger_than_the_drawing_is_not_drawn_but_told():
    def drawn(std: float):
        root = np.zeros((1, Covariance.entry_count(TRUTH.n, TRUTH.nu, TRUTH.ny)))
        root[0, :TRUTH.A.size] = std * np.eye(TRUTH.n).ravel()      # all poles alike
        return pole_figure({'a': (TRUTH, Covariance(root, TRUTH.n, TRUTH.nu, TRUTH.ny))})

    near, far = drawn(0.01), drawn(1e3)
    assert len(near.drawing.panels[0].curves) == 1 + TRUTH.n
    assert 'not shown' not in near.caption
    assert len(far.drawing.panels[0].curves) == 1
    assert f'{TRUTH.n} of {TRUTH.n} regions of 95 % confidence are larger' in far.caption


def test_regions_hold_what_the_covariance_says():
    covariance = np.array([[0.04, 0.01], [0.01, 0.09]])
    outline = region(-1.0 + 3.0j, covariance, 1)
    away = np.stack((outline.x + 1.0, outline.y - 3.0))
    np.testing.assert_allclose(np.einsum('ik,ij,jk->k', away, np.linalg.inv(covariance), away),
                               5.991, rtol=1e-9)
    real = region(-2.0 + 0.0j, np.diag([0.01, 0.0]), 1)
    assert np.ptp(real.y) == 0.0
    assert np.ptp(real.x) == pytest.approx(2 * 1.96 * 0.1)


def test_correlation_is_the_sum_it_says():
    rng = np.random.default_rng(2)
    a, b = rng.standard_normal((2, 30))
    found = correlation(a, b, 30)
    assert found[3] == pytest.approx(a[:-3] @ b[3:])
    assert found[-4] == pytest.approx(a[4:] @ b[:-4])


def test_fits_by_horizon_fall_to_that_of_the_simulation():
    record = sampled(2000)
    model = replace(TRUTH, B=np.hstack([TRUTH.B, -0.5 * TRUTH.B]), D=np.zeros((1, 2)),
                    delay=(0.0, 0.0), x_trim=np.zeros(2), y_trim=np.zeros(1),
                    input_names=('a', 'b'), input_units=('', ''))
    fits = horizon_fits(model, record)
    assert list(fits) == pytest.approx([0.02 * k for k in (1, 2, 5, 10, 20, 50, 100, 200)])
    assert all(f[0] > 90.0 for f in fits.values())


def pixels_of(curves: list[Curve], path: Path) -> list[int]:
    """Return how many pixels of a drawing have the colour of each curve."""
    from matplotlib.colors import to_rgb
    from matplotlib.image import imread

    write_drawings(path, [Axes(curves, x_limits=(0.0, 1.0))])
    pixels = imread(path)[60:-90, 120:-40, :3].reshape(-1, 3)
    return [int(np.sum(np.abs(pixels - to_rgb(COLORS[c.color])).max(axis=1) < 0.02))
            for c in curves]


@pytest.mark.parametrize('count', [2, MOST_MODELS, *slow(3)])
def test_of_crosses_that_agree_every_one_is_seen(count, tmp_path):
    at = np.array([0.3, 0.7])
    seen = pixels_of([Curve(at, at, f'm{k}', k, 'cross', width=over(k, range(count)))
                      for k in range(1, count + 1)], tmp_path / 'same.png')
    assert min(seen) > 0.3 * max(seen) > 0


@pytest.mark.parametrize('count', [3, *slow(2, MOST_MODELS)])
def test_of_lines_that_agree_every_one_is_seen(count, tmp_path):
    x = np.linspace(0.0, 1.0, 400)
    curves = [Curve(x, np.sin(6.0 * x), f'm{k}', k, layer=(k, count), width=2.0)
              for k in range(1, count + 1)]
    seen = pixels_of(curves, tmp_path / 'same.png')
    assert min(seen) > 0.3 * max(seen) > 0
    dashes = [trace['line'].get('dash') for trace in figure(Drawing((Axes(curves),)))['data']]
    assert len(set(dashes)) == count


def test_one_number_along_a_logarithmic_axis_has_few_numbers_beside_it():
    axis = figure(Drawing((Axes([Curve(np.array([0.1]), np.array([94.0]), 'fit', 1, 'both')],
                                x_log=True),)))['layout']['xaxis']
    assert sum(0.01 <= tick <= 1.0 for tick in axis['tickvals']) < 10
