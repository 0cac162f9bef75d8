"""Sessions prepared from a plan: patient, plan and fraction are the plan's, and the window is of its technique.

Whoever goes against the plan is a person, and says why; the audit keeps both.
"""

from dataclasses import dataclass
from typing import Protocol

from sqlalchemy import select
from sqlalchemy.orm import Session as DbSession

from service import schemas
from service.access.calling import Calling
from service.audit_log import AuditLog
from service.db.engine import Database
from service.db.models import SessionRow
from service.errors import BoundError
from service.idempotency import CallersKey
from service.plan_schemas import PlanFractionGroup, PlanSessionRequest, PreparedSession, Prescribed, RtPlan
from service.plans import records
from service.plans.errors import (
    FractionDoneError,
    OverrideNotPersonalError,
    PlanContradictedError,
    PlanGatingError,
    PlanRejectedError,
)
from service.plans.gating import mismatch, prescribed, remark, waits_for_breath_hold
from service.plans.tags import Tag, named
from service.ports import Kept
from service.sessions import ACTION, FromPlan

OVERRIDES = ("overrides_plan_gating", "repeats_fraction", "overrides_contradiction")


class SessionsFromPlans(Protocol):
    """The book of sessions, as it is written in here."""

    def create(
        self, request: schemas.SessionRequest, key: CallersKey | None, plan: FromPlan | None = None
    ) -> Kept[schemas.Session]:
        """Record a new session; one at a time."""


class PlannedSessions:
    """Prepares sessions."""

    def __init__(self, database: Database, log: AuditLog, book: SessionsFromPlans) -> None:
        self._database = database
        self._log = log
        self._book = book

    def prepare(
        self, plan_id: str, request: PlanSessionRequest, caller: Calling, key: CallersKey | None
    ) -> Kept[PreparedSession]:
        """Record a new session of a plan's fraction."""
        operator = caller.acts_as(request.operator)
        with self._log.refusals(actor=operator, action=ACTION, detail={"rt_plan_id": plan_id}):
            with self._database.read() as db:
                plan = records.content(records.plan_row(db, plan_id))
            group = _group(plan, request)
            _refuse_machines(request, caller)
        fraction = _Fraction(plan_id=plan_id, plan=plan, group=group, request=request)
        kept = self._book.create(fraction.session_request(operator), key, fraction.origin())
        answer = PreparedSession(**dict(kept.answer), warnings=fraction.warnings())
        return Kept(answer=answer, is_replay=kept.is_replay)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Fraction:
    """One fraction of a plan, as it is asked for."""

    plan_id: str
    plan: RtPlan
    group: PlanFractionGroup
    request: PlanSessionRequest

    @property
    def gating(self) -> Prescribed:
        """What is prescribed for the beams of this fraction; for all beams where it does not say which are its own."""
        ours = {one.beam_number for one in self.group.beams}
        return prescribed([beam for beam in self.plan.beams if not ours or beam.number in ours], self.plan.setups)

    @property
    def name(self) -> str:
        """Name the fraction; with its group where there are several."""
        fraction = f"FX-{self.request.fraction_number}"
        return fraction if len(self.plan.fraction_groups) == 1 else f"FG-{self.group.number}-{fraction}"

    def session_request(self, operator: str) -> schemas.SessionRequest:
        """Put it into a session's words."""
        asked = self.request
        return schemas.SessionRequest(
            patient_reference=self.plan.patient_reference,
            plan_id=self.plan.label,
            fraction_id=self.name,
            fraction_number=asked.fraction_number,
            operator=operator,
            source=asked.source,
            calibration_id=asked.calibration_id,
            window=asked.window,
            regions=asked.regions,
            model_id=asked.model_id,
        )

    def origin(self) -> FromPlan:
        """Say where the session comes from, and what has to hold when it is written down."""
        given = {name: getattr(self.request, name) for name in OVERRIDES}
        told = {name: reason for name, reason in given.items() if reason is not None}
        detail = {
            "rt_plan_id": self.plan_id,
            "sop_instance_uid": self.plan.sop_instance_uid,
            "plan_gating": self.gating,
        }
        return FromPlan(rt_plan_id=self.plan_id, detail=detail | told, check=self.check)

    def check(self, db: DbSession) -> None:
        """Refuse what goes against the plan."""
        if self.plan.approval == "REJECTED":
            msg = f"the plan was rejected: {named(Tag.APPROVAL)} is REJECTED"
            raise PlanRejectedError(msg, field="plan_id", value="REJECTED", bound="a plan that was not rejected")
        self._refuse_contradicted(db)
        wanted = mismatch(self.gating, self.request.window)
        if wanted is not None and self.request.overrides_plan_gating is None:
            msg = f"the window must be {wanted}; a person may override that, with a reason"
            value = "a breath hold" if waits_for_breath_hold(self.request.window) else "amplitude or phase"
            raise PlanGatingError(msg, field="window.kind", value=value, bound=wanted)
        if self.request.repeats_fraction is None:
            self._refuse_again(db)

    def _refuse_contradicted(self, db: DbSession) -> None:
        """Refuse a plan of which a later file says something else; one that was rejected, whoever asks."""
        said = records.contradictions(db, self.plan_id)
        if any(one.approval == "REJECTED" for one in said):
            msg = "the plan was rejected after it was imported: a later file with its UID says so"
            raise PlanRejectedError(msg, field="plan_id", value="REJECTED", bound="a plan that was not rejected")
        if said and self.request.overrides_contradiction is None:
            msg = (
                f"a later file with the plan's UID says something else ({', '.join(said[0].differing)}); "
                "a person may treat as the plan says, with a reason"
            )
            raise PlanContradictedError(
                msg, field="plan_id", value=self.plan_id, bound="a plan that no later file contradicts"
            )

    def _refuse_again(self, db: DbSession) -> None:
        """Refuse a fraction that was begun before: what it gave, only the treatment machine knows."""
        same = (SessionRow.rt_plan_id == self.plan_id, SessionRow.fraction_id == self.name)
        begun = db.scalar(select(SessionRow.id).where(*same, SessionRow.started_at.is_not(None)).limit(1))
        if begun is not None:
            msg = f"{self.name} was begun before, in session {begun}; a person may repeat it, with a reason"
            bound = "a fraction that no session was started of"
            raise FractionDoneError(msg, field="fraction_number", value=str(self.request.fraction_number), bound=bound)

    def warnings(self) -> list[str]:
        """Say what whoever starts the session should know."""
        said = remark(self.gating)
        notes = [note for note in self.plan.notes if note != said]
        told = [said] if said is not None else []
        if mismatch(self.gating, self.request.window) is not None:
            told.append("the window is not of the technique that the plan prescribes: overridden")
        if self.request.overrides_contradiction is not None:
            told.append("a later file with the plan's UID may say something else: overridden")
        return [*told, *notes]


def _group(plan: RtPlan, request: PlanSessionRequest) -> PlanFractionGroup:
    """Find the fraction group, and refuse a fraction that is not planned."""
    numbers = [group.number for group in plan.fraction_groups]
    number = numbers[0] if request.fraction_group is None and len(numbers) == 1 else request.fraction_group
    found = next((group for group in plan.fraction_groups if group.number == number), None)
    if found is None:
        bound = f"one of the plan's groups: {', '.join(str(one) for one in numbers)}"
        raise BoundError(f"fraction_group must be {bound}", field="fraction_group", value=number, bound=bound)
    most = found.fractions_planned
    if most is not None and request.fraction_number > most:
        bound = f"at most {most}, as many as are planned"
        msg = f"fraction_number must be {bound}"
        raise BoundError(msg, field="fraction_number", value=request.fraction_number, bound=bound)
    return found


def _refuse_machines(request: PlanSessionRequest, caller: Calling) -> None:
    """Refuse that a machine goes against the plan, whoever it says that it acts for."""
    given = next((name for name in OVERRIDES if getattr(request, name) is not None), None)
    if given is not None and not caller.identity.is_person:
        bound = "left out, or sent by a person who has logged in"
        raise OverrideNotPersonalError(f"{given} must be {bound}", field=given, value="a machine's", bound=bound)
