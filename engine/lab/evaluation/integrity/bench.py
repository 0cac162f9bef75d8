"""Runs the catalogue of falsified recordings on several volunteers, in processes of their own."""

import multiprocessing
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from typing import TypeVar

import cv2

from engine.core.bounds import check_whole_number
from engine.core.errors import InvalidValueError, RecordingError
from engine.core.head_direction import HeadDirection
from engine.lab.evaluation.integrity.cases import Case
from engine.lab.evaluation.integrity.session import Session, Volunteer, learn, run
from engine.lab.phantom.builds import find_build

T = TypeVar("T")

MAX_JOBS = 64


def check_plan(volunteers: Sequence[int], seed: int, jobs: int) -> None:
    """Raise InvalidValueError naming field, value and bound."""
    if not volunteers:
        raise InvalidValueError("volunteer", "none", "at least one")
    for volunteer in volunteers:
        find_build(volunteer)
    check_whole_number("seed", seed, 0, 2**32 - 1)
    check_whole_number("jobs", jobs, 1, MAX_JOBS)


def run_all(
    cases: Sequence[Case],
    volunteers: Sequence[int],
    *,
    seed: int,
    jobs: int,
    on_done: Callable[[int], None] = lambda _done: None,
) -> list[list[Session]]:
    """Run every case on every volunteer; return the sessions of each case, in its order.

    ``on_done`` is called with the number of finished jobs: one to learn each model, and one for each session.

    Raises
    ------
    ModelError
        A volunteer's frames were not enough to learn a model.
    RecordingError
        A process was killed.
    """
    poses = sorted({_pose(case) for case in cases}, key=str)
    # Fresh processes: a fork would copy the locks of the caller's threads.
    pool = ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn"), initializer=_prepare_worker)
    try:
        learned = _collect(
            [
                partial(learn, volunteer, seed, is_turned=is_turned, head_direction=head)
                for volunteer in volunteers
                for is_turned, head in poses
            ],
            pool,
            on_done,
        )
        pairs = [(number, volunteer) for number, case in enumerate(cases) for volunteer in _fitting(learned, case)]
        sessions = _collect(
            [partial(run, volunteer, cases[number]) for number, volunteer in pairs],
            pool,
            lambda done: on_done(len(learned) + done),
        )
    except BrokenProcessPool as error:
        raise RecordingError("a process that measured frames was killed; is there memory enough?") from error
    finally:
        pool.shutdown(cancel_futures=True)
    found: list[list[Session]] = [[] for _ in cases]
    for (number, _volunteer), session in zip(pairs, sessions, strict=True):
        found[number].append(session)
    return found


def _collect(calls: Sequence[Callable[[], T]], pool: ProcessPoolExecutor, on_done: Callable[[int], None]) -> list[T]:
    """Return the results in the order of the calls."""
    futures = [pool.submit(call) for call in calls]
    for done, future in enumerate(as_completed(futures), start=1):
        future.result()
        on_done(done)
    return [future.result() for future in futures]


def _prepare_worker() -> None:
    """Use one core, and let Ctrl-C end the process at once; the command reports it."""
    cv2.setNumThreads(1)
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def jobs_of(cases: Sequence[Case], volunteers: Sequence[int]) -> int:
    """Return the number of jobs that `run_all` counts."""
    return len(volunteers) * (len({_pose(case) for case in cases}) + len(cases))


def _pose(of: Case | Volunteer) -> tuple[bool, HeadDirection | None]:
    """Return how the patient lies, and what of it was given: each needs a model of its own."""
    return of.is_turned, of.head_direction


def _fitting(learned: Sequence[Volunteer], case: Case) -> list[Volunteer]:
    return [volunteer for volunteer in learned if _pose(volunteer) == _pose(case)]
