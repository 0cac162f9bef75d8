"""Sessions that continue an earlier one of their fraction, as after a crash.

The earlier beam-on time is kept, to be shown. What is gated stays the same: another window, head direction, calibration
or other regions would escape the budget of the fraction (:mod:`engine.control.reference_budget`).
"""

from sqlalchemy.orm import Session

from service.core.errors import BoundError, NotFoundError
from service.core.schemas import sessions
from service.storage.database import queries
from service.storage.database.tables import SessionRow

FIELD = "continues"
SAME = (
    *("patient_reference", "plan_id", "fraction_id", "fraction_number", "rt_plan_id", "is_simulated_beam"),
    *("window", "regions", "head_direction", "calibration_id"),
)


def continued(db: Session, row: SessionRow) -> dict[str, object]:
    """Check what a new session continues, and return what the audit records of it; nothing if it continues none."""
    if row.continues is None:
        return {}
    earlier = db.get(SessionRow, row.continues)
    if earlier is None:
        msg = "there is no such session"
        raise NotFoundError(msg, field=FIELD, value=row.continues)
    if earlier.started_at is None or earlier.status in queries.OPEN_STATUSES:
        raise _refusal(row.continues, "a session that was started and is over", f"this one is {earlier.status}")
    other = [name for name in SAME if getattr(earlier, name) != getattr(row, name)]
    if other:
        # The values may be another patient's.
        raise _refusal(row.continues, "a session of the same fraction", f"this one differs in {', '.join(other)}")
    later = queries.continuation_of(db, earlier.id)
    if later is not None:
        raise _refusal(row.continues, "a session that none continues", f"continue {later}")
    return {"delivered_before_s": delivered_before_s(db, row)}


def delivered_before_s(db: Session, row: SessionRow) -> float | None:
    """Return the beam-on time of all sessions that this one continues [s]; None without one, or if one has none."""
    if row.continues is None:
        return None
    total_s = 0.0
    # Each session continues an older one: the chain ends.
    earlier_id: str | None = row.continues
    while earlier_id is not None:
        earlier = queries.session_row(db, earlier_id)
        if earlier.summary is None:
            return None
        beam_on_s = sessions.Summary.model_validate_json(earlier.summary).beam_on_s
        if beam_on_s is None:
            return None
        total_s += beam_on_s
        earlier_id = earlier.continues
    return round(total_s, 3)


def _refusal(value: str, bound: str, advice: str) -> BoundError:
    return BoundError(f"{FIELD} must be {bound}: {advice}", field=FIELD, value=value, bound=bound)
