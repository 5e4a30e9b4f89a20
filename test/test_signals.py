# SPDX-License-Identifier: Apache-2.0
from dataclasses import FrozenInstanceError

import numpy as np
import pytest

from ctsid_core.errors import CtsidError, DataError
from ctsid_core.signals.record import Record, Signal, common_interval

T = np.arange(11) * 0.1


def record(**changes) -> Record:
    arguments = {'t_u': T, 'u': np.sin(T), 't_y': T, 'y': np.column_stack((T, T ** 2))} | changes
    return Record.from_arrays(**arguments)


def test_arrays_keep_their_stamps_and_orientation():
    r = record(t_u=[0.05, 0.4, 0.41], u=[1, 2, 3], input_names=['a'], output_units=['m', 'rad'])
    assert (r.nu, r.ny) == (1, 2)
    assert r.inputs[0].values.shape == (3, 1)
    assert r.inputs[0].values.dtype == float
    np.testing.assert_array_equal(r.outputs[0].values[:, 1], T ** 2)
    assert (r.inputs[0].hold, r.outputs[0].hold) == ('linear', 'smooth')
    assert (r.input_names, r.output_names) == (('a',), ('y1', 'y2'))
    assert (r.input_units, r.output_units) == (('',), ('m', 'rad'))
    assert (r.start, r.end, r.epoch_ns) == (0.05, 0.41, 0)
    assert r.duration == pytest.approx(0.36)


def test_values_are_frozen():
    with pytest.raises(FrozenInstanceError):
        record().start = 3.0


def test_records_can_be_compared_and_put_in_sets():
    r = record()
    assert r in [record(), r]
    assert r.inputs[0] != record().inputs[0]
    assert len({r, r, record()}) == 2


def test_names_count_on_across_signals():
    plain = Signal(T, np.zeros((11, 2)))
    named = Signal(T, np.zeros((11, 1)), 'zoh', ('v',), ('V',))
    r = Record.from_signals([plain, named, plain], [plain])
    assert r.input_names == ('u1', 'u2', 'v', 'u4', 'u5')
    assert r.input_units == ('', '', 'V', '', '')


@pytest.mark.parametrize(('hold', 'end'), [('zoh', 0.6), ('linear', 0.5), ('smooth', 0.5)])
def test_a_held_value_is_known_for_one_more_interval(hold, end):
    r = record(t_u=T[1:6], u=T[1:6], input_hold=hold)
    assert (r.start, r.end) == pytest.approx((0.1, end))


def test_the_interval_is_the_same_for_any_order_of_signals():
    rng = np.random.default_rng(0)
    signals = [Signal(np.sort(rng.uniform(-k, 5 + k, 20)), np.zeros((20, 1))) for k in range(4)]
    start, end = common_interval(signals)
    assert common_interval(signals[::-1]) == (start, end)
    assert all(s.time[0] <= start < end <= s.time[-1] for s in signals)
    assert any(s.time[0] == start for s in signals)
    assert any(s.time[-1] == end for s in signals)


def test_between_keeps_context_and_cuts_to_the_interval():
    r = record(t_u=T, u=T)
    part = r.between(0.35, 0.65)
    assert (part.start, part.end) == (0.35, 0.65)
    np.testing.assert_allclose(part.outputs[0].time, T[1:10])
    assert (r.between(-5.0, 99.0).start, r.between(-5.0, 99.0).end) == (0.0, 1.0)
    assert r.between(0.35, 0.65, lead=0.2).inputs[0].time[0] == 0.0
    assert r.between(0.35, 0.65, lead=0.2).outputs[0].time[0] == 0.1
    assert len(r.outputs[0].between(0.2, 0.4, context=0).time) == 3


def test_parts_of_parts_are_parts_of_the_whole():
    r = record()
    np.testing.assert_array_equal(r.between(0.2, 0.9).between(0.4, 0.6).outputs[0].values,
                                  r.between(0.4, 0.6).outputs[0].values)


def test_nothing_between_is_an_error():
    for start, end in ((2.0, 3.0), (-2.0, -1.0), (0.5, 0.5), (0.6, 0.5)):
        with pytest.raises(DataError, match='nothing of the record'):
            record().between(start, end)


def test_period_is_the_median_interval():
    assert Signal(np.array([0.0, 1.0, 2.0, 10.0]), np.zeros((4, 1))).period == 1.0
    assert Signal(np.array([0.0]), np.zeros((1, 1))).period == np.inf


@pytest.mark.parametrize(('changes', 'message'), [
    ({'u': np.zeros((1, 11))}, r'`u`.*11 stamps but 1 samples.*transpose'),
    ({'u': np.zeros((11, 1, 1))}, r'`u`.*\(11, 1, 1\)'),
    ({'t_u': T[:, None]}, r'`t_u`.*time has shape \(11, 1\)'),
    ({'t_u': 0.0, 'u': 1.0}, r'time has shape \(\)'),
    ({'u': np.where(T > 0.35, np.nan, 0.0)}, r'sample 4 is not finite: \[nan\]'),
    ({'t_y': np.where(T > 0.35, np.inf, T)}, 'stamp 4 is not finite'),
    ({'t_u': np.where(T == T[3], 0.2, T)}, r'stamps must increase, but stamp 3 is .*0\.2.* after'),
    ({'t_u': T[::-1]}, 'stamps must increase'),
    ({'t_u': T + 5.0}, r'do not overlap in time.*\[5, 6\] s.*same clock'),
    ({'t_u': [], 'u': []}, 'has no sample'),
    ({'t_u': [0.5], 'u': [1.0]}, 'do not overlap'),
    ({'u': ['a'] * 11}, '`u` is not an array of real numbers'),
    ({'u': ['1'] * 11}, '`u` is not an array of real numbers'),
    ({'u': T + 1j}, '`u` is not an array of real numbers'),
    ({'u': [[1], [1, 2]]}, '`u` is not an array of real numbers'),
    ({'t_y': T.astype('timedelta64[s]')}, '`t_y`.*times are in seconds'),
    ({'u': [None] * 11}, 'sample 0 is not finite|real numbers'),
    ({'input_hold': 'foh'}, "hold is 'foh'; choose one of"),
    ({'output_names': ['y']}, '1 names for 2 channels'),
    ({'output_units': ['m', 'm', 'm']}, '3 units for 2 channels'),
])
def test_what_cannot_be_a_record_is_refused(changes, message):
    with pytest.raises(DataError, match=f'(?s){message}'):
        record(**changes)


def test_errors_are_value_errors_too():
    with pytest.raises(ValueError, match='`outputs` is empty') as caught:
        Record.from_signals([], [])
    assert isinstance(caught.value, CtsidError)


def test_a_record_needs_no_input():
    assert Record.from_signals([], [Signal(T, T[:, None])]).nu == 0
