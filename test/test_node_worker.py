# SPDX-License-Identifier: Apache-2.0
"""The thread of identification, with real threads."""

from threading import Event, Lock

from ctsid_ros.node.worker import Worker

PATIENCE = 180.0  # s


def make(work):
    failures = []
    worker = Worker(work, failures.append)
    worker.start()
    return worker, failures


def test_jobs_are_done_and_the_newest_of_those_that_wait_is_kept():
    begun, go, done = Event(), Event(), []

    def work(job):
        begun.set()
        assert go.wait(PATIENCE)
        done.append(job)
        if job == 4:
            finished.set()

    finished = Event()
    worker, failures = make(work)
    worker.submit(1)
    assert begun.wait(PATIENCE)
    for job in (2, 3, 4):
        worker.submit(job)
    go.set()
    assert finished.wait(PATIENCE)
    assert worker.stop(PATIENCE)
    assert (done, worker.skipped, failures) == ([1, 4], 2, [])


def test_a_job_that_fails_is_told_and_the_next_is_done():
    done = Event()

    def work(job):
        if job == 'bad':
            raise ValueError('broken')
        done.set()

    failed, failures = Event(), []

    def take(error):
        failures.append(error)
        failed.set()

    worker = Worker(work, take)
    worker.start()
    worker.submit('bad')
    assert failed.wait(PATIENCE)
    worker.submit('good')
    assert done.wait(PATIENCE)
    assert worker.stop(PATIENCE)
    assert [str(f) for f in failures] == ['broken']


def test_a_long_job_does_not_hold_up_stopping():
    begun, go = Event(), Event()

    def work(job):
        begun.set()
        go.wait(PATIENCE)

    worker, _ = make(work)
    worker.submit(1)
    worker.submit(2)
    assert begun.wait(PATIENCE)
    assert not worker.stop(0.01)
    go.set()
    assert worker.stop(PATIENCE)


def test_what_is_dropped_is_not_done():
    begun, go, done = Event(), Event(), []

    def work(job):
        begun.set()
        go.wait(PATIENCE)
        done.append(job)

    worker, _ = make(work)
    worker.submit(1)
    assert begun.wait(PATIENCE)
    worker.submit(2)
    worker.drop()
    go.set()
    assert worker.stop(PATIENCE)
    assert (done, worker.skipped) == ([1], 0)


def test_workers_that_share_a_turn_never_work_at_once():
    turn, begun, go, done = Lock(), Event(), Event(), []

    def first_work(job):
        begun.set()
        go.wait(PATIENCE)
        done.append(job)

    finished = Event()

    def second_work(job):
        done.append(job)
        finished.set()

    first, second = (Worker(work, done.append, turn) for work in (first_work, second_work))
    first.start()
    second.start()
    first.submit('a')
    assert begun.wait(PATIENCE)
    assert not first.stop(0.01)
    second.submit('b')
    second.submit('c')
    assert not finished.wait(0.1)
    go.set()
    assert finished.wait(PATIENCE)
    assert first.stop(PATIENCE)
    assert second.stop(PATIENCE)
    assert (done, second.skipped) == (['a', 'c'], 1)


def test_one_that_waits_for_its_turn_can_be_stopped():
    turn = Lock()
    with turn:
        worker = Worker(lambda job: None, lambda error: None, turn)
        worker.start()
        worker.submit(1)
        assert worker.stop(PATIENCE)
