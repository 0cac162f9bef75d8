"""C-STORE of a session's files to a PACS: one association a session, tried again until the PACS has taken them."""

import io
import logging
import socket
import ssl
import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from sqlalchemy.exc import SQLAlchemyError

from engine.core.errors import InvalidValueError, TidegateError
from service.core.periodic import PeriodicWorker
from service.core.settings.groups import PACS_PLACE
from service.exchange.outbox import Outbox, Sending
from service.storage.audit import SYSTEM, Event
from service.storage.audit.log import AuditLog

if TYPE_CHECKING:
    from pydicom.dataset import Dataset
    from pynetdicom.association import Association

OWN_TITLE = "TIDEGATE"
WAIT_S = 10.0
ANSWER_S = 30.0
EVERY_S = 1.0
FIRST_PAUSE_S, LONGEST_PAUSE_S = 10.0, 3600.0
SUCCESS, UNKNOWN_TRANSACTION = 0x0000, 0x0115
SENT, COMMITTED = "session.sent", "session.committed"
COMMITMENT, COMMITMENT_INSTANCE = "1.2.840.10008.1.20.1", "1.2.840.10008.1.20.1.1"
WARNINGS = range(0xB000, 0xB100)
logger = logging.getLogger(__name__)


class PacsError(TidegateError):
    """The PACS did not take a file."""

    code = "pacs_failed"


@dataclass(frozen=True, slots=True, kw_only=True)
class Pacs:
    """Where to send: application entity, host and port; ``ca`` are the authorities of its certificate, for TLS."""

    title: str
    host: str
    port: int
    ca: Path | None = None
    commit_port: int = 0


def pacs_of(text: str, ca: Path | None = None, commit_port: int = 0) -> Pacs:
    """Read ``TITLE@host:port``.

    Raises
    ------
    InvalidValueError
        It is of another form, or the port is out of 1 to 65535.
    """
    found = PACS_PLACE.fullmatch(text)
    if found is None or not 1 <= int(found[3]) <= 65_535:
        raise InvalidValueError("pacs", text[:80], "TITLE@host:port, a title of 1 to 16 characters")
    title, host = found[1].strip(), found[2].strip("[]")
    return Pacs(title=title, host=host, port=int(found[3]), ca=ca, commit_port=commit_port)


def send(pacs: Pacs, files: Sequence[bytes], transaction: str = "") -> bool:
    """Store DICOM files over one association; return whether the PACS was asked to confirm that it keeps them.

    Raises
    ------
    PacsError
        There is no association, or a file was not taken.
    """
    from pydicom import dcmread
    from pynetdicom import AE

    place = f"{pacs.title} at {pacs.host}:{pacs.port}"
    context = _reach(pacs, place)
    found = [dcmread(io.BytesIO(content)) for content in files]
    own = AE(ae_title=OWN_TITLE)
    own.connection_timeout = own.acse_timeout = WAIT_S
    own.dimse_timeout = own.network_timeout = ANSWER_S
    for sop_class in dict.fromkeys(one.SOPClassUID for one in found):
        own.add_requested_context(sop_class, "1.2.840.10008.1.2.1")
    if transaction:
        own.add_requested_context(COMMITMENT)
    tls = None if context is None else (context, pacs.host)
    association = own.associate(pacs.host, pacs.port, ae_title=pacs.title, tls_args=tls)
    if not association.is_established:
        reason = "refused the association" if association.is_rejected else "does not answer"
        _close(association)
        raise PacsError(f"{place} {reason}")
    try:
        for one in found:
            _store(association, pacs, one)
        return bool(transaction) and _ask_commitment(association, found, transaction)
    finally:
        if association.is_established:
            association.release()
        _close(association)


def _ask_commitment(association: "Association", files: Sequence["Dataset"], transaction: str) -> bool:
    """Ask the PACS to confirm that it keeps the files; return False where it does not offer that."""
    from pydicom.dataset import Dataset

    asked = Dataset()
    asked.TransactionUID = transaction
    asked.ReferencedSOPSequence = [_reference(one) for one in files]
    try:
        status, _ = association.send_n_action(asked, 1, COMMITMENT, COMMITMENT_INSTANCE)
    except (RuntimeError, ValueError):  # not offered
        return False
    return "Status" in status and status.Status == SUCCESS


def _reference(file: "Dataset") -> "Dataset":
    from pydicom.dataset import Dataset

    made = Dataset()
    made.ReferencedSOPClassUID, made.ReferencedSOPInstanceUID = file.SOPClassUID, file.SOPInstanceUID
    return made


def _close(association: "Association") -> None:
    """Close the connection, which pynetdicom leaves open where the other side ends it."""
    if association.is_alive():
        association.join(WAIT_S)
    if association.dul.socket is not None and association.dul.socket.socket is not None:
        association.dul.socket.socket.close()


def _reach(pacs: Pacs, place: str) -> ssl.SSLContext | None:
    """Connect once, because pynetdicom neither says why it could not nor closes the socket; return what TLS needs."""
    try:
        context = None if pacs.ca is None else ssl.create_default_context(cafile=pacs.ca)
        with socket.create_connection((pacs.host, pacs.port), timeout=WAIT_S) as plain:
            if context is not None:
                context.wrap_socket(plain, server_hostname=pacs.host).close()
    except ssl.SSLCertVerificationError as error:
        raise PacsError(f"{place} is not trusted ({error.verify_message})") from error
    except OSError as error:
        raise PacsError(f"{place} does not answer ({error.strerror or error})") from error
    return context


def _store(association: "Association", pacs: Pacs, one: object) -> None:
    try:
        status = association.send_c_store(one)  # type: ignore[arg-type]
    except (RuntimeError, ValueError) as error:  # no association any more, or no accepted context
        raise PacsError(f"{pacs.title} does not take this kind of file ({error})") from error
    code = status.Status if "Status" in status else None
    if code is None:
        raise PacsError(f"{pacs.title} did not answer in {ANSWER_S:g} s")
    if code != SUCCESS and code not in WARNINGS:
        raise PacsError(f"{pacs.title} refused a file with status 0x{code:04X}")


class PacsSender:
    """Sends what waits in the outbox, in a thread of its own; never while a session runs.

    Parameters
    ----------
    files_of
        Makes a session's files; raises TidegateError where it has none.
    is_busy
        Whether a session runs.
    """

    def __init__(
        self,
        pacs: Pacs,
        outbox: Outbox,
        files_of: Callable[[str], Sequence[bytes]],
        log: AuditLog,
        *,
        is_busy: Callable[[], bool],
    ) -> None:
        self._pacs, self._outbox, self._files_of, self._log, self._is_busy = pacs, outbox, files_of, log, is_busy
        self._next_s: dict[tuple[str, str], float] = {}
        self._server: Any = None
        self._worker = PeriodicWorker(
            "tidegate-pacs", self.turn, interval_s=EVERY_S, recoverable=(OSError, SQLAlchemyError)
        )

    @property
    def has_ended(self) -> bool:
        """Whether its thread has ended although it was not closed."""
        return self._worker.has_ended

    def start(self) -> None:
        """Start its thread, and listen for what the PACS commits itself to."""
        if self._pacs.commit_port:
            self._listen()
        self._worker.start()

    def close(self) -> None:
        """Stop; a session on its way is given a second, and is sent again by the next start."""
        self._worker.stop(1.0)
        if self._server is not None:
            self._server.shutdown()

    def _listen(self) -> None:
        from pynetdicom import AE, evt

        own = AE(ae_title=OWN_TITLE)
        own.require_called_aet, own.require_calling_aet = True, [self._pacs.title]
        own.add_supported_context(COMMITMENT, scu_role=True, scp_role=True)
        handlers: list[Any] = [(evt.EVT_N_EVENT_REPORT, self._has_reported)]
        try:
            self._server = own.start_server(("", self._pacs.commit_port), block=False, evt_handlers=handlers)
        except OSError as error:
            logger.warning("port %d for storage commitment cannot be used (%s)", self._pacs.commit_port, error.strerror)

    def _has_reported(self, event: Any) -> tuple[int, None]:  # noqa: ANN401 - pynetdicom's event has no public type
        """Note what the PACS keeps, and send again what it does not."""
        told = event.event_information
        transaction = str(told.get("TransactionUID", ""))
        sending = next((one for one in self._outbox.all() if transaction and one.transaction == transaction), None)
        if sending is None:
            return UNKNOWN_TRANSACTION, None
        lost = len(told.get("FailedSOPSequence", ()))
        if lost:
            self._outbox.has_lost(sending, f"{self._pacs.title} does not keep {lost} of the files")
            self._note(sending, "failed", {"lost": lost}, COMMITTED)
        elif sending.committed_at is None:
            self._outbox.has_committed(sending)
            self._note(sending, "done", {"transaction": transaction}, COMMITTED)
        return SUCCESS, None

    def turn(self) -> None:
        """Send the first session whose time has come."""
        if self._is_busy():
            return
        now = time.monotonic()
        due = (one for one in self._outbox.waiting() if self._next_s.get(_key(one), now) <= now and one.asked_by)
        sending = next(due, None)
        if sending is None:
            return
        try:
            transaction = f"2.25.{uuid.uuid4().int}" if self._pacs.commit_port else ""
            self._outbox.begin(sending, transaction)
            is_asked = send(self._pacs, self._files_of(sending.session_id), transaction)
        except (TidegateError, OSError, ValueError) as error:  # of this session alone: others are sent
            pause_s = min(FIRST_PAUSE_S * 2.0 ** min(sending.tries, 10), LONGEST_PAUSE_S)
            self._next_s[_key(sending)] = now + pause_s
            logger.warning("session %s was not sent, again in %.0f s", sending.session_id, pause_s)
            if sending.tries == 0:
                self._note(sending, "failed", {"trouble": str(error)})
            self._outbox.has_failed(sending, str(error))
        else:
            self._outbox.has_sent(sending, transaction, is_asked=is_asked)
            self._note(sending, "done", {"tries": sending.tries + 1})

    def _note(
        self, sending: Sending, outcome: Literal["done", "failed"], detail: dict[str, object], action: str = SENT
    ) -> None:
        place = f"{self._pacs.title}@{self._pacs.host}:{self._pacs.port}"
        detail = {"pacs": place, "asked_by": sending.asked_by, **detail}
        event = Event(actor=SYSTEM, action=action, outcome=outcome, session_id=sending.session_id, detail=detail)
        self._log.write(event)


def _key(sending: Sending) -> tuple[str, str]:
    return sending.session_id, sending.asked_at
