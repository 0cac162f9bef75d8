"""``tidegate smoke URL``: check a service from outside, after an installation, an upgrade or a new certificate."""

import http.client
import json
import socket
import ssl
import sys
import time
from collections.abc import Generator
from contextlib import closing
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal, cast
from urllib.parse import SplitResult, urlsplit

import typer

from engine.core.errors import TidegateError
from service.cli.secret_files import KEY_VARIABLE, secret_from
from service.cli.terminal import refused
from service.client import ClientError, LiveMessage, Sample, TidegateClient, UsageError

SCHEMA = "tidegate.smoke/1"
TIMEOUT_S, WATCH_S = 10.0, 2.0
MAX_AGE_MS = 500.0
"""A frame that was older when it was sent fails the check of the stream."""
MOST_CLOCK_DIFFERENCE_S = 2.0
"""A larger difference of the two clocks is a warning: times of audit and planning system would not fit."""
COLORS = {"ok": "green", "warning": "yellow", "failed": "red", "skipped": "dim"}
FAILED = 1
PIPED_WIDTH = 140

Outcome = Literal["ok", "warning", "failed", "skipped"]


@dataclass(frozen=True, slots=True)
class CheckResult:
    """One check; ``figures`` are the measured values, by name and unit."""

    check: str
    outcome: Outcome
    detail: str
    figures: dict[str, object] = field(default_factory=dict)


def smoke(
    url: Annotated[str, typer.Argument(help="https://host[:port] of the service.")],
    key_file: Annotated[
        Path | None, typer.Option(help=f"File with an API key; by default the variable {KEY_VARIABLE} holds the key.")
    ] = None,
    ca_file: Annotated[Path | None, typer.Option(help="Certificate of the site's certificate authority, PEM.")] = None,
    expect_version: Annotated[str | None, typer.Option(help="The version that must answer, such as 0.2.0.")] = None,
    min_days: Annotated[
        float, typer.Option(help="Least time to the certificate's end [days].", min=0.0, max=3650.0)
    ] = 14.0,
    *,
    needs_frames: Annotated[
        bool, typer.Option("--require-frames", help="Fail where no session runs, or it has no frames.")
    ] = False,
    is_strict: Annotated[bool, typer.Option("--strict", help="Warnings fail too.")] = False,
    is_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Check a running service from outside: certificate, readiness, version, clock, live stream.

    Exit code 0 when every check passed, 1 when one failed, 2 when the options are refused.
    """
    try:
        key = secret_from(key_file, KEY_VARIABLE)
        context = ssl.create_default_context(cafile=None if ca_file is None else str(ca_file))
        client = TidegateClient(url, key=key, ca_file=ca_file, timeout_s=TIMEOUT_S, retries=0)
    except (TidegateError, UsageError, OSError) as error:
        raise refused("smoke", error) from error
    address = urlsplit(url)
    with client:
        results = [_certificate(address, context, min_days), _liveness(address, context)]
        if results[-1].outcome == "failed":
            skipped = ("readiness", "version", "clock", "live stream")
            results += [CheckResult(name, "skipped", "the service cannot be asked") for name in skipped]
        else:
            results += [_readiness(client), *check_stream(client, expect_version, needs_frames=needs_frames)]
    bad = {"failed", "warning"} if is_strict else {"failed"}
    is_passed = not any(one.outcome in bad for one in results)
    if is_json:
        checks = [asdict(one) for one in results]
        typer.echo(json.dumps({"schema": SCHEMA, "url": url, "passed": is_passed, "checks": checks}, indent=1))
    else:
        _print(url, results)
    if not is_passed:
        raise typer.Exit(FAILED)


def _certificate(address: SplitResult, context: ssl.SSLContext, min_days: float) -> CheckResult:
    """Check that the chain is trusted, the name fits, and the end is not near. No secret is sent on this connection."""
    name = "certificate"
    if address.scheme != "https":
        return CheckResult(name, "skipped", "plain HTTP: there is none")
    try:
        ends_at, figures = _shown(address)
        trouble = _distrust(address, context)
    except (OSError, ValueError) as error:
        return CheckResult(name, "failed", f"no TLS connection: {error}")
    days = (ends_at - datetime.now(UTC)).total_seconds() / 86_400
    figures |= {"days_left": round(days, 2), "ends_at": ends_at.isoformat()}
    if trouble is not None:
        return CheckResult(name, "failed", trouble, figures)
    if days < min_days:
        detail = f"ends in {days:.1f} days, on {ends_at:%Y-%m-%d %H:%M} UTC; at least {min_days:g} are required"
        return CheckResult(name, "failed", detail, figures)
    return CheckResult(name, "ok", f"trusted, {days:.0f} days left, {figures['tls']}", figures)


def _shown(address: SplitResult) -> tuple[datetime, dict[str, object]]:
    """Read the certificate without judging it, so that one that has ended can be described too."""
    from cryptography import x509

    unjudged = ssl.create_default_context()
    unjudged.check_hostname = False
    unjudged.verify_mode = ssl.CERT_NONE
    host, port = address.hostname or "", address.port or 443
    with (
        socket.create_connection((host, port), TIMEOUT_S) as plain,
        unjudged.wrap_socket(plain, server_hostname=host) as tls,
    ):
        certificate, version = x509.load_der_x509_certificate(tls.getpeercert(binary_form=True) or b""), tls.version()
    try:
        found = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        addresses = map(str, found.get_values_for_type(x509.IPAddress))
        names = [*found.get_values_for_type(x509.DNSName), *addresses]
    except x509.ExtensionNotFound:
        names = []
    figures: dict[str, object] = {"names": names, "issuer": certificate.issuer.rfc4514_string(), "tls": version or "?"}
    return certificate.not_valid_after_utc, figures


def _distrust(address: SplitResult, context: ssl.SSLContext) -> str | None:
    """Return why a client that verifies refuses the connection; None where it does not."""
    connection = _connection(address, context)
    try:
        connection.connect()
    except ssl.SSLCertVerificationError as error:
        return f"not trusted: {error.verify_message}"
    finally:
        connection.close()
    return None


def _connection(address: SplitResult, context: ssl.SSLContext) -> http.client.HTTPConnection:
    host = address.hostname or ""
    if address.scheme == "http":
        return http.client.HTTPConnection(host, address.port or 80, timeout=TIMEOUT_S)
    return http.client.HTTPSConnection(host, address.port or 443, timeout=TIMEOUT_S, context=context)


def _liveness(address: SplitResult, context: ssl.SSLContext) -> CheckResult:
    connection, began_s = _connection(address, context), time.monotonic()
    try:
        connection.request("GET", "/healthz")
        answer = connection.getresponse()
        body = answer.read(64 * 1024)
    except (OSError, http.client.HTTPException) as error:
        return CheckResult("liveness", "failed", f"no answer: {error}")
    finally:
        connection.close()
    if answer.status != http.client.OK or b'"ok"' not in body:
        return CheckResult("liveness", "failed", f"status {answer.status}: {body[:200].decode(errors='replace')}")
    took_ms = round((time.monotonic() - began_s) * 1000.0, 1)
    return CheckResult("liveness", "ok", f"answers in {took_ms:g} ms", {"answer_ms": took_ms})


def _readiness(client: TidegateClient) -> CheckResult:
    try:
        found = client.readiness()
    except ClientError as error:
        return CheckResult("readiness", "failed", str(error))
    warnings = "; ".join(f"{one['code']}: {one['detail']}" for one in found["warnings"])
    figures: dict[str, object] = {
        "not_ready": found["not_ready"],
        "warnings": [one["code"] for one in found["warnings"]],
    }
    if not found["is_ready"]:
        detail = "; ".join(f"{one['code']}: {one['detail']}" for one in found["reasons"]) or "no reason given"
        return CheckResult("readiness", "failed", detail, figures)
    return CheckResult("readiness", "warning" if warnings else "ok", warnings or "ready", figures)


def check_stream(client: TidegateClient, expect_version: str | None, *, needs_frames: bool) -> list[CheckResult]:
    """Follow the live stream for a while; return the results for version, clock and stream."""
    received, broken = _watched(client)
    messages = [one for one, _ in received]
    version, difference_s = None, None
    for one, at in received:
        if one["type"] == "hello":
            version, difference_s = one["version"], (at - datetime.fromisoformat(one["sent_at"])).total_seconds()
    samples = [cast("Sample", one) for one in messages if one["type"] == "sample"]
    states = [one for one in messages if one["type"] in {"sample", "idle"}]
    is_running = bool(samples) and states[-1] is samples[-1] and samples[-1]["session_status"] == "running"
    oldest_ms = max((one["age_ms"] for one in samples), default=None)
    trouble = broken or _stream_trouble(len(messages), oldest_ms, has_frames=is_running or not needs_frames)
    figures: dict[str, object] = {"messages": len(messages), "frames": len(samples), "oldest_frame_ms": oldest_ms}
    detail = f"{len(messages)} messages, no session runs"
    if oldest_ms is not None:
        detail = f"{len(samples)} frames, the oldest {oldest_ms:.0f} ms"
    return [
        _version(version, expect_version, broken),
        _clock(difference_s),
        CheckResult("live stream", "ok" if trouble is None else "failed", trouble or detail, figures),
    ]


def _watched(client: TidegateClient) -> tuple[list[tuple[LiveMessage, datetime]], str | None]:
    """Return the messages of `WATCH_S` with their times, and why the stream broke; it is not taken up again."""
    messages, end_s = list[tuple[LiveMessage, datetime]](), time.monotonic() + WATCH_S
    stream = cast("Generator[LiveMessage]", client.live(form="full", reconnects=0))
    try:
        with closing(stream):
            for message in stream:
                messages.append((message, datetime.now(UTC)))
                if time.monotonic() >= end_s:
                    break
    except ClientError as error:
        return messages, str(error)
    return messages, None


def _stream_trouble(messages: int, oldest_ms: float | None, *, has_frames: bool) -> str | None:
    if messages < 2:
        return "nothing came after the greeting" if messages else "no message was received"
    if oldest_ms is not None and oldest_ms > MAX_AGE_MS:
        return f"a frame was {oldest_ms:.0f} ms old; at most {MAX_AGE_MS:g} ms are allowed"
    return None if has_frames else "no frame was received: no session runs"


def _version(version: str | None, expected: str | None, broken: str | None) -> CheckResult:
    figures: dict[str, object] = {"version": version}
    if version is None:
        return CheckResult("version", "failed", broken or "no message was received", figures)
    if expected not in {None, version}:
        return CheckResult("version", "failed", f"{version}, and {expected} is required", figures)
    return CheckResult("version", "ok", version, figures)


def _clock(difference_s: float | None) -> CheckResult:
    if difference_s is None:
        return CheckResult("clock", "skipped", "no message was received")
    outcome: Outcome = "warning" if abs(difference_s) > MOST_CLOCK_DIFFERENCE_S else "ok"
    figures: dict[str, object] = {"difference_s": round(difference_s, 3)}
    return CheckResult("clock", outcome, f"{difference_s:+.2f} s from this machine's", figures)


def _print(url: str, results: list[CheckResult]) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table("check", "result", "detail", title=escape(url), title_justify="left")
    for one in results:
        color = COLORS[one.outcome]
        table.add_row(one.check, f"[{color}]{one.outcome}[/{color}]", escape(one.detail))
    Console(width=None if sys.stdout.isatty() else PIPED_WIDTH, highlight=False).print(table)
