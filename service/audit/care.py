"""Everything that looks after the audit while the service runs: heads kept, clocks compared, events passed on."""

import logging
import socket
import threading
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Protocol

from sqlalchemy.exc import SQLAlchemyError

from engine.clock import Clock, MonotonicClock
from service.audit import start
from service.audit.anchors import AnchorFile
from service.audit.chain import SYSTEM, Event
from service.audit.check import check_tail
from service.audit.clock_watch import ClockWatch
from service.audit.dicom_message import Source
from service.audit.forwarding import POSITION_NAME, AuditForwarder, PositionFile
from service.audit.keeper import AnchorKeeper
from service.audit.syslog import SyslogConnection, SyslogServer
from service.audit.walk import head_sequence
from service.audit_settings import AuditSettings
from service.db.engine import Database

logger = logging.getLogger(__name__)

LOOK_S = 1.0
ANSWER_S = 5.0
"""How long a start, and a stop, waits for the file of heads: it may lie on a share that hangs."""
BROKEN = "audit.broken"


class _Worker(Protocol):
    """A thread that goes on until it is told to end."""

    def begin(self) -> None:
        """Start it."""

    def end(self, timeout_s: float) -> None:
        """Let it do what is left, for so long."""

    @property
    def trouble(self) -> str | None:
        """What a person should know."""


class Looking:
    """Looks again and again, in a thread of its own; what fails is told in the log and tried again."""

    def __init__(self, name: str, look: Callable[[], None], last: Callable[[], None] | None = None) -> None:
        self._look = look
        self._last = last
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._failed: str | None = None

    @property
    def trouble(self) -> str | None:
        """Say that the thread ended although nobody told it to."""
        is_dead = self._thread.ident is not None and not self._thread.is_alive() and not self._ending.is_set()
        return f"the thread {self._thread.name} has ended: see the service's log" if is_dead else None

    def begin(self) -> None:
        """Start to look."""
        self._thread.start()

    def end(self, timeout_s: float) -> None:
        """Look a last time, and end; one that hangs is left alone."""
        self._ending.set()
        if self._thread.ident is not None:
            self._thread.join(timeout_s)

    def _run(self) -> None:
        while not self._ending.wait(LOOK_S):
            self._try(self._look)
        if self._last is not None:
            self._try(self._last)

    def _try(self, look: Callable[[], None]) -> None:
        try:
            look()
        except (SQLAlchemyError, OSError) as error:
            # The database's own trouble is told by the readiness; once in the log is enough.
            if self._failed != type(error).__name__:
                logger.warning("%s: %s", self._thread.name, type(error).__name__)
            self._failed = type(error).__name__
        else:
            self._failed = None


class AuditCare:
    """Looks after the audit from the service's start to its end."""

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
        self._keeper: AnchorKeeper | None = None
        self._workers: list[_Worker] = []

    @property
    def troubles(self) -> list[str]:
        """What is wrong, for the readiness; none of it holds a beam."""
        keeper = None if self._keeper is None else self._keeper.trouble
        found = [self._broken, keeper, *(worker.trouble for worker in self._workers)]
        return [trouble for trouble in found if trouble is not None]

    @property
    def passed_on(self) -> int | None:
        """The newest row that was passed on to the site's server; None without one."""
        return next((one.passed_on for one in self._workers if isinstance(one, AuditForwarder)), None)

    def start(self, detail: dict[str, object]) -> None:
        """Check what was written before, write the start down with what changed since the last one, and look on."""
        with self._database.read() as db:
            before = start.last_start(db)
            went_back = start.clock_went_back(db, self._now(), self._settings.audit_clock_jump_ms / 1000)
            seen = head_sequence(db)
        told = start.told_settings(self._settings)
        anchors = self._within(self._check)
        self._write(
            Event(
                actor=SYSTEM,
                action=start.START,
                detail={
                    **detail,
                    "settings": told,
                    "settings_sha256": start.settings_sha256(told),
                    "anchors": anchors,
                },
            )
        )
        changed = start.changes(before, told)
        self._tell(went_back, changed)
        self._look_on(seen)

    def close(self) -> None:
        """Keep the last head, and end."""
        for worker in self._workers:
            worker.end(ANSWER_S)

    def _check(self) -> dict[str, object] | None:
        self._broken = check_tail(self._database, self._file)
        reached = self._file.reached()
        if reached is None:
            return None
        return {"size_bytes": reached.size_bytes, "line_sha256": reached.line_sha256}

    def _within(self, check: Callable[[], dict[str, object] | None]) -> object:
        """Have a check done, or say that the file does not answer."""
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

    def _tell(self, *events: Event | None) -> None:
        for event in events:
            if event is not None:
                self._write(event)
        if self._broken is not None:
            logger.critical("the audit log is broken: %s; see `tidegate audit verify`", self._broken)
            self._write(Event(actor=SYSTEM, action=BROKEN, outcome="failed", detail={"detail": self._broken}))

    def _look_on(self, seen: int) -> None:
        self._keeper = AnchorKeeper(
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
            Looking("tidegate-anchors", self._keeper.look, self._keeper.end),
            Looking("tidegate-clock", watch.look),
        ]
        if self._settings.audit_syslog_host is not None:
            self._workers.append(self._forwarder(self._settings.audit_syslog_host, seen))
        for worker in self._workers:
            worker.begin()

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
