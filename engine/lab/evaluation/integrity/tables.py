"""The table of `tidegate evaluate integrity`: one row a case, over all volunteers."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from engine.core.frames import BoolArray
from engine.lab.evaluation.integrity.session import FPS, WRONG_MM, Session
from engine.lab.evaluation.table import Table

LONGEST_WRONG_S = 0.5
LONGEST_UNNAMED_S = 1.0


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
    on_s, wrong_on_s
        Time of beam on, of the signal with most of it, in all and with the true motion more than 1 mm outside of the
        window.
    """

    measured_percent: float
    wrong_percent: float
    longest_wrong_s: float
    largest_mm: float
    detected_s: float | None
    on_s: float
    wrong_on_s: float


def verdict(sessions: Sequence[Session]) -> Verdict:
    """Judge the sessions of one case."""
    wrong = [_is_wrong(session) for session in sessions]
    detected = [_detected_s(session) for session in sessions]
    errors = np.concatenate([np.abs(session.error_mm[session.is_measured]).ravel() for session in sessions])
    errors = errors[np.isfinite(errors)]
    return Verdict(
        measured_percent=100.0 * float(np.mean(np.concatenate([session.is_measured for session in sessions]))),
        wrong_percent=100.0 * float(np.mean(np.concatenate(wrong))),
        longest_wrong_s=max(_longest_run(one) for one in wrong) / FPS,
        largest_mm=float(errors.max()) if errors.size else 0.0,
        detected_s=None if any(one is None for one in detected) else max(one or 0.0 for one in detected),
        on_s=max(float(session.is_on.sum(axis=0).max()) for session in sessions) / FPS,
        wrong_on_s=max(
            float((session.is_on & (session.outside_mm > WRONG_MM)).sum(axis=0).max()) for session in sessions
        )
        / FPS,
    )


def integrity_table(cases: Sequence[Sequence[Session]]) -> Table:
    """Make the table; a row fails where an error above 1 mm stands as measured for longer than 0.5 s.

    A rigid move fails where it is not named within a second.
    """
    rows, failed = [], set()
    for number, sessions in enumerate(cases):
        case, found = sessions[0].case, verdict(sessions)
        is_unnamed = case.is_rigid and (found.detected_s is None or found.detected_s > LONGEST_UNNAMED_S)
        if found.longest_wrong_s > LONGEST_WRONG_S or is_unnamed:
            failed.add(number)
        reasons = next((session.reasons[0] for session in sessions if session.reasons), None)
        rows.append(
            (
                case.kind,
                case.size,
                found.measured_percent,
                found.wrong_percent,
                found.longest_wrong_s,
                found.largest_mm,
                found.detected_s,
                found.on_s,
                found.wrong_on_s,
                reasons,
            )
        )
    return Table(
        name="integrity",
        title="Falsified recordings",
        columns=(
            "kind",
            "size",
            "measured [%]",
            f"wrong by more than {WRONG_MM:g} mm [%]",
            "longest [s]",
            "largest error [mm]",
            "detected after [s]",
            "beam on [s]",
            "of it outside [s]",
            "first reason",
        ),
        rows=tuple(rows),
        note=(
            "Errors of whole, thorax, abdomen, one cell and one point, in frames that were reported as measured; of "
            "whole alone where the head direction is unknown, because no other signal may gate then; not of a signal "
            "of which the camera sees too little to gate on (that is a detection). "
            "Beam on is that of the signal with most of it; outside: true motion more than 1 mm outside of the window."
        ),
        digits=2,
        failed=frozenset(failed),
    )


def _is_wrong(session: Session) -> BoolArray:
    with np.errstate(invalid="ignore"):
        return np.asarray(session.is_measured & (np.abs(session.error_mm) > WRONG_MM).any(axis=1))


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
