"""Jobs: their rows in the table, from the queue to the result, through failures, cancelling and the end of a
process."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import sqlalchemy as sa
from distributed import LocalCluster

import lab.jobs
from lab.capture.plan import CapturePlan
from lab.capture.session import CaptureSession, Progress
from lab.capture.store import Store
from lab.capture.tables import JobRow
from lab.capture_kinds.dark import DarkSequence
from lab.errors import InputError, NotDetermined
from lab.jobs import JobInfo, JobRunner, check_scheduler
from lab.pipeline import CaptureRequest, Goal, PipelineProgress, PipelineRequest, Tell, capture_here
from tests.lab import fake_bench


@pytest.fixture
def session(store: Store) -> str:
    darks = CapturePlan((DarkSequence(exposures_s=(0.001, 0.1), frames=2),))
    run = CaptureSession.start(store, fake_bench.station(), darks, connect=fake_bench.Bench().drivers)
    return run.run().id


def with_task(monkeypatch: pytest.MonkeyPatch, task: Callable[[PipelineRequest, Tell], object]) -> None:
    """Jobs do `task` in place of the pipeline; what it returns is kept under the job's id, as the pipeline keeps its
    goal."""

    def pipeline(request: PipelineRequest, tell: Tell, *, store: Store, capturer: object) -> None:
        task(request, tell)
        store.add_result(request.goal, request.source, {"path": "made"}, request.job_id)

    monkeypatch.setattr(lab.jobs, "run_pipeline", pipeline)


def test_a_job_goes_from_the_queue_to_its_result(store: Store, session: str, monkeypatch: pytest.MonkeyPatch) -> None:
    go, seen = threading.Event(), []

    def task(asked: PipelineRequest, tell: Tell) -> None:
        tell(PipelineProgress("fit", "half of it", 0.5))
        assert asked.recordings is not None
        seen.append(len(asked.recordings.captures()))
        assert go.wait(20)

    with_task(monkeypatch, task)
    with JobRunner(store) as runner:
        job = runner.submit("fit", session)
        until = time.monotonic() + 20
        while runner.job(job).progress < 0.5:
            assert time.monotonic() < until
            time.sleep(0.01)
        info = runner.job(job)
        assert (info.state, info.message, info.started is not None) == ("running", "fit: half of it", True)
        go.set()
        info = runner.wait(job, 20)
        assert (info.state, info.progress, info.error) == ("done", 1.0, None)
        assert seen == [8]
        assert [one.id for one in runner.jobs()] == [job]
    result = store.result(job)
    assert (result.kind, result.source, result.document) == ("fit", session, {"path": "made"})


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (InputError("folder: damaged; copy it again"), "folder: damaged; copy it again"),
        (NotDetermined("noise", "no flats; capture some"), "noise: no flats; capture some"),
        (ZeroDivisionError("by zero"), "ZeroDivisionError: by zero; this is a defect of calibench, report it"),
    ],
)
def test_a_failure_is_said_and_the_runner_goes_on(
    store: Store, session: str, monkeypatch: pytest.MonkeyPatch, error: Exception, said: str
) -> None:
    def task(asked: PipelineRequest, tell: Tell) -> None:
        if not store.results():
            store.add_result("validate", session, {})
            raise error

    with_task(monkeypatch, task)
    with JobRunner(store) as runner:
        first = runner.wait(runner.submit("fit", session), 20)
        assert (first.state, first.error) == ("failed", said)
        assert runner.wait(runner.submit("fit", session), 20).state == "done"


def test_cancelling_ends_a_job_at_its_next_progress_and_the_next_one_starts(
    store: Store, session: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    began, calls = threading.Event(), []

    def task(asked: PipelineRequest, tell: Tell) -> None:
        calls.append(asked.job_id)
        if len(calls) > 1:
            return
        began.set()
        for step in range(2000):  # 20 s, if nothing ended it
            tell(PipelineProgress("fit", f"step {step}", step / 2000))
            time.sleep(0.01)
        raise AssertionError("not cancelled")

    with_task(monkeypatch, task)
    with JobRunner(store) as runner:
        first, second, third = (runner.submit("fit", session) for _ in range(3))
        assert began.wait(20)
        assert runner.cancel(second).state == "cancelled"  # it is queued behind the first
        assert runner.cancel(first).cancel_requested
        assert runner.wait(first, 20).state == "cancelled"
        assert runner.wait(third, 20).state == "done"
        assert runner.cancel(third).state == "done"
    assert calls == [first, third]
    assert [r.job_id for r in store.results()] == [third]


def test_closing_the_runner_ends_what_is_under_way(store: Store, session: str, monkeypatch: pytest.MonkeyPatch) -> None:
    began = threading.Event()

    def task(asked: PipelineRequest, tell: Tell) -> None:
        began.set()
        while True:
            tell(PipelineProgress("fit", "on and on", 0.1))
            time.sleep(0.01)

    with_task(monkeypatch, task)
    with JobRunner(store) as runner:
        job = runner.submit("fit", session)
        assert began.wait(20)
    with JobRunner(store) as runner:
        assert runner.job(job).state == "cancelled"


def test_jobs_of_a_process_that_ended_are_failed_at_the_next_start(store: Store, session: str) -> None:
    with JobRunner(store) as alive:
        with store.transaction() as db:
            for number, (state, runner) in enumerate(
                [("queued", "gone"), ("running", "gone"), ("done", "gone"), ("running", alive.id)]
            ):
                row = JobRow(id=f"j{number}", kind="fit", source=session, state=state, runner=runner)
                row.created = fake_bench.datetime.now(fake_bench.UTC)
                db.add(row)
        with JobRunner(store) as runner:
            states = [runner.job(f"j{number}") for number in range(4)]
    assert [info.state for info in states] == ["failed", "failed", "done", "running"]
    assert "ended before it was done; start the job again" in (states[0].error or "")
    with store.transaction() as db:
        db.execute(sa.update(JobRow).values(state="done"))


def test_what_is_not_there_is_said(store: Store) -> None:
    with JobRunner(store) as runner:
        with pytest.raises(InputError, match="job 'x'"):
            runner.job("x")
        with pytest.raises(InputError, match="choose from capture, fit, validate, diagnose, report, pipeline"):
            runner.submit("paint", "s")  # type: ignore[arg-type]
        info = runner.wait(runner.submit("fit", "/no/such/folder"), 20)
        assert info.state == "failed"
        assert "no such folder" in (info.error or "")


def test_a_job_that_no_worker_has_any_more_is_failed_with_the_reason(
    store: Store, session: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    began, go = threading.Event(), threading.Event()

    def task(asked: PipelineRequest, tell: Tell) -> None:
        began.set()
        assert go.wait(20)

    with_task(monkeypatch, task)
    with JobRunner(store) as runner:
        job = runner.submit("fit", session)
        assert began.wait(20)
        runner._left(job)  # what Dask tells when the worker was killed and another one found that the job had begun
        info = runner.job(job)
        assert info.state == "failed" and "worker" in (info.error or "")
        go.set()


def test_a_real_fit_on_a_worker_process(store: Store, session: str) -> None:
    # In a process of its own the task has only references: the store's folder and the job's id.
    with (
        LocalCluster(n_workers=1, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0") as cluster,
        JobRunner(store, scheduler=cluster.scheduler_address) as runner,
    ):
        info: JobInfo = runner.wait(runner.submit("fit", session), 120)
        assert (info.state, info.error) == ("done", None)
    document = store.result(info.id).document
    assert document["format"] == "calibench-fit"
    assert document["source"] == session


def test_a_scheduler_that_is_not_there_is_said(store: Store) -> None:
    with (
        JobRunner(store, scheduler="tcp://127.0.0.1:9", connect_timeout_s=0.3) as runner,
        pytest.raises(InputError, match="not reached"),
    ):
        runner.submit("fit", "s")


def test_a_job_that_captures_runs_here_and_is_cancelled_in_good_order(store: Store) -> None:
    bench = fake_bench.Bench(delay_s=0.05)
    darks = CapturePlan((DarkSequence(exposures_s=(0.001, 0.1), frames=2),))
    waiting = CaptureSession.start(store, fake_bench.station(), darks, connect=bench.drivers).id

    def capturer(request: CaptureRequest, tell: Callable[[Progress], None]) -> str:
        return capture_here(store, fake_bench.station(), request, tell, bench.drivers)

    with JobRunner(store, scheduler="tcp://127.0.0.1:9") as runner:  # no Dask: nobody answers there
        job = runner.submit("pipeline", waiting, capturer=capturer)
        until = time.monotonic() + 20
        while not bench.shots:
            assert time.monotonic() < until
            time.sleep(0.01)
        runner.cancel(job)
        info = runner.wait(job, 20)
        assert (info.state, info.error) == ("cancelled", None)
    found = store.session(waiting)
    assert found.state == "interrupted" and found.steps_done < found.steps
    assert not bench.opened  # the shutter is closed
    assert store.results() == []


@pytest.mark.parametrize("kind", ["fit", "pipeline"])
def test_only_a_pipeline_that_captures_resolves(store: Store, session: str, kind: Goal) -> None:
    with JobRunner(store) as runner, pytest.raises(InputError, match="leave resolve out"):
        runner.submit(kind, session, resolve=True)


@pytest.mark.parametrize(
    ("address", "good"),
    [
        ("tcp://127.0.0.1:8786", True),
        ("127.0.0.1:8786", True),
        ("tcp://[::1]:8786", True),
        ("localhost:8786", True),
        ("tls://192.0.2.1:8786", True),
        ("tcp://192.0.2.1:8786", False),
        ("scheduler:8786", False),
        ("ws://lab.example:8786", False),
    ],
)
def test_a_scheduler_is_on_this_computer_or_speaks_tls(tmp_path: Path, address: str, good: bool) -> None:
    """Whoever is the scheduler runs code here."""
    if good:
        check_scheduler(address)
        return
    with contextlib.closing(Store(tmp_path)) as store, pytest.raises(InputError, match="tls://"):
        JobRunner(store, scheduler=address)
