# SPDX-License-Identifier: Apache-2.0
from dataclasses import MISSING, fields, replace

from marks import slow
import pytest
import yaml

from ctsid_core.errors import SettingsError
from ctsid_core.settings import Settings, parameter_name, value_faults
from ctsid_ros.config.channels import CHANNEL_KEYS, OF_INPUTS, SETTINGS_KEYS, Channel, Config
from ctsid_ros.config.node_settings import NODE_KEYS, NodeSettings
from ctsid_ros.config.parameter_file import (
    OWN_KEYS,
    dump_config,
    parameters_markdown,
    parse_config,
    parse_parameters,
    read_config,
    with_parameters,
)

FILE = """\
/**:
  ros__parameters:
    inputs: [torque]
    outputs: [rate]
    torque: {topic: /cmd, type: sensor_msgs/msg/JointState, field: 'effort[0]', unit: N m,
             hold: zoh, stamp: auto, delay: auto}
    rate:   {topic: /imu, type: sensor_msgs/msg/Imu, field: angular_velocity.x, unit: rad/s}
    order: 0
    window: {length: 10.0, stride: 1.0}
"""
TORQUE = Channel('torque', 'input', '/cmd', 'sensor_msgs/msg/JointState', 'effort[0]', 'N m')
RATE = Channel('rate', 'output', '/imu', 'sensor_msgs/msg/Imu', 'angular_velocity.x', 'rad/s')


def plain(**changes) -> dict:
    """Parameters that are right, with changes; None removes one."""
    values = {'inputs': ['torque'], 'outputs': ['rate'],
              'torque': {'topic': '/cmd', 'field': 'effort[0]'},
              'rate': {'topic': '/imu', 'field': 'angular_velocity.x'}} | changes
    return {key: value for key, value in values.items() if value is not None}


def faults_of(values: dict) -> tuple[str, ...]:
    with pytest.raises(SettingsError) as caught:
        parse_parameters(values)
    return caught.value.faults


def only_fault(values: dict) -> str:
    faults = faults_of(values)
    assert len(faults) == 1, faults
    return faults[0]


def test_reads_the_file_of_the_readme(tmp_path):
    path = tmp_path / 'params.yaml'
    path.write_text(FILE, encoding='utf-8')
    config = read_config(path)
    assert config == Config((TORQUE, RATE), Settings())
    assert (config.channels[0].hold, config.channels[1].hold) == ('zoh', 'smooth')
    assert read_config(str(path)) == config


@pytest.mark.parametrize('node', ['/**', 'identifier', '/identifier', '/robot/identifier',
                                  'anything', '/*'])
def test_nested_and_dotted_under_any_node(node):
    dotted = {f'{name}.{key}': value for name in ('torque', 'rate')
              for key, value in plain()[name].items()}
    dotted |= {'inputs': ['torque'], 'outputs': ['rate'], 'window.length': 20.0, 'order': 3}
    nested = plain(window={'length': 20.0}, order=3)
    mixed = plain(**{'torque': {'topic': '/cmd'}, 'torque.field': 'effort[0]',
                     'window.length': 20.0, 'order': 3})
    configs = [parse_config({node: {'ros__parameters': p}}) for p in (dotted, nested, mixed)]
    assert configs[0] == configs[1] == configs[2]
    assert configs[0].settings == Settings(window_length=20.0, order=3)


def test_nodes_in_namespaces_and_overrides():
    base = {'ros__parameters': plain(order=2)}
    own = {'ros__parameters': {'order': 4, 'window': {'length': 5.0}}}
    other = {'ros__parameters': {'port': '/dev/ttyUSB0'}}
    config = parse_config({'/**': base, 'robot': {'identifier': own}, 'driver': other})
    assert (config.settings.order, config.settings.window_length) == (4, 5.0)


def test_of_several_other_nodes_none_is_guessed():
    one = {'ros__parameters': plain()}
    with pytest.raises(SettingsError, match='for /a, /b, but none for identifier'):
        parse_config({'a': one, 'b': one})


def test_parameters_of_ros_itself_are_no_fault():
    parse_parameters(plain(use_sim_time=True, qos_overrides={'/imu': {'subscription': {
        'depth': 5}}}))


def test_whole_numbers_are_taken_for_floats_and_stored_as_such():
    config = parse_parameters(plain(window={'length': 20}, delay=1, torque={
        'topic': '/cmd', 'field': 'effort[0]'}))
    assert repr(config.settings.window_length) == '20.0'
    assert repr(config.settings.delay) == repr(config.inputs[0].delay) == '1.0'


def test_numbers_without_a_point_are_numbers_as_in_ros(tmp_path):
    path = tmp_path / 'params.yaml'
    path.write_text(FILE + '    pbsid: {rank_tolerance: 1e-9}\n    hermite.beta: 2E+1\n'
                           '    hermite.gamma: 1.5e2\n', encoding='utf-8')
    settings = read_config(path).settings
    assert (settings.rank_tolerance, settings.beta, settings.gamma) == (1e-9, 20.0, 150.0)


def test_all_faults_of_a_file_are_listed_at_once():
    faults = faults_of({
        'inputs': ['torque', 'torque', 'speed'], 'outputs': [],
        'torque': {'topic': 5, 'fild': 'effort[0]', 'delay': -1.0},
        'sped': {'topic': '/odom', 'field': 'twist.linear.x'},
        'window': {'lenght': 3.0, 'stride': 'x'}, 'order': 2.5, 'max_order': 51,
        'pbsid.past': 2, 'pbsid.future': 3, 'method': 'n4sid', 'feedthrough': 1})
    wanted = ['torque` is listed 2 times', 'no output', '`torque.topic` is 5 (int)',
              '`torque.fild` is not a parameter; nearest: field', '`torque.field` is missing',
              '`torque.delay` is -1.0, but must lie between 0 and 60 s',
              'channel `speed` is listed but not described', 'nearest: sped',
              'channel `sped` is described but not listed', 'nearest: speed',
              '`window.lenght` is not a parameter; nearest: window.length',
              "`window.stride` is 'x' (str), but a number is wanted",
              '`order` is 2.5 (float), but a whole number', '`max_order` is 51', 'and 50',
              '`pbsid.future` is 3', "`method` is 'n4sid'; choose one of 'hd-pbsid'",
              '`feedthrough` is 1 (int), but a true or false is wanted']
    text = '\n'.join(faults)
    assert [w for w in wanted if w not in text] == []
    assert len(faults) == 15


@pytest.mark.parametrize(('changes', 'fault'), [
    ({'outputs': [], 'rate': None}, 'there is no output; list at least one channel in `outputs`'),
    ({'outputs': 'rate'}, "`outputs` is 'rate', but a list"),
    ({'inputs': 'torque'}, "`inputs` is 'torque', but a list"),
    ({'inputs': ['torque', 'rate']}, '`rate` is listed 2 times'),
    ({'inputs': ['torque', 'window'], 'window.length': 3.0}, "'window' is that of a parameter"),
    ({'inputs': ['torque', 'a b'], 'a b': {'topic': '/x', 'field': 'y'}}, "'a b' does not"),
    ({'torque': {'field': 'effort[0]'}}, '`torque.topic` is missing'),
    ({'torque': {'topic': '/imu', 'field': 'angular_velocity.x'}},
     '`torque` and `rate` are one signal (/imu angular_velocity.x), as input and as output'),
    ({'torque': {'topic': '/cmd'}}, '`torque.field` is missing'),
    ({'torque': None}, '`torque` is listed but not described; add torque: {topic'),
    ({'extra': {'topic': '/x'}}, '`extra` is described but not listed'),
    ({'window': {'topic': '/x'}}, '`window.topic` is not a parameter; nearest: window.'),
    ({'torque.topic': '/x'}, '`torque.topic` is given twice'),
    ({'torque': {'topic': '', 'field': 'x'}}, "`torque.topic` is ''"),
    ({'torque': {'topic': '/c md', 'field': 'x'}}, "`torque.topic` is '/c md'"),
    ({'torque': {'topic': '/cmd', 'field': 'effort['}}, '`torque.field`: expected'),
    ({'torque': {'topic': '/cmd', 'field': 'x', 'type': 'Imu'}}, "`torque.type` is 'Imu'"),
    ({'torque': {'topic': '/cmd', 'field': 'x', 'hold': 'foh'}}, "`torque.hold` is 'foh'; choose"),
    ({'torque': {'topic': '/cmd', 'field': 'x', 'stamp': 'sent'}}, "`torque.stamp` is 'sent'"),
    ({'torque': {'topic': '/cmd', 'field': 'x', 'delay': '0.1'}}, "`torque.delay` is '0.1'"),
    ({'torque': {'topic': '/cmd', 'field': 'x', 'name': 'y'}}, '`torque.name` is not'),
    ({'rate': {'topic': '/imu', 'field': 'x', 'delay': 0.1}}, 'dead time belongs to the inputs'),
    ({'delay': [0.1, 0.2]}, '`delay` has 2 values but there are 1 input'),
    ({'delay': 'x'}, "`delay` is 'x'"),
    ({'delay': 61.0}, '`delay` is 61.0, but must lie between 0 and 60 s'),
    ({'delay': 0.1, 'torque': {'topic': '/cmd', 'field': 'x', 'delay': 0.1}}, 'keep one'),
    ({'order': None, 'ordr': 3}, '`ordr` is not a parameter; nearest: order'),
    ({'order': [3]}, '`order` is a list'),
    ({'order': 10**400}, '`order` is 1'),
    ({'window': {'length': 10**400}}, '`window.length` is 1'),
    ({'window': {'length': float('nan')}}, '`window.length` is nan'),
    ({'window': {'length': None}}, '`window.length` is None'),
    ({'torque': {'topic': '/cmd', 'field': True}}, 'put quotes around the word'),
    ({5: 3}, '5 is not text'),
])
def test_each_fault_is_named(changes, fault):
    assert fault in only_fault(plain(**changes) if 5 not in changes else plain() | changes)


@pytest.mark.parametrize(('content', 'message'), [
    (b'', 'empty'), (b'# nothing\n', 'empty'), (b'a: [1, 2\n', 'not YAML.*line'),
    (b'{torque: {field: effort[0]}}', 'not YAML.*\n.*quotes'),
    (b'\xff\xfe\x00', 'cannot be read'), (b'[1, 2]', 'ros__parameters'),
    (b'just words', 'ros__parameters'), (b'order: 3\n', 'ros__parameters'),
    (b'/**:\n  ros__parameters:\n', '`ros__parameters` is None'),
    (b'/**:\n  ros__parameters:\n    order: 1\n    order: 2\n', '`order` is given twice'),
    (b'\x00', 'not YAML'), (b'a: ' + b'9' * 5000, 'not YAML'), (b'a: 2020-13-45', 'not YAML'),
    *slow((b'[' * 100_000, 'not YAML'), (b'[' * 5_000, 'not YAML')),
    (b'a: !!python/object:os.system x', 'not YAML'), (b'[' * 2_000, 'not YAML')])
def test_files_that_are_no_parameter_files(tmp_path, content, message):
    path = tmp_path / 'params.yaml'
    path.write_bytes(content)
    with pytest.raises(SettingsError, match=f'(?s){message}'):
        read_config(path)


def test_a_missing_file_is_answered_with_the_nearest(tmp_path):
    (tmp_path / 'params.yaml').write_text(FILE, encoding='utf-8')
    with pytest.raises(SettingsError, match='no file .*parms.yaml; nearest: params.yaml'):
        read_config(tmp_path / 'parms.yaml')
    with pytest.raises(SettingsError, match='no file'):
        read_config(tmp_path / 'nowhere' / 'params.yaml')
    with pytest.raises(SettingsError, match='cannot be read'):
        read_config(tmp_path)


def test_names_that_mean_something_to_yaml_want_quotes():
    faults = faults_of(plain(outputs=['rate', True]))
    assert any('with quotes' in fault for fault in faults)


def test_delays_of_channels_and_of_all():
    two = plain(inputs=['torque', 'force'], force={'topic': '/f', 'field': 'data[0:3]'})
    assert parse_parameters(two).settings.delay == 'auto'
    assert parse_parameters(two | {'delay': 'auto'}).settings.delay == 'auto'
    config = parse_parameters(two | {'delay': ['auto', 0.2]})
    assert config.settings.delay == ('auto', 0.2, 0.2, 0.2)
    assert parse_parameters(two | {'delay': 0.0}).settings.delay == 0.0
    assert parse_parameters(two | {'delay': 0.2}).settings.delay == 0.2
    config = parse_parameters(two | {'delay': [0.1, 0.2]})
    assert [c.delay for c in config.inputs] == [0.1, 0.2]
    assert config.settings.delay == (0.1, 0.2, 0.2, 0.2)
    assert config.settings.delays(4) == (0.1, 0.2, 0.2, 0.2)
    assert parse_parameters(two | {'force.delay': 0.3}).settings.delay == ('auto', 0.3, 0.3, 0.3)


def test_timeouts_of_channels_and_of_all():
    two = plain(inputs=['torque', 'force'], force={'topic': '/f', 'field': 'data[0:3]'})
    assert parse_parameters(two).settings.timeout == 'auto'
    assert parse_parameters(two | {'timeout': 0.0}).settings.timeout == 0.0
    config = parse_parameters(two | {'force.timeout': 0.5})
    assert config.settings.timeout == ('auto', 0.5, 0.5, 0.5)
    assert config.settings.delay == 'auto'
    assert parse_config(yaml.safe_load(dump_config(config))) == config
    one = two | {'force': {'topic': '/cmd', 'field': 'data[0:3]', 'timeout': 0.5}}
    assert 'but both are of /cmd' in only_fault(one)
    out = plain(rate={'topic': '/imu', 'field': 'x', 'timeout': 0.5})
    assert 'timeouts belong to the inputs' in only_fault(out)


def test_delays_of_different_inputs_need_known_widths():
    two = plain(inputs=['torque', 'force'], force={'topic': '/f', 'field': 'data[:]'})
    assert parse_parameters(two | {'delay': 0.2}).settings.delay == 0.2
    assert 'give the end of the range' in only_fault(two | {'force.delay': 0.3})


def test_parameters_of_the_node_stand_in_the_same_file():
    config = parse_parameters(plain(autostart=False, ingest={'depth': 100, 'rate': 20},
                                    **{'save.folder': '/tmp'}))
    assert config.node == NodeSettings(autostart=False, ingest_depth=100, ingest_rate=20.0,
                                       save_folder='/tmp')
    assert repr(config.node.ingest_rate) == '20.0'
    faults = faults_of(plain(autostart=1,
                             ingest={'dept': 5, 'rate': 0.0, 'reliability': 'push'},
                             save={'folder': 3}, inputs=['torque', 'save']))
    for part in ('`autostart` is 1 (int), but a true or false', 'nearest: ingest.depth',
                 '`ingest.rate` is 0.0, but must lie between 1 and 1000 Hz',
                 "`ingest.reliability` is 'push'; choose one of 'best_effort', 'reliable'",
                 '`save.folder` is 3 (int)', "the channel name 'save' is that of a parameter"):
        assert any(part in fault for fault in faults), part
    assert len(faults) == 6


def test_declarations_of_the_node_are_in_order():
    assert not NODE_KEYS.keys() & SETTINGS_KEYS.keys()
    for declared in fields(NodeSettings):
        assert value_faults(declared, declared.default) == []
        assert parameter_name(declared).replace('.', '_') == declared.name
        assert declared.metadata['doc'].endswith('.')
    with pytest.raises(SettingsError) as caught:
        NodeSettings(ingest_depth=0, ingest_reliability='some')
    assert len(caught.value.faults) == 2


def test_changing_the_channels_keeps_the_rest():
    config = Config((replace(TORQUE, delay=0.1), RATE), Settings(order=2),
                    NodeSettings(ingest_depth=9))
    assert config.with_channels(config.channels) == config
    changed = config.with_fields({'rate': 'angular_velocity.y'})
    assert (changed.settings, changed.node) == (config.settings, config.node)
    assert changed.outputs[0].field == 'angular_velocity.y'


def test_a_config_made_by_hand_is_checked_like_a_file():
    with pytest.raises(SettingsError, match='no input'):
        Config((RATE,))
    with pytest.raises(SettingsError, match='listed 2 times'):
        Config((TORQUE, RATE, RATE))
    with pytest.raises(SettingsError, match=r"`delay` is 0.3, but the input channels say 'auto'"):
        Config((TORQUE, RATE), Settings(delay=0.3))
    assert Config((replace(TORQUE, delay=0.3), RATE)).settings.delay == 0.3
    with pytest.raises(SettingsError, match="`torque.hold` is 'x'"):
        replace(TORQUE, hold='x')


def test_names_of_scalars():
    assert RATE.scalar_names == ('rate',)
    assert replace(TORQUE, field='effort[2:4]').scalar_names == ('torque[0]', 'torque[1]')
    pose = replace(RATE, name='pose', field='euler(pose.orientation)')
    assert pose.scalar_names == ('pose.roll', 'pose.pitch', 'pose.yaw')
    assert replace(pose, field='euler(pose.orientation).yaw').scalar_names == ('pose',)
    with pytest.raises(SettingsError, match='length is known only from a message'):
        _ = replace(TORQUE, field='effort[:]').scalar_names


def test_open_ranges_can_be_closed():
    config = Config((replace(TORQUE, field='effort[:]', delay=0.1), RATE))
    closed = config.with_fields({'torque': 'effort[0:6]'})
    assert closed.inputs[0].width == 6
    assert closed.outputs == config.outputs
    assert closed.settings == config.settings


CONFIGS = [
    Config((TORQUE, RATE)),
    Config((replace(TORQUE, delay=1e-7, stamp='log', type=''), RATE,
            replace(RATE, name='y', unit="it's 100 %: #1", field='euler(pose.orientation)'),
            replace(TORQUE, name='N', topic='no', unit='\n°\a', hold='linear')),
           Settings(order=3, trim=False, window_length=1e5, rank_tolerance=1e-10, beta=1 / 3)),
    Config((TORQUE, RATE), Settings(window_length=20, window_max_delay=0),
           NodeSettings(autostart=False, ingest_rate=50, ingest_record='a b: #1.mcap',
                        save_folder='')),
]


@pytest.mark.parametrize('comments', [True, False])
@pytest.mark.parametrize('config', CONFIGS)
def test_a_written_file_reads_back_equal(config, comments, tmp_path):
    path = tmp_path / 'params.yaml'
    path.write_text(dump_config(config, comments), encoding='utf-8')
    assert read_config(path) == config
    plain_yaml = yaml.safe_load(path.read_text(encoding='utf-8'))  # as any other reader has it
    assert parse_config(plain_yaml) == config
    assert ('#' in path.read_text(encoding='utf-8').replace('#1', '')) == comments


def test_a_written_file_suits_ros_which_knows_more_booleans():
    text = dump_config(CONFIGS[1]) + dump_config(CONFIGS[2])
    assert "inputs: [torque, 'N']" in text
    assert "outputs: [rate, 'y']" in text
    assert "    'y':\n" in text
    assert "topic: 'no'" in text
    assert 'length: 20.0\n' in text
    assert 'max_delay: 0.0\n' in text
    assert 'rank_tolerance: 1.0e-10\n' in text


def test_a_written_file_explains_every_parameter():
    text = ' '.join(dump_config(Config((TORQUE, RATE))).replace('#', ' ').split())
    for declared in (*CHANNEL_KEYS.values(), *OWN_KEYS.values()):
        if declared in [SETTINGS_KEYS[key] for key in OF_INPUTS]:
            continue  # the channels have it
        assert ' '.join(declared.metadata['doc'].split()) in text
        assert ' '.join(declared.metadata['when'].split()) in text
    assert 'length: 10.0' in text
    assert '[s, 0.001 to 100000, default 10.0]' in text
    assert all(len(line) < 100 for line in dump_config(CONFIGS[1]).splitlines())


def test_the_reference_has_a_row_for_every_parameter():
    rows = [line for line in parameters_markdown().splitlines() if line.startswith('| `')]
    assert len(rows) == len(CHANNEL_KEYS) + len(OWN_KEYS)
    for name, declared in OWN_KEYS.items():
        row = next(row for row in rows if row.startswith(f'| `{name}`'))
        assert declared.metadata['doc'] in row
        assert declared.metadata['unit'] in row
        assert declared.default is not MISSING
        assert row.replace('\\|', '').count('|') == 6


def test_parameters_take_other_values():
    config = parse_parameters(plain())
    found = with_parameters(config, ['order=4', 'validation.held_out=1e-1', 'rate.hold=linear'])
    assert (found.settings.order, found.settings.held_out) == (4, 0.1)
    assert found.outputs[0].hold == 'linear'
    assert with_parameters(found, []) == found
    # One delay for all takes the place of those of the inputs.
    late = with_parameters(config, ['torque.delay=0.2'])
    assert late.inputs[0].delay == 0.2
    assert with_parameters(late, ['delay=auto']).inputs[0].delay == 'auto'
    late = with_parameters(config, ['torque.timeout=0.5'])
    assert late.inputs[0].timeout == late.settings.timeout == 0.5
    assert with_parameters(late, ['timeout=0.0']).inputs[0].timeout == 0.0


@pytest.mark.parametrize(('changes', 'faults'), [
    (['order', '=4'], ["'order' is not NAME=VALUE, such as order=4", "'=4' is not NAME=VALUE"]),
    (['ordr=4', 'order=99'], ['`ordr` is not a parameter; nearest: order', '`order` is 99']),
    (['order=['], ['the value of order=[ cannot be read'])])
def test_what_is_wrong_with_other_values_is_told(changes, faults):
    with pytest.raises(SettingsError) as caught:
        with_parameters(parse_parameters(plain()), changes)
    assert len(caught.value.faults) == len(faults)
    for told, fault in zip(caught.value.faults, faults, strict=True):
        assert told.startswith(fault)
