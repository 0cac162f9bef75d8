"""The service's own TLS certificate: what new connections are shown, its expiry, and its renewal without a restart.

Stands apart from the web server, because readiness, metrics and log report the certificate that is served, which is not
the one on disk while that cannot be used.
"""

import contextlib
import logging
import ssl
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NoReturn, Self

from service.core.periodic import PeriodicWorker
from service.core.settings.settings import Settings

logger = logging.getLogger(__name__)

MAX_BYTES = 1024 * 1024
LOOK_S = 5.0
"""Period at which the files are compared with what is served [s]."""
STOP_S = 1.0
WARN_DAYS = 30
"""`/readyz` and the log warn this long before the certificate ends."""
MISMATCH = "KEY_VALUES_MISMATCH"


class CertificateError(Exception):
    """The TLS certificate or key cannot be used; the message is for the person who installs them."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Pair:
    """A certificate chain with its key, as read at one moment."""

    content: tuple[bytes, bytes]
    context: ssl.SSLContext
    begins_at: datetime
    ends_at: datetime


class ServedCertificate:
    """The certificate that the service shows.

    The files are read again when they change. New connections are shown the new certificate, and present ones continue.
    Files that cannot be used are refused, and the certificate served before stays.

    Parameters
    ----------
    cert, key
        PEM files: the chain, the service's own certificate first, and its key without a passphrase.
    warn_before
        Time before the expiry from which the log warns.
    now
        Returns the time (UTC).

    Raises
    ------
    CertificateError
        The files cannot be read, do not belong together, or the certificate is not valid now.
    """

    def __init__(
        self,
        cert: Path,
        key: Path,
        *,
        warn_before: timedelta = timedelta(days=30),
        now: Callable[[], datetime] = lambda: datetime.now(UTC),
    ) -> None:
        self._cert, self._key = cert, key
        self._warn_before = warn_before
        self._now = now
        self._served = self._load()
        self._refusal: str | None = None
        self._noted: str | None = None
        self._worker = PeriodicWorker("tidegate-certificate", self.look, interval_s=LOOK_S, first_wait_s=0.0)
        # OpenSSL asks at every handshake, also without a server name. Connections that exist keep their own context.
        self.context = self._served.context
        self.context.sni_callback = self._show_newest

    @classmethod
    def of(cls, settings: Settings) -> Self | None:
        """Load the site's certificate; None where the service does not terminate TLS.

        Raises
        ------
        CertificateError
            As the constructor.
        """
        if settings.tls_cert is None or settings.tls_key is None:
            return None
        return cls(settings.tls_cert, settings.tls_key, warn_before=timedelta(days=WARN_DAYS))

    @property
    def ends_at(self) -> datetime:
        """The earliest expiry in the chain that is served (UTC)."""
        return self._served.ends_at

    @property
    def refusal(self) -> str | None:
        """Why the files on disk are not served; None if they are."""
        return self._refusal

    @property
    def has_ended(self) -> bool:
        """Whether the thread that looks at the files has ended although it was not stopped."""
        return self._worker.has_ended

    def start(self) -> None:
        """Start to look at the files, in a thread: a share that hangs delays nothing else."""
        self._worker.start()

    def close(self) -> None:
        """Stop the thread."""
        self._worker.stop(STOP_S)

    def look(self) -> None:
        """Serve the files' certificate if they were replaced and can be used; log an expiry that is near or past."""
        try:
            self._renew()
        except CertificateError as error:
            if str(error) != self._refusal:
                logger.error("%s; the one that ends on %s stays", error, f"{self.ends_at:%Y-%m-%d}")  # noqa: TRY400
            self._refusal = str(error)
        else:
            self._refusal = None
        self._note_expiry()

    def _renew(self) -> None:
        with contextlib.suppress(OSError):  # reported by _load
            if self._read() == self._served.content:
                return
        self._served = self._load()
        logger.info("TLS certificate replaced: the new one ends on %s", f"{self.ends_at:%Y-%m-%d}")

    def _note_expiry(self) -> None:
        left = self.ends_at - self._now()
        state = "ended" if left <= timedelta() else "ends" if left <= self._warn_before else None
        if state not in {None, self._noted}:
            logger.warning("the TLS certificate %s on %s: replace it", state, f"{self.ends_at:%Y-%m-%d}")
        self._noted = state

    def _show_newest(self, connection: ssl.SSLObject, _name: str | None, _context: ssl.SSLContext) -> None:
        connection.context = self._served.context

    def _read(self) -> tuple[bytes, bytes]:
        return _bytes_of(self._cert), _bytes_of(self._key)

    def _load(self) -> _Pair:
        try:
            pair = _loaded(self._cert, self._key, self._read())
            is_whole = self._read() == pair.content
        except (OSError, ValueError) as error:
            raise self._error(_reason_of(error)) from error
        if not is_whole:
            raise self._error("the files are being replaced")
        if pair.ends_at <= self._now():
            raise self._error(f"the certificate ended on {pair.ends_at:%Y-%m-%d %H:%M} UTC")
        if pair.begins_at > self._now():
            raise self._error(f"the certificate is valid from {pair.begins_at:%Y-%m-%d %H:%M} UTC only")
        return pair

    def _error(self, reason: str) -> CertificateError:
        return CertificateError(f"{self._cert} and {self._key} cannot be used for TLS: {reason}")


def _loaded(cert: Path, key: Path, content: tuple[bytes, bytes]) -> _Pair:
    from cryptography import x509  # fifteen megabytes that only TLS needs

    chain = x509.load_pem_x509_certificates(content[0])
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.load_cert_chain(cert, key, _refuse_passphrase)
    return _Pair(
        content=content,
        context=context,
        begins_at=max(one.not_valid_before_utc for one in chain),
        ends_at=min(one.not_valid_after_utc for one in chain),
    )


def _refuse_passphrase() -> NoReturn:
    """Raise instead of OpenSSL's question on the terminal."""
    msg = "the key has a passphrase"
    raise ValueError(msg)


def _bytes_of(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(MAX_BYTES)


def _reason_of(error: OSError | ValueError) -> str:
    if isinstance(error, ssl.SSLError) and error.reason == MISMATCH:
        return "the key does not belong to the certificate"
    if isinstance(error, OSError) and not isinstance(error, ssl.SSLError):
        return f"{error.filename}: {error.strerror}" if error.filename else str(error)
    return str(error)
