# SPDX-License-Identifier: Apache-2.0
"""Folders of flights, of parts, and of bags: what was recorded together."""

from __future__ import annotations

from pathlib import Path

from bag_fixtures import START, flight, write_mcap, write_rosbag2
import numpy as np
import pytest
from recording_files import write_csv

from ctsid_ros.errors import BagError
from ctsid_ros.recordings.grouping import recordings

S = 10**9


def fly(folder: Path, count: int, apart_s: float, name: str = 'flight_{}.mcap') -> list[str]:
    """Write flights of 1 s, one every so many seconds."""
    folder.mkdir(exist_ok=True)
    return [str(write_mcap(folder / name.format(k), flight(
        200, START + round(k * apart_s * S)))) for k in range(count)]


def test_a_folder_of_flights_is_as_many_recordings(tmp_path):
    files = fly(tmp_path / 'many', 20, 100.0)
    assert sorted(recordings([str(tmp_path / 'many')])) == sorted((file,) for file in files)


def test_a_folder_of_parts_is_one(tmp_path):
    fly(tmp_path / 'split', 4, 1.0)
    assert recordings([str(tmp_path / 'split')]) == [(str(tmp_path / 'split'),)]


def test_parts_of_two_flights_in_one_folder(tmp_path):
    first = fly(tmp_path / 'both', 2, 1.0, 'a_{}.mcap')
    second = [str(write_mcap(tmp_path / 'both' / f'b_{k}.mcap', flight(
        200, START + (500 + k) * S))) for k in range(2)]
    assert recordings([str(tmp_path / 'both')]) == [tuple(first), tuple(second)]


def test_files_that_metadata_lists_are_one_whatever_lies_between(tmp_path):
    folder = write_rosbag2(tmp_path / 'bag', flight(200))
    late = write_mcap(folder / 'late.mcap', flight(200, START + 3600 * S))
    assert recordings([str(folder)]) == [(str(folder / 'bag.mcap'),), (str(late),)]
    path = folder / 'metadata.yaml'
    path.write_text(path.read_text().replace('- bag.mcap', '- bag.mcap\n  - late.mcap'))
    assert recordings([str(folder)]) == [(str(folder),)]


def test_a_folder_of_bags(tmp_path):
    folders = [write_rosbag2(tmp_path / f'bag{k}', flight(200, START + k * 60 * S))
               for k in range(3)]
    assert recordings([str(tmp_path)]) == [(str(folder / f'{folder.name}.mcap'),)
                                           for folder in folders]


def test_tables_that_count_from_their_start_are_joined_and_that_is_said(tmp_path):
    t, said = np.arange(0.0, 2.0, 0.1), []
    files = [str(write_csv(tmp_path / f'{name}.csv', {'t': t, name: np.sin(t)})) for name in 'uy']
    assert recordings(files, note=said.append) == [tuple(files)]
    assert len(said) == 1
    assert 'u.csv' in said[0]
    assert 'y.csv: taken for parts of one recording' in said[0]
    assert recordings(files, ['u', 'y'], note=said.append) == [tuple(files)]     # both asked for
    assert len(said) == 1


def test_files_of_a_folder_that_cannot_be_read_are_left_out_and_said(tmp_path):
    files = fly(tmp_path / 'many', 3, 100.0)
    Path(files[1]).write_bytes(b'')
    said = []
    assert recordings([str(tmp_path / 'many')], note=said.append) == [(files[0],), (files[2],)]
    assert len(said) == 1
    assert 'left out' in said[0]
    assert files[1] in said[0]
    with pytest.raises(BagError, match='is empty'):
        recordings([files[0], files[1]])
