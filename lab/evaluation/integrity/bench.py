"""Runs the catalogue of falsified recordings on several volunteers, in processes of their own.

The table of `tidegate evaluate integrity`: one row a case, over all volunteers.
"""

import multiprocessing
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import cv2
import numpy as np

from engine.core.bounds import check_whole_number
from engine.core.errors import InvalidValueError, RecordingError
from engine.core.frames import BoolArray
from engine.core.native_process import end_with_the_pool
from engine.core.signals import HeadDirection
from lab.evaluation.integrity.cases import FALSE_S, Case
from lab.evaluation.integrity.session import FPS, WRONG_MM, Session, Volunteer, learn, run
from lab.evaluation.table import Table
from lab.phantom.builds import NO_DEPARTURE, Departure, find_build
from lab.phantom.sensor import USUAL

T = TypeVar("T")

MAX_JOBS = 64
TITLES = {"integrity": "Falsified recordings", "conditions": "Light, skin, clothing and a cold camera"}
LONGEST_WRONG_S = 0.5
LONGEST_UNNAMED_S = 1.0
LEAST_HONEST_PERCENT = 99.0


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
    sensor: str = USUAL,
    turn: int | None = None,
    on_done: Callable[[int], None] = lambda _done: None,
) -> list[list[Session]]:
    """Run every case on every volunteer; return the sessions of each case, in its order.

    With a ``turn`` each case has one volunteer: the first case that of this number, and so on in turn.
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
                partial(
                    learn,
                    volunteer,
                    seed,
                    is_turned=is_turned,
                    sensor=sensor,
                    head_direction=head,
                    departure=departure,
                    must_learn=departure == NO_DEPARTURE,
                )
                for volunteer in volunteers
                for is_turned, head, departure in poses
            ],
            pool,
            on_done,
        )
        pairs = [
            (number, volunteer)
            for number, case in enumerate(cases)
            for volunteer in _taken(_fitting(learned, case), None if turn is None else turn + number)
        ]
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
    """Use one core, and let Ctrl-C end the process at once, as the command reports it, and the command's own end."""
    cv2.setNumThreads(1)
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    end_with_the_pool()


def jobs_of(cases: Sequence[Case], volunteers: Sequence[int], *, takes_turns: bool = False) -> int:
    """Return the number of jobs that `run_all` counts."""
    each = 1 if takes_turns else len(volunteers)
    return len(volunteers) * len({_pose(case) for case in cases}) + each * len(cases)


def _pose(of: Case | Volunteer) -> tuple[bool, HeadDirection | None, Departure]:
    """Return how the patient lies, what of it was given, and under which light: each needs a model of its own."""
    return of.is_turned, of.head_direction, of.departure


def _fitting(learned: Sequence[Volunteer], case: Case) -> list[Volunteer]:
    return [volunteer for volunteer in learned if _pose(volunteer) == _pose(case)]


def _taken(volunteers: list[Volunteer], turn: int | None) -> list[Volunteer]:
    return volunteers if turn is None else [volunteers[turn % len(volunteers)]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """One case over all volunteers: shares in per cent, times in seconds, errors in mm.

    Attributes
    ----------
    measured_percent
        Share of the frames after the beginning that were reported as measured.
    wrong_percent, longest_wrong_s
        Share of the frames that were reported as measured with an error of more than 1 mm of any signal, and their
        longest run.
    largest_mm
        Largest error that was reported as measured.
    detected_s
        Longest time to the first frame that was lost or held, or of a rigid movement to its report; None where one
        volunteer's never was.
    named_s, named
        Longest time to the first code that names the cause, None where one volunteer's was not named or nothing is to
        be named; and the codes that did on any volunteer.
    on_s, wrong_on_s
        Time of beam on, of the signal with most of it, in all and with the true motion more than 1 mm outside of the
        window.
    """

    measured_percent: float
    wrong_percent: float
    longest_wrong_s: float
    largest_mm: float
    detected_s: float | None
    named_s: float | None
    named: str
    on_s: float
    wrong_on_s: float


def verdict(sessions: Sequence[Session]) -> Verdict:
    """Judge the sessions of one case."""
    wrong = [_is_wrong(session) for session in sessions]
    detected = [_detected_s(session) for session in sessions]
    names = [_named(session) for session in sessions]
    errors = np.concatenate([np.abs(session.error_mm[session.is_measured]).ravel() for session in sessions])
    errors = errors[np.isfinite(errors)]
    return Verdict(
        measured_percent=100.0 * float(np.mean(np.concatenate([session.is_measured for session in sessions]))),
        wrong_percent=100.0 * float(np.mean(np.concatenate(wrong))),
        longest_wrong_s=max(_longest_run(one) for one in wrong) / FPS,
        largest_mm=float(errors.max()) if errors.size else 0.0,
        detected_s=None if any(one is None for one in detected) else max(one or 0.0 for one in detected),
        named_s=None if any(one is None for one in names) else max(one[0] for one in names if one is not None),
        named=", ".join(sorted({one[1] for one in names if one is not None})),
        on_s=max(float(session.is_on.sum(axis=0).max()) for session in sessions) / FPS,
        wrong_on_s=max(
            float((session.is_on & (session.outside_mm > WRONG_MM)).sum(axis=0).max()) for session in sessions
        )
        / FPS,
    )


def integrity_table(cases: Sequence[Sequence[Session]], sensor: str = USUAL, name: str = "integrity") -> Table:
    """Make the table of a sensor, ``name`` for its file.

    A row fails where an error above 1 mm stands as measured for longer than 0.5 s.

    A rigid move fails where it is not named within a second, an honest recording where more than 1 % is lost.
    """
    rows = []
    for sessions in cases:
        case, found = sessions[0].case, verdict(sessions)
        reason = next((session.reasons[0].partition(":")[0] for session in sessions if session.reasons), None)
        rows.append(
            (
                case.kind,
                case.size,
                case.hazard or None,
                found.measured_percent,
                found.wrong_percent,
                found.longest_wrong_s,
                found.largest_mm,
                found.detected_s,
                found.named_s,
                found.named or None,
                found.on_s,
                found.wrong_on_s,
                reason,
                ", ".join(_misses(case, found)) or None,
            )
        )
    return Table(
        name=f"{name}_{sensor}",
        title=f"{TITLES[name]}, sensor {sensor}",
        columns=(
            "kind",
            "size",
            "hazard",
            "measured [%]",
            f"wrong by more than {WRONG_MM:g} mm [%]",
            "longest [s]",
            "largest error [mm]",
            "detected after [s]",
            "named after [s]",
            "as",
            "beam on [s]",
            "of it outside [s]",
            "first reason",
            "misses",
        ),
        rows=tuple(rows),
        note=(
            "Errors of whole, thorax, abdomen, one cell and one point, in frames that were reported as measured; of "
            "whole alone where the head direction is unknown, because no other signal may gate then; not of a signal "
            "of which the camera sees too little to gate on (that is a detection). "
            "Beam on is that of the signal with most of it; outside: true motion more than 1 mm outside of the window."
        ),
        digits=2,
        failed=frozenset(number for number, row in enumerate(rows) if row[-1] is not None),
    )


def _misses(case: Case, found: Verdict) -> list[str]:
    """Return which targets a case misses."""
    is_unnamed = found.named_s is None or found.named_s > LONGEST_UNNAMED_S
    misses = {
        "stands": found.longest_wrong_s > LONGEST_WRONG_S,
        "not named": case.is_rigid and case.seconds <= FALSE_S and is_unnamed,
        "lost": case.is_honest and found.measured_percent < LEAST_HONEST_PERCENT,
    }
    return [name for name, is_missed in misses.items() if is_missed]


def _is_wrong(session: Session) -> BoolArray:
    with np.errstate(invalid="ignore"):
        return np.asarray(session.is_measured & (np.abs(session.error_mm) > WRONG_MM).any(axis=1))


def _named(session: Session) -> tuple[float, str] | None:
    """Return the time to the first code that names the cause, and the code."""
    found = [(session.first_s[code], code) for code in session.case.causes if code in session.first_s]
    return min(found, default=None)


def _detected_s(session: Session) -> float | None:
    is_detected = ~session.is_measured | session.is_held
    if session.case.is_rigid and session.is_moved.size:
        is_detected = is_detected | session.is_moved
    found = np.flatnonzero(is_detected)
    return float(session.seconds[found[0]]) if found.size else None


def _longest_run(flags: BoolArray) -> int:
    """Length of the longest run of True."""
    longest = run = 0
    for flag in flags.tolist():
        run = run + 1 if flag else 0
        longest = max(longest, run)
    return longest
