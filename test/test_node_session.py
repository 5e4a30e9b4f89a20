# SPDX-License-Identifier: Apache-2.0
"""Windows to models in the thread of identification: what resets and stops leave behind."""

from threading import Event

import numpy as np
import pytest

from ctsid_core.sequence.tracking import Tracker
from ctsid_core.settings import Settings
from ctsid_core.signals.record import Record
from ctsid_ros.node.diagnosis import diagnose_identification
from ctsid_ros.node.session import Session

SETTINGS = Settings(order=1, held_out=0.0)
PATIENCE = 180.0  # s


def window(seed=0):
    """Return a record of a first-order plant, pole at -2 rad/s."""
    rng = np.random.default_rng(seed)
    t, y = np.arange(0.0, 8.0, 0.02), np.zeros(400)
    u = np.repeat(rng.standard_normal(80), 5)
    for k in range(399):
        y[k + 1] = np.exp(-0.04) * y[k] + (1 - np.exp(-0.04)) * u[k]
    return Record.from_arrays(t, u, t, y + 0.01 * rng.standard_normal(400), input_hold='zoh')


class Heard:
    """What a session publishes, one result after the other."""

    def __init__(self):
        self.results, self.faults, self.told = [], [], Event()
        self.then = lambda: None

    def publish(self, result):
        self.results.append(result)
        self.then()
        self.told.set()

    def wait(self):
        assert self.told.wait(PATIENCE), self.faults
        self.told.clear()


@pytest.fixture
def heard():
    return Heard()


@pytest.fixture
def session(heard):
    made = Session(SETTINGS, heard.publish, heard.faults.append)
    yield made
    assert made.stop(PATIENCE)
    assert not heard.faults


def test_windows_are_numbered_and_models_kept(session, heard):
    for number in (1, 2):
        session.submit(window(number), None)
        heard.wait()
    assert [result.window.number for result in heard.results] == [1, 2]
    assert session.progress.windows == 2
    assert all(result.tracked.estimate.ok for result in heard.results)


def test_a_model_that_is_published_is_the_one_that_is_kept(session, heard):
    """Who heard it asked to save it at once, and got the one before."""
    kept = []
    heard.then = lambda: kept.append(session.progress.accepted.window.number)
    for number in (1, 2):
        session.submit(window(number), None)
        heard.wait()
    assert kept == [1, 2]


def test_a_reset_while_a_model_is_published_leaves_no_model(session, heard):
    heard.then = session.reset
    session.submit(window(), None)
    heard.wait()
    heard.then = lambda: None
    session.submit(window(1), None)
    heard.wait()
    assert [result.tracked.realisation for result in heard.results] == [1, 2]
    assert session.stop(PATIENCE)
    assert session.progress.accepted.window.number == 2


def test_a_reset_at_the_end_leaves_nothing(session, heard):
    heard.then = session.reset
    session.submit(window(), None)
    heard.wait()
    assert session.stop(PATIENCE)
    assert (session.progress.last, session.progress.accepted) == (None, None)


def test_a_window_under_way_is_void_after_a_reset(session, heard, monkeypatch):
    begun, go, take = Event(), Event(), Tracker.take

    def slowly(tracker, record, cancelled):
        tracked = take(tracker, record, cancelled)
        begun.set()  # the tracker remembers it now
        assert go.wait(PATIENCE)
        return tracked

    monkeypatch.setattr(Tracker, 'take', slowly)
    session.submit(window(), None)
    assert begun.wait(PATIENCE)
    session.submit(window(1), None)  # waits, and is dropped
    session.reset()
    go.set()
    session.submit(window(2), None, requested=True)
    heard.wait()
    result, = heard.results
    assert (result.window.number, result.window.requested) == (3, True)
    assert np.isnan(result.tracked.fresh_fit).all()  # there is no model before it
    assert result.tracked.realisation == 2
    assert session.progress.skipped == 0


@pytest.mark.parametrize('end', ['reset', 'stop'])
def test_a_window_under_way_is_broken_off(session, heard, monkeypatch, end):
    begun, broken, take = Event(), Event(), Tracker.take

    def slowly(tracker, record, cancelled):
        begun.set()
        while not cancelled():
            pass
        broken.set()
        return take(tracker, record, cancelled)

    monkeypatch.setattr(Tracker, 'take', slowly)
    session.submit(window(), None)
    assert begun.wait(PATIENCE)
    assert session.progress.under_way.number == 1
    assert session.progress.under_way.seconds > 0.0
    assert session.reset() is None if end == 'reset' else session.stop(PATIENCE)
    assert broken.wait(PATIENCE)
    assert session.stop(PATIENCE)
    assert (heard.results, session.progress.last, session.progress.under_way) == ([], None, None)


def test_a_fault_is_told_until_a_window_is_identified_again(heard, monkeypatch):
    take = Tracker.take
    session = Session(SETTINGS, heard.publish, lambda text: heard.told.set())
    monkeypatch.setattr(Tracker, 'take', lambda *_: 1 / 0)
    session.submit(window(), None)
    heard.wait()
    assert session.progress.failure.startswith('ZeroDivisionError')
    monkeypatch.setattr(Tracker, 'take', take)
    session.submit(window(), None)
    heard.wait()
    assert session.stop(PATIENCE)
    assert (session.progress.failures, session.progress.failure) == (1, '')
    assert diagnose_identification(session.progress).values['faults'] == 1
    assert 'fault' not in diagnose_identification(session.progress).message
