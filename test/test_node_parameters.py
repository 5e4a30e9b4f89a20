# SPDX-License-Identifier: Apache-2.0
"""Parameters on real nodes: those of a running program are held to what the file is held to."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from threading import Timer
import time

import pytest

rclpy = pytest.importorskip('rclpy')
from live import claim_domain  # noqa: E402
from rclpy.context import Context  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.lifecycle import LifecycleNode  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from rclpy.parameter_client import AsyncParameterClient  # noqa: E402

from ctsid_core.errors import SettingsError  # noqa: E402
from ctsid_core.settings import Settings  # noqa: E402
from ctsid_ros.config.channels import CHANNEL_KEYS, OF_INPUTS, SETTINGS_KEYS, Config  # noqa: E402
from ctsid_ros.config.node_settings import NODE_KEYS, NodeSettings  # noqa: E402
from ctsid_ros.config.parameter_file import OWN_KEYS, parse_parameters, read_config  # noqa: E402
from ctsid_ros.config.parameter_text import dump_config  # noqa: E402
from ctsid_ros.node.parameters import declare, read, watch  # noqa: E402
from ctsid_ros.verbs.params import example  # noqa: E402

Make = Callable[..., Node]
FILE = """\
/**:
  ros__parameters:
    inputs: [torque]
    outputs: [rate]
    torque: {topic: /cmd, type: sensor_msgs/msg/JointState, field: 'effort[0]', unit: N m}
    rate: {topic: imu, type: sensor_msgs/msg/Imu, field: angular_velocity.x}
"""


@pytest.fixture
def make(tmp_path, monkeypatch) -> Iterator[Make]:
    """Make nodes as `ros2 run` does: from a parameter file and arguments."""
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    (domain, claim), contexts, nodes = claim_domain(), [], []

    def made(text: str = FILE, *arguments: str, kind=Node, declared=True, **options) -> Node:
        path = tmp_path / f'{len(nodes)}.yaml'
        path.write_text(text, encoding='utf-8')
        contexts.append(Context())
        rclpy.init(context=contexts[-1], domain_id=domain,
                   args=['--ros-args', '--params-file', str(path), *arguments])
        nodes.append(kind('identifier', context=contexts[-1], **options))
        if declared:
            declare(nodes[-1])
        return nodes[-1]

    yield made
    for node in nodes:
        node.destroy_node()
    for context in contexts:
        rclpy.shutdown(context=context)
    claim.close()


class Watched:
    """A node that takes changes, as the identifier does."""

    def __init__(self, node: Node, locked: bool = True) -> None:
        self.node, self.locked, self.applied = node, locked, []
        watch(node, lambda: self.locked, self.applied.append)

    def set(self, **values: object) -> list[str]:
        """Set parameters together; return what is said against it."""
        result = self.node.set_parameters_atomically([
            value if isinstance(value, Parameter) else Parameter(name, value=value)
            for name, value in values.items()])
        assert result.successful == (not result.reason)
        return result.reason.split('\n') if result.reason else []


def faults_of(node: Node) -> tuple[str, ...]:
    with pytest.raises(SettingsError) as caught:
        read(node)
    return caught.value.faults


def more(**lines: object) -> str:
    return FILE + ''.join(f'    {name}: {value}\n' for name, value in lines.items())


@pytest.mark.parametrize('kind', [Node, LifecycleNode])
@pytest.mark.parametrize('automatic', [False, True])
def test_a_file_means_the_same_to_node_and_command_line(make, tmp_path, kind, automatic):
    text = more(order=3, window='{length: 20, stride: 0.5}', delay='0.1',
                **{'ingest.depth': 7, 'save.folder': "''"})
    node = make(text, kind=kind, automatically_declare_parameters_from_overrides=automatic)
    assert read(node) == read_config(tmp_path / '0.yaml')
    assert read(node).settings == Settings(
        order=3, window_length=20.0, window_stride=0.5, delay=0.1)
    assert read(node).node == NodeSettings(ingest_depth=7, save_folder='')


def test_a_generated_file_suits_the_node(make):
    config = example()
    config = config.with_channels([*config.inputs, *(
        replace(channel, turn=360.0) for channel in config.outputs)])
    node = make(dump_config(config))
    assert read(node) == config
    names = set(node.list_parameters([], 0).names)
    assert {*SETTINGS_KEYS, *NODE_KEYS} - {*OF_INPUTS} <= names
    assert {f'torque.{key}' for key in CHANNEL_KEYS} <= names
    assert 'rate.delay' not in names
    assert node.get_parameter('window.length').value == 10.0


@pytest.mark.parametrize('key', ['/**', 'identifier', '/identifier', '/robot/identifier', '/*/*'])
def test_wildcards_namespaces_and_arguments(make, key):
    text = FILE.replace('/**', key) + '    order: 4\n'
    arguments = ['-r', '__ns:=/robot'] if 'robot' in key or key == '/*/*' else []
    node = make(text, '-p', 'pbsid.past:=6', '-p', 'window.length:=30', '-p', 'trim:=false',
                *arguments)
    assert read(node).settings == Settings(order=4, past=6, window_length=30.0, trim=False)


def test_parameters_given_by_the_program_count(make):
    node = make(parameter_overrides=[Parameter('order', value=5),
                                     Parameter('window.length', value=4)])
    assert read(node).settings == Settings(order=5, window_length=4.0)


def test_what_is_wrong_in_a_file_is_found_when_it_is_read_and_all_at_once(make):
    node = make("""\
/**:
  ros__parameters:
    use_sim_time: false
    qos_overrides./imu.subscription.depth: 5
    inputs: [torque, speed]
    outputs: [rate]
    torque: {topic: /cmd, field: 'effort[', delay: -1, fild: x}
    rate: {topic: /cmd-vel, type: Imu, field: x, unit: 3, hold: n}
    sped: {topic: /odom}
    ordr: 3
    order: [1, 2]
    max_order: 51
    trim: 1
    method: n4sid
    window: {length: abc, lenght: 3.0}
    pbsid: {past: 2, future: 3}
    ingest: {rate: 0, reliability: magic}
    save.folder: 7
""")
    faults = faults_of(node)
    text = '\n'.join(faults)
    wanted = ['channel `speed` is listed but not described', '`torque.fild` is not a parameter',
              '`torque.field`: expected', '`torque.delay` is -1.0, but must lie between 0 and 60',
              "`rate.type` is 'Imu'", '`rate.unit` is 3 (int)',
              '`rate.hold` is False (bool), but a word is wanted (in files, y, n, on',
              "`rate.topic` is '/cmd-vel', which cannot be a topic",
              'channel `sped` is described but not listed', '`ordr` is not a parameter; nearest: ',
              '`order` is a list', '`max_order` is 51', '`trim` is 1 (int), but a true or false',
              "`method` is 'n4sid'; choose", "`window.length` is 'abc'",
              '`window.lenght` is not a parameter; nearest: window.length',
              '`pbsid.future` is 3', '`ingest.rate` is 0.0, but must lie between 1 and 1000 Hz',
              "`ingest.reliability` is 'magic'; choose one of 'best_effort', 'reliable'",
              '`save.folder` is 7']
    assert [w for w in wanted if w not in text] == []
    assert '`torque.type` is missing (nobody publishes /cmd now' in text
    assert len(faults) == len(wanted) + 1, text


@pytest.mark.parametrize(('change', 'fault'), [
    ({'inputs': '[]'}, 'there is no input'), ({'outputs': 'rate'}, "`outputs` is 'rate'"),
    ({'inputs': '[1, 2]'}, '`inputs` is [1, 2]'), ({'order': '[]'}, '`order` is None'),
    ({'feedthrough': '1'}, '`feedthrough` is 1'), ({'order': 'false'}, '`order` is False'),
    ({'delay': '[0.1, 0.2]'}, '`delay` has 2 values but there are 1 input'),
    ({'delay': '0.1', 'torque.delay': '0.0'}, 'keep one of them'),
    ({'delay': 'false'}, '`delay` is False'), ({'inputs': '[torque, window]'}, "'window' is that"),
])
def test_faults_of_lists_and_types(make, change, fault):
    text = FILE
    for name in ('inputs', 'outputs'):
        if name in change:
            text = '\n'.join(x for x in text.splitlines() if name + ':' not in x) + '\n'
    text += ''.join(f'    {name}: {value}\n' for name, value in change.items())
    assert any(fault in found for found in faults_of(make(text))), faults_of(make(text))


def test_one_delay_for_all_or_one_each(make):
    node = make(more(delay=2))
    assert read(node).inputs[0].delay == 2.0
    assert not node.has_parameter('torque.delay')
    text = more(delay='[0.1, 0.2]', force='{topic: f, type: a/msg/B, field: x}').replace(
        '[torque]', '[torque, force]')
    assert read(make(text)).settings.delay == (0.1, 0.2)
    assert read(make(more(**{'torque.delay': 1}))).settings.delay == 1.0
    assert read(make(more(delay='auto'))).settings.delay == 'auto'
    assert read(make(more(**{'torque.delay': 'auto'}))).settings.delay == 'auto'
    assert read(make(more(**{'torque.delay': 0.0}))).settings.delay == 0.0


def test_a_dead_time_may_change_between_number_and_word_while_unconfigured(make):
    watched = Watched(make(), locked=False)
    for value in (0.1, 'auto', 2, 'auto'):
        assert watched.set(**{'torque.delay': value}) == []
        assert read(watched.node).settings.delay == value
    assert any("'late'" in said for said in watched.set(**{'torque.delay': 'late'}))


def test_a_missing_type_is_answered_with_what_is_there(make):
    node = make(FILE.replace(' type: sensor_msgs/msg/Imu,', ''), '-r', 'imu:=/robot/imu')
    fault, = faults_of(node)
    assert fault.startswith('`rate.type` is missing (nobody publishes imu now')
    from std_msgs.msg import String
    publisher = node.create_publisher(String, '/robot/imu', 1)
    fault, = faults_of(node)
    assert fault == ('`rate.type` is missing (imu is of type std_msgs/msg/String now); add it, '
                     'like std_msgs/msg/String')
    node.destroy_publisher(publisher)


def test_a_node_that_has_just_started_waits_for_what_others_publish(make):
    from std_msgs.msg import String
    node = make(FILE.replace(' type: sensor_msgs/msg/Imu,', ''))
    later = Timer(0.3, node.create_publisher, (String, 'imu', 1))
    later.start()
    fault, = faults_of(node)
    later.join()
    assert 'imu is of type std_msgs/msg/String now' in fault


def test_every_parameter_describes_itself(make):
    node = make(dump_config(example()))
    for name, declared in {**OWN_KEYS, **{f'torque.{k}': d for k, d in CHANNEL_KEYS.items()}
                           }.items():
        if name in OF_INPUTS:
            continue
        meta, told = declared.metadata, node.describe_parameter(name)
        assert declared.metadata['doc'] in told.description
        assert meta['unit'] in told.description
        assert meta['when'] in told.description
        assert all(choice in told.additional_constraints for choice in meta['choices'])
        assert ('Fixed' in told.additional_constraints) == meta['structural']
        assert told.dynamic_typing == bool(meta['words'])      # a number or a word
        if meta['words']:
            wanted = (*meta['words'], f'{meta["low"]:g} to')
            assert all(text in told.additional_constraints for text in wanted)
            continue
        ranges = [*told.integer_range, *told.floating_point_range]
        assert [(r.from_value, r.to_value) for r in ranges] == (
            [] if meta['low'] is None else [(meta['low'], meta['high'])])
    assert node.describe_parameter('autostart').read_only
    assert node.describe_parameter('inputs').description


def test_values_at_the_ends_and_amid_a_range_are_taken(make):
    watched = Watched(make())
    for value in (0, 1, 7, 50):
        assert watched.set(order=value) == []
    for value in (0.0, 0.123456789, 1e12):
        assert watched.set(**{'hermite.beta': value}) == []
    assert [c.settings.order for c in watched.applied][:4] == [0, 1, 7, 50]


@pytest.mark.parametrize(('values', 'reason'), [
    ({'order': 51}, 'order out of range. Min: 0, Max: 50, value: 51'),
    ({'order': 2.5}, 'Wrong parameter type'),
    ({'hermite.edges': 'round'}, "`hermite.edges` is 'round'; choose one of 'exact', 'paper'"),
    ({'ingest.timeout': 0.0}, 'out of range'),
    ({'ingest.timeout': float('nan')}, 'out of range'),
    ({'hermite.edge_margin': 20.0000000001}, 'must lie between 2 and 20'),  # near enough for ROS
    ({'pbsid.past': 2, 'pbsid.future': 3}, '`pbsid.future` is 3 but must not exceed'),
    ({'window.length': 20.0}, '`window.length` is fixed while the node is configured'),
    ({'torque.topic': '/x'}, 'ros2 lifecycle set /identifier cleanup'),
    ({'inputs': ['rate']}, '`inputs` is fixed'), ({'ingest.depth': 9}, '`ingest.depth` is fixed'),
    ({'autostart': False}, 'read-only'),
])
def test_a_wrong_change_is_rejected_with_a_reason_and_changes_nothing(make, values, reason):
    watched = Watched(make())
    before = read(watched.node)
    assert any(reason in said for said in watched.set(**values))
    assert any(reason in said for said in watched.set(**{'max_order': 5, **values}))
    assert read(watched.node) == before
    assert watched.applied == []


def test_changes_are_judged_together_and_applied_once(make):
    watched = Watched(make(more(pbsid='{past: 5, future: 4}')))
    assert watched.set(**{'pbsid.past': 3}) != []
    assert watched.set(**{'pbsid.past': 3, 'pbsid.future': 3, 'hermite.gamma': 20}) == []
    assert [c.settings for c in watched.applied] == [Settings(past=3, future=3, gamma=20.0)]
    reasons = watched.set(**{'window.stride': 2.0, 'hermite.edges': 'x', 'torque.unit': 'kg'})
    assert len(reasons) == 3


def test_what_is_fixed_may_be_set_to_what_it_is(make):
    watched = Watched(make())
    assert watched.set(**{'window.length': 10, 'torque.topic': '/cmd', 'inputs': ['torque']}) == []
    assert watched.applied == []


def test_parameters_of_the_node_are_applied_too(make):
    watched = Watched(make())
    assert watched.set(**{'save.folder': '/var/models', 'ingest.timeout': 5}) == []
    config, = watched.applied
    assert config.node == NodeSettings(save_folder='/var/models', ingest_timeout=5.0)


def test_parameters_of_others_are_none_of_our_business(make):
    node = make()
    node.declare_parameter('mine', 3)
    node.declare_parameter('my.topic', 'x')
    watched = Watched(node)
    assert watched.set(mine=4, use_sim_time=False) == []
    assert watched.applied == []
    watched.locked = False
    assert watched.set(inputs=['force']) == []
    assert node.has_parameter('my.topic')


def test_faults_of_a_file_can_be_mended_while_unconfigured(make):
    watched = Watched(make(more(order='abc', window='{length: no}', outputs='rate').replace(
        '    outputs: [rate]\n', '')), locked=False)
    assert len(faults_of(watched.node)) > 2
    assert any('whole number' in said for said in watched.set(order='three'))
    assert any('must lie' in said for said in watched.set(order=-1))
    assert watched.set(order=3) == []
    assert watched.set(**{'window.length': 20}) == []
    assert watched.set(outputs=['rate']) == []
    assert read(watched.node).settings == Settings(order=3, window_length=20.0)
    for name in ('order', 'window.length', 'outputs', 'rate.topic'):
        assert not watched.node.describe_parameter(name).dynamic_typing
    assert watched.node.describe_parameter('order').integer_range[0].to_value == 50
    assert watched.applied == []  # to be read at configure


def test_channels_can_be_added_and_removed_while_unconfigured(make):
    watched = Watched(make(), locked=False)
    assert watched.set(inputs=['torque', 'force']) == []
    assert any('`force` is listed but not described' in f for f in faults_of(watched.node))
    assert any('must lie' in said or 'out of range' in said
               for said in watched.set(**{'force.delay': 99.0}))
    assert watched.set(**{'force.topic': 'f', 'force.field': 'effort['}) != []
    assert watched.set(**{'force.topic': 'f', 'force.type': 'a/msg/B', 'force.field': 'x',
                          'force.delay': 1}) == []
    assert [(c.name, c.delay) for c in read(watched.node).inputs] == [
        ('torque', 'auto'), ('force', 1.0)]
    assert watched.set(inputs=['force']) == []
    assert [c.name for c in read(watched.node).inputs] == ['force']
    assert not watched.node.has_parameter('torque.topic')
    assert watched.set(inputs=['torque']) == []
    assert read(watched.node).inputs[0].topic == '/cmd'  # as in the file
    empty = Parameter('inputs', Parameter.Type.STRING_ARRAY, [])
    assert watched.set(inputs=empty) == []
    assert any('there is no input' in fault for fault in faults_of(watched.node))


def test_nothing_given_is_no_crash(make):
    node = make('/**:\n  ros__parameters:\n    order: 0\n')
    assert faults_of(node) == ('there is no input; list at least one channel in `inputs`',
                               'there is no output; list at least one channel in `outputs`')
    watched = Watched(node, locked=False)
    assert watched.set(inputs=['u'], outputs=['y']) == []
    assert watched.set(**{'u.topic': 'a', 'u.type': 'a/msg/B', 'u.field': 'x',
                          'y.topic': 'b', 'y.type': 'a/msg/B', 'y.field': 'x'}) == []
    assert [c.name for c in read(node).channels] == ['u', 'y']


@contextmanager
def spinning(*nodes: Node):
    executor = SingleThreadedExecutor(context=nodes[0].context)
    for node in nodes:
        executor.add_node(node)
    yield executor
    executor.shutdown()


def test_another_process_can_change_them(make):
    watched = Watched(make())
    client_node = Node('client', context=watched.node.context)
    client = AsyncParameterClient(client_node, 'identifier')
    with spinning(watched.node, client_node) as executor:
        end = time.monotonic() + 180
        while not client.services_are_ready() and time.monotonic() < end:
            executor.spin_once(timeout_sec=0.1)

        def ask(future):
            executor.spin_until_future_complete(future, timeout_sec=180)
            return future.result()
        done = ask(client.set_parameters([
            Parameter('order', value=4), Parameter('hermite.gamma', value=30),
            Parameter('ordr', value=4), Parameter('window.length', value=9.0)])).results
        assert [r.successful for r in done] == [True, True, False, False]
        assert 'fixed while' in done[3].reason
        assert [c.settings for c in watched.applied][-1] == Settings(order=4, gamma=30.0)
        told = ask(client.describe_parameters(['window.length'])).descriptors[0]
        assert '[s, 0.001 to 100000, default 10.0]' in told.description
        assert told.floating_point_range[0].to_value == 1e5
    client_node.destroy_node()


def test_declaring_is_quick(make):
    node = make(declared=False)
    start = time.thread_time()
    declare(node)
    read(node)
    assert time.thread_time() - start < 0.5


def test_the_same_parameters_by_another_door():
    """What `read` asks of the file's reader: that defaults may be left out."""
    config = example()
    plain = {'inputs': ['torque'], 'outputs': ['rate']}
    for channel in config.channels:
        plain[channel.name] = {key: getattr(channel, key) for key in CHANNEL_KEYS
                               if getattr(channel, key) != CHANNEL_KEYS[key].default}
    assert parse_parameters(plain) == config
    assert isinstance(config, Config)
