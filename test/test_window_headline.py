# SPDX-License-Identifier: Apache-2.0
"""What a replay says first: when the plant changed, what failed and when, by one clock."""

from __future__ import annotations

import csv
from dataclasses import replace
import json
import math
import re

from bag_fixtures import START, imu, write_rosbag2
from flights import PARAMS, TRUTH, S, flight, spoilt, stamp_of
from marks import slow
import numpy as np
import pytest
from test_cross_check import first_order
from test_page import Tags, data_of

from ctsid_core.identify import identify
from ctsid_core.model.estimate import Estimate, Status
from ctsid_core.model.storage import load_estimate
from ctsid_core.model.verdict import Grade, Verdict
from ctsid_core.settings import Settings
from ctsid_core.signals.gaps import after_start, by_clock
from ctsid_core.signals.record import Record, Signal
from ctsid_ros.cli import main
from ctsid_ros.replay.along import Windows, along
from ctsid_ros.report.document import Headline
from ctsid_ros.report.headline import Run
from ctsid_ros.report.tables import percent
from ctsid_ros.report.window_headline import window_headline

CHANGE, STUCK = 12.4, 8.0      # [s]


def heavier(sent: list) -> list:
    """Return a flight whose plant is another one from CHANGE on: what a payload does."""
    commands = [s for s in sent if s.topic == '/cmd']
    known = Signal(np.array([(s.log_ns - START) / S for s in commands]),
                   np.array([[s.message.data[0]] for s in commands]), 'zoh')
    heavy = replace(TRUTH, A=0.5 * TRUTH.A + [[0.0, 0.5], [0.0, 0.0]], B=0.5 * TRUTH.B)
    t = np.arange(0.0, 1.0 + (sent[-1].log_ns - START) / S, 0.001)
    light = TRUTH.simulate((known,), t)[:, 0]
    # Of this form the states are the output and its slope, which goes on through the change.
    states = replace(TRUTH, C=np.eye(2), D=np.zeros((2, 1)), K=np.zeros((2, 2)),
                     y_trim=np.zeros(2), output_names=('rate', 'slope'), output_units=('', ''))
    k = round(1e3 * CHANGE)
    at = states.simulate((known,), t[:k + 1])[-1]
    slow = light.copy()
    slow[k:] = heavy.simulate((known,), t[k:], at)[:, 0]

    def loaded(k: int, one):
        ms = round((stamp_of(one) - START) / 1e6)
        rate = one.message.angular_velocity.x + (slow - light)[ms]
        return replace(one, message=imu(stamp_of(one), rate))

    return spoilt('/imu', loaded, sent)


def hung(sent: list) -> list:
    """Return a flight whose sensor repeats its last value from STUCK on."""
    last: list[float] = []

    def held(k: int, one):
        if stamp_of(one) - START < STUCK * S or not last:
            last[:] = [one.message.angular_velocity.x]
        return replace(one, message=imu(stamp_of(one), last[0]))

    return spoilt('/imu', held, sent)


@pytest.fixture(scope='module')
def told(tmp_path_factory) -> dict[str, dict]:
    """Of a flight that changes and one whose sensor hangs: folder, words on the terminal, JSON."""
    place, found = tmp_path_factory.mktemp('along'), {}
    write_rosbag2(place / 'payload', heavier(flight(22.5)))
    write_rosbag2(place / 'hung', hung(flight(14.0)))
    (place / 'params.yaml').write_text(PARAMS)
    for name in ('payload', 'hung'):
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(place)
            said: list[str] = []
            patch.setattr('builtins.print', lambda *words, said=said, **_: said.append(
                ' '.join(map(str, words))))
            words = ('replay', name, '--params', 'params.yaml', '--out', f'res_{name}', '--quiet',
                     '--force')
            assert main([*words]) == 0
            text = '\n'.join(said)
            patch.undo()
            patch.chdir(place)
            out: list[str] = []
            patch.setattr('ctsid_ros.verbs.replay.tell', lambda d, out=out: out.append(d))
            assert main([*words, '--json']) == 0
        page = (place / f'res_{name}/report.html').read_text(encoding='utf-8')
        found[name] = {'place': place / f'res_{name}', 'text': text, 'json': out[0], 'page': page,
                       'words': ' '.join(' '.join(Tags(page).words).split()),
                       'report': (place / f'res_{name}/report.md').read_text()}
    return found


@pytest.mark.slow
def test_a_page_over_a_bag_whose_plant_changes_begins_with_the_change(told):
    payload = told['payload']
    assert '<p class="grade">CHANGED</p>' in payload['page']
    assert payload['report'].splitlines()[2].startswith(
        '**CHANGED.** The plant changed about ')
    seen, = payload['json']['changes']
    assert seen['time'] == pytest.approx(CHANGE, abs=1.0)      # of windows of 5 s
    said = f'The plant changed about {seen["time"]:.1f} s after the start of the bag'
    assert all(said in ' '.join(payload[where].split()) for where in ('words', 'report', 'text'))
    assert payload['json']['verdict'] == 'CHANGED'
    counts = {g.name: sum(w['verdict']['grade'] == g.name for w in payload['json']['windows'])
              for g in Grade}
    shown = ', '.join(f'{n} {g}' for g, n in counts.items() if n)
    assert f'{len(payload["json"]["windows"])} windows: {shown}.' in payload['words']
    best = payload['json']['windows'][payload['json']['best_window'] - 1]
    side = 'before' if best['to'] <= seen['time'] else 'after'
    assert f'{best["from"]:.1f} to {best["to"]:.1f} s, {side} the change' in payload['words']
    for w in payload['json']['windows']:
        where = 'before' * (w['to'] <= seen['time']) or 'after' * (w['from'] >= seen['time'])
        row = next(line for line in payload['text'].splitlines()
                   if line.split()[:3] == [str(w['window']), f'{w["from"]:.1f}', f'{w["to"]:.1f}'])
        assert re.findall(r'(\w+) the change', row) == [where][:bool(where)]
    assert load_estimate(payload['place'] / 'model.json').verdict.grade is Grade.GOOD
    if side == 'before':
        assert re.search(rf'identify payload .*--start {seen["time"]:.1f}', payload['words'])


@pytest.mark.slow
def test_what_is_in_no_window_at_the_end_is_said(told):
    for one, length in ((told['payload'], 22.5), (told['hung'], 14.0)):
        last = one['json']['windows'][-1]['to']
        left = one['json']['seconds_left']
        assert last + left == pytest.approx(length, abs=0.1)
        said = re.findall(r'; the last (\S+) s are in none', one['text'])
        assert [float(s) for s in said] == ([round(left, 1)] if left >= 0.05 else [])


@pytest.mark.slow
def test_a_sensor_that_hangs_is_said_before_the_model_that_was_kept(told):
    hung_ = told['hung']
    assert '<p class="grade">PARTLY</p>' in hung_['page']
    first = hung_['report'].splitlines()[2]
    assert first.index('NO_RESPONSE') < first.index('Kept is the model')
    assert hung_['json']['verdict'] == 'PARTLY'
    assert 'ctsid identify hung --params params.yaml --start 0.0 --duration 7.5' in hung_['words']
    since = float(re.search(r'the same value from (\S+) to \S+ s after the start of the bag',
                            first)[1])
    assert since == pytest.approx(STUCK, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize('name', ['payload', 'hung'])
def test_one_clock_on_one_page(told, name):
    """Axes and tables count from the start of the bag; so do all sentences, wherever they are."""
    found = told[name]
    for where in ('page', 'report', 'text'):
        assert 'start of the window' not in found[where]
    assert 'start of the window' not in json.dumps(found['json'], default=str)
    if 'id="series"' in found['page']:
        for window in data_of(found['page'], 'series')['windows']:
            for at in re.findall(r'(\S+) s after the start of the bag', window['reason']):
                low, high = map(float, re.search(r', (\S+) to (\S+) s', window['title']).groups())
                assert low - 0.1 <= float(at) <= high + 0.1
    # Whoever has the model alone counts from its own window.
    assert all('start of the bag' not in p.read_text(encoding='utf-8')
               for p in found['place'].glob('*.json'))


@pytest.mark.slow
@pytest.mark.parametrize('name', ['payload', 'hung'])
def test_one_quantity_is_one_number_in_json_table_page_report_and_model_file(told, name):
    found = told[name]
    with (found['place'] / 'estimates.csv').open(encoding='utf-8') as stream:
        rows = list(csv.DictReader(stream))
    windows = found['json']['windows']
    shown = data_of(found['page'], 'series')['windows'] if 'id="series"' in found['page'] else \
        [None] * len(rows)
    assert len(rows) == len(windows) == len(shown)
    for number, (row, window, item) in enumerate(zip(rows, windows, shown, strict=True), 1):
        assert row['verdict'] == window['verdict']['grade']
        assert row['status'] == window['status']
        for column, key in (('fit_rate [%]', 'fit'), ('held_out_fit_rate [%]', 'held_out_fit'),
                            ('next_fit_rate [%]', 'next_fit'),
                            ('fresh_fit_rate [%]', 'fresh_fit')):
            value = window[key][0] if len(window[key]) else math.nan
            assert row[column] == ('' if math.isnan(value) else repr(float(value))), column
        fit = percent(window['fit'][0]) if len(window['fit']) else '-'
        line = rf'\| {number} \| {window["from"]:.1f} \| {window["to"]:.1f} \| {row["verdict"]} \|'
        assert re.search(rf'{line} \S+ \| {fit} \|', found['report'])
        if item is not None:
            facts = dict(item['facts'])
            assert (item['grade'], item['reason']) == (row['verdict'],
                                                       window['verdict']['reason'])
            assert facts.get('fit [%]', facts.get('fit, predicted [%]', '-')) == fit
    best = found['json']['best_window']
    stored = load_estimate(found['place'] / 'model.json')
    assert stored.fit[0] == windows[best - 1]['fit'][0]
    assert f'fit of rate [%] {percent(stored.fit[0])}' in found['words']
    assert f'next fit [%] {percent(windows[best - 1]["next_fit"][0])}' in found['words']
    assert f'windows with a model {found["json"]["accepted"]} of {len(rows)}' in found['words']


def windows_of(*gains: float, std: float = 0.01) -> Windows:
    """Return windows of 5 s, one every 2.5 s, with GOOD models of these gains."""
    found = [first_order(gain, std / gain) for gain in gains]
    starts = 2.5 * np.arange(len(found))
    return Windows(found, starts, starts + 5.0, np.full((len(found), 1), np.nan))


@pytest.mark.parametrize(('gains', 'std', 'said'), [
    ((1.0, 1.02, 0.99, 1.01, 1.0), 0.01, 'GOOD'),
    ((1.0, 1.0, 1.0, 1.3, 1.3, 1.3), 0.01, 'CHANGED'),
    ((1.0, 1.0, 1.0, 1.3, 1.3, 1.3), 0.15, 'GOOD'),        # as by chance
    ((1.0, 1.0, 1.0, 1.08, 1.08, 1.08), 0.01, 'GOOD'),     # by less than matters
    ((1.0, 1.0, 1.3, 1.3, 1.0, 1.0), 0.01, 'GOOD')])       # in windows that share their data
def test_models_that_contradict_the_kept_one_are_told_even_if_no_window_shows_a_change(
        gains, std, said):
    first = window_headline(Headline('GOOD', 'Because OK.'), windows_of(*gains, std=std), 0,
                            'the best', Run('', ('bag',), None))
    assert first.grade == said
    told = re.search(r'Other models than the kept one are right for (\S+) to (\S+) s',
                     first.sentence)
    assert bool(told) == (said == 'CHANGED')
    if told:
        assert told.groups() == ('7.5', '17.5')
        assert 'differ by 30.0 ± 1.4 %' in first.sentence
        assert first.command == 'ctsid identify bag --start 7.5 --duration 10.0'


def test_instants_are_words_that_another_clock_can_read():
    assert after_start(-1e-9, 1.0) == 'from 0.0 to 1.0 s after the start of the window'
    text = f'It is stuck {after_start(1.25, 3.0)}; it changed about {after_start(0.5)}.'
    assert text == ('It is stuck from 1.2 to 3.0 s after the start of the window; it changed '
                    'about 0.5 s after the start of the window.')
    assert after_start(1234.5678) == '1234.6 s after the start of the window'
    assert by_clock(text, 1200.0, 'the bag') == (
        'It is stuck from 1201.2 to 1203.0 s after the start of the bag; it changed about '
        '1200.5 s after the start of the bag.')
    assert by_clock('about 3 s after the start of record 2', 5.0, 'the bag') == (
        'about 3 s after the start of record 2')
    # Topics may be called so.
    for name in ('yaw', 'gyro2', 'arm-1.5', '/imu/2', 'from left to right'):
        words = f'check {name} s after the start of the window'
        assert by_clock(words, 5.0, 'the bag') == words
    assert by_clock('(2.0 s after the start of the window)', 5.0, 'the bag') == (
        '(7.0 s after the start of the bag)')


@pytest.mark.parametrize(('statuses', 'said'), [
    (('OK', 'OK'), 'GOOD'), (('OK', 'NO_EXCITATION'), 'GOOD'), (('OK', 'TOO_SHORT'), 'PARTLY'),
    (('OK', 'UNEXPLAINED'), 'PARTLY')])
def test_the_word_for_a_bag_is_that_of_the_model_where_no_window_contradicts_it(statuses, said):
    found = [Estimate(status=Status[s], settings=Settings(), model=TRUTH if s == 'OK' else None,
                      verdict=Verdict(grade=Grade.GOOD if s == 'OK' else Grade.REJECT,
                                      reason=f'Because {s}.')) for s in statuses]
    windows = Windows(found, np.array([0.0, 5.0]), np.array([5.0, 10.0]), np.full((2, 1), np.nan))
    first = window_headline(Headline('GOOD', 'Because OK.'), windows, 0, 'the best', Run(
        '', ('bag',), None))
    assert first.grade == said
    assert ('Because UNEXPLAINED.' in first.sentence) == ('UNEXPLAINED' in statuses)
    assert first.sentence.endswith(
        'Kept is the model of window 1 (0.0 to 5.0 s), the best: Because OK.')
    assert ('(no input moves in 1)' in first.sentence) == ('NO_EXCITATION' in statuses)


@pytest.mark.parametrize('kept', [0, *slow(2, 4)])
def test_a_plant_that_drifts_has_one_word_whichever_model_is_kept(kept):
    """A model from the middle is half as far from either end as these are from each other."""
    rng, t, u = np.random.default_rng(1), np.arange(0.0, 60.0, 0.01), np.zeros(6000)
    u = np.repeat(rng.choice([-1.0, 1.0], 200), 30)
    y, gain = np.zeros(6000), np.linspace(2.0, 1.4, 6000)
    for k in range(5999):
        y[k + 1] = y[k] + 0.01 * 3.0 * (gain[k] * u[k] - y[k])
    y += 0.02 * rng.standard_normal(6000)
    starts = np.arange(0.0, 49.0, 12.0)
    found = [identify(Record.from_arrays(t[p], u[p], t[p], y[p], input_hold='zoh'))
             for p in (slice(int(100 * a), int(100 * a) + 1200) for a in starts)]
    windows = Windows(found, starts, starts + 12.0, np.full((len(found), 1), 90.0))
    said = along(windows, kept)
    assert said.word == 'CHANGED'
    assert ('than that of window 1' in said.unlike[0].words) == (kept == 2)
