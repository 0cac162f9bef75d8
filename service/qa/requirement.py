"""Whether a site's QA lets anybody arm: the newest run that a daily QA is part of must be young, whole and not failed.

A recording is as old as the first run that judged it: yesterday's plate says nothing of today's camera. A run that was
begun and not finished counts as the newest: QA that was not done is not passed. Simulated runs count for nothing, and a
run of another beam line, or by wider bounds, than this service has is no run of this service's. Asked
when somebody arms, never in the way of a frame.
"""

import json
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta

from sqlalchemy.orm import Session

from service.beam_settings import PREFIX
from service.db.engine import Database
from service.db.models import QaRunRow
from service.errors import QaOverdueError
from service.qa import records
from service.settings import Settings

KINDS = ("daily", "monthly", "annual")
"""Each holds all of the one before, so any of them is a daily QA."""

ADVICE = "do a daily QA (tidegate qa daily)"


def refusal(db: Session, settings: Settings, now: datetime) -> str | None:
    """Say why nobody may arm, and what would help; None where somebody may."""
    hours = settings.qa_required_daily_h
    if hours == 0.0:
        return None
    newest = records.newest_run(db, KINDS)
    if newest is None:
        return f"this site asks for a QA every {hours:g} h, and none was ever done: {ADVICE}"
    return (
        _unfit(db, newest)
        or _unfit_setting(newest, settings)
        or _unfit_age(newest, records.plate_since(db, newest), now, hours)
    )


def refuse_without_qa(database: Database, settings: Settings) -> None:
    """Raise QaOverdueError where the site's QA lets nobody arm."""
    if settings.qa_required_daily_h == 0.0:
        return
    with database.read() as db:
        reason = refusal(db, settings, datetime.now(UTC))
    if reason is not None:
        bound = f"passed within {settings.qa_required_daily_h:g} h ({PREFIX}QA_REQUIRED_DAILY_H)"
        raise QaOverdueError(reason, field="qa", bound=bound)


def _unfit(db: Session, newest: QaRunRow) -> str | None:
    outcome = records.outcome_row(db, newest.id)
    said = f"the newest QA ({newest.kind}, {_moment(newest.created_at)})"
    if outcome is None:
        return f"{said} has not ended: wait for its end, or {ADVICE}"
    if outcome.status != "finished" or outcome.verdict is None:
        return f"{said} was not finished ({outcome.status}): {ADVICE}"
    if outcome.verdict == "fail":
        failed = [row.code for row in records.result_rows(db, newest.id) if row.verdict == "fail"]
        return f"{said} failed ({', '.join(failed)}): find out why, then {ADVICE}"
    return None


def _unfit_setting(newest: QaRunRow, settings: Settings) -> str | None:
    """Refuse a run of another line, or by wider bounds, than those of this service: a shell has settings of its own."""
    said = f"the newest QA ({newest.kind}, {_moment(newest.created_at)})"
    place = json.loads(newest.request).get("beam_place")
    if place != settings.beam_place:
        ours = f"this service's ({_named(settings.beam_place)})"
        return f"{said} drilled another beam line ({_named(place)}) than {ours}: {ADVICE}"
    kept = json.loads(newest.bounds)
    wider = [code for code, bound in kept.items() if not bound["fail"] <= settings.qa_bounds.of(code).fail]
    if wider or not kept:
        return f"{said} was judged by wider bounds than this service's ({', '.join(wider) or 'none kept'}): {ADVICE}"
    return None


def _named(place: Mapping[str, object] | None) -> str:
    return ", ".join(str(value) for value in (place or {"": "unknown"}).values())


def _unfit_age(newest: QaRunRow, since: datetime, now: datetime, hours: float) -> str | None:
    age = now - since
    said = f"the newest QA ({newest.kind}) is of {_moment(newest.created_at)}"
    if since < newest.created_at:
        said = f"{said}, but its plate's recording was judged on {_moment(since)} already"
    if age < timedelta(0):
        return f"{said}, which is yet to come: look at this machine's clock"
    if age > timedelta(hours=hours):
        return f"{said}, and this site asks for one every {hours:g} h: {ADVICE}"
    return None


def _moment(at: datetime) -> str:
    return at.astimezone(UTC).strftime("%Y-%m-%d %H:%M UTC")
