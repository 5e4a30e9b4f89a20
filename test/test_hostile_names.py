# SPDX-License-Identifier: Apache-2.0
"""
Names that somebody else has chosen stay text wherever they are shown.

One recording whose topic is markup, whose unit is everything else, and whose frame_id is a
megabyte of quotes and line breaks; every output of every verb that shows them.
"""

from __future__ import annotations

import csv
from dataclasses import replace
from importlib.util import find_spec
import io
import json
from pathlib import Path
import re
import shutil
import subprocess
import sys

from bag_fixtures import Sent, array, imu, write_rosbag2
from flights import PARAMS, TRUTH, flight
from markdown_it import MarkdownIt
import numpy as np
import pytest
from test_page import Tags, data_of
import yaml

from ctsid_core.model.estimate import Estimate, Status
from ctsid_core.model.storage import load_estimate, save_model
from ctsid_core.model.verdict import Grade, Verdict
from ctsid_core.sequence.tracking import Tracked
from ctsid_core.settings import Settings
from ctsid_ros.cli import main
from ctsid_ros.config.channels import Channel, Config
from ctsid_ros.export.estimates_bag import write_estimates
from ctsid_ros.messages.health import Health, Level
from ctsid_ros.recordings.bag import open_bag
from ctsid_ros.report.watching import Watched, picture

FLEET = '=fleet <b>x\x1b[2J'      # a folder: the vehicle of the bags in it
TOPIC = '<script>alert(1)</script>'
UNIT = '=HYPERLINK("http://a.b")\x1b]0;owned\x07\x1b[31m\u202e\n# head\n```\n|*_`$x</script><!--'
FRAME = '"\'\n\r\\{{7*7}}' + 'x' * 10**6
FORMULA = tuple('=+-@\t\r')
DASK = bool(find_spec('distributed') and find_spec('pyarrow'))
ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope='module')
def place(tmp_path_factory) -> Path:
    """A folder with the bag and what the verbs make of it."""
    folder = tmp_path_factory.mktemp('hostile')
    sent = [replace(s, topic=TOPIC) if s.topic == '/imu' else s for s in flight(9.0)]
    for k in (10, 200):     # a megabyte in some of the messages is enough
        one = sent[k] if sent[k].topic == TOPIC else sent[k + 1]
        message = imu(one.log_ns - 2_000_000, one.message.angular_velocity.x)
        message.header.frame_id = FRAME
        sent[sent.index(one)] = replace(one, message=message)
    sent.append(Sent('/=1+1', 'std_msgs/msg/Float64MultiArray', sent[0].log_ns, array(1.0)))
    write_rosbag2(folder / 'bag', sorted(sent, key=lambda s: s.log_ns))
    (folder / FLEET).mkdir()
    shutil.copytree(folder / 'bag', folder / FLEET / 'one')
    (folder / FLEET / '`|*.mcap').write_bytes(b'\x1b[31m<script>alert(1)</script>' * 99)
    params = yaml.safe_load(PARAMS)
    params['/**']['ros__parameters']['rate'] |= {'topic': TOPIC, 'unit': UNIT}
    (folder / 'params.yaml').write_text(yaml.safe_dump(params))
    return folder


@pytest.fixture(scope='module')
def said(place) -> str:
    """Everything that the verbs print."""
    told = io.StringIO()
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        patch.setattr(sys, 'stdout', told)
        patch.setattr(sys, 'stderr', told)
        given = ('--params', 'params.yaml')
        for words in (('info', 'bag'), ('init', 'bag', '-o', 'guess.yaml'),
                      ('identify', 'bag', *given, '--out', 'one'),
                      ('replay', 'bag', *given, '--out', 'along'),
                      ('compare', 'bag', *given, '--out', 'methods', '--orders', '2'),
                      ('show', 'one'), ('show', 'one', 'methods/gobf.json', '--out', 'both'),
                      ('simulate', 'one/model.json', 'bag', '--out', 'again'),
                      *([('batch', FLEET, *given, '--out', 'fleet', '--jobs', '1')] * DASK),
                      *(('export', 'one/model.json', '--to', to, '-o', f'model{end}', *more)
                        for to, end, more in (('yaml', '.yaml', ()),
                                              ('c', '.c', ('--rate', '100'))))):
            assert main([*words]) == 0, (words, told.getvalue()[-2000:])
        assert main(['identify', 'bag', *given, '--out', TOPIC.replace('/', '') + '\x1b[2J',
                     '--start', '100']) == 1
    return told.getvalue()


def test_a_terminal_gets_no_escape_sequence(said):
    assert not re.search(r'[\x00-\x08\x0b-\x1f\x7f-\x9f\u202e]', said)
    assert TOPIC in said
    assert len(said) < 100_000


def test_pages_show_it_and_run_nothing(place, said):
    pages = sorted(place.rglob('report.html'))
    assert len(pages) == 5 + DASK
    for path in pages:
        page = path.read_text(encoding='utf-8')
        assert len(page) < 8_000_000
        assert not re.search(r'<script>alert|<!--[^-]*$|\x1b|\x07|\u202e', page)
        found = Tags(page)
        assert sum(t == 'script' for t, _ in found.tags) in (0, 4)
        assert not any(key.startswith('on') for _, a in found.tags for key in a)
        assert 'HYPERLINK' in page or path.parent.name == 'fleet'   # in tables or at axes
        if 'id="figures"' in page:
            texts = json.dumps(data_of(page, 'figures'))
            assert '</script>' not in texts.replace('&lt;/script&gt;', '')
    shown = ' '.join(Tags((place / 'one/report.html').read_text(encoding='utf-8')).words)
    assert TOPIC in shown
    if DASK:
        shown = ' '.join(Tags((place / 'fleet/report.html').read_text(encoding='utf-8')).words)
        assert r'=fleet <b>x\x1b[2J' in shown


def test_markdown_stays_text(place, said):
    for path in place.rglob('report.md'):
        text = path.read_text(encoding='utf-8')
        assert '\x1b' not in text
        assert len(text) < 100_000
        shown = Tags(MarkdownIt('commonmark', {'html': True}).enable('table').render(text))
        assert {t for t, _ in shown.tags} <= {
            'h1', 'h2', 'p', 'strong', 'code', 'pre', 'ul', 'li', 'table', 'thead', 'tbody', 'tr',
            'th', 'td'}, path
        assert 'head' not in [w.strip() for w in shown.words]


def test_no_cell_of_a_csv_file_is_a_formula(place, said):
    wild = replace(TRUTH, output_names=('=1+1\n',), output_units=(UNIT,))
    save_model(place / '@SUM(A1).json', wild, force=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        assert main(['compare', '@SUM(A1).json', '@SUM(A1).json', '--out', 'wild', '--force',
                     '--quiet']) in (0, 3)
    files = sorted(place.rglob('*.csv'))
    assert len(files) >= 4
    for path in files:
        rows = list(csv.reader(path.open(encoding='utf-8', newline='')))
        for cell in (c for row in rows for c in row):
            assert not cell.startswith(FORMULA) or _is_number(cell), (path, cell)
            assert cell.isprintable()
    assert any("'@SUM(A1)" in path.read_text() for path in files)


def _is_number(text: str) -> bool:
    try:
        return float(text) == float(text)
    except ValueError:
        return False


def test_yaml_and_code_hold_it_as_a_value(place, said):
    for name in ('model.yaml', 'guess.yaml'):
        text = (place / name).read_text(encoding='utf-8')
        assert '\x1b' not in text
        assert len(text) < 100_000
        yaml.safe_load(text)
    assert list(yaml.safe_load((place / 'guess.yaml').read_text())) == ['/**']
    code = (place / 'model.c').read_text(encoding='utf-8')
    assert code.isascii()
    assert '\x1b' not in code
    assert subprocess.run(['cc', '-fsyntax-only', '-I', str(place), place / 'model.c'],
                          check=False, capture_output=True).returncode == 0
    assert load_estimate(place / 'one/model.json').model.output_units == (UNIT,)


def test_what_layouts_plot_has_names_of_its_own(place, said):
    """Paths of the layouts are fixed words: no name of an output is part of one."""
    wild = replace(TRUTH, output_names=(TOPIC,), output_units=(UNIT,))
    estimate = Estimate(status=Status.OK, settings=Settings(), model=wild, fit=np.array([90.0]),
                        verdict=Verdict(grade=Grade.GOOD, reason=UNIT), end_ns=10**18)
    config = Config((Channel('u', 'input', '/u', 'std_msgs/msg/Float64', 'data'),
                     Channel('y', 'output', TOPIC, 'std_msgs/msg/Float64', 'data', UNIT)))
    path = place / 'names.mcap'
    path.unlink(missing_ok=True)
    write_estimates(path, config, [Tracked(estimate)])
    with open_bag([str(path)]) as bag:
        topics = set(bag.topics)
    assert {t.partition('/identifier/')[2] for t in topics} >= {'model', 'summary'}
    assert not any('<' in topic for topic in topics)
    for layout in ('foxglove.json', 'plotjuggler.xml'):
        text = (ROOT / 'config' / layout).read_text(encoding='utf-8')
        used = set(re.findall(r'/identifier/(\w+)', text))
        assert used == {'summary'}
        assert set(re.findall(r'key==\\"(\w+)\\"', text)) <= {
            'grade', 'order', 'worst', 're', 'im', 'std', 'natural_frequency', 'damping'}


def test_a_watched_node_cannot_write_to_the_terminal():
    from rich.console import Console

    wild = replace(TRUTH, output_names=(UNIT,))
    watched = Watched('/identifier')
    watched.diagnostics([
        Health('/identifier: ingest', Level.WARN, UNIT, {
            f'{TOPIC}[red]{UNIT} rate [1/s]': '1', f'{TOPIC}[red]{UNIT} messages': '2'}),
        Health('/identifier: identification', Level.OK, '[bold]x[/bold]', {'windows': UNIT})], 0.0)
    watched.model(Estimate(status=Status.OK, settings=Settings(), model=wild,
                           fit=np.array([90.0]), verdict=Verdict(grade=Grade.GOOD, reason=UNIT)),
                  {'window': 1})
    shown = io.StringIO()
    Console(file=shown, width=200).print(picture(watched, 0.0))
    text = shown.getvalue() + watched.line()
    assert not re.search(r'[\x00-\x09\x0b-\x1f\x7f-\x9f\u202e]', text)
    assert f'{TOPIC}[red]' in text          # no markup of rich either
    assert '[bold]x[/bold]' in text
