"""Checks of the service itself: liveness, readiness, version, live stream."""

import time
from collections.abc import Generator, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import cast

from service.cli.smoke.results import CheckResult, Outcome
from service.client import ClientError, LiveMessage, Sample, TidegateClient

MOST_CLOCK_DIFFERENCE_S = 2.0
"""A larger difference of the two clocks is a warning: times of audit and planning system would not fit."""
NOTHING = "no message was received"


@dataclass(frozen=True, slots=True, kw_only=True)
class Demands:
    """What is required of the service, by the options of the command."""

    version: str | None
    min_days: float
    watch_s: float
    max_age_ms: float
    needs_frames: bool


@dataclass(slots=True)
class Watched:
    """What came on the live stream."""

    version: str | None = None
    clock_difference_s: float | None = None
    messages: int = 0
    samples: int = 0
    ages_ms: list[float] = field(default_factory=list)
    session_status: str | None = None
    broken: str | None = None


def check_readiness(client: TidegateClient) -> CheckResult:
    """Check that a session could run."""
    try:
        found = client.readiness()
    except ClientError as error:
        return CheckResult(check="readiness", outcome=Outcome.FAILED, detail=str(error))
    warnings = [f"{one['code']}: {one['detail']}" for one in found["warnings"]]
    codes = [one["code"] for one in found["warnings"]]
    figures: dict[str, object] = {"not_ready": found["not_ready"], "warnings": codes}
    if not found["is_ready"]:
        detail = "; ".join(f"{one['code']}: {one['detail']}" for one in found["reasons"]) or "no reason given"
        return CheckResult(check="readiness", outcome=Outcome.FAILED, detail=detail, figures=figures)
    outcome = Outcome.WARNING if warnings else Outcome.OK
    return CheckResult(check="readiness", outcome=outcome, detail="; ".join(warnings) or "ready", figures=figures)


def check_stream(client: TidegateClient, demands: Demands) -> list[CheckResult]:
    """Follow the live stream for a while; return the results for version, clock and stream."""
    seen = watch(client, demands.watch_s)
    return [_version(seen, demands), _clock(seen), _stream(seen, demands)]


def watch(client: TidegateClient, seconds: float) -> Watched:
    """Take what comes within so many seconds; a stream that breaks is reported, not taken up again."""
    seen, end_s = Watched(), time.monotonic() + seconds
    messages = cast("Generator[LiveMessage]", client.live(form="full", reconnects=0))
    try:
        with closing(messages):
            _take(messages, seen, end_s)
    except ClientError as error:
        seen.broken = str(error)
    return seen


def _take(messages: Iterator[LiveMessage], seen: Watched, end_s: float) -> None:
    for message in messages:
        seen.messages += 1
        if message["type"] == "hello":
            seen.version = message["version"]
            sent = datetime.fromisoformat(message["sent_at"])
            seen.clock_difference_s = (datetime.now(UTC) - sent).total_seconds()
        elif message["type"] == "sample":
            sample = cast("Sample", message)
            seen.samples += 1
            seen.session_status = sample["session_status"]
            seen.ages_ms.append(sample["age_ms"])
        elif message["type"] == "idle":
            seen.session_status = None
        if time.monotonic() >= end_s:
            return


def _version(seen: Watched, demands: Demands) -> CheckResult:
    figures: dict[str, object] = {"version": seen.version}
    if seen.version is None:
        return CheckResult(check="version", outcome=Outcome.FAILED, detail=seen.broken or NOTHING, figures=figures)
    if demands.version is not None and seen.version != demands.version:
        detail = f"{seen.version}, and {demands.version} is required"
        return CheckResult(check="version", outcome=Outcome.FAILED, detail=detail, figures=figures)
    return CheckResult(check="version", outcome=Outcome.OK, detail=seen.version, figures=figures)


def _clock(seen: Watched) -> CheckResult:
    difference_s = seen.clock_difference_s
    if difference_s is None:
        return CheckResult(check="clock", outcome=Outcome.SKIPPED, detail=NOTHING)
    is_far = abs(difference_s) > MOST_CLOCK_DIFFERENCE_S
    detail = f"{difference_s:+.2f} s from this machine's"
    outcome = Outcome.WARNING if is_far else Outcome.OK
    return CheckResult(check="clock", outcome=outcome, detail=detail, figures={"difference_s": round(difference_s, 3)})


def _stream(seen: Watched, demands: Demands) -> CheckResult:
    worst_ms = max(seen.ages_ms, default=None)
    figures: dict[str, object] = {"messages": seen.messages, "frames": seen.samples, "oldest_frame_ms": worst_ms}
    trouble = _stream_trouble(seen, demands, worst_ms)
    if trouble is not None:
        return CheckResult(check="live stream", outcome=Outcome.FAILED, detail=trouble, figures=figures)
    detail = f"{seen.messages} messages, no session runs"
    if worst_ms is not None:
        detail = f"{seen.samples} frames, the oldest {worst_ms:.0f} ms"
    return CheckResult(check="live stream", outcome=Outcome.OK, detail=detail, figures=figures)


def _stream_trouble(seen: Watched, demands: Demands, worst_ms: float | None) -> str | None:
    if seen.broken is not None:
        return seen.broken
    if seen.messages < 2:
        return "nothing came after the greeting" if seen.messages else NOTHING
    if worst_ms is not None and worst_ms > demands.max_age_ms:
        return f"a frame was {worst_ms:.0f} ms old; at most {demands.max_age_ms:g} ms are allowed"
    if demands.needs_frames and (not seen.samples or seen.session_status != "running"):
        return "no frame was received: no session runs"
    return None
