"""QA requirement for arming: the newest run that includes a daily QA must be recent, finished and not failed.

A plate recording dates from the first run that judged it, because an old recording does not show today's camera. A run
that was started but not finished counts as the newest, so it refuses arming. Simulated runs do not count. A run on
another beam line, with wider bounds than this service's, or without one of its daily checks refuses arming. This runs
at arming, not per frame.
"""

import json
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta

from sqlalchemy.orm import Session

from engine.core.sentences import say
from engine.qa import QaKind, checks_of
from service.core.errors import QaOverdueError
from service.core.settings.names import setting_name
from service.core.settings.settings import Settings
from service.qa import queries
from service.storage.database.engine import Database
from service.storage.database.tables import QaRunRow

KINDS = ("daily", "monthly", "annual")
"""Each kind includes the checks of the previous one, so each includes the daily QA."""

ADVICE = say("do a daily QA (tidegate qa daily)")


def refusal(db: Session, settings: Settings, now: datetime) -> str | None:
    """Return why arming is refused and what to do; None if the requirement is met or the site has none."""
    hours = settings.qa_required_daily_h
    if hours == 0.0:
        return None
    newest = queries.newest_run(db, KINDS)
    if newest is None:
        return say(
            "this site asks for a QA every {hours:g} h, and none was ever done: {advice}", hours=hours, advice=ADVICE
        )
    return (
        _unfit(db, newest)
        or _unfit_setting(newest, settings)
        or _unfit_age(newest, queries.plate_recorded_since(db, newest), now, hours)
    )


def refuse_without_qa(database: Database, settings: Settings) -> None:
    """Raise QaOverdueError if the site requires QA before arming and the newest run does not meet it."""
    if settings.qa_required_daily_h == 0.0:
        return
    with database.read() as db:
        reason = refusal(db, settings, datetime.now(UTC))
    if reason is not None:
        bound = f"passed within {settings.qa_required_daily_h:g} h ({setting_name('qa_required_daily_h')})"
        raise QaOverdueError(reason, field="qa", bound=bound)


def _unfit(db: Session, newest: QaRunRow) -> str | None:
    outcome = queries.outcome_row(db, newest.id)
    run_text = say("the newest QA ({kind}, {created_at})", kind=newest.kind, created_at=_moment(newest.created_at))
    if outcome is None:
        return say("{run_text} has not ended: wait for its end, or {advice}", run_text=run_text, advice=ADVICE)
    if outcome.status != "finished" or outcome.verdict is None:
        return say(
            "{run_text} was not finished ({status}): {advice}", run_text=run_text, status=outcome.status, advice=ADVICE
        )
    if outcome.verdict == "fail":
        failed = [row.code for row in queries.result_rows(db, newest.id) if row.verdict == "fail"]
        return say(
            "{run_text} failed ({failed}): find the cause, then {advice}",
            run_text=run_text,
            failed=", ".join(failed),
            advice=ADVICE,
        )
    return None


def _unfit_setting(newest: QaRunRow, settings: Settings) -> str | None:
    """Refuse a run on another beam line or with wider bounds: the command line may have other settings."""
    run_text = say("the newest QA ({kind}, {created_at})", kind=newest.kind, created_at=_moment(newest.created_at))
    place = json.loads(newest.request).get("beam_place")
    if place != settings.beam_place:
        ours = say("this service's ({beam_place})", beam_place=_named(settings.beam_place))
        return say(
            "{run_text} tested another beam line ({place}) than {ours}: {advice}",
            run_text=run_text,
            place=_named(place),
            ours=ours,
            advice=ADVICE,
        )
    bounds = json.loads(newest.bounds)
    daily = [check for check in checks_of(QaKind.DAILY) if not check.is_optional]
    missing = [check.code for check in daily if bounds and check.code not in bounds]
    if missing:
        return say(
            "{run_text} did not include {missing}, which the daily QA has now: {advice}",
            run_text=run_text,
            missing=", ".join(missing),
            advice=ADVICE,
        )
    wider = [code for code, bound in bounds.items() if not bound["fail"] <= settings.qa_bounds.of(code).fail]
    if wider or not bounds:
        names = ", ".join(wider) or say("none stored")
        return say(
            "{run_text} was judged with wider bounds than this service's ({names}): {advice}",
            run_text=run_text,
            names=names,
            advice=ADVICE,
        )
    return None


def _named(place: Mapping[str, object] | None) -> str:
    return ", ".join(str(value) for value in (place or {"": "unknown"}).values())


def _unfit_age(newest: QaRunRow, since: datetime, now: datetime, hours: float) -> str | None:
    age = now - since
    run_text = say("the newest QA ({kind}) is of {created_at}", kind=newest.kind, created_at=_moment(newest.created_at))
    if since < newest.created_at:
        run_text = say(
            "{run_text}, but its plate's recording was judged on {since} already",
            run_text=run_text,
            since=_moment(since),
        )
    if age < timedelta(0):
        return say("{run_text}, which is in the future: check this machine's clock", run_text=run_text)
    if age > timedelta(hours=hours):
        return say(
            "{run_text}, and this site requires one every {hours:g} h: {advice}",
            run_text=run_text,
            hours=hours,
            advice=ADVICE,
        )
    return None


def _moment(at: datetime) -> str:
    return at.astimezone(UTC).strftime("%Y-%m-%d %H:%M UTC")
