"""Sessions prepared from a plan: patient, plan and fraction come from the plan, and the window matches its technique.

Only a person may override the plan, with a reason; the audit records both.
"""

from collections.abc import Iterable
from dataclasses import dataclass

from sqlalchemy import select
from sqlalchemy.orm import Session as DbSession

from engine.core.signals import HeadDirection
from service.access.request.identity import RequestCaller
from service.core.errors import BoundError
from service.core.schemas import sessions
from service.core.schemas.plans import (
    PlanBeam,
    PlanFractionGroup,
    PlanSessionRequest,
    PlanSetup,
    PreparedSession,
    Prescribed,
    RtPlan,
)
from service.engine_host.site_limits.window_limits import FIELD, GANTRY_SIDE, SUPPORTED_POSITIONS, head_of
from service.planning.rt_plan import repository
from service.planning.rt_plan.errors import (
    FractionDoneError,
    OverrideNotPersonalError,
    PlanContradictedError,
    PlanGatingError,
    PlanPositionError,
    PlanRejectedError,
)
from service.planning.rt_plan.gating import NOT_TREATED, mismatch, prescribed, remark, waits_for_breath_hold
from service.planning.rt_plan.tags import Tag, named
from service.sessions.records.sessions import ACTION, FromPlan, SessionRepository
from service.storage.audit.log import AuditLog
from service.storage.database import identities
from service.storage.database.engine import Database
from service.storage.database.idempotency import CallersKey, IdempotentAnswer
from service.storage.database.tables import SessionRow

OVERRIDES = ("overrides_plan_gating", "repeats_fraction", "overrides_contradiction")


# The head direction that a plan's Patient Position (0018,5100) demands in this room.
#
# The position is in the patient setups of the fraction's treatment beams (PS3.3 C.8.8.12; terms in C.7.3.1.1.2). Only
# supine patients are measured: the markers are ordered for a body that is seen from its front.
def position_of(beams: Iterable[PlanBeam], setups: Iterable[PlanSetup]) -> str | None:
    """Return the position of the treatment beams; None if the plan has none.

    Raises
    ------
    PlanPositionError
        The patient does not lie supine along the couch, or not in the same position for all beams.
    """
    known = list(setups)
    treated = [beam for beam in beams if beam.delivery not in NOT_TREATED]
    own = [setup for beam in treated for setup in known if beam.setup_number in {None, setup.number}]
    found = sorted({setup.position for setup in own if setup.position is not None})
    if len(found) > 1:
        raise _refused(", ".join(found), "the same for all beams of the fraction")
    if found and found[0] not in SUPPORTED_POSITIONS:
        raise _refused(found[0], f"{' or '.join(SUPPORTED_POSITIONS)}: only supine patients are measured")
    return found[0] if found else None


def head_direction(
    requested: HeadDirection | None, position: str | None, gantry: HeadDirection | None
) -> HeadDirection | None:
    """Return the session's head direction: as requested, otherwise as plan and room say; None if neither is known.

    Raises
    ------
    PlanPositionError
        The request contradicts plan and room.
    """
    planned = head_of(position, gantry)
    if requested is not None and planned is not None and requested is not planned:
        bound = f"{planned}: the plan's position is {position}, and the gantry is at the {gantry} ({GANTRY_SIDE})"
        raise PlanPositionError(f"{FIELD} must be {bound}", field=FIELD, value=requested.value, bound=bound)
    return requested or planned


def position_notes(head: HeadDirection | None, position: str | None, gantry: HeadDirection | None) -> list[str]:
    """Return what could not be compared, for the operator."""
    notes = []
    if position is None:
        notes.append("the plan has no Patient Position: the head direction is not compared with it")
    elif gantry is None:
        notes.append(f"the head direction is not compared with the plan's position {position}: set {GANTRY_SIDE}")
    if head is None:
        notes.append("without a head direction only the whole region and its volume may gate")
    return notes


def _refused(value: str, bound: str) -> PlanPositionError:
    element = named(Tag.PATIENT_POSITION)
    return PlanPositionError(f"{element} is {value}: must be {bound}", field=element, value=value, bound=bound)


class PlannedSessions:
    """Prepares sessions from stored plans."""

    def __init__(
        self, database: Database, log: AuditLog, sessions: SessionRepository, gantry_side: HeadDirection | None
    ) -> None:
        self._gantry = gantry_side
        self._database = database
        self._log = log
        self._sessions = sessions

    def prepare(
        self, plan_id: str, request: PlanSessionRequest, caller: RequestCaller, key: CallersKey | None
    ) -> IdempotentAnswer[PreparedSession]:
        """Create a session of a plan's fraction.

        Raises
        ------
        PlanError, BoundError, NotFoundError
            The plan, its fraction or the window does not permit the session, or a machine requested an override.
        """
        operator = caller.checked_actor(request.operator)
        with self._log.refusals(actor=operator, action=ACTION, detail={"rt_plan_id": plan_id}):
            with self._database.read() as db:
                plan = repository.content(repository.plan_row(db, plan_id))
            group = _group(plan, request)
            _refuse_machines(request, caller)
            fraction = _Fraction(plan_id=plan_id, plan=plan, group=group, request=request, gantry=self._gantry)
            _ = fraction.head  # refuses a position that is not supported, or contradicts the request
        created = self._sessions.create(fraction.session_request(operator), key, fraction.origin())
        answer = PreparedSession(**dict(created.answer), warnings=fraction.warnings())
        return IdempotentAnswer(answer=answer, is_replay=created.is_replay)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Fraction:
    """One requested fraction of a plan."""

    plan_id: str
    plan: RtPlan
    group: PlanFractionGroup
    request: PlanSessionRequest
    gantry: HeadDirection | None

    @property
    def beams(self) -> list[PlanBeam]:
        """The fraction's beams; all beams if the fraction refers to none."""
        numbers = {one.beam_number for one in self.group.beams}
        return [beam for beam in self.plan.beams if not numbers or beam.number in numbers]

    @property
    def gating(self) -> Prescribed:
        """The technique prescribed for the fraction's beams."""
        return prescribed(self.beams, self.plan.setups)

    @property
    def position(self) -> str | None:
        """The patient's position for the fraction's beams; raises PlanPositionError."""
        return position_of(self.beams, self.plan.setups)

    @property
    def head(self) -> HeadDirection | None:
        """The session's head direction; raises PlanPositionError."""
        requested = self.request.head_direction
        return head_direction(None if requested is None else HeadDirection(requested), self.position, self.gantry)

    @property
    def name(self) -> str:
        """The fraction's name; includes the group number if the plan has several groups."""
        fraction = f"FX-{self.request.fraction_number}"
        return fraction if len(self.plan.fraction_groups) == 1 else f"FG-{self.group.number}-{fraction}"

    def session_request(self, operator: str) -> sessions.SessionRequest:
        """Return the request of the session."""
        request, head = self.request, self.head
        return sessions.SessionRequest(
            patient_reference=self.plan.patient_reference,
            plan_id=self.plan.label,
            fraction_id=self.name,
            fraction_number=request.fraction_number,
            operator=operator,
            source=request.source,
            calibration_id=request.calibration_id,
            window=request.window,
            regions=request.regions,
            model_id=request.model_id,
            continues=request.continues,
            head_direction=None if head is None else head.value,
        )

    def origin(self) -> FromPlan:
        """Return the session's origin for the audit, with the check to run in the creating transaction."""
        given = {name: getattr(self.request, name) for name in OVERRIDES}
        overrides = {name: reason for name, reason in given.items() if reason is not None}
        detail = {
            "rt_plan_id": self.plan_id,
            "sop_instance_uid": self.plan.sop_instance_uid,
            "plan_gating": self.gating,
            "plan_position": self.position,
        }
        return FromPlan(rt_plan_id=self.plan_id, detail=detail | overrides, check=self.check)

    def check(self, db: DbSession) -> None:
        """Refuse a session that contradicts the plan without an override."""
        if self.plan.approval == "REJECTED":
            msg = f"the plan was rejected: {named(Tag.APPROVAL)} is REJECTED"
            raise PlanRejectedError(msg, field="plan_id", value="REJECTED", bound="a plan that was not rejected")
        self._refuse_contradicted(db)
        required = mismatch(self.gating, self.request.window)
        if required is not None and self.request.overrides_plan_gating is None:
            msg = f"the window must be {required}; a person may override that, with a reason"
            value = "a breath hold" if waits_for_breath_hold(self.request.window) else "amplitude or phase"
            raise PlanGatingError(msg, field="window.kind", value=value, bound=required)
        if self.request.repeats_fraction is None:
            self._refuse_again(db)

    def _refuse_contradicted(self, db: DbSession) -> None:
        """Refuse a contradicted plan without an override, and a rejected plan always."""
        later = repository.contradictions(db, self.plan_id)
        if any(one.approval == "REJECTED" for one in later):
            msg = "the plan was rejected after it was imported: a later file with its UID has the status REJECTED"
            raise PlanRejectedError(msg, field="plan_id", value="REJECTED", bound="a plan that was not rejected")
        if later and self.request.overrides_contradiction is None:
            msg = (
                f"a later file with the plan's UID differs ({', '.join(later[0].differing)}); "
                "a person may override this, with a reason"
            )
            raise PlanContradictedError(
                msg, field="plan_id", value=self.plan_id, bound="a plan that no later file contradicts"
            )

    def _refuse_again(self, db: DbSession) -> None:
        """Refuse a fraction that was started before: only the treatment machine records the delivered dose."""
        name = identities.stored(db, self.plan.patient_reference, self.plan.label, self.name).fraction_id
        same = (SessionRow.rt_plan_id == self.plan_id, SessionRow.fraction_id == name)
        started = db.scalar(select(SessionRow.id).where(*same, SessionRow.started_at.is_not(None)).limit(1))
        if started is not None:
            msg = f"{self.name} was started before, in session {started}; a person may repeat it, with a reason"
            bound = "a fraction without a started session"
            raise FractionDoneError(msg, field="fraction_number", value=str(self.request.fraction_number), bound=bound)

    def warnings(self) -> list[str]:
        """Return the warnings for the operator: technique, overrides and the plan's notes."""
        gating_note = remark(self.gating)
        notes = [note for note in self.plan.notes if note != gating_note]
        warnings = [gating_note] if gating_note is not None else []
        if mismatch(self.gating, self.request.window) is not None:
            warnings.append("the window does not match the technique that the plan prescribes: overridden")
        if self.request.overrides_contradiction is not None:
            warnings.append("a later file with the plan's UID may differ: overridden")
        return [*warnings, *position_notes(self.head, self.position, self.gantry), *notes]


def _group(plan: RtPlan, request: PlanSessionRequest) -> PlanFractionGroup:
    """Return the fraction group; raise BoundError for an unknown group or an unplanned fraction."""
    numbers = [group.number for group in plan.fraction_groups]
    number = numbers[0] if request.fraction_group is None and len(numbers) == 1 else request.fraction_group
    found = next((group for group in plan.fraction_groups if group.number == number), None)
    if found is None:
        bound = f"one of the plan's groups: {', '.join(str(one) for one in numbers)}"
        raise BoundError(f"fraction_group must be {bound}", field="fraction_group", value=number, bound=bound)
    most = found.fractions_planned
    if most is not None and request.fraction_number > most:
        bound = f"at most {most}, the planned number"
        msg = f"fraction_number must be {bound}"
        raise BoundError(msg, field="fraction_number", value=request.fraction_number, bound=bound)
    return found


def _refuse_machines(request: PlanSessionRequest, caller: RequestCaller) -> None:
    """Refuse an override from a machine, also on behalf of a person."""
    given = next((name for name in OVERRIDES if getattr(request, name) is not None), None)
    if given is not None and not caller.identity.is_person:
        bound = "left out, or sent by a person who has logged in"
        raise OverrideNotPersonalError(f"{given} must be {bound}", field=given, value="a machine's", bound=bound)
