"""Compare the live stream of a session with the service's records: frames, beam-on time, transitions, audit."""

import csv
from collections.abc import Iterable, Set
from pathlib import Path

from service.client import TidegateClient
from service.planning.simulated_tps.delivery import BEAM_ON, BeamClock, Recorded, recorded
from service.planning.simulated_tps.report import SessionReport

MAX_DIFFERENCE_S = 0.1
"""Largest difference of beam-on time besides gaps: each beam edge lies between two frames."""

MIN_SEEN = 0.75
"""Least share of the recorded frames, up to the last live frame, that must have been received live."""

MIN_SEEN_WITH_BEAM = 0.5
"""The same for frames with beam; lower, because one slow read can fall into a short beam."""

MAX_HOLD_DELAY_S, MAX_STOP_DELAY_S = 1.0, 5.0
"""Longest time that the beam and the recording may continue after the last live frame, while calls are repeated."""

LOST_IN_A_KILL_S = 1.0
FRAME_S = 1 / 30
STARTED = ("session.start",)


def checked(
    session_id: str, clock: BeamClock, announced_missing: int, tps: TidegateClient, folder: Path
) -> SessionReport:
    """Fetch samples, transitions and audit of an ended session and compare them with the live frames in ``clock``."""
    session = tps.read_session(session_id)
    exported = tps.export_samples(session_id, folder / f"{session_id}.csv")
    with exported.path.open(newline="") as file:
        record = recorded(csv.DictReader(file))
    edges = sum(one["to_state"] == BEAM_ON for one in tps.transitions(session_id))
    actions = [row["action"] for row in tps.audit(session_id=session_id) if row["outcome"] == "done"]
    seen = set(clock.frames or ())
    unrecorded, missed = seen - record.frames, record.frames - seen
    troubles = [
        *_frame_troubles(record, session["summary"]["missed_frames"]),
        *_live_troubles(record, seen),
        *_time_troubles(clock, record, is_killed=session["status"] == "interrupted", unrecorded=len(unrecorded)),
        *([] if edges == record.rises else [f"the recorder shows {record.rises} beam rises, the transitions {edges}"]),
        *(f"the audit has no {action}" for action in STARTED if action not in actions),
        *([] if tps.verify_audit()["is_intact"] else ["the audit's hash chain is broken"]),
    ]
    return SessionReport(
        session_id=session_id,
        status=session["status"],
        live_frames=len(seen),
        recorded_frames=len(record.frames),
        missed_live=len(missed),
        told_missing=announced_missing,
        unrecorded=len(unrecorded),
        live_on_s=round(clock.on_s, 3),
        recorded_on_s=round(record.on_s, 3),
        unseen_s=round(clock.unseen_s, 3),
        beam_edges=edges,
        audit_rows=len(actions),
        troubles=tuple(troubles),
    )


def _frame_troubles(record: Recorded, missed_frames: int) -> Iterable[str]:
    if not record.frames:
        yield "no sample was recorded"
        return
    holes = max(record.frames) + 1 - len(record.frames)
    if holes > missed_frames:
        yield f"{holes} frames are not in the recorder, and the camera missed {missed_frames}"


def _live_troubles(record: Recorded, seen: set[int]) -> Iterable[str]:
    """Report a live stream that covers too little of the record for a meaningful comparison."""
    if not seen:
        yield "no live frame was received"
    elif record.frames and not record.frames & seen:
        yield f"no recorded sample was compared: none of the {len(record.frames)} was seen live"
    else:
        last = max(seen)
        yield from _share_trouble({frame for frame in record.frames if frame <= last}, seen, MIN_SEEN, "")
        yield from _share_trouble(record.on_frames, seen, MIN_SEEN_WITH_BEAM, " with beam")
        yield from _end_trouble(record.on_frames, last, MAX_HOLD_DELAY_S, "last beam")
        yield from _end_trouble(record.frames, last, MAX_STOP_DELAY_S, "record")


def _share_trouble(recorded: Set[int], seen: set[int], least: float, which: str) -> Iterable[str]:
    count = len(recorded & seen)
    if count < least * len(recorded):
        share = count / len(recorded)
        share_text = f"{count} of {len(recorded)} recorded frames{which} ({share:.0%})".replace("%", " %")
        yield f"the live stream showed {share_text}, and at least {100 * least:.0f} % are needed"


def _end_trouble(recorded: Set[int], last: int, latest_s: float, what: str) -> Iterable[str]:
    early_s = (max(recorded, default=last) - last) * FRAME_S
    if early_s > latest_s:
        yield f"the live stream ended {early_s:.1f} s before the {what}"


def _time_troubles(clock: BeamClock, record: Recorded, *, is_killed: bool, unrecorded: int) -> Iterable[str]:
    """Compare beam-on times; only a killed service may lose records, and at most its last second."""
    lost_s = LOST_IN_A_KILL_S if is_killed else 0.0
    difference_s = abs(clock.on_s - record.on_s)
    if difference_s > MAX_DIFFERENCE_S + clock.unseen_s + lost_s:
        yield f"beam-on time differs by {difference_s:.3f} s between the stream and the recorder"
    if unrecorded * FRAME_S > lost_s + FRAME_S:
        yield f"{unrecorded} frames were seen live and are not in the recorder"
