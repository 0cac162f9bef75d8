"""Removes files older than the site's retention: at the start and every hour, never while a session runs.

Whether there is room for another session, before one begins; while one runs, the writer holds as the disk fills.
"""

import contextlib
import logging
import os
import shutil
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path

from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError

from engine.core.files import file_sha256, sync_folder
from service.core.errors import StorageLowError
from service.core.periodic import PeriodicWorker
from service.core.settings.groups import StorageSettings
from service.core.settings.settings import Settings
from service.storage import audit
from service.storage.audit import SYSTEM, Event
from service.storage.believed_time import BelievedTime, believed_ends
from service.storage.database.base import utc_text
from service.storage.database.engine import Database
from service.storage.database.idempotency import forget_answers
from service.storage.database.queries import OPEN_STATUSES
from service.storage.database.startup import SAMPLES_FOLDER
from service.storage.database.tables import SessionRow
from service.storage.files.motion_models import RAW_FOLDER, TAPES_FOLDER

KINDS = {SAMPLES_FOLDER: "samples", TAPES_FOLDER: "tape", RAW_FOLDER: "raw"}
"""Folders of files named after their session, and the kind of each."""
SETTING_OF = {"samples": "retain_samples_days", "tape": "retain_samples_days", "raw": "retain_raw_days"}
logger = logging.getLogger(__name__)
EVERY_S = 3600.0
AGAIN_S = 60.0
JOIN_S = 1.0
IDEMPOTENCY_DAYS = 7.0
"""Lifetime of an Idempotency-Key; after it the key is treated as new."""
"""The stop does not wait longer for a large file being hashed; a later turn removes it [s]."""
MIB = 1024 * 1024
GIB = 1024 * MIB
FRAMES_A_MINUTE = 30 * 60
BYTES_A_FRAME = 1700
"""A sample in its stream and in the Parquet file beside it, with room to spare."""


# Removal of old samples, tapes and raw recordings: by age alone, oldest first, each with a row in the audit.
#
# Files of a closed session are removed once they are older than the site's retention; without a setting nothing is
# removed. Files of open and of unknown sessions and the audit are never removed.
@dataclass(frozen=True, slots=True, kw_only=True)
class Holding:
    """One file of a closed session."""

    kind: str
    session_id: str
    ended_at: datetime
    path: Path


def holdings(data_dir: Path, ended: Mapping[str, datetime]) -> list[Holding]:
    """List the files of closed sessions, oldest session first."""
    found = [
        Holding(kind=kind, session_id=session_id, ended_at=ended[session_id], path=path)
        for folder, kind in KINDS.items()
        for path in sorted((data_dir / folder).glob("*"))
        if path.is_file() and (session_id := path.name.partition(".")[0]) in ended
    ]
    return sorted(found, key=lambda one: (one.ended_at, one.session_id))


def removable(found: Sequence[Holding], settings: StorageSettings, now: datetime) -> list[tuple[Holding, str]]:
    """Return the files older than the retention, each with the rule that applies."""
    chosen = []
    for one in found:
        name = SETTING_OF[one.kind]
        days: int = getattr(settings, name)
        if days and now - one.ended_at > timedelta(days=days):
            chosen.append((one, f"{name} is {days}"))
    return chosen


def ended_sessions(database: Database) -> dict[str, datetime]:
    """When each session ended that is over."""
    query = select(SessionRow.id, SessionRow.ended_at).where(
        SessionRow.status.not_in(OPEN_STATUSES), SessionRow.ended_at.is_not(None)
    )
    with database.read() as db:
        return {session_id: ended_at for session_id, ended_at in db.execute(query) if ended_at is not None}


def remove_old(database: Database, data_dir: Path, settings: StorageSettings, now: datetime) -> list[Holding]:
    """Remove the files older than the retention; return them."""
    if not (settings.retain_samples_days or settings.retain_raw_days):
        return []
    chosen = removable(holdings(data_dir, ended_sessions(database)), settings, now)
    if chosen:  # old by their own rows: not before any row that was written before them
        with database.read() as db:
            ends = believed_ends(db, {one.session_id: one.ended_at for one, _ in chosen})
        chosen = removable([replace(one, ended_at=ends[one.session_id]) for one, _ in chosen], settings, now)
    for one, rule in chosen:
        _remove(database, one, rule)
    return [one for one, _ in chosen]


def _remove(database: Database, one: Holding, rule: str) -> None:
    """Audit the removal, then remove: after a kill in between the next turn removes the file."""
    detail = {
        "file": one.path.name,
        "bytes": one.path.stat().st_size,
        "sha256": file_sha256(one.path),
        "ended_at": utc_text(one.ended_at),
        "rule": rule,
    }
    with database.write() as db:
        audit.append(db, Event(actor=SYSTEM, action=f"{one.kind}.removed", session_id=one.session_id, detail=detail))
    one.path.unlink(missing_ok=True)
    sync_folder(one.path.parent)
    logger.warning("removed %s of session %s: %s", one.path.name, one.session_id, rule)


class CleanupWorker:
    """Removes old files in a thread of its own; waits while a session runs, which has the disk to itself.

    Parameters
    ----------
    is_busy
        Whether a session runs.
    time
        Knows whether the clock can be believed.
    """

    def __init__(
        self,
        database: Database,
        settings: Settings,
        *,
        is_busy: Callable[[], bool],
        time: BelievedTime | None = None,
    ) -> None:
        self._database = database
        self._settings = settings
        self._is_busy = is_busy
        self._time = time or BelievedTime(database)
        self._worker = PeriodicWorker("tidegate-cleanup", self._turn, interval_s=EVERY_S, first_wait_s=0.0)
        self._one_at_a_time = threading.Lock()

    @property
    def has_ended(self) -> bool:
        """Whether its thread has ended although it was not closed."""
        return self._worker.has_ended

    def start(self) -> None:
        """Start its thread; the first turn is at once."""
        self._worker.start()

    def tidy(self) -> list[Holding]:
        """Remove old files and old Idempotency-Keys now, if the clock can be believed; from any thread."""
        with self._one_at_a_time:
            doubt = self._time.doubt()
            if doubt is not None:
                logger.warning("%s", doubt)
                return []
            now = self._time.now()
            forget_answers(self._database, days=IDEMPOTENCY_DAYS, now=now)
            return remove_old(self._database, self._settings.data_dir, self._settings, now)

    def close(self) -> None:
        """Stop; a removal in progress is finished, unless that takes longer than `JOIN_S`."""
        self._worker.stop(JOIN_S)

    def _turn(self) -> float:
        """Do one turn; return the wait until the next [s]."""
        if self._is_busy():
            return AGAIN_S
        try:
            self.tidy()
        except (SQLAlchemyError, OSError) as error:
            logger.warning("old files could not be removed: %s", type(error).__name__)
            return AGAIN_S
        return EVERY_S


def session_bytes(settings: Settings) -> int:
    """Disk space of a session of the site's length [bytes]; raw recordings check the disk themselves."""
    return int(settings.session_room_min * FRAMES_A_MINUTE * BYTES_A_FRAME)


def refuse_without_room(settings: Settings, make_room: Callable[[], object]) -> None:
    """Raise StorageLowError if disk or quota have no room for a session, after removing old files."""
    if _shortage(settings) is None:
        return
    with contextlib.suppress(OSError):  # a remaining shortage is reported below
        make_room()
    shortage = _shortage(settings)
    if shortage is not None:
        raise shortage


def folder_bytes(folder: Path) -> int:
    """Add up a folder's files; those that vanish meanwhile do not count."""
    total = 0
    for root, _, names in os.walk(folder):
        for name in names:
            try:
                total += os.lstat(os.path.join(root, name)).st_size  # noqa: PTH118 - a path object a file is too slow
            except FileNotFoundError:
                continue
    return total


def _shortage(settings: Settings) -> StorageLowError | None:
    needed = session_bytes(settings)
    free = shutil.disk_usage(settings.data_dir).free - settings.min_free_disk_mb * MIB
    if free < needed:
        bound = f"at least {needed / MIB:.0f} MiB beyond the {settings.min_free_disk_mb:g} MiB that stay free"
        msg = "the disk has no room for a session: make some, or let old samples be removed (docs/3-operate/samples.md)"
        return StorageLowError(msg, field="disk", value=f"{max(free, 0) / MIB:.0f} MiB", bound=bound)
    if settings.data_quota_gb:
        held = folder_bytes(settings.data_dir)
        if held + needed > settings.data_quota_gb * GIB:
            bound = f"at most {settings.data_quota_gb:g} GiB with the {needed / MIB:.0f} MiB that a session takes"
            msg = "the data folder's quota leaves no room for a session"
            return StorageLowError(msg, field="data_quota_gb", value=f"{held / GIB:.3f} GiB held", bound=bound)
    return None
