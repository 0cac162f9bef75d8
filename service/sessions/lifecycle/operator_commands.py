"""The commands of operators to the running session, each with its audit row."""

from collections.abc import Callable, Collection

from engine.capture import SourceDescription
from engine.core.commands import (
    ActivateModel,
    ApplyModel,
    Arm,
    CorrectBaseline,
    Countersign,
    HoldBeam,
    ReleaseBeam,
    Retrain,
    SetReference,
    SignPosition,
)
from engine.core.reference import ReferenceMoment
from engine.core.sentences import say
from engine.core.signals import HeadDirection
from service.core.errors import BoundError
from service.core.schemas import sessions
from service.core.schemas.gate import BaselineCorrectionRequest
from service.engine_host.protocols import CommandName
from service.sessions.lifecycle.commands import COMMANDS, Acknowledgement, EngineCommander, takes_permission_away
from service.sessions.lifecycle.start import SessionStarter
from service.sessions.lifecycle.window_setting import (
    WindowSetting,
    check_correction,
    correction_detail,
    moved_window,
    naming_the_field,
    window_detail,
)
from service.sessions.records.sessions import SessionRepository
from service.sessions.views.position import live_position_check, proposal_views, tolerance_of
from service.storage import audit
from service.storage.audit.log import AuditLog
from service.storage.database import queries

NOTHING_SEEN = "In clinical mode an arming names what was looked at."


class OperatorCommands:
    """What operators and programs tell the running session; each call waits for the engine's answer.

    Parameters
    ----------
    starter
        Its alarms, database, models, equipment slot and settings.
    commander
        Sends a command to the engine and records it.
    refuse_arming
        Raises a TidegateError where a site rule, such as an overdue QA, forbids arming; given the session's source,
        None where it is not known.
    """

    def __init__(
        self,
        *,
        starter: SessionStarter,
        commander: EngineCommander,
        log: AuditLog,
        records: SessionRepository,
        refuse_arming: Callable[[SourceDescription | None], None],
    ) -> None:
        self._models, self._settings = starter.models, starter.settings
        self._database, self._equipment = starter.database, starter.equipment
        self._commander, self._log, self._records = commander, log, records
        self._refuse_arming = refuse_arming
        self._window_setting = WindowSetting(
            commander=commander, equipment=starter.equipment, database=starter.database, settings=starter.settings
        )
        self._acknowledgement = Acknowledgement(alarms=starter.alarms, equipment=starter.equipment, commander=commander)

    def command(self, session_id: str, name: CommandName, operator: str, *, is_person: bool) -> sessions.SessionDetail:
        """Submit a command of an operator and wait until the engine has executed or refused it.

        ``is_person`` is False for a program with a key.
        """
        command = COMMANDS[name](operator, is_person)
        self._commander.execute(session_id, command, operator, f"session.{name}")
        return self._records.detail(
            session_id, self._commander.priority_database if takes_permission_away(command) else None
        )

    def acknowledge(self, session_id: str, operator: str, alarms: Collection[int] | None) -> sessions.SessionDetail:
        """Acknowledge the latched fault and alarms; ``alarms`` are the numbers of those meant, None for all."""
        self._acknowledgement.acknowledge(session_id, operator, alarms)
        return self._records.detail(session_id)

    def arm(
        self,
        session_id: str,
        operator: str,
        head: HeadDirection | None,
        *,
        is_person: bool,
        seen: str | None = None,
        reason: str = "",
    ) -> sessions.SessionDetail:
        """Arm the gate; ``head`` is the head direction that the operator confirms, and the audit records it.

        ``is_person`` is False for a program with a key; ``seen`` names what the operator looked at; ``reason`` is
        required for conditions joined by *or*.
        """
        action = "session.arm"
        detail: dict[str, object] = {} if head is None else {"head_direction": head.value}
        if seen is not None:
            detail["state"] = seen
        if reason:
            detail["reason"] = reason
        with self._log.refusals(actor=operator, action=action, session_id=session_id, detail=detail):
            if seen is None and self._settings.mode == "clinical":
                raise BoundError(NOTHING_SEEN, field="state", value="null", bound="the state of GET .../arming")
            running = self._equipment.of(session_id)
            if running is not None:  # otherwise the command is refused
                self._refuse_arming(running.engine.status.source)
        command = Arm(operator=operator, head_direction=head, is_person=is_person, seen=seen, reason=reason)
        self._commander.execute(session_id, command, operator, action, detail)
        return self._records.detail(session_id)

    def arming_state(self, session_id: str) -> str | None:
        """Return what an arming would take, by the newest status of the engine; None where the session does not run."""
        running = self._equipment.of(session_id)
        return None if running is None else running.engine.status.arming_state

    def set_reference(
        self, session_id: str, operator: str, request: sessions.ReferenceRequest, *, may_exceed: bool
    ) -> sessions.SessionDetail:
        """Set the reference; the audit records the moment, what the operator was shown, and what was proposed.

        ``may_exceed`` is whether the operator is a person who may arm; with a reason, the reference may then lie beyond
        the budget from the fraction's first one.

        Raises
        ------
        BoundError
            In clinical mode, stickers and chest are not confirmed in this session yet.
        """
        self._refuse_unconfirmed_setup(session_id, confirmed=request.setup_confirmed)
        command = SetReference(
            operator=operator,
            moment=ReferenceMoment(request.at),
            level_seen=request.level_seen,
            move_seen_mm=request.move_seen_mm,
            reason=request.reason,
            may_exceed=may_exceed,
        )
        running = self._equipment.of(session_id)
        budget_mm = self._settings.max_reference_distance_mm
        views = (
            []
            if running is None
            else proposal_views(running.engine.status.learning, budget_mm, tolerance_of(self._settings))
        )
        proposed = next((view.model_dump() for view in views if view.at == request.at), None)
        detail = {**request.model_dump(exclude={"operator"}), "proposed": proposed}
        self._commander.execute(session_id, command, operator, "session.reference", detail)
        return self._records.detail(session_id)

    def _refuse_unconfirmed_setup(self, session_id: str, *, confirmed: bool) -> None:
        """Refuse a reference before a person of this session has confirmed that stickers and chest are as they must."""
        if confirmed or self._settings.mode != "clinical":
            return
        with self._database.read() as db:
            earlier = queries.newest_done(db, session_id, ("session.reference",))
        if earlier is None:
            bound = "true: stickers on the skin or a tight shirt, chest not covered"
            msg = f"setup_confirmed must be {bound}"
            raise BoundError(msg, field="setup_confirmed", value="false", bound=bound)

    def sign_position(
        self, session_id: str, operator: str, request: sessions.PositionCheckRequest, *, may_exceed: bool
    ) -> sessions.SessionDetail:
        """Sign the patient's position against the plan's; the audit records the figures that were shown.

        ``may_exceed`` is whether the operator is a person who may arm; with a reason, the position may be beyond the
        tolerance.
        """
        command = SignPosition(
            operator=operator,
            reference_number=request.reference_number,
            reason=request.reason,
            may_exceed=may_exceed,
        )
        running = self._equipment.of(session_id)
        view = None if running is None else running.engine.status.view
        shown = None if running is None or view is None else live_position_check(view, running.plan)
        detail = {
            **request.model_dump(exclude={"operator"}),
            "shown": None if shown is None else shown.model_dump(exclude={"signed_by", "reason", "status", "text"}),
        }
        self._commander.execute(session_id, command, operator, "session.position_check", detail)
        return self._records.detail(session_id)

    def countersign(self, session_id: str, operator: str, state: str, signer: str | None) -> sessions.SessionDetail:
        """Countersign the reference and the window in the name of ``signer``, or of the person who is logged in.

        The audit records the window, and who was logged in at the page.
        """
        running = self._equipment.of(session_id)
        view = None if running is None else running.engine.status.view
        detail: dict[str, object] = {
            "state": state,
            "page_of": operator,
            "window": None if view is None else window_detail(view),
        }
        command = Countersign(operator=signer or operator, seen=state)
        self._commander.execute(session_id, command, command.operator, "session.countersign", detail)
        return self._records.detail(session_id)

    def release(self, session_id: str, operator: str, *, is_person: bool) -> sessions.SessionDetail:
        """Release the operator's own hold, a person without one all; a person then answers for the armed gate."""
        command = ReleaseBeam(operator=operator, is_person=is_person)
        self._commander.execute(session_id, command, operator, "session.release")
        return self._records.detail(session_id)

    def hold_unattended(self, session_id: str, armed_by: str) -> None:
        """Hold as an operator does, because the login or key of the person who armed has ended."""
        detail: dict[str, object] = {
            "reason": say("{armed_by} armed the gate and is not logged in any more", armed_by=armed_by),
            "armed_by": armed_by,
        }
        self._commander.execute(session_id, HoldBeam(operator=audit.SYSTEM), audit.SYSTEM, "session.hold", detail)

    def retrain(self, session_id: str, operator: str, *, keeps_reference: bool) -> sessions.SessionDetail:
        """Train a new model in the background."""
        command = Retrain(operator=operator, keeps_zero=keeps_reference)
        self._commander.execute(session_id, command, operator, "model.retrain", {"keeps_reference": keeps_reference})
        return self._records.detail(session_id)

    def apply_model(self, session_id: str, operator: str) -> sessions.SessionDetail:
        """Apply the new model that is waiting; disarms."""
        self._commander.execute(session_id, ApplyModel(operator=operator), operator, "model.apply")
        return self._records.detail(session_id)

    def activate(self, model_id: str, operator: str) -> sessions.SessionDetail:
        """Activate a stored model of the running session; disarms."""
        action = "model.activate"
        with self._log.refusals(actor=operator, action=action, detail={"model_id": model_id}):
            with self._database.read() as db:
                row = queries.model_row(db, model_id)
                session_id, sha256 = row.session_id, row.sha256
            self._commander.running(session_id)
            model = self._models.load(sha256)
        detail: dict[str, object] = {"model_id": model_id, "sha256": sha256}
        self._commander.execute(session_id, ActivateModel(operator=operator, model=model), operator, action, detail)
        return self._records.detail(session_id)

    def correct_baseline(
        self, session_id: str, operator: str, request: BaselineCorrectionRequest, *, may_exceed: bool
    ) -> sessions.SessionDetail:
        """Shift the window by a baseline drift that a person confirms; disarms. ``may_exceed`` as for a reference."""
        action = "session.baseline_correction"
        running = self._equipment.of(session_id)
        before = None if running is None else running.engine.status.view
        detail = correction_detail(request, before)
        if running is not None:
            with self._log.refusals(actor=operator, action=action, session_id=session_id, detail=detail):
                check_correction(request, before, self._settings)
        command = CorrectBaseline(operator=operator, by=request.by, reason=request.reason, may_exceed=may_exceed)
        with naming_the_field(request):
            self._commander.execute(
                session_id, command, operator, action, detail, after=lambda now: moved_window(now, before)
            )
        return self._records.detail(session_id)

    def set_window(
        self, session_id: str, operator: str, request: sessions.WindowRequest, *, may_exceed: bool
    ) -> sessions.SessionDetail:
        """Gate by another window; refused while the gate is armed. ``may_exceed`` as for a reference."""
        self._window_setting.set_window(session_id, operator, request, may_exceed=may_exceed)
        return self._records.detail(session_id)

    def note_presence(self, session_id: str, operator: str) -> None:
        """Note that the operator is present at the page; comes every second and is not audited."""
        self._commander.running(session_id).engine.note_presence(operator)
