"""Replay of a stored session: its tape and frames are run again and compared with the audit and the sample file."""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sqlalchemy import select

from engine.capture import part_of
from engine.control import FrameRecord
from engine.core.errors import TidegateError
from engine.offline.replay import (
    METHOD,
    PROCESSOR,
    RAW,
    Comparison,
    Difference,
    Replay,
    Row,
    Survey,
    TapeHeader,
    comparison_of,
    read_head,
    read_tape,
    replay,
    same,
    sha256_of,
    survey,
    text_of,
    this_machine,
    this_software,
)
from service.engine_host.session_tape import encoding_of
from service.storage.database import queries
from service.storage.database.engine import Database
from service.storage.database.tables import AuditRow
from service.storage.files.motion_models import MODELS_FOLDER, ModelStore, raw_path, tape_path
from service.storage.samples.layout import sample_values
from service.storage.samples.store import SampleStore

SAMPLES_FOLDER = "samples"

ONE_BY_ONE = ("regions_mm", "named_mm")
"""Columns with many numbers per row; compared only where the tape's digest of each frame, which covers them in full
precision, cannot be."""

AUDITED = {
    "from_state": "from",
    "to_state": "to",
    "reason": "reason",
    "frame_index": "frame",
    "operator": "operator",
    "detail": "detail",
    "captured_us": "captured_us",
    "received_ns": "received_ns",
    "captured_ns": "captured_ns",
    "decided_ns": "decided_ns",
    "asserted_ns": "asserted_ns",
    "armed_by": "armed_by",
}
"""Fields of a transition in the audit, and their names on a tape."""


class NotReplayableError(TidegateError):
    """A session that cannot be replayed, or not on this machine; the message has the reason."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """The result of a replay.

    Attributes
    ----------
    comparison
        What counted as the same.
    differences
        What is not as it was; empty where all is.
    motion
        Every sample that was made, as columns of a sample file.
    notes
        What a person should know of besides.
    """

    replay: Replay
    head: TapeHeader
    comparison: Comparison
    differences: list[Difference]
    samples: int
    audited: int
    motion: list[dict[str, Any]]
    notes: list[str] = field(default_factory=list)

    @property
    def agrees(self) -> bool:
        """Whether all results are the same within the comparison's tolerance."""
        return not self.differences

    @property
    def is_identical(self) -> bool:
        """Whether all results are the same, and every frame bit for bit."""
        return self.agrees and self.replay.identical_frames == self.replay.frames


class StoredSession:
    """One session's files in a data folder, and its audit.

    Raises
    ------
    NotFoundError
        There is no such session.
    NotReplayableError
        It has no tape, no frames, or ran as another version.
    RecordingError, ModelError
        A file of it cannot be read.
    """

    def __init__(self, database: Database, data_dir: Path, session_id: str) -> None:
        self._database, self._data_dir, self._session_id = database, data_dir, session_id
        with database.read() as db:
            self._is_open = queries.session_row(db, session_id).ended_at is None
        self._encoding = encoding_of(ModelStore(data_dir / MODELS_FOLDER))
        path = tape_path(data_dir, session_id)
        if not path.is_file():
            msg = f"session {session_id} has no tape: it ran before tapes were kept, or its tape was removed"
            raise NotReplayableError(msg)
        self._path = path
        self.survey: Survey = survey(path)
        self._refuse_changed_tape()
        self.head = read_head(read_tape(path).head, self._encoding)

    def _refuse_changed_tape(self) -> None:
        """Refuse a tape whose hash differs from the one in the audit's entry of the session's end."""
        closing = self._details("session.close")
        wanted = closing[-1].get("tape_sha256") if closing else None
        if wanted is not None and sha256_of(self._path) != wanted:
            msg = f"{self._path} was changed after the session was closed: its SHA-256 is not the audit's"
            raise NotReplayableError(msg)

    def _details(self, action: str) -> list[dict[str, Any]]:
        mine = (AuditRow.session_id == self._session_id, AuditRow.action == action)
        with self._database.read() as db:
            return [
                json.loads(text)
                for text in db.scalars(select(AuditRow.detail).where(*mine).order_by(AuditRow.sequence))
            ]

    def refuse_other_version(self) -> None:
        """Refuse a session of another software version, whose results may differ on purpose."""
        if self.head.software != this_software():
            msg = f"the session ran as {self.head.software}, this is {this_software()}: run that, or say --any-version"
            raise NotReplayableError(msg)
        if self.head.method != METHOD:
            raise NotReplayableError(f"{_method_note(self.head)}: run an earlier version, or use --any-version")

    def run_again(self, recording: Path | None, on_frame: Callable[[int], None]) -> Verdict:
        """Run the session again and compare the results with what is stored."""
        values: list[dict[str, Any]] = []
        comparison = comparison_of(self.head.machine, this_machine())

        def keep(outcome: object) -> None:
            if isinstance(outcome, FrameRecord):
                value = sample_values(outcome)
                values.append(_plain(value) if comparison.is_exact else value)

        outcome = replay(
            read_tape(self._path),
            self.head,
            self._frames(recording),
            self._encoding,
            comparison=comparison,
            on_frame=on_frame,
            on_output=keep,
        )
        differences = [] if outcome.difference is None else [outcome.difference]
        audited = self._audited()
        compared = 0
        if not differences:
            differences += audit_differences(outcome, audited, is_torn=not self.survey.is_whole, is_open=self._is_open)
            found, compared = self._sample_differences(values, comparison)
            differences += found
        return Verdict(
            replay=outcome,
            head=self.head,
            comparison=comparison,
            differences=differences,
            samples=compared,
            audited=len(audited),
            motion=[_plain(value) for value in values],
            notes=self._notes(outcome, audited, comparison),
        )

    def _frames(self, recording: Path | None) -> Path:
        if self.head.frames.kind is None:
            msg = "the session's camera was not recorded: TIDEGATE_RECORD_RAW was false"
            raise NotReplayableError(msg)
        if self.head.frames.kind == RAW:
            return recording or self._raw_recording()
        path = recording or self.head.frames.path
        if path is None or not path.is_file():
            msg = f"the recording that was played is not at {path}: name it with --recording"
            raise NotReplayableError(msg)
        wanted = self.survey.facts.get("recording_sha256")
        if wanted is not None and sha256_of(path) != wanted:
            msg = f"{path} is not the recording that was played: its SHA-256 is another one"
            raise NotReplayableError(msg)
        return path

    def _raw_recording(self) -> Path:
        path = raw_path(self._data_dir, self._session_id)
        found = next((one for one in (path, part_of(path)) if one.is_file()), None)
        if found is None:
            msg = "the session's raw recording is not there: it was removed, or never begun"
            raise NotReplayableError(msg)
        return found

    def _audited(self) -> list[Row]:
        details = self._details(queries.TRANSITION)
        return [{name: detail.get(key) for key, name in AUDITED.items()} for detail in details]

    def _sample_differences(self, values: list[dict[str, Any]], comparison: Comparison) -> tuple[list[Difference], int]:
        """Compare every stored sample; a killed session may lack its last ones, and retention may have removed all."""
        made = {value["frame_index"]: value for value in values}
        compared = 0
        for row in self._samples(comparison):
            value = made.get(row["frame_index"])
            if value is None:
                if self.survey.is_whole:
                    return [Difference(frame=row["frame_index"], recorded=text_of(row), replayed="no sample")], compared
                continue
            names = comparison.differing(row, value)
            if names:
                both = [", ".join(f"{name} {side[name]}" for name in names) for side in (row, value)]
                return [Difference(frame=row["frame_index"], recorded=both[0], replayed=both[1])], compared
            compared += 1
        return [], compared

    def _samples(self, comparison: Comparison) -> Iterator[dict[str, Any]]:
        for batch in SampleStore(self._data_dir / SAMPLES_FOLDER).batches(self._session_id):
            unread = [name for name in ONE_BY_ONE if comparison.is_exact and name in batch.schema.names]
            yield from batch.drop_columns(unread).to_pylist()

    def _notes(self, outcome: Replay, audited: list[Row], comparison: Comparison) -> list[str]:
        notes = _machine_notes(self.head, comparison)
        if self.head.software != this_software():
            notes.append(f"the session ran as {self.head.software}, this is {this_software()}")
        if self.head.method != METHOD:
            notes.append(f"{_method_note(self.head)}, so that differences may be intended")
        if outcome.torn is not None:
            notes.append(f"the tape ends early: {outcome.torn}")
        elif not outcome.is_whole:
            notes.append("the tape has no end: the service was killed; replayed up to the tear")
        if self._is_open:
            notes.append("the session is not closed: what its audit lacks yet, the service's next start recovers")
        beyond = len(audited) - len(outcome.transitions) - len(outcome.elsewhere)
        if beyond > 0:
            notes.append(f"{beyond} transitions of the audit lie beyond the tape's end, and were not replayed")
        if outcome.elsewhere:
            notes.append(f"{len(outcome.elsewhere)} transitions were the watchdog's own: compared, not decided again")
        return notes


def _method_note(head: TapeHeader) -> str:
    return f"the session was measured with method {head.method}, this version measures with method {METHOD}"


def _machine_notes(head: TapeHeader, comparison: Comparison) -> list[str]:
    """Return how the session's machine differs from this one."""
    if comparison.reasons:
        return [f"the session ran on a machine that may round otherwise: {'; '.join(comparison.reasons)}"]
    name = head.machine.get(PROCESSOR)
    if name != this_machine()[PROCESSOR]:
        return [f"the session ran on another processor of the same features: {name}"]
    return []


def _plain(values: dict[str, object]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if name not in ONE_BY_ONE}


def audit_differences(outcome: Replay, audited: list[Row], *, is_torn: bool, is_open: bool) -> list[Difference]:
    """Compare the audit's changes of the gate with the tape's, in their order and to the last bit.

    Those of another thread may lie anywhere between.

    A torn tape may end before the audit does, and the audit of a session that is not closed may end before its tape.
    """
    waiting = [_audit_row(row) for row in outcome.elsewhere]
    replayed = iter([_audit_row(row) for row in outcome.recorded_transitions])
    for row in audited:
        if any(same(row, other) for other in waiting):
            waiting.remove(next(other for other in waiting if same(row, other)))
            continue
        now = next(replayed, None)
        if now is None and is_torn:
            return []
        if now is None or not same(row, now):
            there = "no transition" if now is None else text_of(now)
            return [Difference(frame=row["frame"], recorded=text_of(row), replayed=there)]
    left = next(replayed, None) or next(iter(waiting), None)
    if left is not None and not is_open:
        return [Difference(frame=left["frame"], recorded="no such transition in the audit", replayed=text_of(left))]
    return []


def _audit_row(row: Row) -> Row:
    return {name: row.get(name) for name in AUDITED.values()}
