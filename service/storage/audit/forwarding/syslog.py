"""Syslog over TLS: RFC 5424 messages with RFC 5425 framing, and detection of their arrival.

Syslog has no acknowledgement, so the TCP acknowledgement of every byte is used. The connection is checked before each
batch, so that a closed one is noticed before data is sent.
"""

import array
import fcntl
import select
import socket
import ssl
import termios
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from engine.core.clock import NS_PER_S, Clock

FACILITY_AUTHPRIV = 10
SEVERITY_NOTICE = 5
PRIORITY = FACILITY_AUTHPRIV * 8 + SEVERITY_NOTICE
MESSAGE_ID = "DICOM+RFC3881"
"""As required by IHE ATNA (ITI TF-2, 3.20)."""
APP_NAME = "tidegate"
BYTE_ORDER_MARK = b"\xef\xbb\xbf"
SETTLE_S = 0.25
"""Wait after the handshake [s]: with TLS 1.3 a refused client certificate is reported only afterwards."""
ACK_INTERVAL_S = 0.002
NIL = "-"


@dataclass(frozen=True, slots=True, kw_only=True)
class SyslogServer:
    """Address, certificates and time-out [s] of a syslog server."""

    host: str
    port: int
    ca_file: Path
    cert_file: Path | None
    key_file: Path | None
    timeout_s: float


class SyslogLostError(OSError):
    """The server closed the connection, or did not acknowledge data in time."""


class SyslogConnection:
    """One TLS connection; every method raises OSError (also ssl.SSLError) if it fails."""

    def __init__(self, server: SyslogServer, clock: Clock) -> None:
        self._timeout_s = server.timeout_s
        self._clock = clock
        plain = socket.create_connection((server.host, server.port), server.timeout_s)
        try:
            plain.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            plain.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            self._line = _context(server).wrap_socket(plain, server_hostname=server.host)
        except BaseException:
            plain.close()
            raise
        try:
            self.check_alive(SETTLE_S)
        except BaseException:
            self._line.close()
            raise

    def check_alive(self, wait_s: float = 0.0) -> None:
        """Raise SyslogLostError if the server has closed; it never sends data, so readable means closed."""
        readable, _, _ = select.select([self._line], [], [], wait_s)
        if not readable:
            return
        self._line.settimeout(0.0)
        try:
            if self._line.recv(1024) == b"":
                msg = "the syslog server closed the connection"
                raise SyslogLostError(msg)
        except (ssl.SSLWantReadError, BlockingIOError):
            return  # TLS session tickets
        finally:
            self._line.settimeout(self._timeout_s)

    def send(self, messages: Sequence[bytes]) -> None:
        """Send framed messages; return when every byte is acknowledged and the connection is still open."""
        self.check_alive()
        self._line.sendall(b"".join(messages))
        end_ns = self._clock.now_ns() + round(self._timeout_s * NS_PER_S)
        while _unacknowledged_bytes(self._line):
            self.check_alive(ACK_INTERVAL_S)
            if self._clock.now_ns() > end_ns:
                msg = f"the syslog server did not take what it was sent within {self._timeout_s:g} s"
                raise SyslogLostError(msg)
        self.check_alive()

    def end(self) -> None:
        """Close TLS and wait for the server's close, which confirms that it has read everything."""
        self._line.unwrap().close()

    def close(self) -> None:
        """Close without waiting."""
        self._line.close()


def framed(message: bytes, *, at: str, host_name: str, process_id: str) -> bytes:
    """Return the message with its RFC 5424 header and RFC 5425 length."""
    name = "".join(letter for letter in host_name if "!" <= letter <= "~")[:255] or NIL
    header = f"<{PRIORITY}>1 {at} {name} {APP_NAME} {process_id} {MESSAGE_ID} {NIL} ".encode("ascii")
    whole = header + BYTE_ORDER_MARK + message
    return f"{len(whole)} ".encode("ascii") + whole


def _context(server: SyslogServer) -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)  # checks the certificate, and the name in it
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.load_verify_locations(server.ca_file)
    if server.cert_file is not None:
        context.load_cert_chain(server.cert_file, server.key_file)
    return context


def _unacknowledged_bytes(line: socket.socket) -> int:
    waiting = array.array("i", [0])
    fcntl.ioctl(line.fileno(), termios.TIOCOUTQ, waiting)
    return waiting[0]
