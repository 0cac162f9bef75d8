"""Background work of the audit while the service runs: anchoring, clock check and forwarding."""

import logging
import socket
import threading
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Protocol

from sqlalchemy.exc import SQLAlchemyError

from engine.core.clock import Clock, MonotonicClock
from service.core.periodic import PeriodicWorker
from service.core.settings.audit import AuditSettings
from service.storage.audit import startup as start
from service.storage.audit.anchor_writer import AnchorWriter
from service.storage.audit.anchors import AnchorFile
from service.storage.audit.chain import SYSTEM, Event
from service.storage.audit.check import check_tail
from service.storage.audit.clock_watch import ClockWatch
from service.storage.audit.formats.dicom import Source
from service.storage.audit.forwarding.forwarder import POSITION_NAME, AuditForwarder, PositionFile
from service.storage.audit.forwarding.syslog import SyslogConnection, SyslogServer
from service.storage.audit.verification import head_sequence
from service.storage.database.engine import Database

logger = logging.getLogger(__name__)

INTERVAL_S = 1.0
ANSWER_S = 5.0
"""Longest wait for the anchor file at start and stop [s]; it may be on a share that hangs."""
BROKEN = "audit.broken"


class _Worker(Protocol):
    """A background thread."""

    def start(self) -> None:
        """Start the thread."""

    def stop(self, timeout_s: float) -> None:
        """Finish pending work and stop; give up waiting after the timeout [s]."""

    @property
    def trouble(self) -> str | None:
        """A sentence for the readiness; None while all is well."""


class AuditSupervision:
    """Starts and stops the audit's background work, and audits the start of the service."""

    def __init__(
        self,
        *,
        database: Database,
        settings: AuditSettings,
        write: Callable[[Event], None],
        site: str = "",
        clock: Clock | None = None,
        now: Callable[[], datetime] = lambda: datetime.now(UTC),
    ) -> None:
        self._database = database
        self._settings = settings
        self._write = write
        self._site = site
        self._clock = clock or MonotonicClock()
        self._now = now
        self._file = AnchorFile(settings.anchor_file)
        self._broken: str | None = None
        self._anchor_writer: AnchorWriter | None = None
        self._workers: list[_Worker] = []

    @property
    def troubles(self) -> list[str]:
        """Sentences about what is wrong, for readiness; none of them holds the beam."""
        anchors = None if self._anchor_writer is None else self._anchor_writer.trouble
        found = [self._broken, anchors, *(worker.trouble for worker in self._workers)]
        return [trouble for trouble in found if trouble is not None]

    @property
    def passed_on(self) -> int | None:
        """Sequence of the newest row forwarded to the site's syslog server; None without forwarding."""
        return next((one.passed_on for one in self._workers if isinstance(one, AuditForwarder)), None)

    def start(self, detail: dict[str, object]) -> None:
        """Verify the newest rows, audit the start with changed settings, and start the background threads."""
        with self._database.read() as db:
            before = start.last_start(db)
            went_back = start.clock_went_back(db, self._now(), self._settings.audit_clock_jump_ms / 1000)
            seen = head_sequence(db)
        settings = start.redacted_settings(self._settings)
        anchors = self._with_timeout(self._check)
        self._write(
            Event(
                actor=SYSTEM,
                action=start.START,
                detail={
                    **detail,
                    "settings": settings,
                    "settings_sha256": start.settings_sha256(settings),
                    "anchors": anchors,
                },
            )
        )
        changed = start.changes(before, settings)
        self._report(went_back, changed)
        self._start_workers(seen)

    def close(self) -> None:
        """Stop the background threads; anchor the last head and forward the last rows first."""
        for worker in self._workers:
            worker.stop(ANSWER_S)

    def _check(self) -> dict[str, object] | None:
        self._broken = check_tail(self._database, self._file)
        reached = self._file.reached()
        if reached is None:
            return None
        return {"size_bytes": reached.size_bytes, "line_sha256": reached.line_sha256}

    def _with_timeout(self, check: Callable[[], dict[str, object] | None]) -> object:
        """Run a check in a thread; return its result, or a sentence if it fails or times out."""
        found: list[object] = []

        def run() -> None:
            try:
                found.append(check())
            except OSError as error:
                found.append(f"the anchor file cannot be read: {error.strerror or error}")
            except SQLAlchemyError as error:
                found.append(f"the database did not answer ({type(error).__name__})")

        thread = threading.Thread(target=run, name="tidegate-audit-check", daemon=True)
        thread.start()
        thread.join(ANSWER_S)
        return found[0] if found else f"the anchor file has not answered for {ANSWER_S:g} s"

    def _report(self, *events: Event | None) -> None:
        for event in events:
            if event is not None:
                self._write(event)
        if self._broken is not None:
            logger.critical("the audit log is broken: %s; see `tidegate audit verify`", self._broken)
            self._write(Event(actor=SYSTEM, action=BROKEN, outcome="failed", detail={"detail": self._broken}))

    def _start_workers(self, seen: int) -> None:
        self._anchor_writer = AnchorWriter(
            database=self._database,
            file=self._file,
            clock=self._clock,
            interval_s=self._settings.audit_anchor_interval_s,
            write=self._write,
            after=seen,
        )
        watch = ClockWatch(
            clock=self._clock, now=self._now, jump_ms=self._settings.audit_clock_jump_ms, write=self._write
        )
        self._workers = [
            _worker("tidegate-anchors", self._anchor_writer.update, self._anchor_writer.end),
            _worker("tidegate-clock", watch.check),
        ]
        if self._settings.audit_syslog_host is not None:
            self._workers.append(self._forwarder(self._settings.audit_syslog_host, seen))
        for worker in self._workers:
            worker.start()

    def _forwarder(self, host: str, seen: int) -> AuditForwarder:
        settings, clock = self._settings, self._clock
        assert settings.audit_syslog_ca_file is not None, "the settings were refused without one"
        server = SyslogServer(
            host=host,
            port=settings.audit_syslog_port,
            ca_file=settings.audit_syslog_ca_file,
            cert_file=settings.audit_syslog_cert_file,
            key_file=settings.audit_syslog_key_file,
            timeout_s=settings.audit_syslog_timeout_s,
        )
        return AuditForwarder(
            database=self._database,
            connect=lambda: SyslogConnection(server, clock),
            positions=PositionFile(settings.data_dir / POSITION_NAME),
            source=Source(host_name=socket.gethostname(), site=self._site),
            clock=clock,
            write=self._write,
            after=seen,
            with_patients=settings.audit_syslog_patients,
        )


def _worker(name: str, work: Callable[[], None], last: Callable[[], None] | None = None) -> PeriodicWorker:
    """Make a worker that runs every second; database and file errors do not end it."""
    return PeriodicWorker(name, work, interval_s=INTERVAL_S, last=last, recoverable=(SQLAlchemyError, OSError))
