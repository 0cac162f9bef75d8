"""Whether the wall clock can be believed: asked before every act that depends on it and cannot be undone.

A machine whose clock lost its battery starts in 2001, and one that was set by a typing error in 2036. The audit knows
when the service last wrote: a clock that starts far from that, in either direction, or that is set while the service
runs, is believed after a day of run time only. Until then nothing is removed and no answer is forgotten.

A session's end is not before any row that was written before the session: one by a wrong clock is not taken for old.
"""

import threading
from collections.abc import Callable
from datetime import UTC, datetime, timedelta

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from engine.core.clock import NS_PER_S, Clock, MonotonicClock
from service.storage.database.engine import Database
from service.storage.database.tables import AuditRow

FAR = timedelta(days=3)
"""How long a service may have been off before its clock is doubted at the start."""
WAIT = timedelta(days=1)
"""Run time after which a clock that was doubted is believed."""
JUMP = timedelta(minutes=5)
"""Change of the wall clock against the run time from which it is doubted again."""


class BelievedTime:
    """Compares the wall clock with the audit's times and the run time; from any thread.

    Parameters
    ----------
    now
        The wall clock.
    clock
        Run time that no setting of the wall clock moves.
    """

    def __init__(
        self,
        database: Database,
        *,
        now: Callable[[], datetime] = lambda: datetime.now(UTC),
        clock: Clock | None = None,
    ) -> None:
        self._database, self._now, self._clock = database, now, clock or MonotonicClock()
        self._lock = threading.Lock()
        self._latest: datetime | None = None
        self._mark = (now(), self._clock.now_ns())
        self._believed_ns: int | None = None
        self._why = ""

    def start(self) -> None:
        """Compare the clock with the latest time in the audit; before this start writes its own rows."""
        with self._database.read() as db:
            self._latest = latest_time(db)
        now, latest = self._now(), self._latest
        if latest is not None and not -JUMP <= now - latest <= FAR:
            was, wrote = f"{now:%Y-%m-%d %H:%M}", f"{latest:%Y-%m-%d %H:%M}"
            self._doubt(f"the clock was at {was} at the start, and the audit's latest time is {wrote}")

    def now(self) -> datetime:
        """Return the wall clock."""
        return self._now()

    def doubt(self) -> str | None:
        """Return why the clock is not believed, as a sentence; None where it is."""
        with self._lock:
            now, run_ns = self._now(), self._clock.now_ns()
            before, before_ns = self._mark
            moved = (now - before) - timedelta(seconds=(run_ns - before_ns) / NS_PER_S)
            self._mark = (now, run_ns)
            if abs(moved) > JUMP:
                self._doubt(f"the clock was set by {moved.total_seconds() / 3600.0:+.1f} h while the service ran")
            if self._believed_ns is None or run_ns >= self._believed_ns:
                return None
            left_h = (self._believed_ns - run_ns) / NS_PER_S / 3600.0
            return f"{self._why}: nothing is removed for another {left_h:.0f} h of run time"

    def behind(self, db: Session, tolerance: timedelta) -> datetime | None:
        """Return the latest time in the audit where the clock is behind it by more than the tolerance; else None."""
        newest = _time(db.scalar(select(AuditRow.at).order_by(AuditRow.sequence.desc()).limit(1)))
        with self._lock:
            times = [time for time in (self._latest, newest) if time is not None]
            self._latest = max(times, default=None)
            latest = self._latest
        return latest if latest is not None and latest - self._now() > tolerance else None

    def _doubt(self, why: str) -> None:
        self._why, self._believed_ns = why, self._clock.now_ns() + int(WAIT.total_seconds() * NS_PER_S)


def latest_time(db: Session) -> datetime | None:
    """Return the latest time of all rows of the audit; None for an empty one. Times are text of one length."""
    return _time(db.scalar(select(func.max(AuditRow.at))))


def believed_ends(db: Session, ended: dict[str, datetime]) -> dict[str, datetime]:
    """Return each session's end, but not before any row of the audit that was written up to its first one."""
    ends, latest = dict(ended), ""
    query = select(AuditRow.session_id, AuditRow.at).order_by(AuditRow.sequence)
    waiting = set(ended)
    for session_id, at in db.execute(query.execution_options(yield_per=10_000)):
        latest = max(latest, at)
        if session_id in waiting:
            waiting.remove(session_id)
            ends[session_id] = max(ended[session_id], _time(latest) or ended[session_id])
    return ends


def _time(text: str | None) -> datetime | None:
    try:
        found = None if text is None else datetime.fromisoformat(text)
    except ValueError:
        return None  # a tampered row: the verification reports it
    return None if found is None or found.tzinfo is None else found
