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
from ctsid_core.model.validation import Validation, simulation
from ctsid_core.model.verdict import Excitation, Grade, Remedy, Verdict
from ctsid_core.sequence.tracking import Tracked
from ctsid_core.settings import Actuator, Settings
from ctsid_core.signals.record import Record, Signal
from ctsid_ros.progress import progress, time_left, working
from ctsid_ros.replay.along import Windows
from ctsid_ros.replay.replay import Result
from ctsid_ros.report.document import Bullets, Figure, Section, to_markdown, to_text
from ctsid_ros.report.drawing import Axes, Curve, Drawing, Span
from ctsid_ros.report.drawing import thinned as fewer
from ctsid_ros.report.explorer import facts
from ctsid_ros.report.interactive import figure
from ctsid_ros.report.model_page import Shown, output_section, response_sections
from ctsid_ros.report.outputs import Part, sampling_figures
from ctsid_ros.report.page import to_html
from ctsid_ros.report.poles import track_curve
from ctsid_ros.report.residual_figures import horizon_figure
from ctsid_ros.report.responses import (
    bode_figures,
    frequencies,
    response_of,
    response_std,
    step_figures,
)
from ctsid_ros.report.sections import (
    bode_section,
    choice_section,
    fit_table,
    model_section,
    remark_section,
    status_section,
    truth_section,
    window_section,
)
from ctsid_ros.report.spectra import supported_band
from ctsid_ros.report.static import inline_svg, write_drawings
from ctsid_ros.report.tables import Table, join, number, percent, plus_minus, pole_text, thinned
from ctsid_ros.report.tracks import Mode, Track, match, modes, tracks
from ctsid_ros.report.window_figures import window_figure

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
    assert plus_minus(math.inf, math.inf) == plus_minus(math.inf, 1e24) == 'inf'
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
    plain, banded = (bode_figures({'model': (TRUTH, c)})[0].drawing for c in (None, known))
    assert [p.curves[0].low is None for p in (*plain.panels, *banded.panels)] == [
        True, True, False, False]
    curve = banded.panels[0].curves[0]
    np.testing.assert_allclose(curve.high - curve.y, np.minimum(
        2 * response_std(TRUTH, curve.x, known)[0][:, 0, 0], 20.0), rtol=1e-6)
    row = to_text([bode_section(TRUTH, 5, known)]).splitlines()[-1]
    assert row.count('±') == 2


def test_fits_poles_and_lists():
    assert [percent(v) for v in (97.649, math.nan, -math.inf, -12.0)] == [
        '97.6', '-', '< -999', '-12.0']
    assert pole_text(-1.5 + 3j) == pole_text(-1.5 - 3j) == '-1.500 ± 3.000j'
    assert pole_text(complex(-2)) == '-2.000'
    assert [join(w) for w in ([], ['a'], ['a', 'b', 'c'])] == ['', 'a', 'a, b and c']


TABLE = Table(('name', 'value'), (('a|b', '1.0'), ('<long>', '22.0')), ('name',))


def test_table_for_terminal_markdown_and_page():
    assert TABLE.text(0).splitlines() == [
        'name    value', '──────  ─────', 'a|b       1.0', '<long>   22.0']
    assert TABLE.markdown().splitlines() == [
        '| name | value |', '| --- | ---: |', '| a\\|b | 1.0 |', '| \\<long> | 22.0 |']
    page = to_html('t', [Section('s', (TABLE,))])
    root = ET.fromstring(page[page.index('<table>'):page.index('</table>') + 8])
    assert [[cell.text for cell in row] for row in root.iter('tr')] == [
        ['name', 'value'], ['a|b', '1.0'], ['<long>', '22.0']]
    assert [cell.get('data-label') for cell in root.iter('td')] == ['name', 'value'] * 2


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
        if tag not in ('meta', 'link'):
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
        Section('Drawn', (Figure(Drawing((Axes([]),)), 'a caption'),))]
    text, markdown = to_text(sections), to_markdown('Title', sections)
    assert text.startswith('First\n  A `word` & more.\n  name')
    assert 'Detail' not in text
    assert '  - two <b>' in text
    assert markdown.startswith('# Title\n\n## First\n\nA `word` \\& more.\n\n| name |')
    assert '## Detail' in markdown
    assert 'Empty' not in markdown + text
    assert 'Drawn' not in markdown + text
    checker = Checker()
    checker.feed(to_html('Title <1>', sections))
    assert checker.open == []
    joined = ' '.join(checker.texts)
    for words in ('Title <1>', 'hidden on the terminal', 'two <b>', 'a caption', '& more.'):
        assert words in joined


# --- drawings


def test_long_curves_keep_their_peaks_and_gaps():
    y = np.sin(np.arange(100_000) / 5000)
    y[54_321], y[70_000] = 7.0, math.nan
    found = fewer(Curve(np.arange(100_000.0), y), 1500)
    assert len(found.x) < 2000
    assert np.nanmax(found.y) == 7.0
    assert np.isnan(found.y).sum() == 1
    dots = fewer(Curve(np.arange(100_000.0), y, kind='dots'), 1500)
    assert len(dots.x) < 1600
    assert np.nanmax(dots.y) == 7.0
    assert np.mean(np.abs(dots.y) < 0.5) > 0.2        # not the extremes alone


ODD = [
    Axes([]), Axes([Curve(np.empty(0), np.empty(0))]), Axes([Curve(np.ones(3), np.ones(3))]),
    Axes([Curve(np.array([1.0]), np.array([2.0]), kind='both', low=np.array([1.0]),
                high=np.array([3.0]))], y_log=True),
    Axes([Curve(np.arange(3.0), np.array([-1.0, 0.0, math.nan]))], y_log=True,
         spans=[Span(0.5, 9.0)], levels=[1.0, 2.0], title='a < b & "c" $x^'),
    *(Axes([Curve(np.arange(1.0, 4.0), np.array([1.0, math.inf, 2.0]), '_<b>', kind=kind)],
           marks=[(2.0, 'here')], x_log=True, x_limits=(1.0, 5.0), step=45.0, bare=True)
      for kind in ('dots', 'dashed', 'cloud', 'cross', 'steps', 'stems'))]


def test_odd_drawings_are_drawn_by_matplotlib():
    text = inline_svg(Drawing(tuple(ODD)), 350.0)
    assert ET.fromstring(text.replace('xlink:', '')).tag.endswith('svg')
    assert 'a &lt; b &amp; "c" $x^' in text
    assert '#1769c4' not in text                          # the page has its own colours
    assert 'var(--c1)' in text


def test_odd_drawings_are_figures_of_plotly():
    go = pytest.importorskip('plotly.graph_objects')

    def named(value):
        """Colours are filled in by the page."""
        if isinstance(value, dict):
            return {k: named(v) for k, v in value.items()}
        if isinstance(value, list):
            return [named(v) for v in value]
        return 'red' if isinstance(value, str) and value.startswith('--') else value

    found = named(figure(Drawing(tuple(ODD))))
    drawn = go.Figure(found)                              # raises where plotly knows better
    assert len(drawn.data) == 11
    assert 'a &lt; b &amp; "c" $x^' in drawn.layout.annotations[0].text
    assert drawn.data[-1].name == '_&lt;b&gt;'
    assert 'NaN' not in repr(found)


def test_axes_above_each_other_share_their_x():
    found = figure(Drawing((Axes([Curve(np.arange(3.0), np.arange(3.0))], height=100.0),
                            Axes([], x_label='t [s]', height=200.0))))['layout']
    assert found['xaxis2']['matches'] == 'x'
    assert not found['xaxis']['showticklabels']
    assert found['xaxis2']['title']['text'] == 't [s]'
    tall, low = (np.ptp(found[a]['domain']) for a in ('yaxis2', 'yaxis'))
    assert tall == pytest.approx(2 * low, rel=1e-3)


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


def seen(estimates) -> Windows:
    starts = np.array([e.start_ns * 1e-9 for e in estimates])
    ends = np.array([e.end_ns * 1e-9 for e in estimates])
    return Windows(estimates, starts, ends, np.full((len(estimates), 1), np.nan))


def test_window_figure_shows_every_window_and_the_truth():
    estimates = [estimate(shifted(TRUTH, 0.1 * i), start=i) for i in range(5)]
    panels = {p.title: p for p in window_figure(seen(estimates), TRUTH).drawing.panels}
    assert list(panels) == ['verdict', 'fit [%]', 'natural frequency [rad/s]',
                            'damping ratio of the oscillating modes']
    assert len(panels['natural frequency [rad/s]'].curves[0].x) == 5
    assert len(panels['natural frequency [rad/s]'].levels) == 1
    assert len(panels['verdict'].spans) == 1            # neighbours of one kind together
    short = estimate(None, status=Status.TOO_SHORT, fit=np.empty(0), start=5)
    (strip, _, *rest) = window_figure(seen([short])).drawing.panels
    assert (strip.spans[0].text, rest) == ('REJECT', [])
    strip = window_figure(seen([*estimates, short, short])).drawing.panels[0]
    assert [s.text for s in strip.spans] == ['GOOD', 'REJECT']
    assert strip.spans[0].high == strip.spans[1].low


def test_modes_of_every_window_are_drawn_however_few_windows_have_them():
    """Those that were seen for longer are lines, all others dots: none is left out."""
    plants = [StateSpace([[-(3.0 ** k)]], [[1.0]], [[1.0]]) for k in range(20)]
    found = window_figure(seen([estimate(p, start=i) for i, p in enumerate(plants)]))
    panel = next(p for p in found.drawing.panels if p.title == 'natural frequency [rad/s]')
    shown = [y for curve in panel.curves for y in curve.y.tolist() if not math.isnan(y)]
    assert sorted(shown) == pytest.approx([3.0 ** k for k in range(20)])
    assert [c.label for c in panel.curves].count('seen in few windows') == len(panel.curves)


def test_bands_are_two_standard_deviations():
    real, pair = Mode(complex(-2), 0.1), Mode(-1 + 3j, 0.1)
    size = math.sqrt(10)
    curve = track_curve(Track((0, 2), (real, pair)), np.array([5.0, 6.0, 7.0]), 0, frequency=True)
    np.testing.assert_allclose(curve.x, [5.0, 6.0, 7.0])
    np.testing.assert_allclose(curve.y, [2.0, np.nan, size])        # a window has none
    # The variance of a pair's pole has two directions, of which one changes its magnitude.
    np.testing.assert_allclose(curve.high - curve.y, [0.2, np.nan, 0.2 / math.sqrt(2)])
    assert [x.tolist() for x, _, _ in curve.bands] == [[5.0], [7.0]]
    x, y = np.arange(7.0), np.array([1.0, 1.0, np.nan, 1.0, 1.0, np.nan, 1.0])
    broken = Drawing((Axes([Curve(x, y, 'a', low=y - 1.0, high=y + 1.0)]),))
    shapes = [t['x'] for t in figure(broken)['data'] if t.get('fill') == 'toself']
    bars = [t['x'] for t in figure(broken)['data'] if 'error_y' in t]
    assert (shapes, bars) == ([[0.0, 1.0, 1.0, 0.0], [3.0, 4.0, 4.0, 3.0]], [[6.0]])
    assert inline_svg(broken, 600.0).count('opacity: 0.2') == 2
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
    short = estimate(None, status=Status.TOO_SHORT, fit=np.empty(0), start=3.0)
    results = [Result(Tracked(estimate(start=2.0)), np.array([91.0])),
               Result(Tracked(short), np.array([math.nan]))]
    lines = to_text([window_section(results, 0)]).splitlines()
    assert lines[3].split() == ['1', '2.0', '7.0', 'GOOD', '2', '95.0', '91.0', '-1.50', '±',
                                '3.00j']
    assert lines[4].split() == ['2', '3.0', '8.0', 'REJECT', '-', '-', '-', 'none:', 'TOO_SHORT']
    many = to_text([window_section([results[0]] * 300, 0)])
    assert '40 of 300 windows are shown' in many
    six = StateSpace(np.diag(-np.arange(1.0, 7.0)), np.ones((6, 1)), np.ones((1, 6)))
    rejected = replace(estimate(None, status=Status.CHANGED, start=3.0), rejected_model=six)
    assert '2 more' in to_text([window_section([Result(Tracked(estimate(six)), np.ones(1))], 0)])
    assert 'more' not in to_text([window_section([Result(Tracked(rejected), np.ones(1))], 0)])


def test_weak_windows_are_counted_by_what_to_try():
    def weak(remedy, reason):
        return Result(Tracked(replace(estimate(), verdict=Verdict(
            grade=Grade.WEAK, reason=reason, remedy=remedy))), np.array([90.0]))

    results = [weak(Remedy.EXCITE, 'Little moves; move it more.'),
               *(weak(Remedy.SETTING, f'Order {n}; set it.') for n in (2, 3)),
               Result(Tracked(estimate()), np.array([90.0]))]
    assert to_text([status_section(results)]).splitlines()[1:] == [
        '  - 2 of 4 windows gave a WEAK model, such as: Order 3; set it.',
        '  - 1 of 4 windows gave a WEAK model, such as: Little moves; move it more.']


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
    (estimate(held_out_fit=np.array([60.0])), 'far better'),
    (estimate(settings=Settings(max_order=2)), 'that `max_order` allows'),
    (estimate(shifted(TRUTH, 5.0)), 'unstable')])
def test_remarks_fit_the_outcome(given, words):
    text = to_markdown('', [remark_section(given, np.empty(0))])
    if words is None:
        assert 'dead time' in text  # all that is left to say
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
    *lines, last = err.splitlines()
    assert len(lines) == 9
    for i, line in enumerate(lines, 1):  # a second passes with each look at the clock
        assert re.fullmatch(rf'working: {10 * i} %, at {10 * i}, about (\d+) s left', line), line
    assert last == 'working: 100 %, at 100'
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
    given = estimate(None, status=Status.TOO_SHORT)
    text = to_markdown('', [model_section(given, 'x'), remark_section(given, np.empty(0))])
    assert text.count(Status.TOO_SHORT.value) == 1


def test_bands_are_shaded_for_each_input():
    two = replace(TRUTH, B=np.hstack([TRUTH.B] * 2), D=np.zeros((1, 2)), delay=(0.0, 0.0),
                  input_names=('a', 'b'), input_units=('', ''))
    figures = bode_figures({'model': (two, None)}, [(0.5, 2.0), (10.0, 40.0)])
    assert [f.title for f in figures] == ['a → rate', 'b → rate']
    assert [[(s.low, s.high) for s in p.spans] for f in figures for p in f.drawing.panels] == [
        [(0.5, 2.0)], [(0.5, 2.0)], [(10.0, 40.0)], [(10.0, 40.0)]]
    first, second = bode_figures({'model': (two, None)}, [None, (1.0, 2.0)])
    assert not first.drawing.panels[0].spans
    assert second.drawing.panels[0].spans


def test_what_acts_is_told_where_it_is_not_all():
    assert ' no direct feedthrough. Each' in to_text([model_section(estimate(), 'Model')])
    stops = replace(TRUTH, actuators=(Actuator(timeout=0.5, limit=2.0),), input_units=('N m',))
    name = stops.input_names[0]
    assert (f'; input {name} counts as 0 from 0.5 s after a message on, until the next one; '
            f'input {name} acts by at most 2 N m. ') in ' '.join(
                to_text([model_section(estimate(stops), 'Model')]).split())
    assert facts(estimate(stops), {})['timeout [s]'] == '0.500'


def test_inputs_are_drawn_as_they_act():
    """A robot stood while the page showed its last command; spectra were 6 dB off."""
    rng = np.random.default_rng(0)
    sent = np.sort(rng.choice(np.arange(0.0, 60.0, 0.05), 150, replace=False))
    given = Signal(sent, np.where(rng.random((150, 1)) < 0.5, -1.0, 1.0), 'zoh', ('u',))
    model = StateSpace([[-4.0]], [[4.0]], [[1.0]], actuators=(Actuator(0.2),), input_names=('u',),
                       output_names=('y',))
    t = np.arange(0.0, 59.0, 0.02)
    seen = Signal(t, model.simulate([given], t), 'smooth', ('y',))
    record = Record.from_signals([given], [seen])
    found = simulation(model, record)
    shown = Shown(record, model, [Part('all', found, found.fit)], 0.0)
    measured, = output_section(shown, Settings()).parts[-1].figures
    drawn = measured.drawing.panels[-1].curves[0]
    assert set(np.unique(drawn.y)) == {-1.0, 0.0, 1.0}
    bode = next(response_sections({'model': (model, None)}, shown)).parts[-1].figures[0]
    dots = next(c for c in bode.drawing.panels[0].curves if 'spectra' in c.label)
    assert np.median(dots.y[dots.x < 2.0]) == pytest.approx(0.0, abs=1.0)       # dB


def test_choices_are_told_in_the_files_only():
    section = choice_section(estimate(choices=(Choice('order', 2, 'it is likeliest'),)))
    assert to_text([section]) == ''
    assert '- `order` = 2: it is likeliest' in to_markdown('', [section])


@pytest.mark.parametrize(('domain', 'said'), [
    ('predictions', 'which know the outputs before as well as the inputs'),
    ('disturbed', 'where a controller holds the plant, its set point')])
def test_what_a_domain_means_is_told_everywhere(domain, said):
    section = choice_section(estimate(choices=(Choice('domain', domain, 'it is likelier'),)),
                             brief=True)
    for text in (to_text([section]), to_markdown('', [section]), to_html('', [section])):
        assert said in ' '.join(text.split())


def test_mode_of_zero_has_no_damping():
    assert math.isnan(Mode(0j).damping)


def test_nothing_slower_than_what_was_excited_is_drawn():
    """A pole that is zero but for rounding made eight empty decades and 1000 s of nothing."""
    model = StateSpace(np.diag([-1.7e-8, -3.0]), [[1.0], [1.0]], [[1.0, 1.0]], input_names=('u',),
                       output_names=('y',))
    band = (0.12, 17.0)
    assert frequencies(model, band)[[0, -1]] == pytest.approx([0.012, 170.0])
    assert frequencies(model)[[0, -1]] == pytest.approx([0.3, 30.0])
    bode = bode_figures({'model': (model, None)}, [band])[0].drawing.panels[0]
    step = step_figures({'model': (model, None)}, bands=[band])[0].drawing.panels[0]
    assert bode.x_limits[0] == pytest.approx(0.012)
    assert step.x_limits[1] == pytest.approx(10.0 / 0.12)
    fast = StateSpace([[-3.0]], [[1.0]], [[1.0]])
    assert step_figures({'model': (fast, None)}, bands=[band])[0].drawing.panels[0].x_limits[
        1] == pytest.approx(5.0 / 3.0)


def test_a_compact_drawing_has_every_point_where_it_was(monkeypatch, tmp_path):
    """A cloud of 500 dots is a path of as many points; lines keep theirs to 0.005 points."""
    rng = np.random.default_rng(3)
    x, y = rng.standard_normal((2, 500))
    axes = Axes([Curve(x, y, 'runs', 1, 'cloud', opacity=0.6), Curve(np.sort(x), y, 'line', 2)],
                'A title', 'x 0.123456')
    write_drawings(tmp_path / 'compact.svg', [axes])
    monkeypatch.setattr('ctsid_ros.report.static.compact', lambda text, size: text)
    write_drawings(tmp_path / 'whole.svg', [axes])
    compact, whole = ((tmp_path / f'{name}.svg').read_text() for name in ('compact', 'whole'))
    ET.fromstring(compact)
    assert len(compact) < 0.5 * len(whole)
    assert 'x 0.123456' in compact

    def numbers(text: str) -> np.ndarray:
        return np.array([[float(v) for v in pair] for pair in text])

    dots = numbers(re.findall(r'M([-\d.]+) ([-\d.]+)h0', compact))
    before = numbers(re.findall(r'x="([-\d.]+)" y="([-\d.]+)" style="fill: #1769c4', whole))
    assert len(dots) == len(before) - 1 == 500      # the last one is in the legend
    assert np.abs(dots - before[:500]).max() <= 0.00501
    longest = [max(re.findall(r'<path d="([^"]*)" clip-path', text), key=len)
               for text in (compact, whole)]
    line, line_before = (numbers(re.findall(r'([-\d.]+) ([-\d.]+)', t)) for t in longest)
    assert np.abs(line - line_before).max() <= 0.00501


def test_a_logarithmic_axis_has_plain_numbers(tmp_path):
    x = np.geomspace(0.01, 100.0, 50)
    write_drawings(tmp_path / 'log.svg', [Axes([Curve(x, x)], x_log=True, y_log=True)])
    text = (tmp_path / 'log.svg').read_text()
    assert all(f'>{tick}<' in text for tick in ('0.1', '1', '10'))
    assert 'e−01' not in text
    assert 'e-01' not in text


def test_a_fit_below_the_figure_is_told():
    fits = {0.1: np.array([90.0]), 1.0: np.array([-300.0])}
    assert 'The least fit, -300 %, is below the figure.' in horizon_figure(
        TRUTH, fits, np.array([95.0])).caption
    assert 'below' not in horizon_figure(TRUTH, {0.1: np.array([-10.0])},
                                         np.array([95.0])).caption


@pytest.mark.parametrize(('choices', 'heads'), [
    ((), ('fit [%]', 'held-out fit [%]')),
    ((Choice('domain', 'predictions', ''),), ('fit 10 ahead [%]', 'held-out fit 1 ahead [%]'))])
def test_fits_of_predictions_say_how_far_they_look_ahead(choices, heads):
    assert fit_table(estimate(choices=choices), TRUTH).head == ('output', *heads)


def test_stamps_of_whole_nanoseconds_are_drawn_as_even():
    """What they round was drawn as the jitter, on an axis of 19.999999 to 20.000001 ms."""
    t = np.round(1e9 * np.arange(500) / 50.0 + np.arange(500) % 2) * 1e-9
    signal = Signal(t, np.zeros((500, 1)), 'zoh', ('u',))
    drawn, = sampling_figures(Record((signal,), (), 0.0, t[-1]), 0.0)
    assert np.ptp(drawn.drawing.panels[0].curves[0].y) == 0.0
    assert 'left out) 0 ms' in drawn.caption
