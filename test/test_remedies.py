# SPDX-License-Identifier: Apache-2.0
"""Every weakness and every rejection ends in one thing to try, the same wherever it is told."""

from __future__ import annotations

from dataclasses import replace
import json
from pathlib import Path
import re

from bag_fixtures import START, Sent, array, imu, write_mcap
from flights import PARAMS, TRUTH, S, at, flight, spoilt, stamp_of, write_flight, write_params
from marks import slow
import numpy as np
import pytest

from ctsid_core import Estimate, Settings
from ctsid_core.judge import rules
from ctsid_core.judge.changed import Change
from ctsid_core.judge.drift import Drift, InputDrift
from ctsid_core.judge.evidence import Evidence
from ctsid_core.judge.unmoved import Stuck
from ctsid_core.model.estimate import Status
from ctsid_core.model.model_json import from_json, to_json
from ctsid_core.model.storage import load_estimate
from ctsid_core.model.verdict import UNJUDGED, Agreement, Excitation, Grade, Remedy
from ctsid_core.signals.record import Record, Signal
from ctsid_ros.cli import main
from ctsid_ros.report.headline import Run, headline

RUN = Run('', ('bag',), 'params.yaml', 'model.json', (0.0, 10.0))
BAD = np.array([np.nan, 0.9, 0.9])
# Everything that may be wrong with a model of two inputs and three outputs.
WORST = Evidence(
    input_names=('a', 'b'), output_names=('x', 'y', 'z'), fixed_inputs=(0,), fixed_outputs=(0,),
    stuck=(Stuck(1, 2.0, 9.0),), expected=np.full(3, np.nan),
    fitted=np.array([np.nan, 0.1, np.inf]), driven=np.zeros(3),
    distance_to_controller=np.array([1.0, 0.1]), lead=np.zeros(2), apart=np.zeros(2),
    poles=np.array([-1.0 + 0.0j, np.nan]), change=Change(cost=50.0), where='about 3 s', worst='',
    numbers=replace(UNJUDGED, error=np.array([np.nan, 0.1, np.inf]), coloured_error=BAD,
                    held_out_error=BAD, response_uncertainty=np.full(3, 2.0),
                    curve_gain=np.full(3, 9.0), excitation=(
                        Excitation('a'), Excitation('b', 1.0, 2.0, 1.0, 1.0, 0.5))))
CONTRADICTIONS = [Agreement('gobf', False, True, problem='TOO_SHORT'),
                  Agreement('gobf', False, True, late='a', dead_time=0.1),
                  Agreement('gobf', False, True, 0.3, 9.0, 'a', 1.0)]


def findings() -> list[tuple[Remedy, str]]:
    """Return all that can be said against a model."""
    shared = replace(WORST.numbers, excitation=(
        Excitation('a', 1.0, 2.0, 9.0, 0.01, 0.5),) * 2)
    record = Record.from_arrays(np.arange(9.0), np.arange(9.0), np.arange(9.0), np.arange(9.0))
    good = replace(UNJUDGED, grade=Grade.GOOD, reason='Every test is passed.')
    found = [(remedy, reason) for _, remedy, reason in rules._rejections(WORST)]
    line = replace(WORST.numbers, excitation=(Excitation('a', 3.0, 3.0, 9.0, 1.0, 0.01),) * 2)
    late = replace(WORST, lead=np.array([0.1, 0.06]))
    jumps = Drift(0, 9.0, inputs=(InputDrift('a', 0.2, 0.0),), moved=9.0, jumps=3)
    acts = replace(WORST, doubt=('input a acts as if it were 0', 'a.timeout: 0.5'),
                   at_once=(0.1, np.inf), drift=jumps)
    stamps = replace(WORST, doubt=('a mode decays', 'feedthrough: true'), stamp_sensitivity=0.4,
                     follows_at_once=True)
    for one in (replace(WORST, unproven=True), late, acts, stamps, *(
            replace(WORST, numbers=n, fixed_inputs=()) for n in (line, shared))):
        found += rules._weaknesses(one)
    estimate = Estimate(status=Status.OK, settings=Settings(), model=TRUTH, verdict=good)
    verdicts = [rules.unusable_estimate(s, record, Settings()).verdict for s in (
        Status.NO_EXCITATION, Status.NO_RESPONSE, Status.TOO_SHORT)]
    verdicts += [Estimate(status=s, settings=Settings()).verdict for s in Status
                 if s is not Status.OK]
    verdicts += [rules.unusable_estimate(Status.UNRELIABLE, record, Settings(),
                                         failed='x').verdict, UNJUDGED,
                 rules.rejected_over_change(estimate, 0.3).verdict]
    verdicts += [rules.weakened(replace(good, agreement=a)) for a in CONTRADICTIONS]
    verdicts += [rules.in_sequence(estimate, *(np.array([x]) for x in numbers)).verdict
                 for numbers in ((9.0, 5.0, 0.0), (99.0, 1.0, 0.2))]
    return [*found, *((v.remedy, v.reason) for v in verdicts)]


def test_every_rule_is_looked_at():
    said = ' '.join(reason for _, reason in findings())
    for words in ('Gains change', 'hinges on the stamps', 'Outputs that are stamped late',
                  'as if it were 0', 'at once how',
                  'not move', 'exactly the same', 'changed', 'No linear', 'does not follow',
                  'finite', 'zero column', '1 frequency', 'independently',
                  'move it 5.3 times as much', 'explain little', 'is not linear', 'held out',
                  'response to input a is at', 'not been tested', 'Nobody', 'minus one over',
                  'before input a', 'before input b',
                  'badly (its fit there', 'is unstable', 'of its motion apart',
                  'An earlier window', 'arithmetic', 'acts 0.1 s later', 'too few', 'gobf failed'):
        assert words in said, words


def test_every_reason_ends_in_one_thing_to_try():
    for remedy, reason in findings():
        finding, _, advice = reason.removesuffix('.').rpartition('; ')
        assert finding, reason
        assert advice, reason
        assert not re.search(r'\bor\b|\bcheck\b.*\bcheck\b', advice), reason
        assert isinstance(remedy, Remedy), reason


def test_every_remedy_has_a_command():
    for remedy in Remedy:
        for status in (Status.OK, Status.UNEXPLAINED):
            given = Estimate(
                status=status, settings=Settings(), model=TRUTH if status is Status.OK else None,
                verdict=replace(UNJUDGED, remedy=remedy, reason='x; y.', grade=Grade.WEAK
                                if status is Status.OK else Grade.REJECT))
            for run in (RUN, replace(RUN, params=None), replace(RUN, interval=('--start', '3'))):
                told = headline(given, run)
                assert told.command.startswith(('ctsid ', 'ros2 bag record ')), remedy
                assert told.purpose, remedy


def test_a_remedy_is_kept_in_files_and_may_be_missing_in_older_ones():
    given = Estimate(status=Status.TOO_SHORT, settings=Settings())
    text = to_json(given)
    assert from_json(text).verdict.remedy is given.verdict.remedy is Remedy.LONGER
    document = json.loads(text)
    del document['verdict']['remedy']
    assert from_json(json.dumps(document)).verdict.remedy is Remedy.LONGER


def sine() -> list:
    """Return a flight whose input is one sine."""
    t_u, t_y = 0.05 * np.arange(400.0), 0.01 * np.arange(2000.0)
    u = np.sin(3.0 * t_u)
    y = TRUTH.simulate((Signal(t_u, u[:, np.newaxis], 'zoh'),), t_y)[:, 0]
    y += 0.02 * np.random.default_rng(0).standard_normal(len(y))
    return sorted([*(Sent('/cmd', 'std_msgs/msg/Float64MultiArray', START + round(t * S),
                          array(v, 0.5)) for t, v in zip(t_u, u, strict=True)),
                   *(Sent('/imu', 'sensor_msgs/msg/Imu', START + round(t * S),
                          imu(START + round(t * S), v)) for t, v in zip(t_y, y, strict=True))],
                  key=lambda s: s.log_ns)


def dead() -> list:
    """Return a flight whose sensor dies after 12 s."""
    return spoilt('/imu', lambda k, s: at(s, stamp_of(s), 0.7) if k > 1200 else s)


@pytest.mark.parametrize(('name', 'sent', 'verb'), [
    ('dead', dead, 'replay'), *slow(('good', flight, 'simulate'), ('sine', sine, 'advise'))])
def test_it_is_the_same_everywhere(name, sent, verb, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_flight(tmp_path / name, sent())
    write_params(tmp_path / 'params.yaml', PARAMS)
    main(['identify', name, '--params', 'params.yaml', '--out', 'res', '--quiet'])
    terminal, said = capsys.readouterr()
    commands = {line.strip() for line in terminal.splitlines() if line.startswith('  ctsid ')}
    assert len(commands) == 1
    assert 'ctsid ' not in said
    command, = commands
    assert command.startswith(f'ctsid {verb} ')
    page = Path('res/report.html').read_text(encoding='utf-8')
    assert ''.join(re.findall(r'<span>(.*?)</span>', page.partition('</header>')[0])) == \
        command.replace(' ', '')
    text = Path('res/report.md').read_text(encoding='utf-8')
    assert text.count('Try next') == page.partition('<script')[0].count('Try next') == 1
    assert f'    {command}\n' in text
    main(['advise', name, '--params', 'params.yaml', '--quiet'])
    advised, _ = capsys.readouterr()
    if verb == 'replay':
        assert f'  {command}\n' in advised
        assert 'Which experiment' not in advised + text
    if verb == 'advise':        # it says itself what its command is for
        assert 'Which experiment would help' in advised
        assert 'Try next' not in advised
        assert 'no further data are needed' not in advised
        assert re.search(r'move torque between \S+ and \S+ Hz', ' '.join(advised.split()))


def test_of_several_inputs_the_one_known_least_is_named():
    numbers = replace(WORST.numbers, curve_gain=np.zeros(3), excitation=tuple(
        Excitation(name, 1.0, 2.0, 9.0, 1.0, unsure)
        for name, unsure in (('a', 0.14), ('b', 2.0))))
    reasons = [reason for _, reason in rules._weaknesses(
        replace(WORST, numbers=numbers, fixed_inputs=(), distance_to_controller=np.ones(2)))]
    assert reasons[0].startswith('The response to input b has')
    assert reasons[1].startswith('The response to input a has')


def test_what_saturates_is_not_advised_to_move_more():
    """The response to its input is not known either, but that is what comes of it."""
    reasons = rules._weaknesses(replace(WORST, fixed_inputs=(), distance_to_controller=np.ones(2)))
    remedy, reason = next(r for r in reasons if 'move' in r[1])
    assert remedy is Remedy.PART
    assert 'take a part of the data in which it moves less' in reason


@pytest.mark.slow
def test_a_simulation_at_half_the_speed_is_to_be_recorded_by_its_own_clock(tmp_path):
    """`ctsid info` was named, which says nothing more; with the right clock it is the plant."""
    def recorded(rate: float) -> list[Sent]:
        return [replace(one, log_ns=START + round((one.log_ns - START) / rate))
                for one in flight(20.0)]

    params = PARAMS.replace(', field:', ', stamp: log, field:')     # as `ctsid init` writes it
    write_params(tmp_path / 'params.yaml', params)
    found = {}
    for rate in (1.0, 0.5):
        write_mcap(tmp_path / 'sim.mcap', recorded(rate))
        assert main(['identify', str(tmp_path / 'sim.mcap'), '--params', str(
            tmp_path / 'params.yaml'), '--out', str(tmp_path / 'out'), '--force', '--quiet']) == 0
        found[rate] = load_estimate(tmp_path / 'out/model.json'), (
            tmp_path / 'out/report.md').read_text(encoding='utf-8')
    assert found[1.0][0].good
    assert 'use-sim-time' not in found[1.0][1]
    assert not found[0.5][0].good
    assert found[0.5][0].verdict.remedy is Remedy.RECORD
    assert 'record with `--use-sim-time`' in found[0.5][0].verdict.reason
    assert 'ros2 bag record -a --use-sim-time' in found[0.5][1]


@pytest.mark.parametrize(('reason', 'command'), [
    ('mixed; stop all but one of them.', 'ros2 bag record -a -o ANOTHER_BAG'),
    ('drift; set `stamp: log` for all channels.', 'ctsid identify bag --params params.yaml'),
    ('rounded; say it, `--time 10Hz`.',
     'ctsid identify bag --params params.yaml --time 10Hz')])
def test_what_mends_samples_is_the_command(reason, command):
    given = Estimate(status=Status.OK, settings=Settings(), model=TRUTH, verdict=replace(
        UNJUDGED, remedy=Remedy.RECORD, reason=reason, grade=Grade.WEAK))
    assert headline(given, Run('', ('bag',), 'params.yaml')).command == command



@pytest.mark.parametrize(('reason', 'made'), [
    ('It is so. If it is so, set `delay: auto`.', '--set order=2 --set delay=auto'),
    ('It is so; set `method: hd-pbsid`.', '--set delay=0.3 --set order=2 --set method=hd-pbsid'),
    ('It is late; correct the stamps (in a bag: set `stamp: log` for all channels).',
     '--set delay=0.3 --set order=2'),
    ('It is a bound; set `delay`, or take a longer window.', '--set delay=0.3 --set order=2')])
def test_what_to_try_next_makes_the_change_that_the_reason_names(reason, made):
    """In place of what was given: the same command once more would say the same."""
    weak = Estimate(status=Status.OK, settings=Settings(), model=TRUTH, verdict=replace(
        UNJUDGED, grade=Grade.WEAK, reason=reason, remedy=Remedy.SETTING))
    run = replace(RUN, changes=('delay=0.3', 'order=2'))
    assert headline(weak, run).command == f'ctsid identify bag --params params.yaml {made}'
