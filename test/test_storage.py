# SPDX-License-Identifier: Apache-2.0
"""Files: to the last bit and back, and refused with a cure if they are anything else."""

import csv
from dataclasses import fields, replace
import json
import math
import os
from pathlib import Path
import threading

import numpy as np
import pytest

from ctsid_core.errors import StorageError
from ctsid_core.model import storage
from ctsid_core.model.covariance import Covariance, Rival
from ctsid_core.model.estimate import Choice, Estimate, OrderTried, Status
from ctsid_core.model.statespace import StateSpace
from ctsid_core.model.storage import (
    from_json,
    load_estimate,
    load_metadata,
    load_model,
    load_series,
    save_model,
    save_series,
    to_json,
)
from ctsid_core.model.verdict import Excitation
from ctsid_core.settings import Actuator, Settings

ACTUATORS = Actuator(0.1 + 0.2, rate_limit=1 / 3), Actuator(limit=2.0)


def model(seed=0, n=3, nu=2, ny=2, **more):
    rng = np.random.default_rng(seed)
    sizes = {'A': (n, n), 'B': (n, nu), 'C': (ny, n), 'D': (ny, nu), 'K': (n, ny),
             'x_trim': (n,), 'y_trim': (ny,), 'noise': (ny, ny)}
    arrays = {name: rng.standard_normal(size) * 10.0 ** rng.integers(-8, 8, size)
              for name, size in sizes.items()}
    return StateSpace(**{**arrays, 'delay': tuple(rng.uniform(0, 1, nu)),
                         'input_names': tuple(f'stick "{i}", \u00e9\n' for i in range(nu)),
                         'output_units': ('\u00b0/s',) * ny, **more})


def covariance(seed=0, n=3, nu=2, ny=2, rows=4):
    rng = np.random.default_rng(seed)
    shape = rows, Covariance.entry_count(n, nu, ny)
    root = rng.standard_normal(shape) * 10.0 ** rng.integers(-12, 12, shape)
    root[:, -nu:] = -0.0
    return Covariance(root, n, nu, ny)


def estimate(seed=0, **more):
    whole = {
        'status': Status.OK, 'model': model(seed), 'rejected_model': model(seed + 100, n=1),
        'settings': Settings(order=3, delay=(0.1, 1 / 3), beta=0.1 + 0.2, feedthrough=False),
        'pole_std': np.array([np.nan, 1e-300, 5e-324]), 'fit': np.array([99.9, -np.inf]),
        'held_out_fit': np.array([np.nan, -0.0]), 'singular_values': np.array([3.0, 1e-17]),
        'condition': np.inf, 'start_ns': 1_700_000_000_123_456_789,
        'end_ns': 1_700_000_010_123_456_789,
        'choices': (Choice('order', 3, 'the drop \u2192 is there'), Choice('late', (0.1, 2), ''),
                    Choice('trim', True, 'x'), Choice('nothing', None, 'x')),
        'notes': ('one', 'two'), 'statistics': {'rms [rad]': 0.1, 'nan': np.nan, 'inf': -np.inf}}
    return Estimate(**{**whole, **more})


def same(a, b):
    """Whether two estimates agree to the last bit, NaN and the sign of zero included."""
    def bits(x):
        return x.tobytes() + str(x.shape).encode() if isinstance(x, np.ndarray) else repr(x)
    for f in fields(Estimate):
        x, y = getattr(a, f.name), getattr(b, f.name)
        if isinstance(x, StateSpace | Covariance) and type(x) is type(y):
            if any(bits(getattr(x, g.name)) != bits(getattr(y, g.name)) for g in fields(x)):
                return False
        elif bits(x) != bits(y):
            return False
    return True


def broken(change):
    """Return the JSON of an estimate after a change of its document."""
    document = json.loads(to_json(estimate()))
    change(document)
    return json.dumps(document)


def test_the_comparison_of_this_test_sees_single_bits():
    whole = estimate()
    assert same(whole, replace(whole))
    moved = replace(whole.model, A=np.nextafter(whole.model.A, 10))
    for other in (replace(whole, model=moved), replace(whole, held_out_fit=np.zeros(2)),
                  replace(whole, notes=()), replace(whole, covariance=covariance()),
                  replace(whole, condition=1.0),
                  replace(whole, model=replace(whole.model, actuators=ACTUATORS)),
                  replace(whole, model=replace(whole.model, delay=(0.0, 0.0)))):
        assert not same(whole, other)


@pytest.mark.parametrize('whole', [
    estimate(), estimate(covariance=covariance()),
    estimate(status=Status.CHANGED, model=None, rejected_model=model(), covariance=covariance()),
    estimate(covariance=covariance(rows=0)),
    estimate(covariance=replace(covariance(), rivals=(Rival(0.1 + 0.2, model(5, n=1)),
                                                      Rival(1.0, model(6, noise=None))))),
    Estimate(status=Status.NO_EXCITATION, settings=Settings()),
    estimate(status=Status.UNRELIABLE, model=None),
    estimate(model=model(1, n=0, nu=0, ny=1), pole_std=np.empty(0), fit=np.empty(0),
             held_out_fit=np.empty(0)),
    estimate(model=model(1, noise=None)), estimate(model=model(1, actuators=ACTUATORS))],
    ids=['all', 'covariance', 'of a rejected', 'no rows', 'rivals', 'none', 'rejected',
         'no states', 'no noise', 'timeout'])
def test_round_trip_to_the_last_bit(whole, tmp_path):
    assert same(from_json(to_json(whole)), whole)
    save_model(tmp_path / 'model.json', whole)
    assert same(load_estimate(tmp_path / 'model.json'), whole)
    assert to_json(from_json(to_json(whole))) == to_json(whole)


def test_the_text_is_strict_json_that_describes_itself():
    def refuse(word):
        raise AssertionError(word)
    text = to_json(estimate(), {'bag': 'flight 1'})
    document = json.loads(text, parse_constant=refuse)
    assert document['format'] == 'ctsid-model'
    assert document['version'] == 2
    assert document['message'] == Status.OK.value
    assert document['model']['A'] == estimate().model.A.tolist()
    pole = document['model']['poles'][0]
    assert complex(pole['re'], pole['im']) == estimate().model.poles[0]
    assert document['pole_std'][0] is None
    assert document['condition'] == 'Infinity'
    assert document['settings']['pbsid.past'] == 0
    assert document['metadata'] == {'bag': 'flight 1'}
    assert max(map(len, text.splitlines())) < 250


def test_files_of_version_1_still_load():
    """Their verdicts have other numbers: those that are gone are dropped, new ones not known."""
    band = Excitation('u', 0.1, 20.0, 12.0, 1.0, 0.01)
    now = estimate(verdict=replace(estimate().verdict, excitation=(band,)))
    document = json.loads(to_json(now)) | {'version': 1}
    verdict = document['verdict']
    for key in ('error', 'coloured_error', 'held_out_error', 'independent', 'change_cost'):
        del verdict[key]
    verdict |= {'missing': [0.01], 'missing_p_value': [0.5], 'next_ratio': [1.2]}
    document['orders'] = [{'order': 2, 'criterion': 0.0, 'fit': 90.0, 'held_out_fit': None}]
    old = from_json(json.dumps(document))
    assert old.model == now.model
    assert old.verdict.grade is now.verdict.grade
    assert old.verdict.excitation == now.verdict.excitation
    assert not len(old.verdict.error)
    assert math.isnan(old.verdict.change_cost)
    assert old.orders == (OrderTried(2, 0.0, 90.0),)


def test_files_of_models_and_metadata(tmp_path):
    path = tmp_path / 'model.json'
    save_model(path, estimate(), {'bag': 'b', 'sha': None, 'sizes': (1, np.float64(2.5))})
    assert load_model(path) == estimate().model
    assert load_metadata(path) == {'bag': 'b', 'sha': None, 'sizes': [1, 2.5]}
    save_model(path, model(7), force=True)
    assert load_model(path) == model(7)
    assert 'stored by itself' in load_estimate(path).notes[0]
    save_model(str(path), estimate(status=Status.UNEXPLAINED, model=None), force=True)
    with pytest.raises(StorageError, match='no accepted model: No linear model explains'):
        load_model(path)


@pytest.mark.parametrize('name', ['a.json', 'a.npz', 'a.csv'])
def test_nothing_is_overwritten_without_force(tmp_path, name):
    path = tmp_path / name
    save = save_model if name == 'a.json' else lambda p, e, **k: save_series(p, [e], **k)
    path.write_text('mine')
    with pytest.raises(StorageError, match=f'{name} exists already; choose another name, or fo'):
        save(path, estimate())
    assert path.read_text() == 'mine'
    save(path, estimate(), force=True)
    assert path.read_bytes() != b'mine'
    assert os.listdir(tmp_path) == [name]


def test_a_failing_write_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    path = tmp_path / 'model.json'
    save_model(path, model(1))
    old = path.read_bytes()

    def full(*_):
        raise OSError(28, 'No space left on device')
    monkeypatch.setattr(os, 'fsync', full)
    with pytest.raises(StorageError, match='No space left.*has room'):
        save_model(path, model(2), force=True)
    assert path.read_bytes() == old
    assert os.listdir(tmp_path) == ['model.json']


def test_places_that_cannot_be_written(tmp_path):
    (tmp_path / 'file').write_text('')
    for path in (tmp_path / 'no' / 'model.json', tmp_path / 'file' / 'model.json'):
        with pytest.raises(StorageError, match='check that the folder exists'):
            save_model(path, model())
    with pytest.raises(StorageError, match='choose another name'):
        save_model(tmp_path, model(), force=True)
    with pytest.raises(StorageError, match=r'name it \.csv or \.npz'):
        save_series(tmp_path / 'series.txt', [])


def test_a_reader_never_meets_half_a_file(tmp_path):
    path, stop, faults = tmp_path / 'model.json', threading.Event(), []
    save_model(path, model(0, n=20))

    def read():
        while not stop.is_set():
            try:
                load_model(path)
            except StorageError as error:
                faults.append(error)
    reader = threading.Thread(target=read)
    reader.start()
    for seed in range(30):
        save_model(path, model(seed, n=20), force=True)
    stop.set()
    reader.join()
    assert not faults
    assert load_model(path) == model(29, n=20)


@pytest.mark.parametrize(('data', 'message'), [
    (b'', 'not JSON, or cut off'), (b'{"format": "ctsid-model"', 'not JSON, or cut off'),
    (b'\xff\xfe\x00', 'not a text file'), (b'[1, 2]', 'choose a model.json'),
    (b'{"format": "other"}', "`format` is 'other'"), (b'{}', '`format` is None'),
    (b'{"format": "ctsid-model"}', '`version` is None'),
    (b'{"format": "ctsid-model", "version": 3}', 'upgrade ctsid'),
    (b'{"format": "ctsid-model", "version": true}', '`version` is True'),
    (b'{"format": "ctsid-model", "version": 1}', 'missing: equations, status'),
    (b'{"a": NaN}', 'holds NaN'), (b'{"a": 1, "a": 2}', "'a' occurs twice"),
    (b'[' * 100000, 'not JSON'), (b'{"a": 1' + b'0' * 5000 + b'}', 'not JSON'),
])
def test_other_files_are_refused(tmp_path, data, message):
    path = tmp_path / 'model.json'
    path.write_bytes(data)
    with pytest.raises(StorageError, match=message) as error:
        load_model(path)
    assert str(error.value).startswith(str(path))


def test_every_truncation_is_refused(tmp_path):
    text = to_json(estimate())
    for end in range(0, len(text.rstrip()), 97):
        with pytest.raises(StorageError, match='cut off'):
            from_json(text[:end])


def test_paths_that_cannot_be_read(tmp_path):
    for path in (tmp_path / 'missing.json', tmp_path):
        for load in (load_model, load_metadata, load_series):
            with pytest.raises(StorageError, match='cannot be read .*check the path'):
                load(path)


def put(value, *where):
    """Return a change of a document that sets (or, for KeyError, removes) one entry."""
    def change(document):
        for key in where[:-1]:
            document = document[key]
        if value is KeyError:
            del document[where[-1]]
        else:
            document[where[-1]] = value
    return change


@pytest.mark.parametrize(('change', 'message'), [
    (put(1, 'more'), r'unknown: more'), (put(KeyError, 'notes'), 'missing: notes'),
    (put(1, 'model', 'E'), 'in `model`.*unknown: E'),
    (put(KeyError, 'model', 'K'), 'in `model`.*missing: K'),
    (put(None, 'model', 'A', 0, 0), r'`model.A\[0\]\[0\]` is null, but a finite number'),
    (put('Infinity', 'model', 'B', 0, 0), r'`model.B\[0\]\[0\]` is "Infinity"'),
    (put(True, 'model', 'C', 0, 0), r'`model.C\[0\]\[0\]` is true'),
    (put(10 ** 400, 'model', 'C', 0, 0), 'finite number is wanted'),
    (put([1.0], 'model', 'A', 1), r'`model.A\[1\]` has 1 entries, but 3 numbers'),
    (put([[1.0]], 'model', 'A'), '`model.A` has 1 entries, but 3 by 3 numbers'),
    (put(5, 'model', 'A'), '`model.A` is 5, but a list'),
    (put(1e9, 'model', 'A', 0, 0), '`model.poles` are not the eigenvalues of `model.A`'),
    (put([], 'model', 'poles'), '`model.poles` are not the eigenvalues'),
    (put([3], 'model', 'poles'), '`model.poles` is not a list of poles'),
    (put(4, 'model', 'n'), '`model.A` has 3 entries, but 4 by 4'),
    (put(-1, 'model', 'n'), 'negative dimensions'), (put(1.5, 'model', 'n'), '`model.n` is 1.5'),
    (put([-1, 0], 'model', 'delay'), 'none negative'),
    (put(['a'], 'model', 'input_names'), 'wanted are 2'),
    (put([1, 2], 'model', 'input_names'), r'`model.input_names\[0\]` is 1, but a word'),
    (put([[1]], 'model', 'noise'), '`model.noise` has 1 entries'),
    (put([], 'model'), r'`model` is \[\], but an object'),
    (put(None, 'model'), '`status` is OK but `model` is null'),
    (put('UNRELIABLE', 'status'), 'contradict'),
    (put('FINE', 'status'), 'knows OK, TOO_SHORT'), (put(None, 'status'), '`status` is null'),
    (put([1, 2], 'pole_std'), '`pole_std` has 2 numbers, but the model wants 3'),
    (put([1], 'fit'), '`fit` has 1 numbers'), (put('x', 'fit'), '`fit` is "x"'),
    (put(['x'], 'fit'), r'`fit\[0\]` is "x"'), (put('big', 'condition'), '`condition` is "big"'),
    (put(1.5, 'start_ns'), '`start_ns` is 1.5'), (put('now', 'end_ns'), '`end_ns` is "now"'),
    (put('a note', 'notes'), '`notes` is "a note", but a list'),
    (put([3], 'notes'), r'`notes\[0\]` is 3'), (put([], 'statistics'), '`statistics`'),
    (put('x', 'statistics', 'nan'), '`statistics.nan`'), (put([], 'metadata'), '`metadata`'),
    (put([{}], 'choices'), r'`choices\[0\]`.*missing: name, value, why'),
    (put([3], 'choices'), r'`choices\[0\]` is 3'), (put(3, 'settings'), '`settings` is 3'),
    (put([], 'covariance'), r'`covariance` is \[\], but an object'),
    (put({'n': 3}, 'covariance'), 'in `covariance`.*missing: nu, ny, root'),
    (put({'n': 2, 'nu': 2, 'ny': 2, 'root': []}, 'covariance'), 'that is not the model'),
    (put({'n': 3, 'nu': 2, 'ny': 2, 'root': [[1.0]]}, 'covariance'),
     r'`covariance.root\[0\]` has 1 entries, but 27 numbers'),
    (put({'n': 3, 'nu': 2, 'ny': 2, 'root': [[None] * 27]}, 'covariance'), 'finite number'),
    (put(3, 'settings', 'ordre'), '`ordre` is not a parameter; did you mean order'),
    (put(-3, 'settings', 'order'), '`order` is -3'),
])
def test_changed_documents_are_refused_with_their_place(change, message):
    with pytest.raises(StorageError, match=message):
        from_json(broken(change))


def test_parameters_that_a_file_does_not_know_yet_take_their_defaults():
    older = from_json(broken(put(KeyError, 'settings', 'hermite.gamma')))
    assert same(older, estimate())


def series():
    return [estimate(0, covariance=covariance()), estimate(1, status=Status.CHANGED, model=None),
            estimate(2, model=model(3, n=2), covariance=covariance(n=2),
                     pole_std=np.array([0.5, 0.25])),
            Estimate(status=Status.TOO_SHORT, settings=Settings())]


def test_npz_series_round_trip_and_arrays(tmp_path):
    path = tmp_path / 'estimates.npz'
    save_series(path, series())
    assert all(same(a, b) for a, b in zip(load_series(path), series(), strict=True))
    with np.load(path, allow_pickle=False) as found:
        assert found['status'].tolist() == ['OK', 'CHANGED', 'OK', 'TOO_SHORT']
        assert found['order'].tolist() == [3, 0, 2, 0]
        assert found['start_ns'][0] == series()[0].start_ns
        assert np.array_equal(found['poles'][0], series()[0].model.poles)
        assert np.array_equal(found['A'][2, :2, :2], series()[2].model.A)
        assert np.isnan(found['A'][2, 2]).all()
        assert np.isnan(found['A'][1]).all()
        assert found['D'].shape == (4, 2, 2)
        assert found['pole_std'][2].tolist()[:2] == [0.5, 0.25]
        assert np.array_equal(found['damping_std'][0], series()[0].damping_std)
    save_series(tmp_path / 'none.npz', [])
    assert load_series(tmp_path / 'none.npz') == ()


def test_csv_series(tmp_path):
    path = tmp_path / 'estimates.csv'
    save_series(path, series())
    with open(path, encoding='utf-8', newline='') as stream:
        rows = list(csv.DictReader(stream))
    assert [row['status'] for row in rows] == ['OK', 'CHANGED', 'OK', 'TOO_SHORT']
    assert [row['verdict'] for row in rows] == ['WEAK', 'REJECT', 'WEAK', 'REJECT']
    assert [row['order'] for row in rows] == ['3', '', '2', '']
    assert int(rows[0]['start_ns']) == series()[0].start_ns
    first = series()[2].model
    for k in range(2):
        cell = f'pole{k + 1}'
        assert float(rows[2][f'{cell}_re [rad/s]']) == first.poles[k].real
        assert float(rows[2][f'{cell}_im [rad/s]']) == first.poles[k].imag
        assert float(rows[2][f'{cell}_std [rad/s]']) == series()[2].pole_std[k]
        assert float(rows[2][f'{cell}_natural_frequency [rad/s]']) == abs(first.poles[k])
        assert float(rows[2][f'{cell}_damping']) == first.damping[k]
        for name, unit in (('natural_frequency', ' [rad/s]'), ('damping', '')):
            std = getattr(series()[2], f'{name}_std')[k]
            assert float(rows[2][f'{cell}_{name}_std{unit}']) == std
    assert rows[2]['pole3_re [rad/s]'] == rows[1]['pole1_re [rad/s]'] == ''
    assert rows[0]['fit_y1 [%]'] == '99.9'
    assert rows[0]['held_out_fit_y1 [%]'] == ''
    save_series(tmp_path / 'none.csv', [])
    assert Path(tmp_path / 'none.csv').read_text() == 'start_ns,end_ns,status,verdict,order\n'


def test_csv_has_dead_times_and_gains_as_far_as_they_are_known(tmp_path):
    """Of windows one with a gain, one whose outputs move on, one without a model."""
    names = {'input_names': ('rudder', 'flap'), 'output_names': ('yaw',)}
    known = {'status': Status.OK, 'settings': Settings(), 'pole_std': np.array([0.1])}
    settles, moves = (StateSpace([[pole]], [[3.0, 1.0]], [[1.0]], delay=(0.25, 0.0),
                                 actuators=(Actuator(0.0), Actuator(0.5)), **names)
                      for pole in (-2.0, 0.0))
    root = np.zeros((1, Covariance.entry_count(1, 2, 1)))
    root[0, 1], root[0, -2] = 0.2, 0.01                 # of the first input: B and the dead time
    save_series(tmp_path / 'e.csv', [
        Estimate(model=settles, covariance=Covariance(root, 1, 2, 1), **known),
        Estimate(model=moves, **known), Estimate(status=Status.TOO_SHORT, settings=Settings())])
    with open(tmp_path / 'e.csv', encoding='utf-8', newline='') as stream:
        rows = list(csv.DictReader(stream))
    assert [row['delay_rudder [s]'] for row in rows] == ['0.25', '0.25', '']
    assert [row['delay_std_rudder [s]'] for row in rows] == ['0.01', '', '']
    assert [row['timeout_rudder [s]'] for row in rows] == ['0.0', '0.0', '']
    assert [row['timeout_flap [s]'] for row in rows] == ['0.5', '0.5', '']
    assert [row['gain_yaw/rudder'] for row in rows] == ['1.5', '', '']
    assert [row['gain_yaw/flap'] for row in rows] == ['0.5', '', '']
    assert [row['rate_gain_yaw/rudder'] for row in rows] == ['', '3.0', '']
    assert [row['gain_std_yaw/rudder'] for row in rows] == ['0.1', '', '']


def test_csv_names_outputs_even_with_commas(tmp_path):
    named = estimate(model=model(0, output_names=('roll, raw', 'p')))
    save_series(tmp_path / 'e.csv', [Estimate(status=Status.CHANGED, settings=Settings()), named])
    with open(tmp_path / 'e.csv', encoding='utf-8', newline='') as stream:
        head = next(csv.reader(stream))
    assert head[-4:] == ['fit_roll, raw [%]', 'fit_p [%]', 'held_out_fit_roll, raw [%]',
                         'held_out_fit_p [%]']


def test_other_npz_files_are_refused(tmp_path):
    path = tmp_path / 'estimates.npz'
    save_series(path, series())
    whole = path.read_bytes()
    for data in (b'', b'text', whole[:-50], whole[:len(whole) // 2]):
        path.write_bytes(data)
        with pytest.raises(StorageError, match='not a ctsid-series file'):
            load_series(path)
    np.savez(path, a=np.zeros(3))
    with pytest.raises(StorageError, match='other arrays'):
        load_series(path)
    np.savez(path, format='ctsid-series', version=1, json=np.array([{}], dtype=object))
    with pytest.raises(StorageError, match='not a ctsid-series file'):
        load_series(path)
    np.savez(path, format='ctsid-series', version=2, json=np.array([b'']))
    with pytest.raises(StorageError, match='upgrade ctsid'):
        load_series(path)
    np.savez(path, format='ctsid-series', version=1, json=np.array([b'{}']))
    with pytest.raises(StorageError, match='estimates.npz.*`format` is None'):
        load_series(path)


def test_public_names_exist():
    assert all(callable(getattr(storage, name)) for name in storage.__all__)
