"""The summary before arming: everything that decides what is gated, from the session as it is now.

It never permits anything: the engine refuses for itself what this summary calls missing.
"""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from engine.capture import SourceDescription
from engine.core.errors import TidegateError
from engine.core.signals import depends_on_head
from service.core.schemas.gate import ArmingItem, ArmingSummary
from service.core.schemas.records import Model
from service.core.schemas.sessions import SessionDetail
from service.core.settings.settings import Settings
from service.engine_host.equipment import EquipmentSlot
from service.engine_host.roles import RunningSession
from service.sessions.records.calibrations import ModelRepository
from service.sessions.records.sessions import SessionRepository
from service.storage.database import queries
from service.storage.database.engine import Database

REFERENCE_SET = "session.reference"
NO_PREDICTION = "not compared with free breathing: see that its edges are those of a held breath"
NOT_COMPARED = "a recording does not say which camera made it: see that the calibration is that camera's"
NO_QA = "no QA is required here"
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
            return ArmingItem(code="model", state="missing", text="no motion model yet: wait for the training to end")
        if learning.model_shortcoming is not None:
            return ArmingItem(code="model", state="missing", text=learning.model_shortcoming)
        if detail.active_model_id is None:
            return ArmingItem(code="model", state="attention", text="in use, not stored yet")
        return ArmingItem(code="model", state="ok", text=_model_text(self.models.get(detail.active_model_id)))

    def _reference(self, detail: SessionDetail) -> ArmingItem:
        if not detail.has_reference:
            return ArmingItem(code="reference", state="missing", text="not set: set it and look at its level")
        parts = [self._confirmed(detail.id), None if detail.reference is None else detail.reference.text]
        is_beyond = detail.reference is not None and detail.reference.is_beyond
        return ArmingItem(
            code="reference",
            state="attention" if is_beyond else "ok",
            text="; ".join(part for part in parts if part) or "set",
        )

    def _confirmed(self, session_id: str) -> str:
        """Return who confirmed the newest reference, when, and what was shown; empty if the audit has none."""
        with self.database.read() as db:
            row = queries.newest_done(db, session_id, (REFERENCE_SET,))
            if row is None:
                return ""
            made = json.loads(row.detail)
            by, at = row.actor, row.at
        moment = {"end_exhale": "end of exhale", "end_inhale": "end of inhale"}.get(made["at"], "present position")
        shown = made.get("proposed")
        seen = (
            "" if shown is None else f" of {shown['breaths']} breaths, scatter {shown['scatter']:.2f} {shown['unit']}"
        )
        return f"{moment}{seen}, set by {by} at {at[11:16]} UTC"

    def _window(self, detail: SessionDetail) -> ArmingItem:
        unresolved = detail.gate_window is None or any(one.unit == "percent" for one in detail.gate_window.conditions)
        if unresolved:
            return ArmingItem(code="window", state="missing", text="in per cent of a range that is not known yet")
        duty = detail.predicted_duty_percent
        if duty is None:
            return ArmingItem(code="window", state="attention", text=NO_PREDICTION)
        text = f"{duty:.0f} % of the learned breaths lie inside"
        if duty > self.settings.max_duty_percent:
            bound = f"at most {self.settings.max_duty_percent:g} % may: set a narrower window"
            return ArmingItem(code="window", state="missing", text=f"{text}; {bound}")
        return ArmingItem(code="window", state="ok" if duty > 0.0 else "attention", text=text)

    def _checks(self, detail: SessionDetail) -> ArmingItem:
        """Say which checks of the measurement cannot work; a site that needs all of them holds the beam for one."""
        silent = [one for one in detail.checks if one.state != "on"]
        if not detail.checks:
            return ArmingItem(code="checks", state="attention", text="not known before the reference is set")
        if not silent:
            return ArmingItem(code="checks", state="ok", text=", ".join(one.name for one in detail.checks))
        return ArmingItem(code="checks", state="attention", text="; ".join(f"{one.name}: {one.text}" for one in silent))

    def _site(self, running: RunningSession | None) -> ArmingItem:
        try:
            self.refuse_arming(None if running is None else running.engine.status.source)
        except TidegateError as error:
            return ArmingItem(code="site", state="missing", text=str(error))
        if self.settings.qa_required_daily_h == 0.0:
            return ArmingItem(code="site", state="attention", text=NO_QA)
        return ArmingItem(code="site", state="ok", text="QA and camera latency as this site requires")


def _plan(detail: SessionDetail) -> ArmingItem:
    number = "" if detail.fraction_number is None else f" (no. {detail.fraction_number})"
    imported = "" if detail.rt_plan_id is None else ", from an imported RT Plan"
    return ArmingItem(
        code="plan", state="ok", text=f"{detail.plan_id}, fraction {detail.fraction_id}{number}{imported}"
    )


def _camera(detail: SessionDetail, running: RunningSession | None) -> ArmingItem:
    if running is None or detail.camera is None:
        return ArmingItem(code="camera", state="missing", text="not open")
    text = f"{detail.camera.name}, calibrated as {running.plan.calibration.camera}"
    source = running.engine.status.source
    uncompared = None if source is not None and source.is_live else NOT_COMPARED
    said = "; ".join(
        filter(None, [detail.camera.warning, detail.calibration_warning, detail.source_warning, uncompared])
    )
    return ArmingItem(code="camera", state="attention" if said else "ok", text=f"{text}: {said}" if said else text)


def _head(detail: SessionDetail, running: RunningSession | None) -> ArmingItem:
    if detail.head_direction is not None:
        text = f"at the {detail.head_direction} of the picture: arming confirms it"
        return ArmingItem(code="head_direction", state="ok", text=text)
    view = None if running is None else running.engine.status.view
    if view is not None and any(depends_on_head(choice) for choice in view.window.choices):
        text = "unknown: create the session with it, or gate on whole or volume"
        return ArmingItem(code="head_direction", state="missing", text=text)
    return ArmingItem(code="head_direction", state="ok", text="unknown; not needed for this window")


def _view(detail: SessionDetail) -> ArmingItem:
    texts = {
        "measuring": "the patient is measured",
        "training": "still training",
        "lost": "the patient is not visible",
        None: "no picture yet",
    }
    state = "ok" if detail.measurement_state == "measuring" else "missing"
    body = None if detail.body is None else detail.body.warning
    if state == "ok" and body is not None:
        return ArmingItem(code="view", state="attention", text=body)
    return ArmingItem(code="view", state=state, text=texts[detail.measurement_state])


def _model_text(model: Model) -> str:
    made = f"model {model.number} of {model.created_at:%H:%M} UTC"
    if model.training_frames is not None and model.cycles is not None:
        made += f", learned from {model.training_frames} frames, {model.cycles} breaths"
    if model.quality is None:
        return made
    quality = model.quality
    return (
        f"{made}; breathing {quality.amplitude_mm:.1f} mm, {100.0 * quality.explained_share:.1f} % explained, "
        f"residual {quality.residual_mm:.2f} mm"
    )


def _position(detail: SessionDetail) -> ArmingItem:
    found = detail.position_check
    if found is None:
        return ArmingItem(code="position", state="missing", text="not known until a frame was decided on")
    return ArmingItem(code="position", state="ok" if found.status in POSITION_OK else "missing", text=found.text)


def _countersignature(running: RunningSession | None) -> Iterator[ArmingItem]:
    """Yield who has countersigned, where the next arming needs it."""
    found = None if running is None else running.engine.status.countersignature
    if found is None or not found.is_required:
        return
    if found.signed_by is None:
        text = "a second person looks at window and reference, and signs"
        yield ArmingItem(code="countersignature", state="missing", text=text)
    else:
        yield ArmingItem(code="countersignature", state="ok", text=f"{found.signed_by}; another person arms")


def _gate(detail: SessionDetail) -> ArmingItem:
    gate = detail.gate
    if gate is None:
        return ArmingItem(code="gate", state="missing", text=f"the session is {detail.status}: it must be running")
    if gate.is_armed:
        return ArmingItem(code="gate", state="missing", text=f"armed already, by {gate.armed_by or 'unknown'}")
    if gate.state == "fault":
        return ArmingItem(code="gate", state="missing", text=f"a fault is latched ({gate.hold_text}): acknowledge it")
    if gate.operator_holds:
        holders = ", ".join(gate.operator_holds)
        return ArmingItem(code="gate", state="attention", text=f"held by {holders}: armed, it stays held")
    line = "SIMULATED beam line" if detail.is_simulated_beam else "beam line"
    return ArmingItem(code="gate", state="ok", text=f"{line}, disarmed")
