"""Whether a session could run now, and if not, what is missing.

The result is cached for a moment, since orchestrators poll many times a second. One probe runs at a time: a request
that arrives while it hangs is answered from the cache or with ``not_known``.
"""

import shutil
import threading
from collections.abc import Callable, Iterable, Iterator
from datetime import UTC, datetime, timedelta
from functools import cache

from sqlalchemy import text
from sqlalchemy.exc import SQLAlchemyError

from engine.capture.drivers import is_any_installed, missing_text
from engine.core.clock import NS_PER_MS, Clock, MonotonicClock
from service.core.errors import CameraLatencyError, QaOverdueError
from service.core.schemas.base import Readiness, ReadinessCode, ReadinessReason
from service.core.settings.settings import Settings
from service.monitoring.certificate import WARN_DAYS, ServedCertificate
from service.qa.arming_requirement import refuse_without_qa
from service.qa.latency.requirement import refuse_unmeasured_site
from service.storage.audit.supervision import CLOCK_JUMP_MS
from service.storage.believed_time import BelievedTime
from service.storage.database.engine import Database

MIB = 1024 * 1024
MOST_LOG_MB = 64.0
KEPT_MS = 1_000.0
"""Time for which an answer is kept."""
LONGEST_AGE_MS = 5_000.0
"""An older result is not returned, even while a probe hangs."""


class ReadinessProbe:
    """Checks the database, the disk, the folders, the certificate, the clock, the audit and the threads.

    Parameters
    ----------
    audit_troubles
        Returns the faults of the audit log's supervision.
    ended_threads
        Returns the names of threads that ended unexpectedly.
    engine_trouble
        Returns why no engine can be started; None if one can.
    is_stopping
        Whether the service is stopping.
    certificate
        The service's own TLS certificate; None without one.
    """

    def __init__(
        self,
        database: Database,
        settings: Settings,
        audit_troubles: Callable[[], list[str]] = list,
        *,
        ended_threads: Callable[[], Iterable[str]] = tuple,
        engine_trouble: Callable[[], str | None] = lambda: None,
        is_stopping: Callable[[], bool] = lambda: False,
        certificate: ServedCertificate | None = None,
        has_camera_runtime: Callable[[], bool] = is_any_installed,
        now: Callable[[], datetime] = lambda: datetime.now(UTC),
        clock: Clock | None = None,
        time: BelievedTime | None = None,
    ) -> None:
        self._time = time or BelievedTime(database, now=now)
        self._database = database
        self._settings = settings
        self._audit_troubles = audit_troubles
        self._ended_threads = ended_threads
        self._engine_trouble = engine_trouble
        self._is_stopping = is_stopping
        # Checked once: each check starts a process, and a newly installed runtime needs a restart anyway.
        self._has_camera_runtime = cache(has_camera_runtime)
        self._now = now
        self._clock = clock or MonotonicClock()
        self._certificate = certificate
        self._probing = threading.Lock()
        self._cached: tuple[int, Readiness] | None = None

    def readiness(self) -> Readiness:
        """Return what is missing; the result may be ``KEPT_MS`` old."""
        cached = self._younger_than(KEPT_MS)
        if cached is not None:
            return cached
        if not self._probing.acquire(blocking=False):
            return self._younger_than(LONGEST_AGE_MS) or self._not_known()
        try:
            found = self._probe()
            self._cached = (self._clock.now_ns(), found)
        finally:
            self._probing.release()
        return found

    def _younger_than(self, age_ms: float) -> Readiness | None:
        cached = self._cached
        is_young = cached is not None and self._clock.now_ns() - cached[0] < age_ms * NS_PER_MS
        # Stopping is reported at once, so that no load balancer sends another session.
        return cached[1] if cached is not None and is_young and not self._is_stopping() else None

    def _probe(self) -> Readiness:
        return self._answer(list(self._missing()), list(self._warnings()))

    def _not_known(self) -> Readiness:
        detail = "the previous check has not returned: a disk, a share or the database may hang"
        return self._answer([ReadinessReason(code=ReadinessCode.NOT_KNOWN, detail=detail)], [])

    def _answer(self, reasons: list[ReadinessReason], warnings: list[ReadinessReason]) -> Readiness:
        return Readiness(
            is_ready=not reasons,
            not_ready=[one.detail for one in reasons],
            reasons=reasons,
            warnings=warnings,
            checked_at=self._now(),
        )

    def _missing(self) -> Iterator[ReadinessReason]:
        if self._is_stopping():
            yield _reason(ReadinessCode.SERVICE_STOPPING, "the service is stopping")
        yield from self._database_trouble()
        yield from self._disk_trouble()
        yield from self._folder_trouble()
        yield from self._qa_trouble()
        yield from self._latency_trouble()
        for trouble in self._audit_troubles():
            yield _reason(ReadinessCode.AUDIT_TROUBLE, trouble)
        for name in () if self._is_stopping() else self._ended_threads():
            yield _reason(ReadinessCode.THREAD_ENDED, f"the thread {name} has ended: see the service's log")
        engine = self._engine_trouble()
        if engine is not None:
            yield _reason(ReadinessCode.ENGINE_MISSING, engine)
        yield from self._runtime_trouble(is_needed=True)
        yield from self._certificate_trouble()

    def _warnings(self) -> Iterator[ReadinessReason]:
        yield from self._runtime_trouble(is_needed=False)
        yield from self._certificate_warning()
        yield from self._clock_trouble()
        log_mb = self._database.log_bytes() / MIB
        if log_mb > MOST_LOG_MB:
            detail = f"the database's write-ahead log has {log_mb:.0f} MiB: another process reads it and does not end"
            yield _reason(ReadinessCode.DATABASE_LOG_LARGE, detail)
        if self._settings.anchor_file.resolve().is_relative_to(self._settings.data_dir.resolve()):
            detail = (
                "the audit's anchors lie in the data folder: rows that are cut off together with their anchors are not "
                "noticed. Set audit.anchor_file to a place outside of it"
            )
            yield _reason(ReadinessCode.ANCHORS_INSIDE, detail)

    def _database_trouble(self) -> Iterator[ReadinessReason]:
        try:
            with self._database.write() as db:
                db.execute(text("SELECT 1"))
        except SQLAlchemyError as error:
            detail = f"the database cannot be written ({type(error).__name__})"
            yield _reason(ReadinessCode.DATABASE_UNWRITABLE, detail)

    def _disk_trouble(self) -> Iterator[ReadinessReason]:
        free_mb = shutil.disk_usage(self._settings.data_dir).free / MIB
        if free_mb < self._settings.min_free_disk_mb:
            detail = f"only {free_mb:.0f} MiB of disk are free, {self._settings.min_free_disk_mb:g} are needed"
            yield _reason(ReadinessCode.DISK_LOW, detail)

    def _qa_trouble(self) -> Iterator[ReadinessReason]:
        try:
            refuse_without_qa(self._database, self._settings)
        except QaOverdueError as error:
            yield _reason(ReadinessCode.QA_OVERDUE, str(error))
        except SQLAlchemyError:
            return  # reported by _database_trouble

    def _latency_trouble(self) -> Iterator[ReadinessReason]:
        try:
            refuse_unmeasured_site(self._database, self._settings)
        except CameraLatencyError as error:
            yield _reason(ReadinessCode.CAMERA_LATENCY, str(error))
        except SQLAlchemyError:
            return  # reported by _database_trouble

    def _folder_trouble(self) -> Iterator[ReadinessReason]:
        for path in self._settings.recordings_dirs:
            if not path.is_dir():
                yield _reason(ReadinessCode.RECORDINGS_MISSING, f"the recordings folder {path} does not exist")

    def _runtime_trouble(self, *, is_needed: bool) -> Iterator[ReadinessReason]:
        """Yield a missing runtime: required in clinical mode, where every session runs on a camera."""
        if (self._settings.mode == "clinical") is is_needed and not self._has_camera_runtime():
            yield _reason(ReadinessCode.CAMERA_RUNTIME_MISSING, f"{missing_text()}; no session can run on a camera")

    def _certificate_trouble(self) -> Iterator[ReadinessReason]:
        if self._certificate is not None and self._certificate.ends_at <= self._now():
            detail = f"the TLS certificate ended on {self._certificate.ends_at:%Y-%m-%d}"
            yield _reason(ReadinessCode.CERTIFICATE_ENDED, detail)

    def _certificate_warning(self) -> Iterator[ReadinessReason]:
        if self._certificate is None:
            return
        ends_at, refusal = self._certificate.ends_at, self._certificate.refusal
        if refusal is not None:
            detail = f"{refusal}; the one that ends on {ends_at:%Y-%m-%d} is served, and the next start would fail"
            yield _reason(ReadinessCode.CERTIFICATE_UNREADABLE, detail)
        if timedelta() < ends_at - self._now() <= timedelta(days=WARN_DAYS):
            yield _reason(ReadinessCode.CERTIFICATE_ENDS_SOON, f"the TLS certificate ends on {ends_at:%Y-%m-%d}")

    def _clock_trouble(self) -> Iterator[ReadinessReason]:
        tolerance = timedelta(milliseconds=CLOCK_JUMP_MS)
        try:
            with self._database.read() as db:
                latest = self._time.behind(db, tolerance)
        except SQLAlchemyError:
            return
        if latest is not None:
            detail = f"the wall clock is behind the audit's latest time, {latest:%Y-%m-%d %H:%M}: it was set back"
            yield _reason(ReadinessCode.CLOCK_BEHIND, detail)
        doubt = self._time.doubt()
        if doubt is not None:
            yield _reason(ReadinessCode.CLOCK_DOUBTED, doubt)


def _reason(code: ReadinessCode, detail: str) -> ReadinessReason:
    return ReadinessReason(code=code, detail=detail)
