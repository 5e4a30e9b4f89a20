# SPDX-License-Identifier: Apache-2.0
from dataclasses import MISSING, FrozenInstanceError, fields, replace
import math
import re

import pytest

from ctsid_core.errors import CtsidError, SettingsError
from ctsid_core.settings import Settings, parameter, parameter_name, value_faults

FIELDS = fields(Settings)
NUMBERS = [f for f in FIELDS if f.metadata['low'] is not None]


def test_defaults_are_valid_and_survive_ros_names():
    settings = Settings()
    assert Settings.from_dict(settings.to_dict()) == settings
    other = Settings(order=3, delay=(0.1, 0.2), trim=False, window_length=3.5)
    assert Settings.from_dict(other.to_dict()) == other
    as_ros_has_it = {k: list(v) if isinstance(v, tuple) else v for k, v in other.to_dict().items()}
    assert Settings.from_dict(as_ros_has_it) == other
    assert Settings.from_dict({}) == settings


def test_names_are_unique_dotted_lower_snake_case_and_explained():
    names = [parameter_name(f) for f in FIELDS]
    assert len(set(names)) == len(names)
    for declared, name in zip(FIELDS, names, strict=True):
        assert re.fullmatch(r'[a-z][a-z_]*(\.[a-z][a-z_]*)?', name)
        assert declared.metadata['doc'].endswith('.')
        assert declared.metadata['when'].endswith('.') or not declared.metadata['when']
        assert declared.default is not MISSING


@pytest.mark.parametrize('declared', NUMBERS, ids=parameter_name)
def test_ends_of_a_range_belong_to_it_and_nothing_beyond(declared):
    kind = float if declared.metadata['words'] else type(declared.default)
    for end, beyond in ((declared.metadata['low'], -1), (declared.metadata['high'], 1)):
        assert value_faults(declared, kind(end)) == []
        outside = end + beyond if kind is int else math.nextafter(end, beyond * math.inf)
        fault, = value_faults(declared, outside)
        name = parameter_name(declared)
        assert fault.startswith(f'`{name}` is {outside!r}, but must lie between')
        assert declared.metadata['unit'] in fault


@pytest.mark.parametrize('declared', NUMBERS, ids=parameter_name)
@pytest.mark.parametrize('value', [math.nan, math.inf, -math.inf, 10**400, -10**400, True, None,
                                   '3', [1], 1j, {}])
def test_no_number_no_parameter(declared, value):
    fault, = value_faults(declared, value)
    assert parameter_name(declared) in fault
    with pytest.raises(SettingsError):
        Settings(**{declared.name: value})


def test_infinity_is_no_value_even_without_a_range():
    declared = replace_declared()
    assert value_faults(declared, 1e300) == []
    assert value_faults(declared, 10**400) == []
    assert len(value_faults(declared, math.inf)) == len(value_faults(declared, math.nan)) == 1


def replace_declared():
    from dataclasses import make_dataclass
    made = make_dataclass('Free', [('x', float, parameter(1.0, 'Free.'))])
    return fields(made)[0]


@pytest.mark.parametrize(('values', 'message'), [
    ({'order': 2.0}, r'`order` is 2.0 \(float\), but a whole number is wanted'),
    ({'trim': 1}, r'`trim` is 1 \(int\), but a true or false is wanted'),
    ({'method': 3}, r'`method` is 3 \(int\), but a word is wanted'),
    ({'method': 'n4sid'}, "`method` is 'n4sid'; choose one of 'hd-pbsid'"),
    ({'order': (1, 2)}, '`order` is a list, but one whole number'),
    ({'delay': (0.1, -0.1)}, '`delay` is -0.1'),
    ({'past': 2, 'future': 3}, '`pbsid.future` is 3 but must not exceed `pbsid.past` \\(2\\)'),
])
def test_wrong_values_are_named(values, message):
    with pytest.raises(SettingsError, match=message) as caught:
        Settings(**values)
    assert len(caught.value.faults) == 1


def test_whole_numbers_are_numbers():
    assert Settings(window_length=20, delay=0).window_length == 20


def test_all_faults_at_once():
    with pytest.raises(SettingsError) as caught:
        Settings.from_dict({'ordr': 3, 'method': 'x', 'window.length': -1.0, 'pbsid.past': 2,
                           'pbsid.future': 3, 'quite_something_else': 1})
    text = '\n'.join(caught.value.faults)
    assert len(caught.value.faults) == 5
    for part in ('`ordr` is not a parameter; did you mean order', "`method` is 'x'",
                 '`window.length` is -1.0', '`pbsid.future` is 3',
                 '`quite_something_else` is not a parameter; known names: method'):
        assert part in text
    assert str(caught.value).startswith('5 faults in the parameters:\n  ')
    assert isinstance(caught.value, ValueError)
    assert isinstance(caught.value, CtsidError)


def test_settings_do_not_change_but_copies_do():
    settings = Settings()
    with pytest.raises(FrozenInstanceError):
        settings.order = 3
    assert settings.replace(order=3) == replace(settings, order=3) == Settings(order=3)
    with pytest.raises(SettingsError, match='`order` is -1'):
        settings.replace(order=-1)


def test_delays_may_be_left_to_the_data():
    assert Settings().delay == 'auto'
    mixed = Settings(delay=('auto', 0.2))
    assert mixed.delays(2) == (0.0, 0.2)
    assert mixed.unknown_delays(2) == (True, False)
    assert mixed.with_known_delays().delay == (0.0, 0.2)
    assert Settings().with_known_delays().delay == 0.0
    for wrong in ('Auto', ('auto', 'x'), True, ('auto', -1.0)):
        with pytest.raises(SettingsError, match='`delay` is'):
            Settings(delay=wrong)


def test_timeouts_may_be_left_to_the_data():
    assert Settings().timeout == 'auto'
    mixed = Settings(timeout=('auto', 0.5))
    assert [own.timeout for own in mixed.actuators(2)] == [0.0, 0.5]
    assert mixed.unknown_actuators('timeout', 2) == (True, False)
    assert Settings.from_dict(mixed.to_dict()) == mixed
    for wrong in ('Auto', ('auto', 'x'), True, -1.0, 61.0):
        with pytest.raises(SettingsError, match='`timeout` is'):
            Settings(timeout=wrong)
    with pytest.raises(SettingsError, match='`timeout` has 2 values but there are 3 inputs'):
        mixed.actuators(3)


def test_delays_are_one_for_all_or_one_each():
    assert Settings(delay=0.2).delays(3) == (0.2, 0.2, 0.2)
    assert Settings(delay=(0.1, 0.2)).delays(2) == (0.1, 0.2)
    assert Settings().delays(0) == ()
    with pytest.raises(SettingsError, match='`delay` has 2 values but there are 3 inputs'):
        Settings(delay=(0.1, 0.2)).delays(3)
