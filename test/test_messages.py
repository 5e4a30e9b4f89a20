# SPDX-License-Identifier: Apache-2.0
"""Messages of the node: what is published comes back to the last bit, and nothing else passes."""

from dataclasses import replace
import json
import math
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip('rclpy')
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus  # noqa: E402
from rclpy.serialization import deserialize_message, serialize_message  # noqa: E402
from std_msgs.msg import Float64MultiArray, MultiArrayDimension, String  # noqa: E402

from ctsid_core.errors import DataError, StorageError  # noqa: E402
from ctsid_core.model.estimate import Choice, Estimate, Status  # noqa: E402
from ctsid_core.model.statespace import StateSpace  # noqa: E402
from ctsid_core.model.storage import from_json, to_json  # noqa: E402
from ctsid_core.sequence.tracking import Tracked  # noqa: E402
from ctsid_core.settings import Settings  # noqa: E402
from ctsid_ros.config.channels import Channel  # noqa: E402
from ctsid_ros.messages import (  # noqa: E402
    Health,
    Level,
    decode_diagnostics,
    decode_eigenvalues,
    decode_matrix,
    decode_metadata,
    decode_model,
    decode_system_matrix,
    encode_diagnostics,
    encode_eigenvalues,
    encode_matrices,
    encode_matrix,
    encode_model,
    encode_system_matrix,
    provenance,
)
from ctsid_ros.verbs.params import example  # noqa: E402

SIZES = [(3, 1, 4), (1, 1, 1), (5, 2, 3), (0, 1, 1), (2, 0, 2)]


def model_of(n=3, nu=1, ny=4, seed=0) -> StateSpace:
    rng = np.random.default_rng(seed)
    shapes = {'A': (n, n), 'B': (n, nu), 'C': (ny, n), 'D': (ny, nu), 'K': (n, ny)}
    return StateSpace(**{key: rng.standard_normal(shape) / 3 for key, shape in shapes.items()},
                      x_trim=rng.standard_normal(n), delay=(0.1,) * nu,
                      output_names=tuple(f'y{i}' for i in range(ny)))


def tracked_of(model=None, **changes) -> Tracked:
    model = model or model_of()
    order = np.arange(model.n)[::-1]
    estimate = Estimate(
        status=Status.OK, settings=Settings(order=model.n), model=model,
        pole_std=np.full(model.n, np.nan), fit=np.linspace(90, 100, model.ny) / 3,
        held_out_fit=np.full(model.ny, -math.inf), condition=math.inf,
        choices=(Choice('order', model.n, 'so'),), notes=('a "note"\n°',),
        start_ns=1_700_000_000_000_000_001, end_ns=1_700_000_010_000_000_003,
        statistics={'x [s]': 1 / 3, 'unknown': math.nan})
    return Tracked(**{
        'estimate': estimate, 'realisation': 2, 'modes': tuple(range(7, 7 + model.n)),
        'eigenvalues': model.poles[order], 'eigenvalue_std': np.full(model.n, np.nan),
        'fresh_fit': np.array([np.nan, 1 / 3, -math.inf, 99.0])[:model.ny],
        'fresh_start_ns': 1_700_000_009_000_000_001, 'fresh_end_ns': 1_700_000_010_000_000_003,
        **changes})


def rejected() -> Tracked:
    return Tracked(estimate=Estimate(status=Status.NO_EXCITATION, settings=Settings()))


def travelled(msg):
    """Return the message as it comes out of the middleware."""
    return deserialize_message(serialize_message(msg), type(msg))


def same(one: Estimate, other: Estimate) -> bool:
    return to_json(one) == to_json(other) and one.model == other.model


def bits(array) -> bytes:
    return np.ascontiguousarray(array).tobytes()


@pytest.mark.parametrize('size', SIZES)
def test_a_model_comes_back_to_the_last_bit(size):
    tracked = tracked_of(model_of(*size))
    msg = travelled(encode_model(tracked))
    assert type(msg) is String
    estimate = decode_model(msg)
    assert same(estimate, tracked.estimate)
    assert bits(estimate.model.A) == bits(tracked.estimate.model.A)
    assert estimate.pole_std.tobytes() == tracked.estimate.pole_std.tobytes()
    assert estimate.held_out_fit.tolist() == tracked.estimate.held_out_fit.tolist()
    assert encode_model(tracked) == encode_model(tracked)


def test_a_window_without_a_model_is_told_too():
    msg = travelled(encode_model(rejected(), {'window': 3}))
    estimate = decode_model(msg)
    assert (estimate.ok, estimate.status) == (False, Status.NO_EXCITATION)
    found = decode_metadata(msg)
    assert (found['window'], found['modes'], found['realisation']) == (3, (), 0)
    assert found['eigenvalues'].shape == found['fresh_fit'].shape == (0,)
    assert found['eigenvalues'].dtype == complex


def test_metadata_come_back_usable():
    tracked, config = tracked_of(), example()
    msg = travelled(encode_model(tracked, provenance(
        config, '/robot/identifier', 12, latency=math.nan, host='r2')))
    found = decode_metadata(msg)
    assert (found['node'], found['window'], found['host']) == ('/robot/identifier', 12, 'r2')
    assert found['ctsid'][0].isdigit()
    assert tuple(Channel(**channel) for channel in found['channels']) == config.channels
    assert (found['realisation'], found['modes']) == (2, (7, 8, 9))
    assert bits(found['eigenvalues']) == bits(tracked.eigenvalues)
    np.testing.assert_array_equal(found['eigenvalue_std'], tracked.eigenvalue_std)
    np.testing.assert_array_equal(found['fresh_fit'], tracked.fresh_fit)
    assert (found['fresh_start_ns'], found['fresh_end_ns']) == (
        tracked.fresh_start_ns, tracked.fresh_end_ns)
    assert found['latency'] is None  # what only JSON knows stays as JSON has it
    assert set(found['eigenvalues']) == set(decode_model(msg).model.poles)


def test_signs_of_zero_survive():
    values = np.array([complex(-0.0, -0.0), complex(0.0, -0.0), complex(-0.0, 0.0)])
    tracked = tracked_of(eigenvalues=values)
    assert bits(decode_metadata(encode_model(tracked))['eigenvalues']) == bits(values)
    assert bits(decode_eigenvalues(encode_eigenvalues(tracked)).values) == bits(values)


def test_a_model_file_is_read_by_the_same_decoder():
    tracked = tracked_of()
    msg = String(data=to_json(tracked.estimate, {'bag': ['a']}))
    assert same(decode_model(msg), tracked.estimate)
    assert decode_metadata(msg) == {'bag': ['a']}  # nothing is made up
    assert same(from_json(encode_model(tracked).data), tracked.estimate)


def test_any_object_like_the_message_is_read():
    tracked = tracked_of()
    assert same(decode_model(SimpleNamespace(data=encode_model(tracked).data)), tracked.estimate)
    msg = encode_system_matrix(tracked.estimate.model)
    like = SimpleNamespace(layout=msg.layout, data=np.asarray(msg.data))
    assert bits(decode_system_matrix(like).A) == bits(tracked.estimate.model.A)


@pytest.mark.parametrize('msg', [
    String(), String(data='hello'), String(data='{}'), String(data='[1]'), String(data='nan'),
    Float64MultiArray(data=[1.0]), SimpleNamespace(), SimpleNamespace(data=b'{}'), None,
    String(data=json.dumps({'format': 'ctsid-model', 'version': 99})),
    String(data=json.dumps({'format': 'ctsid-model', 'version': 1}))])
@pytest.mark.parametrize('decode', [decode_model, decode_metadata])
def test_what_is_no_model_is_refused_with_a_reason(msg, decode):
    with pytest.raises(StorageError, match='not a model of ctsid: .*The topic is `~/model`'):
        decode(msg)


@pytest.mark.parametrize(('key', 'value'), [
    ('eigenvalues', [1.0]), ('eigenvalues', 'x'), ('fresh_fit', {'a': 1}), ('fresh_fit', ['x']),
    ('modes', 3), ('modes', ['a']), ('eigenvalue_std', [[1.0], [1.0, 2.0]]),
    ('eigenvalues', [[1.0, 2.0, 3.0]]), ('modes', [1.5])])
def test_metadata_that_make_no_sense_are_refused(key, value):
    document = json.loads(encode_model(tracked_of()).data)
    document['metadata'][key] = value
    with pytest.raises(StorageError, match=f'`{key}` in the metadata of this message'):
        decode_metadata(String(data=json.dumps(document)))


@pytest.mark.parametrize('size', SIZES)
def test_matrices_come_back_to_the_last_bit(size):
    n, nu, ny = size
    model = model_of(*size)
    msg = travelled(encode_system_matrix(model))
    assert [dim.label for dim in msg.layout.dim] == [f'x:{n},y:{ny}', f'x:{n},u:{nu},y:{ny}']
    for name, matrix in decode_system_matrix(msg)._asdict().items():
        assert matrix.shape == getattr(model, name).shape
        assert bits(matrix) == bits(getattr(model, name))
    messages = {name: travelled(m) for name, m in encode_matrices(model).items()}
    assert list(messages) == ['a', 'b', 'c', 'd', 'k']
    for name, message in messages.items():
        assert decode_matrix(message).shape == getattr(model, name.upper()).shape
        assert bits(decode_matrix(message)) == bits(getattr(model, name.upper()))
    assert [dim.label for dim in messages['k'].layout.dim] == [f'x:{n}', f'y:{ny}']


def test_the_system_matrix_is_what_the_equations_say():
    model = model_of()
    whole = decode_matrix(encode_system_matrix(model))
    rng = np.random.default_rng(1)
    x, u, e = (rng.standard_normal(size) for size in (model.n, model.nu, model.ny))
    both = whole @ np.concatenate([x, u, e])
    np.testing.assert_allclose(both[:3], model.A @ x + model.B @ u + model.K @ e)
    np.testing.assert_allclose(both[3:], model.C @ x + model.D @ u + e)


def test_layout_is_as_std_msgs_says():
    """multiarray(i, j) = data[data_offset + stride of dimension 1 * i + j]."""
    matrix = np.arange(6.0).reshape(2, 3)
    msg = encode_matrix('gain', matrix, 'u', 'x')
    rows, columns = msg.layout.dim
    assert (rows.label, rows.size, rows.stride) == ('u:2', 2, 6)
    assert (columns.label, columns.size, columns.stride) == ('x:3', 3, 3)
    assert all(msg.data[columns.stride * i + j] == matrix[i, j]
               for i in range(2) for j in range(3))
    padded = Float64MultiArray(data=[-1.0, 0, 1, 2, -1, 3, 4, 5, -1])
    padded.layout.data_offset = 1
    padded.layout.dim = [MultiArrayDimension(size=2, stride=8),
                         MultiArrayDimension(size=3, stride=4)]
    np.testing.assert_array_equal(decode_matrix(padded), matrix)


@pytest.mark.parametrize('matrix', [[1.0, 2.0], 3.0, [[np.nan]], [[1.0, np.inf]], [[[1.0]]]])
def test_only_finite_matrices_are_sent(matrix):
    with pytest.raises(DataError, match='`gain` has shape .*matrix of finite numbers'):
        encode_matrix('gain', matrix, 'u', 'x')


def broken(change) -> Float64MultiArray:
    msg = encode_system_matrix(model_of())
    change(msg)
    return msg


@pytest.mark.parametrize('change', [
    lambda m: m.data.pop(), lambda m: setattr(m, 'data', []), lambda m: m.layout.dim.pop(),
    lambda m: setattr(m.layout, 'data_offset', 1), lambda m: setattr(m.layout.dim[1], 'stride', 7),
    lambda m: setattr(m.layout.dim[1], 'stride', 2),
    lambda m: setattr(m.layout.dim[0], 'size', 9),
    lambda m: setattr(m.layout.dim[0], 'label', 'x:2,y:5'),
    lambda m: setattr(m.layout.dim[0], 'label', 'x:3'),
    lambda m: setattr(m.layout.dim[1], 'label', 'x:3,y:4,u:1'),
    lambda m: m.data.__setitem__(-1, 2.0)])
def test_arrays_that_are_no_system_matrix_are_refused(change):
    with pytest.raises(StorageError, match='this message is not|layout of this message'):
        decode_system_matrix(broken(change))


@pytest.mark.parametrize('msg', [String(data='x'), Float64MultiArray(), None])
@pytest.mark.parametrize('decode', [decode_matrix, decode_system_matrix, decode_eigenvalues])
def test_other_messages_are_no_matrix(decode, msg):
    with pytest.raises(StorageError, match='not a std_msgs/Float64MultiArray with two'):
        decode(msg)


def test_eigenvalues_keep_rows_and_identities():
    values = np.array([-0.5 + 3j, -0.5 - 3j, -7.0, 0.0])
    tracked = tracked_of(modes=(4, 5, 2, 11), eigenvalues=values)
    msg = travelled(encode_eigenvalues(tracked))
    assert [dim.label for dim in msg.layout.dim] == [
        'mode 4,mode 5,mode 2,mode 11', 're,im,natural_frequency,damping']
    found = decode_eigenvalues(msg)
    assert found.modes == tracked.modes
    assert bits(found.values) == bits(values)
    table = decode_matrix(msg)
    assert table.shape == (4, 4)
    size = math.sqrt(9.25)
    np.testing.assert_allclose(table[:, 2], [size, size, 7.0, 0.0])
    np.testing.assert_allclose(table[:, 3], [0.5 / size, 0.5 / size, 1.0, np.nan])
    empty = decode_eigenvalues(travelled(encode_eigenvalues(rejected())))
    assert (empty.modes, empty.values.shape) == ((), (0,))


def test_eigenvalues_agree_with_the_model():
    model = model_of(5, 2, 3)
    table = decode_matrix(encode_eigenvalues(tracked_of(model)))[::-1]
    np.testing.assert_array_equal(table[:, 2], model.natural_frequency)
    np.testing.assert_array_equal(table[:, 3], model.damping)


def test_another_matrix_is_no_table_of_eigenvalues():
    with pytest.raises(StorageError, match='not a table of eigenvalues: it is 7 by 8'):
        decode_eigenvalues(encode_system_matrix(model_of()))


def test_diagnostics():
    stamp_ns = 1_700_000_000_123_456_789
    health = [Health('ctsid: ingest', Level.WARN, 'It is late.',
                     {'rate [Hz]': 1000.04004, 'lost': 3, 'sim time': True, 'age [s]': math.nan,
                      'numpy [s]': np.float64(1 / 3)}),
              Health('ctsid: identification', Level.STALE, 'Nothing.')]
    msg = travelled(encode_diagnostics(stamp_ns, health))
    assert type(msg) is DiagnosticArray
    assert [s.level for s in msg.status] == [DiagnosticStatus.WARN, DiagnosticStatus.STALE]
    assert [level.value for level in Level] == [
        getattr(DiagnosticStatus, level.name)[0] for level in Level]
    found_ns, found = decode_diagnostics(msg)
    assert found_ns == stamp_ns
    assert found[0].values == {'rate [Hz]': '1000.04', 'lost': '3', 'sim time': 'true',
                               'age [s]': 'nan', 'numpy [s]': '0.333333'}
    assert [replace(h, values={}) for h in found] == [replace(h, values={}) for h in health]
    with pytest.raises(StorageError, match='not a diagnostic_msgs/DiagnosticArray'):
        decode_diagnostics(String())
