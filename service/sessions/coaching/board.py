"""The running session's coaching: its settings, and the newest message for the patient screens.

Reads what the engine has published and sends it nothing: no message and no setting can reach the gate.
"""

import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from engine.control import EngineStatus, LiveView
from engine.core.gate_state import GateState
from engine.gating import HoldStage
from service.core.errors import BoundError, SessionStateError
from service.core.schemas.coaching import Coaching, Language
from service.engine_host.protocols import LiveFrame, RunningSession
from service.sessions.coaching.guide import US_PER_S, GuideFrame, guide_frame, guided_by, span_of
from service.storage.audit import Event
from service.storage.audit.log import AuditLog

SET = "coaching.set"
ENDED_STAGES = frozenset({HoldStage.HELD, HoldStage.DRIFTED, HoldStage.OVER})


@dataclass(frozen=True, slots=True, kw_only=True)
class Guidance:
    """A frame as the patient screen shows it, with the settings in use."""

    frame: GuideFrame
    settings: Coaching


@dataclass(frozen=True, slots=True, kw_only=True)
class _Rest:
    """Whether the last measured frame was of a hold, and when that hold was over by the device's clock [us]."""

    was_held: bool = False
    since_us: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class _State:
    """Coaching of one session."""

    session_id: str = ""
    settings: Coaching = field(default_factory=Coaching)
    rest: _Rest = field(default_factory=_Rest)


class CoachingBoard:
    """Settings and guidance of the session that runs; any thread may call it.

    Parameters
    ----------
    running
        Returns a session if it runs, else raises SessionStateError or NotFoundError.
    """

    def __init__(self, *, running: Callable[[str], RunningSession], log: AuditLog) -> None:
        self._running, self._log = running, log
        self._changing = threading.Lock()
        self._state = _State()

    @property
    def language(self) -> Language:
        """Language of the session that ran last."""
        return self._state.settings.language

    def settings(self, session_id: str) -> Coaching:
        """Return the settings of the running session."""
        self._running(session_id)
        state = self._state
        return state.settings if state.session_id == session_id else Coaching()

    def set(self, session_id: str, wanted: Coaching, *, operator: str) -> Coaching:
        """Replace the settings of the running session, and audit both.

        Raises
        ------
        BoundError
            The band of a breath hold leaves the window, or the breathing range is not known yet.
        SessionStateError
            The session does not run, or practice was wanted while the gate is armed.
        """
        detail: dict[str, object] = {"before": self._of(session_id).settings.model_dump(), "after": wanted.model_dump()}
        with self._log.refusals(actor=operator, action=SET, session_id=session_id, detail=detail):
            status = self._running(session_id).engine.status
            _check_practice(status, wanted)
            _check_ranges(status, wanted)
        self._log.write(Event(actor=operator, action=SET, session_id=session_id, detail=detail))
        with self._changing:
            self._state = replace(self._of(session_id), settings=wanted)
        return wanted

    def end_practice(self, session_id: str) -> None:
        """End the practice of a session that is about to be armed; takes neither the database nor the engine."""
        with self._changing:
            self._state = _without_practice(self._of(session_id))

    def guidance(self, live: LiveFrame | None) -> Guidance | None:
        """Return what the screens show of the newest frame; None where they show nothing."""
        view = None if live is None or live.status is None else live.status.view
        if live is None or live.status is None or view is None:
            return None
        with self._changing:
            state = self._of(live.message.session_id)
            if view.is_armed:
                state = _without_practice(state)
            state = self._state = replace(state, rest=_followed(state.rest, view))
        if not _is_shown(live, state.settings):
            return None
        learned = live.status.learned_ranges.get(view.window.choices[0])
        is_resting = _is_resting(state, view.record.measurement.timestamp_us)
        frame = guide_frame(view, learned, state.settings, is_resting=is_resting)
        return Guidance(frame=frame, settings=state.settings)

    def _of(self, session_id: str) -> _State:
        """Return the state of a session: another session's is forgotten, except for the language."""
        state = self._state
        if state.session_id == session_id:
            return state
        return _State(session_id=session_id, settings=Coaching(language=state.settings.language))


def _is_shown(live: LiveFrame, settings: Coaching) -> bool:
    """Whether the patient is guided: the session runs, a reference is set, and the gate is armed or practised with."""
    if live.status is None or live.message.session_status != "running" or not live.status.learning.has_reference:
        return False
    is_fault = live.message.gate == GateState.FAULT.value
    return live.message.is_armed or (settings.is_practice and not is_fault)


def _followed(rest: _Rest, view: LiveView) -> _Rest:
    """Follow the breath hold from frame to frame: rest begins where a hold that had settled is over."""
    state, measurement = guided_by(view).state, view.record.measurement.as_gated
    if state is None or measurement.motion is None:
        return rest
    if state.stage in ENDED_STAGES:
        return _Rest(was_held=True)
    # An unusable frame interrupts the stage, not the hold: the level at which it settled is kept then.
    if rest.was_held and state.stage is HoldStage.AWAITED and state.settled_at is None:
        return _Rest(since_us=measurement.timestamp_us)
    return rest


def _is_resting(state: _State, now_us: int) -> bool:
    since_us = state.rest.since_us
    return since_us is not None and 0 <= now_us - since_us < state.settings.rest_s * US_PER_S


def _without_practice(state: _State) -> _State:
    if not state.settings.is_practice:
        return state
    return replace(state, settings=state.settings.model_copy(update={"is_practice": False}))


def _check_practice(status: EngineStatus, wanted: Coaching) -> None:
    if wanted.is_practice and status.view is not None and status.view.is_armed:
        msg = "practice is without beam: disarm the gate first"
        raise SessionStateError(
            msg, field="is_practice", value=wanted.is_practice, bound="false while the gate is armed"
        )


def _check_ranges(status: EngineStatus, wanted: Coaching) -> None:
    """Refuse per cent of a range that is not known, and a band in which the gate would not count a breath hold."""
    if wanted.band is None and wanted.scale is None:
        return
    name = "scale" if wanted.band is None else "band"
    learned = None if status.view is None else status.learned_ranges.get(status.view.window.choices[0])
    if status.view is None or learned is None:
        msg = "the breathing range is not known yet: set the reference first"
        raise BoundError(msg, field=name, value="given", bound="left out until the breathing range is known")
    guided = guided_by(status.view)
    if wanted.band is None or guided.hold is None or guided.edges is None:
        return
    band, lower, upper = span_of(wanted.band, learned), *map(learned.percent, guided.edges)
    if band.lower < guided.edges.lower or band.upper > guided.edges.upper:
        bound = f"inside the window of the breath hold: {lower:.0f} to {upper:.0f} %"
        value = f"{wanted.band.lower_percent:g} to {wanted.band.upper_percent:g} %"
        raise BoundError(f"the band must be {bound}", field="band", value=value, bound=bound)
