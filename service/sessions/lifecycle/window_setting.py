"""Another window for a running session, while its gate is disarmed: checked as at its creation, audited and stored."""

from dataclasses import dataclass

from engine.control import LiveView
from engine.gating import GateLimits, SetWindow
from service.core.schemas import sessions
from service.core.schemas.windows import Window
from service.core.settings.settings import Settings
from service.engine_host.equipment import EquipmentSlot
from service.engine_host.roles import RunningEngine, SessionPlan
from service.engine_host.site_rules.window_limits import check_window, gate_limits
from service.sessions.lifecycle.baseline_correction import moved_window, window_detail
from service.sessions.lifecycle.commands import EngineCommander
from service.storage.database import queries
from service.storage.database.engine import Database

ACTION = "session.window"


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
