"""What was seen live, held against what the service keeps: frames, beam-on time, transitions, audit."""

import csv
from collections.abc import Iterable
from pathlib import Path

from service.client import TidegateClient
from service.tps.delivery import BEAM_ON, BeamClock, Recorded, recorded
from service.tps.report import StretchReport

MOST_DIFFERENCE_S = 0.1
"""Beam-on time may differ by this much, besides what nobody saw: an edge lies between two frames on either side."""

LOST_IN_A_KILL_S = 1.0
FRAME_S = 1 / 30
STARTED = ("session.start",)


def checked(session_id: str, clock: BeamClock, told_missing: int, tps: TidegateClient, folder: Path) -> StretchReport:
    """Fetch samples, transitions and audit of a session that is over, and compare."""
    session = tps.read_session(session_id)
    exported = tps.export_samples(session_id, folder / f"{session_id}.csv")
    with exported.path.open(newline="") as file:
        kept = recorded(csv.DictReader(file))
    edges = sum(one["to_state"] == BEAM_ON for one in tps.transitions(session_id))
    actions = [row["action"] for row in tps.audit(session_id=session_id) if row["outcome"] == "done"]
    seen = set(clock.frames or ())
    unrecorded, missed = seen - kept.frames, kept.frames - seen
    troubles = [
        *_frame_troubles(kept, session["summary"]["missed_frames"]),
        *_time_troubles(clock, kept, is_killed=session["status"] == "interrupted", unrecorded=len(unrecorded)),
        *([] if edges == kept.rises else [f"the beam rose {kept.rises} times, and {edges} transitions say so"]),
        *(f"the audit has no {action}" for action in STARTED if action not in actions),
        *([] if tps.verify_audit()["is_intact"] else ["the audit's chain of hashes is broken"]),
    ]
    return StretchReport(
        session_id=session_id,
        status=session["status"],
        live_frames=len(seen),
        recorded_frames=len(kept.frames),
        missed_live=len(missed),
        told_missing=told_missing,
        unrecorded=len(unrecorded),
        live_on_s=round(clock.on_s, 3),
        recorded_on_s=round(kept.on_s, 3),
        unseen_s=round(clock.unseen_s, 3),
        beam_edges=edges,
        audit_rows=len(actions),
        troubles=tuple(troubles),
    )


def _frame_troubles(kept: Recorded, missed_frames: int) -> Iterable[str]:
    if not kept.frames:
        yield "nothing was recorded"
        return
    holes = max(kept.frames) + 1 - len(kept.frames)
    if holes > missed_frames:
        yield f"{holes} frames are not in the recorder, and the camera missed {missed_frames}"


def _time_troubles(clock: BeamClock, kept: Recorded, *, is_killed: bool, unrecorded: int) -> Iterable[str]:
    """Compare times; of a killed service the last second may be lost, and nothing else of any."""
    lost_s = LOST_IN_A_KILL_S if is_killed else 0.0
    difference_s = abs(clock.on_s - kept.on_s)
    if difference_s > MOST_DIFFERENCE_S + clock.unseen_s + lost_s:
        yield f"beam-on time differs by {difference_s:.3f} s between the stream and the recorder"
    if unrecorded * FRAME_S > lost_s + FRAME_S:
        yield f"{unrecorded} frames were seen live and are not in the recorder"
