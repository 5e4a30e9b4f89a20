# SPDX-License-Identifier: Apache-2.0
"""What reports show is right, and every rendering holds it."""

from __future__ import annotations

from dataclasses import replace
from html.parser import HTMLParser
from io import StringIO
import math
import re
from threading import Event, active_count
import xml.etree.ElementTree as ET

from flights import TRUTH
import numpy as np
import pytest
import scipy.signal

from ctsid_core.model.covariance import Covariance, Entries
from ctsid_core.model.estimate import Choice, Estimate, Status
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.validation import Validation
from ctsid_core.model.verdict import Excitation, Grade, Verdict
from ctsid_core.sequence.tracking import Tracked
from ctsid_core.settings import Settings
from ctsid_ros.progress import progress, time_left, working
from ctsid_ros.replay.replay import Result
from ctsid_ros.report.document import Bullets, Figure, Section, to_html, to_markdown, to_text
from ctsid_ros.report.figures import (
    bode_figures,
    output_figures,
    response_of,
    response_std,
    supported_band,
    track_curve,
    track_figures,
)
from ctsid_ros.report.sections import (
    advice_section,
    bode_section,
    model_section,
    truth_section,
    window_section,
)
from ctsid_ros.report.svg import Axes, Curve, draw, linear_ticks, log_ticks
from ctsid_ros.report.tables import Table, join, number, percent, plus_minus, pole_text, thinned
from ctsid_ros.report.tracks import Mode, Track, match, modes, tracks

GOOD = Verdict(grade=Grade.GOOD, reason='Every test is passed.',
               excitation=(Excitation('torque', 0.1, 30.0, 12.0, 1.0, 0.01),),
               error=np.array([0.05]), coloured_error=np.array([0.003]),
               held_out_error=np.array([0.06]))


def estimate(model: StateSpace | None = TRUTH, std: float = 0.1, start: float = 0.0,
             **more) -> Estimate:
    given = {'status': Status.OK, 'settings': Settings(), 'model': model,
             'pole_std': np.full(model.n if model else 0, std), 'fit': np.array([95.0]),
             'held_out_fit': np.array([93.0]), 'verdict': GOOD, 'start_ns': round(start * 1e9),
             'end_ns': round((start + 5) * 1e9)}
    return Estimate(**(given | more))


def shifted(model: StateSpace, by: float) -> StateSpace:
    return replace(model, A=model.A + by * np.eye(model.n))


# --- words


@pytest.mark.parametrize(('value', 'digits', 'text'), [
    (0.0, 4, '0'), (1.0, 4, '1.000'), (-12.3456, 4, '-12.35'), (9.9996, 4, '10.00'),
    (99.996, 4, '100.0'), (123456.0, 4, '123456'), (1e7, 3, '1.00e+07'), (2e-5, 2, '2.0e-05'),
    (math.nan, 4, '-'), (math.inf, 4, 'inf'), (-math.inf, 4, '-inf'), (0.00123, 2, '0.0012')])
def test_numbers_have_significant_digits(value, digits, text):
    assert number(value, digits) == text


def test_deviations_stand_beside_their_numbers():
    assert plus_minus(12.3456, 0.04321) == '12.35 ± 0.043'
    assert plus_minus(12.3456, 0.0) == plus_minus(12.3456, math.nan) == '12.35'


def test_bode_bands_are_two_standard_deviations_and_no_wider_than_a_picture():
    entries = Entries(*(np.ones((1, *shape)) * size for shape, size in (
        ((TRUTH.n,) * 2, 0.0), (TRUTH.B.shape, 0.0), (TRUTH.C.shape, 0.0), ((1, 1), 0.001),
        ((1,), 0.0))))
    known = Covariance(np.hstack([e.reshape(1, -1) for e in entries]), TRUTH.n, 1, 1)
    omega = np.array([1.0, 5.0, 1e6])
    response = TRUTH.frequency_response(omega)[:, 0, 0]
    gain, phase = (std[:, 0, 0] for std in response_std(TRUTH, omega, known))
    np.testing.assert_allclose(gain, 20 / math.log(10) * np.abs((0.001 / response).real))
    np.testing.assert_allclose(phase, np.degrees(np.abs((0.001 / response).imag)))
    plain, banded = (bode_figures(TRUTH, (), None, c) for c in (None, known))
    assert [f.svg.count('opacity="0.2"') for f in (*plain, *banded)] == [0, 0, 1, 1]
    row = to_text([bode_section(TRUTH, 5, known)]).splitlines()[-1]
    assert row.count('±') == 2


def test_fits_poles_and_lists():
    assert [percent(v) for v in (97.649, math.nan, -math.inf, -12.0)] == [
        '97.6', '-', '< -999', '-12.0']
    assert pole_text(-1.5 + 3j) == pole_text(-1.5 - 3j) == '-1.500 ± 3.000j'
    assert pole_text(complex(-2)) == '-2.000'
    assert [join(w) for w in ([], ['a'], ['a', 'b', 'c'])] == ['', 'a', 'a, b and c']


TABLE = Table(('name', 'value'), (('a|b', '1.0'), ('<long>', '22.0')), ('name',))


def test_table_in_three_renderings():
    assert TABLE.text(0).splitlines() == [
        'name    value', '──────  ─────', 'a|b       1.0', '<long>   22.0']
    assert TABLE.markdown().splitlines() == [
        '| name | value |', '| --- | ---: |', '| a\\|b | 1.0 |', '| <long> | 22.0 |']
    root = ET.fromstring(TABLE.html().replace('class=wide', 'class="wide"').replace(
        'class=l', 'class="l"'))
    assert [[cell.text for cell in row] for row in root.iter('tr')] == [
        ['name', 'value'], ['a|b', '1.0'], ['<long>', '22.0']]


def test_rows_are_thinned_evenly_with_both_ends():
    rows = [(str(i),) for i in range(101)]
    assert [r[0] for r in thinned(rows, 5)] == ['0', '25', '50', '75', '100']
    assert [r[0] for r in thinned(rows, 3, keep=7)] == ['0', '7', '50', '100']
    assert thinned(rows[:4], 5) == tuple(rows[:4])


class Checker(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.texts: list[str] = []

    def handle_starttag(self, tag, attrs):
        if tag != 'meta':
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_startendtag(self, tag, attrs):
        pass

    def handle_data(self, data):
        self.texts.append(data)


def test_document_in_three_renderings():
    sections = [
        Section('First', ('A `word` & more.', TABLE, Bullets(('one', 'two <b>')))),
        Section('Detail', ('hidden on the terminal',), brief=False),
        Section('Empty', ()),
        Section('Drawn', (Figure('<svg></svg>', 'a caption'),))]
    text, markdown = to_text(sections), to_markdown('Title', sections)
    assert text.startswith('First\n  A `word` & more.\n  name')
    assert 'Detail' not in text
    assert '  - two <b>' in text
    assert markdown.startswith('# Title\n\n## First\n\nA `word` & more.\n\n| name |')
    assert '## Detail' in markdown
    assert 'Empty' not in markdown + text
    assert 'svg' not in markdown + text
    checker = Checker()
    checker.feed(to_html('Title <1>', sections))
    assert checker.open == []
    joined = ' '.join(checker.texts)
    for words in ('Title <1>', 'hidden on the terminal', 'two <b>', 'a caption', '& more.'):
        assert words in joined


# --- drawings


def drawing(axes: Axes) -> ET.Element:
    text = draw(axes)
    assert 'nan' not in text
    assert 'inf' not in text
    return ET.fromstring(text)


def path_points(element: ET.Element) -> np.ndarray:
    return np.array([[float(v) for v in p.split()] for p in re.split('[ML]', element.get('d'))
                     if p.strip('Z ')])


def test_curve_is_where_its_values_are():
    x, y = np.array([0.0, 1.0, 3.0, 4.0]), np.array([0.0, 10.0, 5.0, -10.0])
    (path,) = drawing(Axes([Curve(x, y)])).iter('path')
    points = path_points(path)
    across, up = points.T
    np.testing.assert_allclose((across - across[0]) / (across[-1] - across[0]), x / 4, atol=1e-3)
    np.testing.assert_allclose((up[1] - up) / (up[1] - up[-1]), (10 - y) / 20, atol=1e-2)
    x = np.array([1.0, 10.0, 100.0])
    (path,) = drawing(Axes([Curve(x, x)], x_log=True, y_log=True)).iter('path')
    for values in path_points(path).T:
        assert values[1] == pytest.approx((values[0] + values[2]) / 2, abs=0.1)


def test_long_curves_keep_their_peaks_and_gaps():
    y = np.sin(np.arange(100_000) / 5000)
    y[54_321], y[70_000] = 7.0, math.nan
    (path,) = drawing(Axes([Curve(np.arange(100_000.0), y)])).iter('path')
    points = path_points(path)
    assert len(points) < 2000
    up = points[:, 1]
    assert np.sum(up < up.min() + 0.2) == 1
    y = np.array([1.0, 2.0, math.nan, 4.0, math.inf, 6.0, 7.0])
    (path,) = drawing(Axes([Curve(np.arange(7.0), y)])).iter('path')
    assert path.get('d').count('M') == 3


@pytest.mark.parametrize('axes', [
    Axes([]), Axes([Curve(np.empty(0), np.empty(0))]), Axes([Curve(np.ones(3), np.ones(3))]),
    Axes([Curve(np.array([1.0]), np.array([2.0]), kind='both', low=np.array([1.0]),
                high=np.array([3.0]))], y_log=True),
    Axes([Curve(np.arange(3.0), np.array([-1.0, 0.0, math.nan]))], y_log=True, shade=(0.5, 9.0),
         levels=[1.0, 2.0], title='a < b & "c"')])
def test_odd_drawings_are_still_drawings(axes):
    assert drawing(axes).tag == 'svg'


@pytest.mark.parametrize(('low', 'high'), [(0.0, 1.0), (-3.7, 12.9), (1e-6, 3e-6), (5e8, 9e8)])
def test_ticks_are_round_and_inside(low, high):
    ticks = np.array(linear_ticks(low, high))
    assert 3 <= len(ticks) <= 8
    assert (ticks >= low - 1e-9 * (high - low)).all()
    assert (ticks <= high + 1e-9 * (high - low)).all()
    step = ticks[1] - ticks[0]
    np.testing.assert_allclose(np.diff(ticks), step)
    assert any(math.isclose(step / 10 ** math.floor(math.log10(step)), k)
               for k in (1, 2, 5, 10))
    assert log_ticks(0.9, 110.0) == pytest.approx([1, 2, 5, 10, 20, 50, 100])
    assert log_ticks(1e-4, 1e4) == pytest.approx([10.0 ** k for k in range(-4, 5)])


def test_response_is_that_of_scipy_with_a_continuous_phase():
    omega = np.geomspace(0.01, 100, 200)
    late = replace(TRUTH, delay=(0.3,))
    gain, phase = response_of(late, omega, 0, 0)
    _, magnitude, angle = scipy.signal.bode(([22.5], [1.0, 3.0, 11.25]), omega)
    np.testing.assert_allclose(gain, magnitude)
    np.testing.assert_allclose(phase, angle - np.degrees(0.3 * omega), atol=1e-6)
    negative = replace(TRUTH, B=-TRUTH.B)
    assert response_of(negative, omega, 0, 0)[1][0] == pytest.approx(-180, abs=1)


def test_supported_band_ends_where_noise_begins():
    rng = np.random.default_rng(0)
    times = np.arange(20_000) / 100
    low_pass = scipy.signal.butter(4, 2.0, fs=100, output='sos')
    signal = scipy.signal.sosfilt(low_pass, rng.standard_normal(20_000))
    y = signal + 0.02 * rng.standard_normal(20_000)
    found = Validation(times=times, y=y[:, np.newaxis], y_hat=signal[:, np.newaxis],
                       fit=np.zeros(1), vaf=np.zeros(1), x0=np.zeros(1))
    low, high = supported_band(found)
    # The filter falls to the noise's 0.02 at 2 Hz * 50^(1/4)
    assert low == pytest.approx(2 * math.pi / 200, rel=0.01)
    assert high == pytest.approx(2 * math.pi * 2.0 * 50 ** 0.25, rel=0.15)
    assert supported_band(replace(found, y_hat=0 * found.y_hat)) is None
    few = replace(found, times=times[:50], y=found.y[:50], y_hat=found.y_hat[:50])
    assert supported_band(few) is None


def test_figures_of_a_diverged_simulation_are_drawings():
    times = np.arange(100.0)
    y = np.sin(times)[:, np.newaxis]
    wild = np.exp(np.minimum(times, 800) * 5)[:, np.newaxis]
    wild[-1] = math.inf
    found = Validation(times=times, y=y, y_hat=wild, fit=np.array([-math.inf]), vaf=np.zeros(1),
                       x0=np.zeros(2))
    for figure in (*output_figures(TRUTH, found, 0.0, 'x'), *bode_figures(TRUTH)):
        assert 'nan' not in figure.svg
        ET.fromstring(figure.svg)


# --- poles


def test_match_pairs_the_most_alike():
    assert match([-2, -20, -1 + 30j], [-1.1 + 31j, -19, -5, -2.1]) == {0: 3, 1: 1, 2: 0}
    assert match([-1, -1.1], [-1.05]) == {1: 0}
    assert match([], [-1]) == {}


def test_modes_are_poles_with_pairs_as_one():
    model = StateSpace(np.diag([-2.0, 0.0]), np.ones((2, 1)), np.ones((1, 2)))
    assert [(m.pole, m.std) for m in modes(model, np.array([0.1, 0.2]))] == [(0, 0.1), (-2, 0.2)]
    (pair,) = modes(TRUTH)
    assert pair.pole == pytest.approx(-1.5 + 3j)
    assert pair.frequency == pytest.approx(math.sqrt(11.25))
    assert pair.damping == pytest.approx(1.5 / math.sqrt(11.25))
    assert math.isnan(pair.std)


def test_tracks_join_windows_and_end_where_a_mode_is_lost():
    slow = StateSpace([[-1.0]], [[1.0]], [[1.0]])
    two = StateSpace(np.diag([-1.05, -10.0]), np.ones((2, 1)), np.ones((1, 2)))
    rejected = estimate(None, status=Status.NO_EXCITATION)
    found = tracks([estimate(slow), estimate(two), rejected, estimate(slow), estimate(two)])
    assert [t.windows for t in found] == [(0, 1, 3, 4), (1,), (4,)]
    assert [m.pole for m in found[0].modes] == pytest.approx([-1, -1.05, -1, -1.05])


def test_track_figures_show_every_window_and_the_truth():
    estimates = [estimate(shifted(TRUTH, 0.1 * i), start=i) for i in range(5)]
    figures = track_figures(estimates, np.arange(5.0), TRUTH)
    assert len(figures) == 2
    for figure in figures:
        root = ET.fromstring(figure.svg)
        assert len(list(root.iter('circle'))) == 5
        assert figure.svg.count('stroke-dasharray="5 4"') == 1
    assert track_figures([estimate(None, status=Status.GAPS)], np.zeros(1)) == []


def test_bands_are_two_standard_deviations():
    real, pair = Mode(complex(-2), 0.1), Mode(-1 + 3j, 0.1)
    size = math.sqrt(10)
    curve = track_curve(Track((0, 2), (real, pair)), np.array([5.0, 6.0, 7.0]), 0, frequency=True)
    np.testing.assert_allclose(curve.x, [5.0, 7.0])
    np.testing.assert_allclose(curve.y, [2.0, size])
    # The variance of a pair's pole has two directions, of which one changes its magnitude.
    np.testing.assert_allclose(curve.high - curve.y, [0.2, 0.2 / math.sqrt(2)])
    curve = track_curve(Track((1,), (pair,)), np.arange(3.0), 0, frequency=False)
    np.testing.assert_allclose(curve.y - curve.low, 0.2 / math.sqrt(2) / size)


# --- sections


def test_truth_section_counts_deviations():
    near, far = estimate(shifted(TRUTH, 0.2), 0.1), estimate(shifted(TRUTH, 0.5), 0.1)
    text = to_text([truth_section(near, [], TRUTH)])
    assert re.search(r'-1\.500 ± 3\.000j\s+-1\.300 ± 3\.000j\s+0\.10\s+0\.20\s+2\.0\n', text)
    assert 'All 1 true poles and pairs are identified; the largest error is 2.0' in text
    results = [Result(Tracked(estimate(shifted(TRUTH, by))), np.array([90.0]))
               for by in (0, 0.1, 0.9)]
    text = to_text([truth_section(far, results, TRUTH)])
    assert 'median of 3 windows' in text
    assert '-1.400 ± 3.000j' in text
    assert '0 of 1 true poles and pairs are identified within 3' in text
    more = StateSpace(np.diag([-3.0, -7.0]), np.ones((2, 1)), np.ones((1, 2)))
    text = to_text([truth_section(estimate(more), [], TRUTH)])
    # Of -3 and -7 the first is nearer to the true pair.
    assert 'The model has more poles than the truth: -7.00 (std 0.10).' in text


def test_windows_are_told_with_what_became_of_them():
    gaps = estimate(None, status=Status.GAPS, fit=np.empty(0), start=3.0)
    results = [Result(Tracked(estimate(start=2.0)), np.array([91.0])),
               Result(Tracked(gaps), np.array([math.nan]))]
    lines = to_text([window_section(results, 0)]).splitlines()
    assert lines[3].split() == ['1', '2.0', '7.0', 'GOOD', '2', '95.0', '91.0', '-1.50', '±',
                                '3.00j']
    assert lines[4].split() == ['2', '3.0', '8.0', 'REJECT', '-', '-', '-', 'none:', 'GAPS']
    many = to_text([window_section([results[0]] * 300, 0)])
    assert '40 of 300 windows are shown' in many


def test_a_rejected_model_is_shown_as_such():
    rejected = estimate(None, status=Status.UNEXPLAINED, rejected_model=TRUTH,
                        pole_std=np.full(2, 0.3), fit=np.array([12.0]))
    text = to_text([model_section(rejected, 'Model')])
    assert 'REJECT. No linear model explains' in text
    assert 'REJECTED (UNEXPLAINED)' in text
    assert 'response std [%]' in text
    assert 'docs/glossary.md' in text
    assert '-1.500 ± 3.000j' in text
    assert '12.0' in text
    text = to_text([model_section(estimate(None, status=Status.TOO_SHORT), 'Model')])
    assert 'too few samples' in text


@pytest.mark.parametrize(('given', 'words'), [
    (estimate(), None),
    (estimate(held_out_fit=np.array([60.0])), 'longer'),
    (estimate(settings=Settings(max_order=2)), 'reached `max_order`'),
    (estimate(std=9.0), 'hardly determined'),
    (estimate(shifted(TRUTH, 5.0)), 'unstable')])
def test_advice_fits_the_outcome(given, words):
    text = to_markdown('', [advice_section(given, np.empty(0), ())])
    if words is None:
        assert 'dead time' in text  # all that is left to try
        assert text.count('\n- ') == 1
    else:
        assert words in text


def test_bode_table_has_a_row_per_frequency():
    text = to_text([bode_section(TRUTH, 5)])
    last = [float(v) for v in text.splitlines()[-1].split()]
    response = TRUTH.frequency_response([last[0]])[0, 0, 0]
    assert last[2] == pytest.approx(20 * math.log10(abs(response)), abs=0.1)
    assert last[3] == pytest.approx(math.degrees(np.angle(response)), abs=0.1)


def test_lines_of_progress_are_told_on_the_stream_when_time_goes_by(monkeypatch, capsys):
    clock = iter(range(1000))
    monkeypatch.setattr('ctsid_ros.progress.monotonic', lambda: float(next(clock)))
    with progress('working') as advance:
        for i in range(0, 101):
            advance(i / 100, f'at {i}')
    out, err = capsys.readouterr()
    assert out == ''
    assert err.splitlines() == [f'working: {10 * i} %, at {10 * i}' for i in range(1, 11)]
    with progress('working', quiet=True) as advance:
        advance(1.0, '')
    assert capsys.readouterr() == ('', '')


def test_bar_of_progress_is_drawn_for_a_person():
    class Terminal:
        encoding = 'utf-8'

        def __init__(self) -> None:
            self.text = ''

        def write(self, text: str) -> int:
            self.text += text
            return len(text)

        def flush(self) -> None:
            pass

        def isatty(self) -> bool:
            return True

        def fileno(self) -> int:
            raise OSError

    stream = Terminal()
    with progress('working [now]', stream=stream) as advance:
        advance(0.5, '3 windows [x]')
        advance(1.0, 'done')
    assert 'working [now]' in stream.text


def test_time_left_is_told_once_it_can_be_known():
    assert [time_left(*args) for args in ((0.0, 9.0), (0.5, 0.1), (1.0, 9.0))] == ['', '', '']
    assert time_left(0.25, 10.0) == 'about 30 s left'
    assert time_left(0.1, 100.0) == 'about 15 min left'


def test_work_without_an_end_is_one_line_once_it_has_taken_a_while(monkeypatch):
    class Stream(StringIO):
        def flush(self) -> None:
            told.set()

    told, stream = Event(), Stream()
    monkeypatch.setattr('ctsid_ros.progress._PATIENCE', 1000.0)
    with working('brief', stream=stream):
        pass
    monkeypatch.setattr('ctsid_ros.progress._PATIENCE', 0.0)
    with working('thinking', stream=stream):
        assert told.wait(180.0)
    assert stream.getvalue() == 'thinking ...\n'
    threads = active_count()
    with working('hidden', quiet=True, stream=stream):
        assert active_count() <= threads  # nobody who could tell it


def test_an_estimate_without_a_model_is_told_once():
    given = estimate(None, status=Status.GAPS)
    text = to_markdown('', [model_section(given, 'x'), advice_section(given, np.empty(0), ())])
    assert text.count(Status.GAPS.value) == 1


def test_bands_are_shaded_for_each_input():
    two = replace(TRUTH, B=np.hstack([TRUTH.B] * 2), D=np.zeros((1, 2)), delay=(0.0, 0.0),
                  input_names=('a', 'b'), input_units=('', ''))
    first, _, second, _ = bode_figures(two, [(0.5, 2.0), (10.0, 40.0)])
    places = [re.search(r'<rect x="([\d.]+)" y="[\d.]+" width="([\d.]+)"[^>]*--shade', f.svg)
              for f in (first, second)]
    assert float(places[0][1]) < float(places[0][1]) + float(places[0][2]) < float(places[1][1])
    assert '--shade' not in bode_figures(two, [None, (1.0, 2.0)])[0].svg


def test_the_simulated_line_does_not_hide_the_measured_one():
    t = np.linspace(0.0, 1.0, 50)
    found = Validation(times=t, y=t[:, None], y_hat=t[:, None], fit=np.array([97.7]),
                       vaf=np.zeros(1), x0=np.zeros(2))
    figure, = output_figures(TRUTH, found, 0.0, 'x', np.array([95.04]))
    widths = [float(w) for w in re.findall(r'<path[^>]*stroke-width="([\d.]+)"', figure.svg)]
    assert widths[0] > 3 * widths[1]  # drawn first, behind
    assert figure.caption.endswith('Fit: 95.0 %.')
    assert output_figures(TRUTH, found, 0.0, 'x')[0].caption.endswith('Fit: 97.7 %.')


def test_choices_are_told_in_the_files_only():
    from ctsid_ros.report.sections import choice_section
    section = choice_section(estimate(choices=(Choice('order', 2, 'it is likeliest'),)))
    assert to_text([section]) == ''
    assert '- `order` = 2: it is likeliest' in to_markdown('', [section])


def test_mode_of_zero_has_no_damping():
    assert math.isnan(Mode(0j).damping)
