# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
from plants import jittered
import pytest

from ctsid_core import Record, Settings, Signal, Status
from ctsid_core.bases.preparation import Usable, usable
from ctsid_core.bases.records import Joint, join_records
from ctsid_core.errors import SettingsError

T = np.linspace(0.0, 10.0, 201)
MOVING = np.column_stack((np.sin(T), np.cos(2.0 * T), np.sin(3.0 * T)))


def record(u=MOVING[:, :2], y=MOVING, *, t_u=T, t_y=T, **options) -> Record:
    return Record.from_arrays(t_u, u, t_y, y, **options)


def test_a_good_record_is_left_as_it_is():
    given = record()
    part = usable(given, Settings(trim=False))
    assert isinstance(part, Usable)
    assert part.record.inputs[0] is given.inputs[0]
    assert part.record.outputs[0] is given.outputs[0]
    assert (part.u, part.y, part.notes) == ((0, 1), (0, 1, 2), ())
    assert part.whole is given
    assert not part.u_level.any()
    assert not part.y_level.any()


def test_levels_are_taken_off_where_the_trim_is_estimated():
    u, y = MOVING[:, :2] + [1500.0, -3.0], MOVING + [0.0, 101325.0, 1e-3]
    part = usable(record(u, y), Settings())
    for signal, level, given in ((part.record.inputs[0], part.u_level, u),
                                 (part.record.outputs[0], part.y_level, y)):
        np.testing.assert_allclose(level, given.mean(axis=0), rtol=1e-12)
        np.testing.assert_allclose(signal.values + level, given, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(signal.values.mean(axis=0), 0.0, atol=1e-10)


@pytest.mark.parametrize('level', [0.0, 7.0, -1e9, 1e-30])
def test_constant_channels_are_left_out_and_named(level):
    u, y = MOVING[:, :2].copy(), MOVING.copy()
    u[:, 0] = y[:, 1] = level
    given = record(u, y, input_names=('a', 'b'), output_names=('p', 'q', 'r'),
                   output_units=('m', 'rad', 's'))
    part = usable(given, Settings())
    assert (part.u, part.y) == ((1,), (0, 2))
    assert part.record.input_names == ('b',)
    assert part.record.output_names == ('p', 'r')
    assert part.record.output_units == ('m', 's')
    np.testing.assert_allclose(part.record.outputs[0].values + part.y_level, y[:, [0, 2]],
                               atol=1e-12)
    assert any('input a is constant' in note for note in part.notes)
    assert any('output q is constant' in note for note in part.notes)


@pytest.mark.parametrize('size', [1e-12, 1e-3, 1e12])
def test_small_and_large_channels_move_all_the_same(size):
    assert usable(record(size * MOVING[:, :1], size * MOVING), Settings()).notes == ()


def test_rounding_on_top_of_an_offset_is_no_movement():
    y = MOVING.copy()
    y[:, 0] = 1e6 + 1e-9 * np.sin(T)
    assert usable(record(y=y), Settings()).y == (1, 2)


def test_a_small_movement_on_an_offset_is_movement():
    y = MOVING.copy()
    y[:, 0] = 101325.0 + 0.1 * np.sin(T)
    assert usable(record(y=y), Settings()).y == (0, 1, 2)


def test_channels_count_on_across_signals():
    still = Signal(T, np.ones((201, 1)), 'zoh')
    moving = Signal(T, MOVING[:, :2], 'zoh')
    half = Signal(T, np.column_stack((np.ones(201), MOVING[:, 0])), 'zoh')
    given = Record.from_signals([still, moving, half], [moving, still, half])
    part = usable(given, Settings())
    assert part.u == (1, 2, 4)
    assert part.y == (0, 1, 4)
    assert [s.width for s in part.record.inputs] == [2, 1]


def test_no_input_moves():
    assert usable(record(np.ones((201, 2))), Settings()) is Status.NO_EXCITATION


def test_no_output_moves():
    assert usable(record(y=np.ones((201, 2))), Settings()) is Status.NO_RESPONSE


def test_too_few_samples_of_an_output():
    for count, good in ((19, False), (20, True)):
        t = np.linspace(0.0, 10.0, count)
        found = usable(record(t_y=t, y=np.sin(t)), Settings())
        assert isinstance(found, Usable) if good else found is Status.TOO_SHORT


def test_samples_outside_of_the_window_do_not_count():
    given = replace(record(), start=2.0, end=2.5)
    assert usable(given, Settings()) is Status.TOO_SHORT
    still = MOVING.copy()
    still[(T > 3.0) & (T < 8.0), 0] = 1.0
    part = usable(replace(record(y=still), start=3.2, end=7.8), Settings())
    assert part.y == (1, 2)


def test_an_input_that_changes_at_the_edge_of_the_window_moves():
    u = (T > 5.0).astype(float)
    part = usable(replace(record(u, input_hold='zoh'), start=5.02, end=10.0), Settings())
    assert part is Status.NO_EXCITATION or part.u == (0,)


@pytest.mark.parametrize(('at', 'delay', 'acts'), [
    (0.5, 1.0, True), (9.5, 1.0, False), (9.5, 0.0, True)])
def test_an_input_counts_when_it_reaches_the_outputs(at, delay, acts):
    given = record((T > at).astype(float), input_hold='zoh')
    part = usable(given, Settings(delay=delay))
    assert isinstance(part, Usable) if acts else part is Status.NO_EXCITATION
    joint = join_records((given, replace(given, epoch_ns=10 ** 10)), Settings(delay=delay))
    assert isinstance(joint, Joint) is acts


def test_each_input_counts_by_its_own_dead_time():
    u = np.column_stack((T > 0.5, T > 9.5, T > 0.5)).astype(float)
    part = usable(record(u, input_hold='zoh'), Settings(delay=(1.0, 1.0, 0.0)))
    assert part.u == (0,)


@pytest.mark.parametrize(('width', 'told'), [(0.15, ''), (2.0, '20 %'), (4.0, '40 %')])
def test_gaps_of_an_output_are_noted(width, told):
    t = T[(T < 3.0) | (T >= 3.0 + width)]
    found = usable(record(t_y=t, y=np.sin(t), output_names=('roll',)), Settings())
    assert found.notes == ((f'{told} of the window has no samples of roll',) if told else ())


def test_held_inputs_have_no_gaps():
    given = record(t_u=[-1.0, 2.0, 2.1, 2.2, 9.0], u=np.arange(5.0), input_hold='zoh')
    assert usable(given, Settings()).notes == ()


def test_the_window_starts_where_delayed_inputs_are_known():
    given = record()
    part = usable(given, Settings(delay=0.8))
    assert part.record.start == pytest.approx(0.8)
    assert '0.8 s' in part.notes[0]
    part = usable(given, Settings(delay=(0.3, 0.8)))
    assert part.record.start == pytest.approx(0.8)
    # With samples from before the window nothing is lost.
    assert usable(replace(given, start=1.0), Settings(delay=0.8)).record.start == 1.0


def test_dead_times_count_on_across_signals():
    late, early = Signal(T, MOVING[:, :1], 'zoh'), Signal(T - 2.0, MOVING[:, :1], 'zoh')
    given = Record((late, early), (Signal(T, MOVING),), 0.0, 10.0)
    assert usable(given, Settings(delay=(0.1, 2.5))).record.start == pytest.approx(0.5)
    assert usable(given, Settings(delay=(0.1, 2.0))).record.start == pytest.approx(0.1)


def test_a_dead_time_longer_than_the_window():
    assert usable(record(), Settings(delay=12.0)) is Status.TOO_SHORT


def test_the_number_of_dead_times_must_fit():
    with pytest.raises(SettingsError, match='`delay` has 3 values but there are 2 inputs'):
        usable(record(), Settings(delay=(0.1, 0.2, 0.3)))


def test_a_record_without_inputs():
    given = Record.from_signals((), (Signal(T, MOVING),))
    assert usable(given, Settings()) is Status.NO_EXCITATION


def test_jitter_is_no_gap():
    t = jittered(np.random.default_rng(0), 20.0)
    assert usable(record(t_y=t, y=np.sin(t)), Settings()).notes == ()
