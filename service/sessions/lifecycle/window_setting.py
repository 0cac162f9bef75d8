"""Another window for a running session, while its gate is disarmed: checked as at its creation, audited and stored.

A correction of the window by a baseline drift, checked against the present drift: it may have changed meanwhile.

The window never follows the patient automatically. A person states the shift and the drift that was displayed; the
engine shifts the window and disarms, and the audit records the drift and both windows.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from engine.control import LiveView
from engine.core.errors import CommandRefusedError, InvalidValueError, ReferenceDistanceError
from engine.core.sentences import say
from engine.gating import GateLimits, SetWindow
from service.core.errors import BoundError
from service.core.schemas import sessions
from service.core.schemas.gate import BaselineCorrectionRequest
from service.core.schemas.windows import Window
from service.core.settings.settings import Settings
from service.engine_host.equipment import EquipmentSlot
from service.engine_host.protocols import RunningEngine, SessionPlan
from service.engine_host.site_limits.window_limits import check_window, gate_limits
from service.sessions.lifecycle.commands import EngineCommander
from service.sessions.views.breath import gated_breath, live_window
from service.storage.database import queries
from service.storage.database.engine import Database

TOLERANCE_MM = 1.0
"""How far the drift may differ from the one that was displayed; of the volume a tenth of a litre for each mm."""

MOVED_WITHIN_S = 0.3
POLL_S = 0.02
ACTION = "session.window"


def check_correction(request: BaselineCorrectionRequest, view: LiveView | None, settings: Settings) -> None:
    """Refuse a correction that is too large, in the wrong unit, or of a drift that is not there.

    Raises
    ------
    BoundError
        Beyond the site's bound, or not towards the drift that was seen.
    CommandRefusedError
        The drift is not known now, or is another by now.
    """
    if view is None:
        raise CommandRefusedError(say("no frame has come yet"))
    choice = view.window.choices[0]
    unit, tolerance = choice.unit, TOLERANCE_MM * choice.per_mm
    if request.unit != unit:
        raise _broken(f"by_{request.unit}", request.by, f"left out: the window is on {choice.label}, give it in {unit}")
    reach = settings.max_baseline_correction_mm * choice.per_mm
    if abs(request.by) > reach:
        raise _broken(f"by_{unit}", request.by, f"from {-reach:g} to {reach:g}, this site's limit")
    if request.by * request.drift_seen < 0.0 or abs(request.by) > abs(request.drift_seen) + tolerance:
        raise _broken(f"by_{unit}", request.by, f"from 0 to the drift that was seen ({request.drift_seen:g})")
    drift = known_drift(view)
    if drift is None:
        raise CommandRefusedError(
            say("the drift of the baseline is not known now: let the patient breathe, and look again")
        )
    if abs(drift - request.drift_seen) > tolerance:
        msg = say(
            "the drift is {drift:.2f} {unit} by now, not {drift_seen:g}: look again",
            drift=drift,
            unit=unit,
            drift_seen=request.drift_seen,
        )
        raise CommandRefusedError(msg)


@contextmanager
def naming_the_field(request: BaselineCorrectionRequest) -> Iterator[None]:
    """Put the request's field into the engine's refusal, which names only ``by``."""
    try:
        yield
    except InvalidValueError as error:
        if error.field != "by":
            raise
        raise _broken(f"by_{request.unit}", request.by, error.bound) from error
    except ReferenceDistanceError as error:
        raise ReferenceDistanceError(f"by_{request.unit}", error.value, error.bound, error.advice) from error


def known_drift(view: LiveView) -> float | None:
    """Return how far the baseline of the gated signal is from where it was learned."""
    breath = gated_breath(view.record.measurement.breaths, view.window.choices[0])
    return None if breath is None else breath.drift


def correction_detail(request: BaselineCorrectionRequest, view: LiveView | None) -> dict[str, object]:
    """Return what the audit records of the request: the shift, the drift and the window before."""
    return {
        "by": request.by,
        "unit": request.unit,
        "drift_seen": request.drift_seen,
        "reason": request.reason,
        "drift_known": None if view is None else known_drift(view),
        "window_before": None if view is None else window_detail(view),
    }


def moved_window(engine: RunningEngine, before: LiveView | None) -> dict[str, object]:
    """Return the shifted window for the audit; waits up to 0.3 s for the frame that has it."""
    end_s = time.monotonic() + MOVED_WITHIN_S
    while time.monotonic() < end_s:
        view = engine.status.view
        if view is not None and before is not None and view.window != before.window:
            return {"window_after": window_detail(view)}
        time.sleep(POLL_S)
    view = engine.status.view
    return {"window_after": None if view is None else window_detail(view)}


def window_detail(view: LiveView) -> list[dict[str, object]]:
    """Return the window as the gate applies it, without the state of its conditions."""
    state = {"is_inside", "stage", "seen_share"}
    return [
        one.model_dump(mode="json", exclude=state, exclude_none=True) for one in live_window(view.window).conditions
    ]


def _broken(field: str, value: float, bound: str) -> BoundError:
    return BoundError(f"{field} must be {bound}", field=field, value=value, bound=bound)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WindowSetting:
    """Sets the windows of running sessions."""

    commander: EngineCommander
    equipment: EquipmentSlot
    database: Database
    settings: Settings

    def set_window(self, session_id: str, operator: str, request: sessions.WindowRequest, *, may_exceed: bool) -> None:
        """Have the engine gate by the window, then store it as the session's.

        Raises
        ------
        BoundError, InvalidValueError
            Wider than the site allows, or on other signals than the session's window.
        CommandRefusedError
            The gate is armed.
        ReferenceDistanceError
            Beyond the fraction's budget, without a person's reason.
        SessionStateError
            The session does not run.
        """
        window, reason = request.window, request.reason.strip()
        running = self.equipment.of(session_id)
        before = None if running is None else running.engine.status.view
        detail: dict[str, object] = {
            "window": window.model_dump(mode="json", exclude_none=True),
            "window_before": None if before is None else window_detail(before),
        } | ({"reason": reason} if reason else {})
        log = self.commander.log
        with log.refusals(actor=operator, action=ACTION, session_id=session_id, detail=detail):
            plan = self.commander.running(session_id).plan
            limits = self._checked(window, plan)
        command = SetWindow(
            operator=operator,
            window=limits.window,
            dwell_ms=limits.dwell_ms,
            min_on_ms=limits.min_on_ms,
            min_off_ms=limits.min_off_ms,
            max_cycles_per_min=limits.max_cycles_per_min,
            reason=reason,
            may_exceed=may_exceed,
        )

        def store(engine: RunningEngine) -> dict[str, object]:
            return self._store(session_id, window, engine, before)

        self.commander.execute(session_id, command, operator, ACTION, detail, after=store)

    def _checked(self, window: Window, plan: SessionPlan) -> GateLimits:
        check_window(window, self.settings)
        return gate_limits(window, self.settings, plan.regions)

    def _store(
        self, session_id: str, window: Window, engine: RunningEngine, before: LiveView | None
    ) -> dict[str, object]:
        with self.database.write() as db:
            queries.session_row(db, session_id).window = window.model_dump_json()
        return moved_window(engine, before)
