# SPDX-License-Identifier: Apache-2.0
"""BLAS has one thread while a model is identified, and as many as before when it is not."""

from __future__ import annotations

from contextlib import nullcontext
import itertools
import subprocess
import sys
from threading import Barrier, Thread

import numpy as np
from plants import paper
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from ctsid_core import Record, Settings, identify
from ctsid_core.effort import THREADS, Cancelled, one_thread

QUICK = Settings(order=2, delay=0.0)


def threads() -> set[int]:
    return {own['num_threads'] for own in threadpool_info() if own['user_api'] == 'blas'}


@pytest.fixture(autouse=True)
def several(monkeypatch):
    for name in THREADS:
        monkeypatch.delenv(name, raising=False)
    with threadpool_limits(limits=3, user_api='blas'):
        if threads() != {3}:
            pytest.skip('this BLAS has no threads')
        yield


def short() -> Record:
    """Return a record of few samples, for any will do."""
    return paper(np.random.default_rng(0), 'hd51', 20, count=201)


def test_while_a_model_is_identified():
    seen, asked = set(), itertools.count()

    def look() -> bool:
        if next(asked) % 20 == 0:          # the libraries are looked for each time
            seen.update(threads())
        return False

    record = short()
    found = identify(record, QUICK, cancelled=look)
    assert seen == {1}
    assert threads() == {3}
    with threadpool_limits(limits=2, user_api='blas'):
        again = identify(record, QUICK)
    for name in 'ABCDK':
        np.testing.assert_array_equal(getattr(again.model, name), getattr(found.model, name))
    with pytest.raises(Cancelled):
        identify(record, cancelled=lambda: True)
    assert threads() == {3}


def test_where_the_environment_says_so_no_library_is_looked_for(monkeypatch):
    """A Ctrl-C meanwhile would be lost; commands and node set these before BLAS is loaded."""
    for name in THREADS:
        monkeypatch.setenv(name, '1')
    assert isinstance(one_thread(), nullcontext)
    monkeypatch.setenv(THREADS[0], '2')
    assert not isinstance(one_thread(), nullcontext)


def test_other_threads_leave_what_they_found():
    record, ready = short(), Barrier(3)

    def other() -> None:
        ready.wait()
        identify(record, QUICK)

    several = [Thread(target=other) for _ in range(2)]
    for thread in several:
        thread.start()
    ready.wait()
    for thread in several:
        thread.join()
    assert threads() == {3}


def test_without_the_package():
    done = subprocess.run([sys.executable, '-c', """
import sys
sys.modules['threadpoolctl'] = None
import numpy as np
from ctsid_core import Record, Settings, identify
t = np.linspace(0.0, 10.0, 1001)
u = np.sign(np.sin(2.0 * t) + np.sin(5.1 * t))
y = np.zeros(1001)
for k in range(1000):
    y[k + 1] = u[k] + (y[k] - u[k]) * np.exp(-0.03)
record = Record.from_arrays(t, u, t, y, input_hold='zoh')
print(identify(record, Settings(order=1, delay=0.0)).model.poles.real.round(2))
"""], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == '[-3.]'
