"""Makes, measures and judges the bench's runs, on as many processes as asked for; what is complete is not done again.

A run's folder holds its recording with ``recipe.json`` and what was measured on it, ``measured.npz`` with
``measured.json``. Either recipe is written last. A run that was interrupted has none, and is done anew.
"""

import fcntl
import multiprocessing
import multiprocessing.connection
import os
import queue
import shutil
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.synchronize import Event
from pathlib import Path

from engine.errors import InvalidValueError, RecordingError, TidegateError
from engine.evaluation.datasets import Run, is_made, make_dataset, write_recipe
from engine.evaluation.judged import Judged, judge_run
from engine.evaluation.outcome import Outcome
from engine.evaluation.trial import TrialSettings, measure_run, recipe_of
from engine.threads import keep_calls_in_their_thread

MEASURED, MEASURED_RECIPE = "measured.npz", "measured.json"
MAX_JOBS = 64
REPORT_EVERY_FRAMES = 10
WAIT_S = 0.2


class BenchStoppedError(TidegateError):
    """The bench was told to stop before it was through."""

    code = "bench_stopped"


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """How far a run has come: ``doing`` is "making", "measuring" or "done"; every frame is made, then measured."""

    run: str
    doing: str
    frames_done: int


Report = Callable[[Progress], None]


def run_bench(
    plan: list[Run],
    work: Path,
    *,
    jobs: int,
    report: Report,
    settings: TrialSettings | None = None,
) -> list[Judged]:
    """Do what is left of a plan in the folder ``work``, and judge all of it.

    Raises
    ------
    InvalidValueError
        ``jobs`` is out of bounds, or another bench uses the folder.
    """
    check_jobs(jobs)
    wanted = settings or TrialSettings()
    work.mkdir(parents=True, exist_ok=True)
    with _alone_in(work):
        _clear_drafts(work)
        left = []
        for run in plan:
            if is_measured(run, work, wanted):
                report(Progress(run=run.name, doing="done", frames_done=2 * run.frames))
            else:
                left.append(run)
        if jobs == 1 or len(left) == 1:
            keep_calls_in_their_thread()
            for run in left:
                do_run(run, work, wanted, report)
        elif left:
            _do_all(left, work, wanted, min(jobs, len(left)), report)
        return [judge_run(run, Outcome.load(work / run.name / MEASURED)) for run in plan]


def check_jobs(jobs: int) -> None:
    """Refuse a number of processes out of bounds."""
    if isinstance(jobs, bool) or not 1 <= jobs <= MAX_JOBS:
        raise InvalidValueError("jobs", jobs, f"a whole number from 1 to {MAX_JOBS}")


def is_measured(run: Run, work: Path, settings: TrialSettings) -> bool:
    """Whether the run's measurement stands there, complete and made by this code."""
    folder = work / run.name
    return (folder / MEASURED).exists() and is_made(folder, _recipe(run, settings), MEASURED_RECIPE)


def do_run(run: Run, work: Path, settings: TrialSettings, report: Report) -> None:
    """Make the recording where it is missing, and measure it."""
    folder = work / run.name
    (folder / MEASURED_RECIPE).unlink(missing_ok=True)

    def made(done: int, _all: int) -> None:
        report(Progress(run=run.name, doing="making", frames_done=done))

    def measured(done: int) -> None:
        if done % REPORT_EVERY_FRAMES == 0:
            report(Progress(run=run.name, doing="measuring", frames_done=run.frames + done))

    make_dataset(run, folder, made)
    measure_run(run, folder, settings=settings, on_frame=measured).save(folder / MEASURED)
    write_recipe(folder, _recipe(run, settings), MEASURED_RECIPE)
    report(Progress(run=run.name, doing="done", frames_done=2 * run.frames))


def _recipe(run: Run, settings: TrialSettings) -> dict[str, object]:
    return recipe_of(run) | {"settings": repr(settings)}


@contextmanager
def _alone_in(work: Path) -> Iterator[None]:
    """Refuse to share the folder: two benches would write over each other."""
    with (work / ".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InvalidValueError("work", str(work), "a folder no other bench is using now") from error
        yield


def _clear_drafts(work: Path) -> None:
    """Remove what a killed process left: drafts of recordings and partial files."""
    for draft in work.glob(".*-*"):
        shutil.rmtree(draft, ignore_errors=True)
    for partial in work.glob("*/*.partial"):
        partial.unlink(missing_ok=True)


def _do_all(runs: list[Run], work: Path, settings: TrialSettings, jobs: int, report: Report) -> None:
    # Fresh processes: a fork would copy the threads' locks of whoever calls.
    context = multiprocessing.get_context("spawn")
    reports: multiprocessing.Queue[Progress] = context.Queue()
    stop = context.Event()
    pool = ProcessPoolExecutor(jobs, mp_context=context, initializer=_start_worker, initargs=(reports, stop))
    try:
        waiting = {pool.submit(_do_in_worker, run, work, settings) for run in runs}
        while waiting:
            finished, waiting = wait(waiting, timeout=WAIT_S, return_when=FIRST_COMPLETED)
            _pass_on(reports, report)
            for future in finished:
                _result(future)
        _pass_on(reports, report)
    finally:
        stop.set()  # before waiting for them: each ends at its next frame
        pool.shutdown(wait=True, cancel_futures=True)
        reports.close()


def _result(future: "Future[None]") -> None:
    try:
        future.result()
    except BrokenProcessPool as error:
        raise RecordingError("a process of the bench was killed; is there memory enough?") from error


def _pass_on(reports: "multiprocessing.Queue[Progress]", report: Report) -> None:
    while True:
        try:
            report(reports.get_nowait())
        except queue.Empty:
            return


@dataclass(slots=True)
class _Worker:
    reports: "multiprocessing.Queue[Progress]"
    stop: Event

    def report(self, progress: Progress) -> None:
        if self.stop.is_set():
            raise BenchStoppedError("stopped")
        self.reports.put(progress)


_WORKER: list[_Worker] = []


def _start_worker(reports: "multiprocessing.Queue[Progress]", stop: Event) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent stops us, between two frames
    threading.Thread(target=_end_with_parent, daemon=True).start()
    keep_calls_in_their_thread()
    _WORKER[:] = [_Worker(reports, stop)]


def _end_with_parent() -> None:
    """End when the parent was killed: nobody is left to stop us."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)


def _do_in_worker(run: Run, work: Path, settings: TrialSettings) -> None:
    do_run(run, work, settings, _WORKER[0].report)
