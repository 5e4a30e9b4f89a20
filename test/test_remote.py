# SPDX-License-Identifier: Apache-2.0
"""Paths that are URLs: read into a cache, of a file and of a folder."""

from __future__ import annotations

from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
import sys
import threading

from bag_fixtures import flight, refused, rows, write_mcap, write_rosbag2
import pytest

from ctsid_ros.recordings.bag import open_bag
from ctsid_ros.recordings.grouping import recordings
from ctsid_ros.replay.results import bag_name

fsspec = pytest.importorskip('fsspec')

@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path / 'cache'))
    return tmp_path / 'cache' / 'ctsid'


@pytest.fixture
def memory():
    system = fsspec.filesystem('memory')
    yield system
    system.rm('/', recursive=True)


@pytest.fixture
def server(tmp_path):
    """Serve a folder to this computer; give its address."""
    folder = tmp_path / 'served'
    folder.mkdir()
    asked: list[str] = []

    class Handler(SimpleHTTPRequestHandler):
        def log_message(self, text, *values):
            asked.append(text % values)

    with ThreadingHTTPServer(('127.0.0.1', 0), partial(Handler, directory=str(folder))) as http:
        thread = threading.Thread(target=http.serve_forever, kwargs={'poll_interval': 0.02})
        thread.start()
        yield folder, asked, f'http://127.0.0.1:{http.server_port}'
        http.shutdown()
        thread.join()


def test_a_file_from_a_server(server, cache):
    pytest.importorskip('aiohttp')
    folder, asked, address = server
    path = write_mcap(folder / 'flight.mcap', flight())
    url = f'{address}/flight.mcap?key=secret'
    with open_bag(url) as bag:
        (note,) = bag.notes
    (copy,) = cache.glob('*/flight.mcap')
    assert note == f'{address}/flight.mcap was read into {copy}'
    assert copy.read_bytes() == path.read_bytes()
    with open_bag(url) as bag:
        assert bag.notes == (f'{address}/flight.mcap: the copy in {copy} is read',)
    assert sum('GET' in line for line in asked) == 1  # it was read once
    path.unlink()
    assert 'flight.mcap cannot be read: there is no such file' in refused(f'{address}/flight.mcap')


def test_a_folder_and_what_changes_there(memory, tmp_path, cache):
    folder = write_rosbag2(tmp_path / 'bag', flight())
    memory.put(str(folder), '/flights/one', recursive=True)
    url = 'memory://flights/one'
    assert rows(url) == rows(folder)
    with open_bag(url) as bag:
        assert bag.notes[0].startswith(f'{url}: the copy in {cache}')
        assert len(bag.notes) == 1
    more = write_mcap(tmp_path / 'more.mcap', flight(3))
    memory.put_file(str(more), '/flights/one/more.mcap')
    assert len(rows(url)) > len(rows(folder))
    assert not list(cache.rglob('*.part'))


def test_several_are_grouped_and_named(memory, tmp_path):
    for i, start in enumerate((1_700_000_000, 1_700_100_000)):
        path = write_mcap(tmp_path / f'{i}.mcap', flight(start_ns=start * 10**9))
        memory.put_file(str(path), f'/{i}.mcap')
    said = []
    urls = ['memory://0.mcap', 'memory://1.mcap']
    assert recordings(urls, (), said.append) == [(urls[0],), (urls[1],)]
    assert sum('was read into' in text for text in said) == 2
    assert bag_name([urls[0]]) == '0'


def test_mistakes(memory, monkeypatch):
    assert 'memory://nothing.mcap cannot be read: there is no such file' in refused('memory://nothing.mcap')
    assert 'nonsense://a cannot be read: Protocol not known' in refused('nonsense://a')
    monkeypatch.setitem(sys.modules, 'fsspec', None)
    assert 'pip install fsspec (it is the extra `remote` of ctsid)' in refused('memory://a.mcap')
