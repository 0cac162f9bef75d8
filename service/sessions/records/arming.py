"""The summary before arming: everything that decides what is gated, from the session as it is now.

It never permits anything: the engine refuses for itself what this summary calls missing.
"""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from engine.capture import SourceDescription
from engine.core.errors import TidegateError
from engine.core.sentences import listed, say, word
from engine.core.signals import depends_on_head
from service.core.schemas.gate import ArmingItem, ArmingSummary
from service.core.schemas.records import Model
from service.core.schemas.sentences import sentence_parts
from service.core.schemas.sessions import SessionDetail
from service.core.settings.settings import Settings
from service.engine_host.equipment import EquipmentSlot
from service.engine_host.protocols import RunningSession
from service.sessions.records.calibrations import ModelRepository
from service.sessions.records.sessions import SessionRepository
from service.storage.database import queries
from service.storage.database.engine import Database

REFERENCE_SET = "session.reference"
UNSEEN = say("none surely sees a skin-coloured cover of up to 5 mm, or half of the body that rises slowly by 4 mm")
NO_PREDICTION = say("not compared with free breathing: see that its edges are those of a held breath")
NOT_COMPARED = say("a recording does not say which camera made it: see that the calibration is that camera's")
NO_QA = say("no QA is required here")
POSITION_OK = {"first_fraction", "signed"}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ArmingSummaries:
    """Makes the summaries of running sessions.

    Attributes
    ----------
    refuse_arming
        Raises a TidegateError where a site rule, such as an overdue QA, forbids arming.
    """

    sessions: SessionRepository
    models: ModelRepository
    database: Database
    equipment: EquipmentSlot
    settings: Settings
    refuse_arming: Callable[[SourceDescription | None], None]

    def of(self, session_id: str) -> ArmingSummary:
        """Return the summary; of a session that does not run, with what is known and the gate as missing."""
        running = self.equipment.of(session_id)
        state = "" if running is None else running.engine.status.arming_state  # first: what follows is not older
        detail = self.sessions.detail(session_id)
        items = list(self._items(detail, running))
        return ArmingSummary(
            session_id=session_id,
            is_ready=all(item.state != "missing" for item in items),
            items=items,
            sentences=sentence_parts(items),
            window=detail.window,
            gate_window=detail.gate_window,
            predicted_duty_percent=detail.predicted_duty_percent,
            needs_reason=running is not None and running.engine.status.is_reason_needed,
            state=state,
        )

    def _items(self, detail: SessionDetail, running: RunningSession | None) -> Iterator[ArmingItem]:
        yield ArmingItem(code="patient", state="ok", text=detail.patient_reference)
        yield _plan(detail)
        yield _camera(detail, running)
        yield _head(detail, running)
        yield _view(detail)
        yield self._model(detail, running)
        yield self._reference(detail)
        yield self._window(detail)
        yield _position(detail)
        yield self._checks(detail)
        yield from _countersignature(running)
        yield self._site(running)
        yield _gate(detail)

    def _model(self, detail: SessionDetail, running: RunningSession | None) -> ArmingItem:
        learning = None if running is None else running.engine.status.learning
        if learning is None or learning.model is None:
            return ArmingItem(
                code="model", state="missing", text=say("no motion model yet: wait for the training to end")
            )
        if learning.model_shortcoming is not None:
            return ArmingItem(code="model", state="missing", text=learning.model_shortcoming)
        if detail.active_model_id is None:
            return ArmingItem(code="model", state="attention", text=say("in use, not stored yet"))
        return ArmingItem(code="model", state="ok", text=_model_text(self.models.get(detail.active_model_id)))

    def _reference(self, detail: SessionDetail) -> ArmingItem:
        if not detail.has_reference:
            return ArmingItem(code="reference", state="missing", text=say("not set: set it and look at its level"))
        parts = [self._confirmed(detail.id), "" if detail.reference is None else detail.reference.text]
        is_beyond = detail.reference is not None and detail.reference.is_beyond
        return ArmingItem(
            code="reference",
            state="attention" if is_beyond else "ok",
            text=listed("; ", parts) or say("set"),
        )

    def _confirmed(self, session_id: str) -> str:
        """Return who confirmed the newest reference, when, and what was shown; empty if the audit has none."""
        with self.database.read() as db:
            row = queries.newest_done(db, session_id, (REFERENCE_SET,))
            if row is None:
                return ""
            made = json.loads(row.detail)
            by, at = row.actor, row.at
        moment = {"end_exhale": say("end of exhale"), "end_inhale": say("end of inhale")}.get(
            made["at"], say("present position")
        )
        shown = made.get("proposed")
        if shown is not None:
            moment = say(
                "{moment} of {breaths} breaths, scatter {scatter:.2f} {unit}",
                moment=moment,
                breaths=shown["breaths"],
                scatter=shown["scatter"],
                unit=shown["unit"],
            )
        return listed(", ", (moment, say("set by {by} at {at} UTC", by=by, at=at[11:16])))

    def _window(self, detail: SessionDetail) -> ArmingItem:
        unresolved = detail.gate_window is None or any(one.unit == "percent" for one in detail.gate_window.conditions)
        if unresolved:
            return ArmingItem(code="window", state="missing", text=say("in per cent of a range that is not known yet"))
        duty = detail.predicted_duty_percent
        if duty is None:
            return ArmingItem(code="window", state="attention", text=NO_PREDICTION)
        text = say("{duty:.0f} % of the learned breaths lie inside", duty=duty)
        if duty > self.settings.max_duty_percent:
            bound = say(
                "at most {max_duty_percent:g} % may: set a narrower window",
                max_duty_percent=self.settings.max_duty_percent,
            )
            return ArmingItem(code="window", state="missing", text=say("{text}; {bound}", text=text, bound=bound))
        return ArmingItem(code="window", state="ok" if duty > 0.0 else "attention", text=text)

    def _checks(self, detail: SessionDetail) -> ArmingItem:
        """Say which checks of the measurement cannot work; a site that needs all of them holds the beam for one."""
        silent = [one for one in detail.checks if one.state != "on"]
        if not detail.checks:
            return ArmingItem(code="checks", state="attention", text=say("not known before the reference is set"))
        if not silent:
            working = listed(", ", (word(one.name) for one in detail.checks))
            return ArmingItem(code="checks", state="ok", text=listed("; ", (working, UNSEEN)))
        return ArmingItem(
            code="checks",
            state="attention",
            text=listed("; ", (listed(": ", (word(one.name), one.text)) for one in silent)),
        )

    def _site(self, running: RunningSession | None) -> ArmingItem:
        try:
            self.refuse_arming(None if running is None else running.engine.status.source)
        except TidegateError as error:
            return ArmingItem(code="site", state="missing", text=error.args[0] if error.args else str(error))
        if self.settings.qa_required_daily_h == 0.0:
            return ArmingItem(code="site", state="attention", text=NO_QA)
        return ArmingItem(code="site", state="ok", text=say("QA and camera latency as this site requires"))


def _plan(detail: SessionDetail) -> ArmingItem:
    fraction = listed(
        " ",
        (
            say("{plan_id}, fraction {fraction_id}", plan_id=detail.plan_id, fraction_id=detail.fraction_id),
            "" if detail.fraction_number is None else say("(no. {number})", number=detail.fraction_number),
        ),
    )
    imported = "" if detail.rt_plan_id is None else say("from an imported RT Plan")
    return ArmingItem(code="plan", state="ok", text=listed(", ", (fraction, imported)))


def _camera(detail: SessionDetail, running: RunningSession | None) -> ArmingItem:
    if running is None or detail.camera is None:
        return ArmingItem(code="camera", state="missing", text=say("not open"))
    text = say("{name}, calibrated as {camera}", name=detail.camera.name, camera=running.plan.calibration.camera)
    source = running.engine.status.source
    uncompared = None if source is not None and source.is_live else NOT_COMPARED
    warnings = listed(
        "; ", filter(None, [detail.camera.warning, detail.calibration_warning, detail.source_warning, uncompared])
    )
    return ArmingItem(code="camera", state="attention" if warnings else "ok", text=listed(": ", (text, warnings)))


def _head(detail: SessionDetail, running: RunningSession | None) -> ArmingItem:
    if detail.head_direction is not None:
        text = say(
            "at the {head_direction} of the picture: arming confirms it", head_direction=word(detail.head_direction)
        )
        return ArmingItem(code="head_direction", state="ok", text=text)
    view = None if running is None else running.engine.status.view
    if view is not None and any(depends_on_head(choice) for choice in view.window.choices):
        text = say("unknown: create the session with it, or gate on whole or volume")
        return ArmingItem(code="head_direction", state="missing", text=text)
    return ArmingItem(code="head_direction", state="ok", text=say("unknown; not needed for this window"))


def _view(detail: SessionDetail) -> ArmingItem:
    texts = {
        "measuring": say("the patient is measured"),
        "training": say("still training"),
        "lost": say("the patient is not visible"),
        None: say("no picture yet"),
    }
    state = "ok" if detail.measurement_state == "measuring" else "missing"
    body = None if detail.body is None else detail.body.warning
    if state == "ok" and body is not None:
        return ArmingItem(code="view", state="attention", text=body)
    return ArmingItem(code="view", state=state, text=texts[detail.measurement_state])


def _model_text(model: Model) -> str:
    parts = [say("model {number} of {created_at:%H:%M} UTC", number=model.number, created_at=model.created_at)]
    if model.training_frames is not None and model.cycles is not None:
        parts.append(
            say("learned from {frames} frames, {cycles} breaths", frames=model.training_frames, cycles=model.cycles)
        )
    if model.quality is not None:
        parts.append(
            say(
                "breathing {amplitude_mm:.1f} mm, {explained:.1f} % explained, residual {residual_mm:.2f} mm",
                amplitude_mm=model.quality.amplitude_mm,
                explained=100.0 * model.quality.explained_share,
                residual_mm=model.quality.residual_mm,
            )
        )
    return listed("; ", parts)


def _position(detail: SessionDetail) -> ArmingItem:
    found = detail.position_check
    if found is None:
        return ArmingItem(code="position", state="missing", text=say("not known until a frame was decided on"))
    return ArmingItem(code="position", state="ok" if found.status in POSITION_OK else "missing", text=found.text)


def _countersignature(running: RunningSession | None) -> Iterator[ArmingItem]:
    """Yield who has countersigned, where the next arming needs it."""
    found = None if running is None else running.engine.status.countersignature
    if found is None or not found.is_required:
        return
    if found.signed_by is None:
        text = say("a second person looks at window and reference, and signs")
        yield ArmingItem(code="countersignature", state="missing", text=text)
    else:
        yield ArmingItem(
            code="countersignature", state="ok", text=say("{signed_by}; another person arms", signed_by=found.signed_by)
        )


def _gate(detail: SessionDetail) -> ArmingItem:
    gate = detail.gate
    if gate is None:
        return ArmingItem(
            code="gate",
            state="missing",
            text=say("the session is {status}: it must be running", status=word(detail.status)),
        )
    if gate.is_armed:
        return ArmingItem(
            code="gate",
            state="missing",
            text=say("armed already, by {armed_by}", armed_by=gate.armed_by or say("unknown")),
        )
    if gate.state == "fault":
        return ArmingItem(
            code="gate",
            state="missing",
            text=say("a fault is latched: acknowledge it"),
        )
    if gate.operator_holds:
        holders = listed(", ", gate.operator_holds)
        return ArmingItem(
            code="gate", state="attention", text=say("held by {holders}: armed, it stays held", holders=holders)
        )
    line = say("SIMULATED beam line") if detail.is_simulated_beam else say("beam line")
    return ArmingItem(code="gate", state="ok", text=say("{line}, disarmed", line=line))
