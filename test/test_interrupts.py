# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C at any moment of a command: no traceback, and exit code 130 unless it was done."""

from __future__ import annotations

from itertools import count
import os
from pathlib import Path
import signal
import subprocess
import sys
import threading
import time

from marks import slow
import pytest

from ctsid_ros.recordings.chunks import Chunk, _ahead

ROOT = Path(__file__).resolve().parent.parent
BAG = ROOT / 'bags/quadrotor_roll'
PATIENCE = 300  # s
# What the command `ctsid` does, and a word when it begins: before, Python itself is interrupted.
# Between the word and the call of main() as well, but for the handler.
PROGRAM = """
import os, signal, sys
from ctsid_ros.cli import main
if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:
    signal.signal(signal.SIGINT, lambda *_: os._exit(130))
os.write(1, b'+')
sys.exit(main())
"""
READ = ['info', BAG]
IDENTIFY = ['identify', BAG, '--params', ROOT / 'config/quadrotor_roll.yaml', '--duration', '4']


def start(words: list[object], folder: Path) -> subprocess.Popen[str]:
    program = subprocess.Popen(
        [sys.executable, '-c', PROGRAM, *map(str, words)], cwd=folder, text=True,
        env=os.environ | {'PYTHONPATH': str(ROOT)}, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))  # a shell may ignore it
    assert program.stdout is not None
    assert program.stdout.read(1) == '+'
    return program


def interrupted(words: list[object], folder: Path, after: float, times: int = 1
                ) -> tuple[int, str]:
    """Return the exit code of a program that is interrupted, and what it printed."""
    program = start(words, folder)
    time.sleep(after)
    for _ in range(times):
        program.send_signal(signal.SIGINT)
        time.sleep(0.01 * (times > 1))
    out, err = program.communicate(timeout=PATIENCE)
    return program.returncode, out + err


def length(words: list[object], folder: Path) -> float:
    """Return how long a program runs that nobody interrupts [s]."""
    begin = time.monotonic()
    program = start(words, folder)
    program.communicate(timeout=PATIENCE)
    assert program.returncode in (0, 3)
    return time.monotonic() - begin


@pytest.mark.parametrize(('words', 'moments'), [
    (READ, 2), *slow((READ, 3), (READ, 40), (IDENTIFY, 25))],
                         ids=lambda value: str(value if isinstance(value, int) else value[0]))
def test_ctrl_c_ends_a_command_at_any_moment(words, moments, tmp_path):
    folders = (tmp_path / str(number) for number in count())

    def folder() -> Path:
        new = next(folders)
        new.mkdir()
        return new

    whole = length(words, folder())
    codes = []
    for k in range(moments):
        code, text = interrupted(words, folder(), k / moments * whole)
        assert 'Traceback' not in text, text
        assert 'Exception ignored' not in text, text
        assert code in (130, 0, 3), text
        codes.append(code)
    assert codes[0] == 130


def test_ctrl_c_may_be_pressed_again_and_again(tmp_path):
    code, text = interrupted(READ, tmp_path, 0.05, times=20)
    assert 'Traceback' not in text
    assert code == 130


def test_ctrl_c_while_a_reader_is_dropped_is_not_lost():
    """What is raised while Python drops a generator, it prints and forgets."""
    def load(chunk, room):
        time.sleep(0.2)

    readers = [_ahead(load, [[Chunk(0, 0)]] * 4, [])]
    next(readers[0])

    def drop() -> None:
        readers.clear()
        time.sleep(1.0)

    threading.Timer(0.02, signal.pthread_kill, (threading.get_ident(), signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        drop()


def test_ctrl_c_while_an_object_is_dropped_is_not_lost(tmp_path):
    """As while the pool of a reader is: what its callbacks raise Python prints and forgets."""
    program = """
import signal, time, weakref
from ctsid_ros.interrupts import interruptible

class Dropped:
    pass

def dropped(_):
    signal.raise_signal(signal.SIGINT)

with interruptible():
    one = Dropped()
    noticed = weakref.ref(one, dropped)
    try:
        del one
        time.sleep(600.0)
    except KeyboardInterrupt:
        print('interrupted')
    other = Dropped()
    wrong = weakref.ref(other, lambda _: 1 / 0)
    del other
"""
    done = subprocess.run(
        [sys.executable, '-c', program], cwd=tmp_path, text=True, check=False,
        env=os.environ | {'PYTHONPATH': str(ROOT)}, capture_output=True, timeout=PATIENCE)
    assert (done.returncode, done.stdout) == (0, 'interrupted\n')
    assert 'KeyboardInterrupt' not in done.stderr
    assert 'ZeroDivisionError' in done.stderr       # any other is printed


def test_ctrl_c_before_the_command_can_handle_it_is_not_lost(tmp_path):
    """Python itself swallows what is raised at some moments of an import."""
    program = """
import os, signal, sys
from ctsid_ros.cli import main

class Swallows:
    def find_spec(name, *_):
        try:
            if name == 'ctsid_ros.interrupts':
                signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            pass

sys.meta_path.insert(0, Swallows)
sys.exit(main())
"""
    done = subprocess.run(
        [sys.executable, '-c', program, 'params'], cwd=tmp_path, text=True, check=False,
        env=os.environ | {'PYTHONPATH': str(ROOT)}, capture_output=True, timeout=PATIENCE,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))
    assert (done.returncode, done.stdout, done.stderr) == (130, '', '')


def test_who_ignores_ctrl_c_is_obeyed(tmp_path):
    """A shell starts `ctsid ... &` so."""
    ran = subprocess.Popen(
        [sys.executable, '-c', PROGRAM, 'params'], cwd=tmp_path, text=True,
        env=os.environ | {'PYTHONPATH': str(ROOT)}, stdout=subprocess.PIPE,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN))
    assert ran.stdout is not None
    assert ran.stdout.read(1) == '+'
    ran.send_signal(signal.SIGINT)
    out, _ = ran.communicate(timeout=PATIENCE)
    assert (ran.returncode, out.count('ros__parameters')) == (0, 1)


def test_ctrl_c_that_comes_again_waits_where_it_may_not_come(tmp_path):
    """Until compiled code is left, that an exception may not leave."""
    program = """
import signal, time, weakref
from ctsid_ros.interrupts import deferred, interruptible

class Dropped:
    pass

with interruptible():
    one = Dropped()
    noticed = weakref.ref(one, lambda _: signal.raise_signal(signal.SIGINT))
    del one
    with deferred() as check:
        begin = time.monotonic()
        while time.monotonic() < begin + 0.2:
            pass
        try:
            check()
        except KeyboardInterrupt:
            print('interrupted')
"""
    done = subprocess.run(
        [sys.executable, '-c', program], cwd=tmp_path, text=True, check=False,
        env=os.environ | {'PYTHONPATH': str(ROOT)}, capture_output=True, timeout=PATIENCE)
    assert (done.returncode, done.stdout) == (0, 'interrupted\n')
