# SPDX-License-Identifier: Apache-2.0
"""Mistakes of users: each has a message that says what to do, and no traceback."""

from __future__ import annotations

from io import BytesIO
import os
from pathlib import Path
import subprocess
import sys
import tempfile
import zipfile

from bag_fixtures import Sent, flight, joints, refused, write_mcap, write_rosbag2
import pytest
import zstandard

from ctsid_ros.decoding.field_path import parse_field
from ctsid_ros.errors import BagError
from ctsid_ros.recordings.bag import DecodeError, open_bag


def test_missing_files(tmp_path):
    write_mcap(tmp_path / 'flight_2.mcap', flight())
    assert 'no such file or folder; nearest: flight_2.mcap' in refused(tmp_path / 'flight_1.mcap')
    assert 'nearest: flight_2.mcap' in refused(tmp_path / 'flight_2')
    assert 'nearest' not in refused(tmp_path / 'fools')
    assert 'nowhere does not exist either' in refused(tmp_path / 'nowhere' / 'a.mcap')
    assert 'no bag was named' in refused([])
    assert 'no such file' in refused([tmp_path / 'flight_2.mcap', tmp_path / 'x'])


def archive(content: bytes) -> bytes:
    file = BytesIO()
    with zipfile.ZipFile(file, 'w') as packed:
        packed.writestr('a.mcap', content)
    return file.getvalue()


@pytest.mark.parametrize(('content', 'said'), [
    (b'', 'is empty (0 bytes)'), (b't and x\n0.0 and 1.0\n', "looks like text ('t and x' ...)"),
    (b't,u,y\n', 'CSV (rows of numbers, titles above)'),    # no rows yet
    (b'\x1f\x8b\x08\0', 'gzip archive'),
    (archive(b'x'), 'zip archive'), (bytes(5000), 'zeros only'),
    (b'\x81\x02\xff' * 99, 'binary data (81 02 ff 81 ...)'),
    ('température\n'.encode() * 50, "text ('température' ...)"),
    (b'rosbag2_bagfile_information:\n  version: 9\n', 'metadata.yaml'),
    (b'\x89MCAP0\r\n', 'cut off or damaged'), (b'SQLite format 3\0', 'no message can be rec'),
    (b'#ROSBAG V2.0\n', 'cut off before'),
    (zstandard.compress(b'hello\n'), 'looks like text'), (b'\x28\xb5\x2f\xfdxxxx', 'is empty')])
def test_files_that_are_no_bags(tmp_path, content, said):
    path = tmp_path / 'b.mcap'
    path.write_bytes(content)
    assert said in refused(path)
    assert str(path) in refused(path)


def test_folders_without_bags(tmp_path):
    assert 'no bag file (.mcap, .db3' in refused(tmp_path)
    write_rosbag2(tmp_path / 'flights' / 'one', flight())
    assert 'bags in its subfolders one' in refused(tmp_path / 'flights')


def test_things_that_are_no_files(tmp_path):
    os.mkfifo(tmp_path / 'pipe')
    assert 'neither a file nor a folder' in refused(tmp_path / 'pipe')


def test_permission():
    """As another user if this one is root, to whom everything is permitted."""
    with tempfile.TemporaryDirectory(dir='/var/tmp') as name:
        folder = Path(name)
        folder.chmod(0o755)
        path = write_mcap(folder / 'b.mcap', flight(2))
        path.chmod(0)
        locked = folder / 'locked'
        locked.mkdir(mode=0)
        user = {'user': 65534, 'group': 65534} if os.geteuid() == 0 else {}
        code = ('import os, sys; sys.path[:] = eval(sys.argv[1])\n'
                'from ctsid_ros.recordings.bag import open_bag\n'
                'from ctsid_ros.errors import BagError\n'
                'if int(sys.argv[2]): os.setgid(65534); os.setuid(65534)\n'
                'for path in sys.argv[3:]:\n'
                '    try: open_bag(path)\n'
                '    except BagError as error: print(error)\n')
        done = subprocess.run(
            [sys.executable, '-c', code, repr([str(Path(__file__).parent.parent), *sys.path]),
             str(int(bool(user))), str(path), str(locked), str(locked / 'b.mcap')],
            capture_output=True, text=True, check=True, timeout=300)
        locked.chmod(0o755)
    lines = done.stdout.splitlines()
    assert len(lines) == 3
    assert all('permission denied; check its owner' in line for line in lines)


def test_unknown_topics(tmp_path):
    with open_bag(write_mcap(tmp_path / 'b.mcap', flight())) as bag:
        for ask in (lambda: bag.messages(['/imu', '/imu_raw']), lambda: bag.topic('/imu_raw'),
                    lambda: bag.extractor('/imu_raw', []), lambda: bag.scalar_fields('/imu_raw')):
            with pytest.raises(BagError, match="no topic '/imu_raw' in the bag; nearest: /imu; a"):
                ask()
        with pytest.raises(BagError, match='there are: /cmd, /imu'):
            bag.topic('gps')


@pytest.mark.parametrize(('text', 'said'), [
    ('angular_velocty.x', 'topic /imu: .*nearest: angular_velocity'),
    ('angular_velocity', 'choose from: angular_velocity.x'),
    ('header.frame_id', 'not a number but string'), ('orientation_covariance[9]', '9 elements')])
def test_unknown_fields(tmp_path, text, said):
    with open_bag(write_mcap(tmp_path / 'b.mcap', flight())) as bag:
        with pytest.raises(BagError, match=said):
            bag.extractor('/imu', [parse_field(text)])
        with pytest.raises(BagError, match=said):
            bag.bind('/imu', parse_field(text))


def test_messages_that_do_not_decode_are_errors_of_their_own(tmp_path):
    sent = [Sent('/j', 'sensor_msgs/msg/JointState', k, joints(k, range(k))) for k in range(5)]
    sent[3] = Sent('/j', 'sensor_msgs/msg/JointState', 3, b'')
    with open_bag(write_mcap(tmp_path / 'b.mcap', sent)) as bag:
        extract = bag.extractor('/j', [parse_field('position[1]')])
        got = []
        for message in bag.messages():
            try:
                got.append(extract(message.raw))
            except DecodeError:
                got.append(None)
        assert got == [None, None, (2, (1.0,)), None, (4, (1.0,))]
        assert isinstance(DecodeError(), ValueError)
