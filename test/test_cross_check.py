# SPDX-License-Identifier: Apache-2.0
"""A second method: it agrees where models are right, and its word is never lost nor too kind."""

from __future__ import annotations

from dataclasses import replace
import json

from marks import slow
import numpy as np
from plants import PLANTS, held, random_plant, running
import pytest

from ctsid_core import Record, Settings, StateSpace, identify
from ctsid_core.errors import SettingsError, StorageError
from ctsid_core.judge.cross_check import agreement, cross_checked
from ctsid_core.judge.rules import KNOWN, in_sequence, weakened
from ctsid_core.model.covariance import Covariance
from ctsid_core.model.estimate import Estimate, Status
from ctsid_core.model.model_json import from_json, to_json
from ctsid_core.model.verdict import Agreement, Excitation, Grade, Remedy, Verdict
from ctsid_core.settings import Actuator
from ctsid_core.subspace.methods import METHODS
from ctsid_ros.report.document import to_text
from ctsid_ros.report.sections import model_section
from ctsid_ros.studies.robots.families import experiment

ALL = tuple(METHODS)
BAND = Excitation('u', 0.5, 20.0, 30.0, 1.0, 0.01)
GOOD = Verdict(grade=Grade.GOOD, reason='Every test is passed.', excitation=(BAND,))


def record(seed: int = 0) -> Record:
    return running(np.random.default_rng(seed), PLANTS['hd51'], 30, rate=100.0)


def first_order(gain: float, spread: float = 0.0, **more) -> Estimate:
    """Return an estimate of gain / (s + 2), the gain known to a relative deviation."""
    model = StateSpace(A=[[-2.0]], B=[[gain]], C=[[1.0]], D=[[0.0]], K=[[0.0]],
                       input_names=('u',), output_names=('y',))
    root = np.array([[0.0, spread * gain, 0.0, 0.0, 0.0]])
    return Estimate(**({'status': Status.OK, 'settings': Settings(), 'model': model,
                        'covariance': Covariance(root, 1, 1, 1), 'verdict': GOOD,
                        'end_ns': 10**11} | more))


def plain(estimate: Estimate) -> dict:
    """Return all bits but for what asks for and tells of the second method."""
    document = json.loads(to_json(estimate))
    document['settings'].pop('validation.cross_check')
    for key in ('agreement', 'grade', 'reason', 'remedy'):
        document['verdict'].pop(key, None)
    return document


@pytest.mark.parametrize(('method', 'checker', 'seeds'), [
    ('hd-pbsid', 'gobf', 1), *slow(
        ('hd-pbsid', 'ct-pbsid', 2), ('hd-pbsid', 'gobf', 2), ('gobf', 'hd-pbsid', 2),
        ('ct-pbsid', 'hd-pbsid', 2), ('ct-pbsid', 'gobf', 2))])
def test_methods_agree_on_a_plant_that_both_can_be_right_about(method, checker, seeds):
    for seed in range(seeds):
        alone = identify(record(seed), Settings(method=method, order=2))
        both = identify(record(seed), Settings(method=method, order=2, cross_check=checker))
        assert both.verdict.agreement.agrees
        assert both.verdict.agreement.method == checker
        assert both.verdict.agreement.relative < 0.05
        assert both.verdict.grade is alone.verdict.grade is Grade.GOOD
        assert both.verdict.reason == alone.verdict.reason
        assert plain(both) == plain(alone)


def test_without_a_checker_no_second_method_is_run(monkeypatch):
    asked = []
    for name, method in METHODS.items():
        monkeypatch.setitem(METHODS, name, replace(
            method, models=lambda *args, n=name, m=method.models: (asked.append(n), m(*args))[1]))
    found = identify(record())
    assert asked == []
    assert found.verdict.agreement is None
    assert 'agreement' not in json.loads(to_json(found))['verdict']
    identify(record(), Settings(cross_check='gobf'))
    assert set(asked) == {'gobf'}


@pytest.mark.parametrize('factor', [1.0, 1.02, 1.2])
def test_the_difference_is_that_of_the_responses(factor):
    """Of a gain that is wrong by a factor all is known in closed form."""
    found = agreement(first_order(3.0, 0.03), first_order(3.0 * factor, 0.04), 'gobf')
    omega = np.geomspace(0.5, 20.0, 60)
    size = np.abs(1.0 / (1j * omega + 2.0))
    assert found.relative == pytest.approx(
        abs(factor - 1.0) * size.max() / np.sqrt(np.mean(size ** 2)), abs=1e-12)
    assert found.deviations == pytest.approx(
        abs(factor - 1.0) / np.hypot(0.03, 0.04 * factor), abs=1e-9)
    assert found.agrees == (factor < 1.1)
    if factor != 1.0:
        assert found.frequency == pytest.approx(0.5)
        assert found.input == 'u'


def test_models_with_other_timeouts_do_not_agree():
    one = first_order(3.0, 0.03)
    first, second, like = (replace(one, model=replace(one.model, actuators=(Actuator(timeout),)))
                           for timeout in (0.0, 0.5, 0.48))
    found = agreement(first, second, 'gobf')
    assert found.contradicts
    assert '`timeout` of input u is 0.5, and 0 with the first' in str(found)
    assert agreement(second, like, 'gobf').agrees


def test_the_input_whose_response_differs_is_named():
    def two(gain: float) -> Estimate:
        model = StateSpace(A=[[-2.0]], B=[[1.0, gain]], C=[[1.0], [1e3]], D=np.zeros((2, 2)),
                           K=np.zeros((1, 2)), input_names=('stick', 'pedal'))
        root = np.zeros((1, Covariance.entry_count(1, 2, 2)))
        root[0, 1:3] = 0.01, 0.01 * gain
        bands = (replace(BAND, name='stick'), replace(BAND, name='pedal', low=0.0, high=5.0))
        return Estimate(status=Status.OK, settings=Settings(), model=model, end_ns=10 * 10**9,
                        covariance=Covariance(root, 1, 2, 2),
                        verdict=replace(GOOD, excitation=bands))

    found = agreement(two(1e-3), two(1.5e-3), 'gobf')
    assert found.input == 'pedal'
    assert found.frequency == pytest.approx(2 * np.pi / 10)      # the slowest that 10 s can tell
    assert found.deviations == pytest.approx(0.5 / np.hypot(0.01, 0.015))
    assert not found.agrees


@pytest.mark.parametrize('vague', [0.01, 0.11, 0.3])
def test_an_input_that_is_hardly_known_does_not_hide_one_that_contradicts(vague):
    def two(gain: float) -> Estimate:
        model = StateSpace(A=[[-2.0]], B=[[gain, 1.0]], C=[[1.0]], D=[[0.0, 0.0]], K=[[0.0]],
                           input_names=('stick', 'pedal'))
        root = np.zeros((2, Covariance.entry_count(1, 2, 1)))
        root[0, 1], root[1, 2] = 0.01 * gain, vague
        bands = (replace(BAND, name='stick'), replace(BAND, name='pedal'))
        return Estimate(status=Status.OK, settings=Settings(), model=model, end_ns=10**11,
                        covariance=Covariance(root, 1, 2, 1),
                        verdict=replace(GOOD, excitation=bands))

    found = agreement(two(1.0), two(1.3), 'gobf')
    assert found.contradicts
    assert found.difference == pytest.approx(0.3)
    assert found.difference_std == pytest.approx(np.hypot(0.01, 0.013))
    same = agreement(two(1.0), two(1.0), 'gobf')
    assert (same.difference, same.agrees) == (0.0, np.sqrt(2.0) * vague < KNOWN)
    assert same.difference_std == pytest.approx(np.sqrt(2.0) * vague)


@pytest.mark.parametrize(('relative', 'spread', 'method', 'agrees'), [
    (0.1, 0.1 / 2.5, 'gobf', True), (0.1, 0.1 / 2.5, 'hd-pbsid', False),
    (0.1, 0.1 / 3.2, 'gobf', False), (0.1, 0.1 / 1.8, 'hd-pbsid', True),
    (0.01, 1e-4, 'hd-pbsid', True), (0.2, 0.0, 'gobf', False)])
def test_both_limits_have_to_be_exceeded(relative, spread, method, agrees):
    found = agreement(first_order(1.0, spread), first_order(1.0 + relative), method)
    assert (found.agrees, found.contradicts) == (agrees, not agrees)
    assert ('agrees' in found.words) == agrees
    assert bool(found.weakness) == (not agrees)


def test_states_do_not_matter_nor_do_units():
    one = identify(record(), Settings(order=2))
    turned = replace(one, model=one.model.transform([[1.0, 2.0], [-3.0, 1.0]]))
    assert agreement(one, turned, 'gobf').relative < 1e-9
    data = record()
    other = Record.from_arrays(data.inputs[0].time, data.inputs[0].values,
                               data.outputs[0].time, 1e3 * data.outputs[0].values
                               * np.array([1.0, 1e-6]), input_hold='smooth')
    found, scaled = (identify(r, Settings(order=2, cross_check='gobf')).verdict.agreement
                     for r in (data, other))
    assert scaled.relative == pytest.approx(found.relative, rel=1e-4)
    assert scaled.deviations == pytest.approx(found.deviations, rel=1e-4)


def test_deviations_that_are_not_known_excuse_nothing_and_prove_nothing():
    vague = replace(first_order(1.1), covariance=None)
    found = agreement(first_order(1.0, 1.0), vague, 'gobf')
    assert found.contradicts
    assert np.isnan(found.deviations)
    assert 'standard deviations' not in found.weakness
    found = agreement(first_order(1.0, 1.0), replace(first_order(1.01), covariance=None), 'gobf')
    assert (found.agrees, found.contradicts) == (False, False)
    assert found.words == ('gobf cannot tell: over the excited band it differs by 1 % of the '
                           'response, but standard deviations are not known.')


@pytest.mark.parametrize(('factor', 'spread', 'other', 'word'), [
    (1.02, 0.03, 0.04, 'agrees'), (1.1, 0.06, 0.06, 'agrees'),
    (1.02, 1.0, 1.0, 'cannot tell'),            # anything would lie within these deviations
    (1.0, 0.0, 0.13, 'cannot tell'), (1.0, 0.0, 0.11, 'agrees'),
    (1.2, 0.05, 0.05, 'cannot tell'),           # by chance, or by more than matters
    (1.3, 0.03, 0.03, 'does not agree')])
def test_agreement_is_told_only_where_difference_and_deviation_are_within_what_matters(
        factor, spread, other, word):
    """Both in the unit, and with the limit, that the verdict has for the response to an input."""
    found = agreement(first_order(3.0, spread), first_order(3.0 * factor, other), 'gobf')
    assert found.difference == pytest.approx(factor - 1.0)
    assert found.difference_std == pytest.approx(np.hypot(spread, factor * other))
    assert found.words.startswith(f'gobf {word}: ')
    assert (found.agrees, found.contradicts) == (word == 'agrees', word == 'does not agree')
    assert bool(found.weakness) == found.contradicts
    verdict = checked(first_order(3.0, spread), first_order(3.0 * factor, other)).verdict
    assert verdict.grade is (Grade.WEAK if found.contradicts else Grade.GOOD)


@pytest.mark.parametrize(('spread', 'count'), [
    (0.02, 50), (3.0, 50), *slow(
        (0.08, 100), (0.02, 300), (0.08, 300), (0.3, 300), (3.0, 300))])
def test_models_of_two_plants_are_not_told_to_agree_however_vague(spread, count):
    """Gains drawn with the deviations that they claim, of plants 36 % apart, and of the same."""
    rng, apart, same = np.random.default_rng(5), 0, []
    for _ in range(count):
        a, b, c = 1.0 + spread * rng.standard_normal(3)
        def drawn(gain):
            return first_order(gain, spread / gain)
        apart += agreement(drawn(a), drawn(b + 0.36), 'gobf').agrees
        same.append(agreement(drawn(a), drawn(c), 'gobf'))
    assert apart <= 0.03 * count
    assert sum(f.contradicts for f in same) <= 0.01 * count
    assert sum(f.agrees for f in same) >= (0.95 if spread < 0.05 else 0.0) * count


def test_the_deviation_of_the_difference_is_the_response_std_of_the_verdict():
    found = identify(record(), Settings(order=2))
    seen = agreement(found, found, 'gobf')
    own = max(x.uncertainty for x in found.verdict.excitation)
    assert seen.difference == 0.0
    assert seen.difference_std / np.sqrt(2.0) == pytest.approx(own, rel=0.4)


def checked(found: Estimate, other: Estimate) -> Estimate:
    return cross_checked(found, Settings(cross_check='gobf'), lambda settings: other)


def test_a_second_method_without_a_model_is_no_silent_agreement():
    none = Estimate(status=Status.TOO_SHORT, settings=Settings())
    rejected = first_order(1.0, model=None, rejected_model=first_order(1.0).model,
                           status=Status.UNEXPLAINED,
                           verdict=replace(GOOD, grade=Grade.REJECT, reason='Nothing fits.'))
    for other, word in ((none, 'TOO_SHORT'), (rejected, 'UNEXPLAINED. Nothing fits;')):
        found = checked(first_order(1.0), other)
        assert found.verdict.grade is Grade.WEAK
        assert word in found.verdict.reason
        assert 'gobf' in found.verdict.reason
        assert not found.verdict.agreement.agrees
    assert checked(first_order(1.0), rejected).verdict.agreement.relative == 0.0
    quiet = first_order(1.0, verdict=replace(GOOD, excitation=()))
    assert checked(quiet, rejected).verdict.agreement.contradicts


def test_what_cannot_be_compared_does_not_contradict():
    """Nothing was compared: that is no agreement, and nothing against the model."""
    quiet = first_order(1.0, verdict=replace(GOOD, excitation=()))
    steady = first_order(1.0, verdict=replace(GOOD, excitation=(
        replace(BAND, low=2.0, high=2.0),)))
    undamped = replace(steady, model=StateSpace(
        A=[[0.0, 2.0], [-2.0, 0.0]], B=[[1.0], [0.0]], C=[[1.0, 0.0]], D=[[0.0]],
        K=[[0.0], [0.0]], input_names=('u',), output_names=('y',)), covariance=None)
    for first, second, why in ((quiet, quiet, 'no input excites a band to compare in.'),
                               (steady, undamped, 'a response is not finite.'),
                               (undamped, steady, 'a response is not finite.')):
        found = checked(first, second)
        seen = found.verdict.agreement
        assert (seen.agrees, seen.contradicts, seen.answer) == (False, False, 'cannot tell')
        assert seen.problem == why
        assert seen.words == f'gobf cannot be compared: {why}'
        assert seen.weakness == ''
        assert found.verdict.grade is Grade.GOOD


def test_a_model_that_diverges_does_not_agree_however_near_its_response_is():
    """A slow mode that grows is hardly seen in the band, but no simulation is right with it."""
    def beside(pole: float) -> Estimate:
        model = StateSpace(A=[[-2.0, 0.0], [0.0, pole]], B=[[1.0], [1e-3]], C=[[1.0, 1.0]],
                           D=[[0.0]], K=[[0.0], [0.0]], input_names=('u',), output_names=('y',))
        return first_order(1.0, model=model, covariance=Covariance(np.zeros((1, 10)), 2, 1, 1))

    stable, integrates, grows = beside(-0.1), beside(1e-6), beside(0.1)      # of 100 s
    for first, second, words in (
            (stable, grows, 'its model diverges, as exp(0.1 t), and the first does not'),
            (grows, integrates, 'the first model diverges, as exp(0.1 t), and its own does not')):
        found = agreement(first, second, 'gobf')
        assert (found.answer, found.difference < 0.01) == ('no', True)
        assert words in found.words
    for first, second in ((stable, stable), (stable, integrates), (grows, grows)):
        assert agreement(first, second, 'gobf').answer == 'yes'


def test_a_verdict_never_gets_better():
    weak = first_order(1.0, verdict=replace(GOOD, grade=Grade.WEAK, reason='A pole is uncertain.'))
    for factor in (1.0, 2.0):
        found = checked(weak, first_order(factor, 0.01))
        assert (found.verdict.grade, found.verdict.reason) == (Grade.WEAK, 'A pole is uncertain.')
        assert found.verdict.agreement.agrees == (factor == 1.0)
    rejected = Estimate(status=Status.CHANGED, settings=Settings(),
                        rejected_model=weak.model)
    assert cross_checked(rejected, Settings(cross_check='gobf'), pytest.fail) is rejected


def test_models_that_were_foretold_do_not_outvote_the_second_method():
    untested = first_order(1.0, verdict=replace(
        GOOD, grade=Grade.WEAK, reason='Not tested.', remedy=Remedy.TEST))
    fit, ratio = np.array([95.0]), np.array([1.0])
    for factor, grade in ((1.0, Grade.GOOD), (2.0, Grade.WEAK)):
        found = in_sequence(checked(untested, first_order(factor)), fit, ratio, np.array([0.05]))
        assert found.verdict.grade is grade
        assert ('gobf' in found.verdict.reason) == (factor == 2.0)


def test_the_second_method_is_told_order_and_dead_time():
    asked = []
    found = first_order(1.0)
    found = replace(found, model=replace(found.model, delay=(0.3,)))

    def identify_again(settings):
        asked.append(settings)
        return found

    given = Settings(cross_check='gobf', feedthrough=False)
    cross_checked(found, given, identify_again)
    assert asked[-1] == Settings(method='gobf', order=1, delay=(0.3,), feedthrough=False)
    # What the first did not look for is left to one that does, and the order that stood for it.
    cross_checked(found, Settings(method='gobf', cross_check='hd-pbsid'), identify_again)
    assert asked[-1] == Settings()
    cross_checked(found, Settings(method='gobf', cross_check='hd-pbsid', delay=0.3),
                  identify_again)
    assert asked[-1] == Settings(order=1, delay=(0.3,))
    stops = replace(found, model=replace(found.model, actuators=(Actuator(0.5),)))
    cross_checked(stops, given, identify_again)
    assert asked[-1].actuators(1) == (Actuator(timeout=0.5),)


def with_delay(estimate: Estimate, delay: float, std: float) -> Estimate:
    root = estimate.covariance.root.copy()
    root[0, -1] = std
    return replace(estimate, model=replace(estimate.model, delay=(delay,)),
                   covariance=Covariance(root, 1, 1, 1))


@pytest.mark.parametrize(('delay', 'std', 'agrees'), [
    (1e-3, 1e-4, False), (1e-3, 4e-4, True), (0.0, 0.0, True), (1e-3, 0.0, False)])
def test_a_dead_time_beyond_its_deviation_is_no_agreement(delay, std, agrees):
    found = agreement(first_order(1.0), with_delay(first_order(1.0), delay, std), 'hd-pbsid')
    assert found.relative < 0.05
    assert found.agrees == agrees
    assert (found.late, found.dead_time) == (('', 0.0) if agrees else ('u', delay))
    if not agrees:
        assert 'acts 0.001 s later; set its `delay`.' in found.weakness
        assert 'finds that input u acts 0.001 s later' in found.words
    back = agreement(with_delay(first_order(1.0), delay, std), first_order(1.0), 'gobf')
    assert agrees or 'earlier' in back.words


@pytest.mark.parametrize('method', slow('gobf', 'ct-pbsid'))
def test_a_dead_time_that_a_method_does_not_look_for_is_noticed(method):
    """States stand for it so well that the model passes every other test; its poles are wrong."""
    late = held(np.random.default_rng(6), PLANTS['hd51'], 50.0, 100.0, delay=0.08, snr=25)
    alone = identify(late, Settings(method=method))
    assert alone.good
    assert alone.model.n > 2
    both = identify(late, Settings(method=method, cross_check='hd-pbsid'))
    assert both.verdict.grade is Grade.WEAK
    assert both.verdict.agreement.dead_time == pytest.approx(0.08, abs=0.003)
    assert both.verdict.agreement.late == 'u1'
    assert plain(both) == plain(alone)
    known = identify(late, Settings(method=method, cross_check='hd-pbsid', delay=0.08))
    assert known.verdict.agreement.agrees
    assert known.good


@pytest.mark.parametrize('method', ['ct-pbsid', *slow('gobf')])
def test_a_state_too_few_is_noticed(method):
    rng = np.random.default_rng([78, 1])
    data = running(rng, random_plant(rng, 3, 1, 2), 25, rate=200.0)
    for order, agrees in ((2, False), (3, True)):
        found = identify(data, Settings(method=method, cross_check='hd-pbsid', order=order))
        assert found.verdict.agreement.agrees == agrees
        assert found.good == agrees


@pytest.mark.slow
def test_several_records_and_dead_time_are_checked():
    plant = PLANTS['hd51']
    records = [held(np.random.default_rng(seed), plant, 50.0, 100.0, delay=0.08, snr=30,
                    duration=5.0) for seed in (1, 2)]
    found = identify(records, Settings(cross_check='ct-pbsid'))
    assert found.model.delay[0] == pytest.approx(0.08, abs=0.002)
    assert found.good
    assert found.verdict.agreement.agrees
    assert found.verdict.agreement.relative < 0.05


@pytest.mark.parametrize('seen', [
    Agreement('gobf', True, False, 0.012, 0.7, 'stick "é"', 3.25, 0.01, 1 / 3),
    Agreement('gobf', False, False, 0.3, 0.7, 'u', 3.25, 0.2, 1.7),
    Agreement('ct-pbsid', False, True, np.inf, np.nan, 'u', 0.1 + 0.2),
    Agreement('hd-pbsid', False, True, 0.01, 0.3, 'u', 2.0, late='u', dead_time=1 / 30),
    Agreement('gobf', False, True, problem='TOO_SHORT. Take more.')])
def test_it_is_stored_to_the_last_bit(seen):
    found = first_order(1.0, verdict=weakened(replace(GOOD, agreement=seen)))
    text = to_json(found)
    again = from_json(text)
    assert to_json(again) == text
    assert repr(again.verdict.agreement) == repr(seen)       # NaN is not equal to itself
    assert again.verdict.grade is (Grade.WEAK if seen.contradicts else Grade.GOOD)
    for key, value, said in (('agrees', 1, 'true or false'), ('method', 3, 'a word'),
                             ('relative', 'x', 'finite number')):
        document = json.loads(text)
        document['verdict']['agreement'][key] = value
        with pytest.raises(StorageError, match=f'verdict.agreement.{key}.*{said}'):
            from_json(json.dumps(document))
    del document['verdict']['agreement']['input']
    with pytest.raises(StorageError, match='missing: input'):
        from_json(json.dumps(document))


@pytest.mark.parametrize('agreed', [True, False])
def test_an_agreement_of_version_1_is_not_known(agreed):
    """There every difference within its deviations agreed, and none over the band was told."""
    seen = Agreement('gobf', agreed, not agreed, 0.3, 0.7, 'u', 3.25, 0.01, 0.3)
    document = json.loads(to_json(first_order(1.0, verdict=replace(GOOD, agreement=seen))))
    document['version'] = 1
    for key in ('contradicts', 'difference', 'difference_std'):
        del document['verdict']['agreement'][key]
    found = from_json(json.dumps(document)).verdict.agreement
    assert found.answer == ('cannot tell' if agreed else 'no')
    assert 'nan' not in found.words
    if agreed:
        assert found.words == ('gobf cannot tell: by how much it differs over the excited band is '
                               'not known.')
    document['verdict']['agreement']['agrees'] = 1
    with pytest.raises(StorageError, match='agrees.*true or false'):
        from_json(json.dumps(document))


def test_people_are_told():
    found = checked(first_order(1.0, 0.01), first_order(1.3))
    said = found.verdict.agreement.words
    assert said.startswith('gobf does not agree: it differs by ')
    assert said.removeprefix('gobf does not agree: it ')[:14] in found.verdict.reason
    text = ' '.join(to_text([model_section(found, 'Model')]).split())
    assert f'Cross-check: {said}' in text
    assert 'Cross-check' not in to_text([model_section(first_order(1.0), 'Model')])


def test_a_method_does_not_check_itself():
    for method in ('hd-pbsid', 'ct-pbsid', 'gobf'):
        with pytest.raises(SettingsError, match='as `method` is; choose another'):
            Settings(method=method, cross_check=method)
    with pytest.raises(SettingsError, match='cross_check` is .n4sid.; choose one of .none'):
        Settings(cross_check='n4sid')


@pytest.mark.parametrize('number', [3, *slow(1, 2)])
def test_hd_pbsid_refines_its_model_even_if_the_first_method_may_not(number):
    """A dead time that the first has not looked for is found, whatever `refine` says."""
    given = experiment('roll', 23, number)
    found = identify(given.record, Settings(method='gobf', refine=False, cross_check='hd-pbsid'))
    assert found.verdict.agreement.contradicts
    assert found.verdict.agreement.dead_time > 0.03
