# SPDX-License-Identifier: Apache-2.0
"""The thread of identification, with real threads."""

from threading import Event

from ctsid_ros.node.worker import Worker


def make(work):
    failures = []
    worker = Worker(work, failures.append)
    worker.start()
    return worker, failures


def test_jobs_are_done_and_the_newest_of_those_that_wait_is_kept():
    begun, go, done = Event(), Event(), []

    def work(job):
        begun.set()
        assert go.wait(5.0)
        done.append(job)
        if job == 4:
            finished.set()

    finished = Event()
    worker, failures = make(work)
    worker.submit(1)
    assert begun.wait(5.0)
    for job in (2, 3, 4):
        worker.submit(job)
    go.set()
    assert finished.wait(5.0)
    assert worker.stop(5.0)
    assert (done, worker.skipped, failures) == ([1, 4], 2, [])


def test_a_job_that_fails_is_told_and_the_next_is_done():
    done = Event()

    def work(job):
        if job == 'bad':
            raise ValueError('broken')
        done.set()

    worker, failures = make(work)
    worker.submit('bad')
    while not failures:
        pass
    worker.submit('good')
    assert done.wait(5.0)
    assert worker.stop(5.0)
    assert [str(f) for f in failures] == ['broken']


def test_a_long_job_does_not_hold_up_stopping():
    begun, go = Event(), Event()

    def work(job):
        begun.set()
        go.wait(10.0)

    worker, _ = make(work)
    worker.submit(1)
    worker.submit(2)
    assert begun.wait(5.0)
    assert not worker.stop(0.01)
    go.set()
    assert worker.stop(5.0)


def test_what_is_dropped_is_not_done():
    begun, go, done = Event(), Event(), []

    def work(job):
        begun.set()
        go.wait(5.0)
        done.append(job)

    worker, _ = make(work)
    worker.submit(1)
    assert begun.wait(5.0)
    worker.submit(2)
    worker.drop()
    go.set()
    assert worker.stop(5.0)
    assert (done, worker.skipped) == ([1], 0)
