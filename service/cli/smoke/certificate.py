"""The TLS certificate as a client sees it: chain, names, days left. No secret is sent on these connections."""

import http.client
import socket
import ssl
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from urllib.parse import urlsplit

from service.cli.smoke.results import CheckResult, Outcome

NAME = "certificate"


@dataclass(frozen=True, slots=True, kw_only=True)
class Shown:
    """The certificate that the server showed, verified or not."""

    names: tuple[str, ...]
    begins_at: datetime
    ends_at: datetime
    issuer: str
    tls: str

    def days_left(self, now: datetime) -> float:
        """Return the time to the end [days]; negative when it has ended."""
        return (self.ends_at - now).total_seconds() / 86_400


def check_certificate(
    url: str, *, ca_file: Path | None, min_days: float, timeout_s: float, now: datetime | None = None
) -> CheckResult:
    """Check that the chain is trusted, the name fits, and the end is not near; skipped for plain HTTP."""
    parts = urlsplit(url)
    if parts.scheme != "https":
        return CheckResult(check=NAME, outcome=Outcome.SKIPPED, detail="plain HTTP: there is none")
    host, port = parts.hostname or "", parts.port or 443
    try:
        shown = shown_certificate(host, port, timeout_s)
        trouble = _trouble_with(url, ca_file, timeout_s)
    except OSError as error:
        return CheckResult(check=NAME, outcome=Outcome.FAILED, detail=f"no TLS connection: {error}")
    days = shown.days_left(now or datetime.now(UTC))
    figures: dict[str, object] = {
        "days_left": round(days, 2),
        "ends_at": shown.ends_at.isoformat(),
        "names": list(shown.names),
        "issuer": shown.issuer,
        "tls": shown.tls,
    }
    if trouble is not None:
        return CheckResult(check=NAME, outcome=Outcome.FAILED, detail=trouble, figures=figures)
    if days < min_days:
        detail = f"ends in {days:.1f} days, on {shown.ends_at:%Y-%m-%d %H:%M} UTC; at least {min_days:g} are required"
        return CheckResult(check=NAME, outcome=Outcome.FAILED, detail=detail, figures=figures)
    detail = f"trusted, {days:.0f} days left, {', '.join(shown.names)}, {shown.tls}"
    return CheckResult(check=NAME, outcome=Outcome.OK, detail=detail, figures=figures)


def shown_certificate(host: str, port: int, timeout_s: float) -> Shown:
    """Read the certificate without judging it, so that one that has ended can be described too."""
    from cryptography import x509

    context = ssl.create_default_context()
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    with (
        socket.create_connection((host, port), timeout_s) as plain,
        context.wrap_socket(plain, server_hostname=host) as tls,
    ):
        found, protocol = tls.getpeercert(binary_form=True), tls.version()
    if found is None:
        message = "the server showed no certificate"
        raise ssl.SSLError(message)
    certificate = x509.load_der_x509_certificate(found)
    return Shown(
        names=_names_of(certificate),
        begins_at=certificate.not_valid_before_utc,
        ends_at=certificate.not_valid_after_utc,
        issuer=certificate.issuer.rfc4514_string(),
        tls=protocol or "?",
    )


def _names_of(certificate: object) -> tuple[str, ...]:
    from cryptography import x509

    assert isinstance(certificate, x509.Certificate)
    try:
        found = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return ()
    addresses = (str(one) for one in found.get_values_for_type(x509.IPAddress))
    return (*found.get_values_for_type(x509.DNSName), *addresses)


def trusting(url: str, ca_file: Path | None, timeout_s: float) -> http.client.HTTPConnection:
    """Return a connection to the address that verifies certificates, not opened yet."""
    parts = urlsplit(url)
    host = parts.hostname or ""
    if parts.scheme == "http":
        return http.client.HTTPConnection(host, parts.port or 80, timeout=timeout_s)
    return http.client.HTTPSConnection(host, parts.port or 443, timeout=timeout_s, context=_context(ca_file))


def _context(ca_file: Path | None) -> ssl.SSLContext:
    context = ssl.create_default_context(cafile=None if ca_file is None else str(ca_file))
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    return context


def _trouble_with(url: str, ca_file: Path | None, timeout_s: float) -> str | None:
    """Return why a client that verifies refuses the connection; None where it does not."""
    connection = trusting(url, ca_file, timeout_s)
    try:
        connection.connect()
    except ssl.SSLCertVerificationError as error:
        return f"not trusted: {error.verify_message}"
    finally:
        connection.close()
    return None
