"""Makes, measures and scores the evaluation's runs in several processes; complete runs are reused.

A run's folder holds its recording with ``recipe.json``, and its measurement ``measured.npz`` with ``measured.json``.
Each recipe is written last: an interrupted run has none, and is repeated.
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

from engine.core.bounds import check_whole_number
from engine.core.errors import InvalidValueError, RecordingError, TidegateError
from engine.core.native_process import keep_calls_in_their_thread
from lab.evaluation.methods.outcome import Outcome
from lab.evaluation.runs.datasets import Run, is_made, make_dataset, write_recipe
from lab.evaluation.runs.scores import ScoredRun, score_run
from lab.evaluation.runs.trial import TrialSettings, measure_run, recipe_of

MEASURED, MEASURED_RECIPE = "measured.npz", "measured.json"
MAX_JOBS = 64
REPORT_EVERY_FRAMES = 10
WAIT_S = 0.2


class BenchStoppedError(TidegateError):
    """The evaluation was cancelled."""

    code = "bench_stopped"


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """Progress of a run: ``doing`` is "making", "measuring" or "done"; each frame counts once made, once measured."""

    run: str
    doing: str
    frames_done: int


Report = Callable[[Progress], None]
DoAll = Callable[[list[Run], Path, TrialSettings, Report], None]
"""Makes and measures runs in a folder, e.g. on other machines; raises RecordingError for one that could not be done."""


def run_bench(
    plan: list[Run],
    work: Path,
    *,
    jobs: int,
    report: Report,
    settings: TrialSettings | None = None,
    do_all: DoAll | None = None,
) -> list[ScoredRun]:
    """Complete a plan's runs in the folder ``work``, and score all of them.

    Parameters
    ----------
    do_all
        Does what is left; by default ``jobs`` processes of this machine.

    Raises
    ------
    InvalidValueError
        ``jobs`` is out of bounds, or another evaluation uses the folder.
    """
    check_jobs(jobs)
    trial_settings = settings or TrialSettings()
    work.mkdir(parents=True, exist_ok=True)
    with _locked(work):
        _clear_drafts(work)
        left = []
        for run in plan:
            if is_measured(run, work, trial_settings):
                report(Progress(run=run.name, doing="done", frames_done=2 * run.frames))
            else:
                left.append(run)
        if do_all is not None:
            do_all(left, work, trial_settings, report)
        elif jobs == 1 or len(left) == 1:
            keep_calls_in_their_thread()
            for run in left:
                do_run(run, work, trial_settings, report)
        elif left:
            _do_all(left, work, trial_settings, min(jobs, len(left)), report)
        return [score_run(run, Outcome.load(work / run.name / MEASURED)) for run in plan]


def check_jobs(jobs: int) -> None:
    """Raise InvalidValueError if the number of processes is out of bounds."""
    check_whole_number("jobs", jobs, 1, MAX_JOBS)


def is_measured(run: Run, work: Path, settings: TrialSettings) -> bool:
    """Whether the run's measurement is complete and was made by the present code."""
    folder = work / run.name
    return (folder / MEASURED).exists() and is_made(folder, _recipe(run, settings), MEASURED_RECIPE)


def do_run(run: Run, work: Path, settings: TrialSettings, report: Report) -> None:
    """Make the recording if it is missing, and measure it."""
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
def _locked(work: Path) -> Iterator[None]:
    """Lock the folder against a second evaluation; raise InvalidValueError if it is locked."""
    with (work / ".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InvalidValueError("work", str(work), "a folder that no other evaluation is using") from error
        yield


def _clear_drafts(work: Path) -> None:
    """Remove drafts of recordings and partial files of a killed process."""
    for draft in work.glob(".*-*"):
        shutil.rmtree(draft, ignore_errors=True)
    for partial in work.glob("*/*.partial"):
        partial.unlink(missing_ok=True)


def _do_all(runs: list[Run], work: Path, settings: TrialSettings, jobs: int, report: Report) -> None:
    # Fresh processes: a fork would copy the locks of the caller's threads.
    context = multiprocessing.get_context("spawn")
    reports: multiprocessing.Queue[Progress] = context.Queue()
    stop = context.Event()
    pool = ProcessPoolExecutor(jobs, mp_context=context, initializer=_start_worker, initargs=(reports, stop))
    try:
        waiting = {pool.submit(_do_in_worker, run, work, settings) for run in runs}
        while waiting:
            finished, waiting = wait(waiting, timeout=WAIT_S, return_when=FIRST_COMPLETED)
            _forward_reports(reports, report)
            for future in finished:
                _result(future)
        _forward_reports(reports, report)
    finally:
        stop.set()  # before the shutdown waits: each worker ends at its next frame
        pool.shutdown(wait=True, cancel_futures=True)
        reports.close()


def _result(future: "Future[None]") -> None:
    try:
        future.result()
    except BrokenProcessPool as error:
        raise RecordingError("a process of the evaluation was killed; is there enough memory?") from error


def _forward_reports(reports: "multiprocessing.Queue[Progress]", report: Report) -> None:
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
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent stops its workers, between two frames
    threading.Thread(target=_end_with_parent, daemon=True).start()
    keep_calls_in_their_thread()
    _WORKER[:] = [_Worker(reports, stop)]


def _end_with_parent() -> None:
    """Exit if the parent was killed and cannot stop this worker."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)


def _do_in_worker(run: Run, work: Path, settings: TrialSettings) -> None:
    do_run(run, work, settings, _WORKER[0].report)
