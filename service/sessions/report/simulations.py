"""The simulation day of a plan: the breathing that the plan was made on, signed by a person, shown beside today's.

It is a session of that day, or a file of another system. Of a session with a confirmed reference the position enters
the next start, as the plan's position: it is compared in six degrees of freedom where camera, calibration and regions
are the same, and a person signs it before arming (:mod:`service.sessions.views.position`). Nothing else is applied.
"""

import hashlib
import tempfile
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from engine.core.errors import InvalidValueError, RecordingError
from engine.core.frames import FloatArray
from service.core.errors import BoundError, NotFoundError
from service.core.identity import identity_key
from service.core.schemas.simulations import Simulation, SimulationRequest
from service.core.schemas.windows import Window
from service.sessions.lifecycle.commands import state_error
from service.sessions.report.exports import SessionExports
from service.storage import audit
from service.storage.audit import Event
from service.storage.audit.log import AuditLog
from service.storage.database import queries
from service.storage.database.engine import Database

ACTION = "session.simulation"
SHOWN_RATE, SHOWN_S = 10.0, 59.9
LEVELS = (1.0, 99.0)
FIELD = "session_id"
FILE = "waveform.dcm of a Tidegate, or a .vxp"
DICOM_AT, DICOM_MARK = 128, b"DICM"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Day:
    """What was read: n values [mm] at times [s]; whom of; where the beam was on; the window in mm or per cent."""

    origin: Literal["session", "dicom", "vxp"]
    patient: str
    signal: str
    time_s: FloatArray
    motion_mm: FloatArray
    is_on: npt.NDArray[np.bool_]
    begun_at: datetime | None = None
    window: Window | None = None
    has_position: bool = False


class SimulationDays:
    """Takes simulation days, and finds the one of a session's plan."""

    def __init__(self, database: Database, exports: SessionExports, log: AuditLog) -> None:
        self._database, self._exports, self._log = database, exports, log

    def of(self, session_id: str) -> Simulation:
        """Return the simulation day of a session's plan; raise NotFoundError without one."""
        with self._database.read() as db:
            document = queries.simulation_of(db, queries.session_row(db, session_id))
        if document is None:
            msg = "no simulation day was signed for this plan"
            raise NotFoundError(msg, field="simulation", value=session_id)
        return Simulation.model_validate_json(document)

    def sign(self, session_id: str, request: SimulationRequest, actor: str, *, confirmed_by: str) -> Simulation:
        """Take a simulation day for a session that is not started, and for the later ones of its plan.

        Raises
        ------
        SessionStateError
            The session was started; the other one is not over, or has no samples.
        BoundError, InvalidValueError
            It is of another patient or names none; the file cannot be read; it has fewer than two breaths.
        """
        asked = {"simulation_session_id": request.session_id, "signal": request.signal, "confirmed_by": confirmed_by}
        with self._log.refusals(actor=actor, action=ACTION, session_id=session_id, detail=asked):
            with self._database.read() as db:
                row = queries.session_row(db, session_id)
                patient, status = row.patient_reference, row.status
            if status != "created":
                raise state_error(status, "created")
            day = self._session(request) if request.content is None else _file(request.content, request.signal)
            if identity_key(day.patient) != identity_key(patient):
                field, value = (
                    ("file", "of another patient") if request.session_id is None else (FIELD, request.session_id)
                )
                raise _refusal(field, value, "of this session's patient, and name him")
            found = _described(day, request, session_id, actor, confirmed_by)
            with self._database.write() as db:
                row = queries.session_row(db, session_id)
                if row.status != "created":
                    raise state_error(row.status, "created")
                row.simulation = found.model_dump_json()
                detail = found.model_dump(mode="json", exclude={"trace", "of_session", "signed_by", "signed_at"})
                audit.append(db, Event(actor=actor, action=ACTION, session_id=session_id, detail=detail))
        return found

    def _session(self, request: SimulationRequest) -> _Day:
        other, signal = request.session_id or "", request.signal or "whole"
        curve = self._exports.curve(other)
        with self._database.read() as db:
            row = queries.session_row(db, other)
            return _Day(
                origin="session",
                patient=row.patient_reference,
                signal=signal,
                time_s=curve.time_s,
                motion_mm=curve.motion_mm[signal],
                is_on=curve.gates == "beam_on",
                begun_at=curve.begun_at,
                window=Window.model_validate_json(row.window),
                has_position=row.first_reference is not None,
            )


def _file(content: bytes, signal: str | None) -> _Day:
    is_dicom = content[DICOM_AT : DICOM_AT + len(DICOM_MARK)] == DICOM_MARK
    return _dicom(content, signal) if is_dicom else _vxp(content)


def _dicom(content: bytes, signal: str | None) -> _Day:
    from service.exchange.dicom import read_waveform  # with pydicom, which nothing else of a running service needs

    try:
        found = read_waveform(content)
    except Exception as error:  # pydicom raises whatever a foreign file provokes
        raise _refusal("file", type(error).__name__, FILE) from error
    chosen = signal or "abdomen"
    if chosen not in found.motion_mm:
        raise _refusal("signal", chosen, f"{' or '.join(found.motion_mm)} of waveform.dcm")
    return _Day(
        origin="dicom",
        patient=found.patient_id,
        signal=chosen,
        time_s=found.time_s,
        motion_mm=found.motion_mm[chosen],
        is_on=found.is_on,
        begun_at=found.begun_at,
    )


def _vxp(content: bytes) -> _Day:
    from engine.qa import read_trace

    with tempfile.TemporaryDirectory(prefix="tidegate-") as folder:
        path = Path(folder) / "file"
        path.write_bytes(content)
        try:
            trace = read_trace(path)
        except RecordingError as error:
            raise _refusal("file", str(error), FILE) from error
    if trace.kind != "rpm":
        raise _refusal("file", trace.kind, FILE)
    return _Day(
        origin="vxp",
        patient=trace.patient_id,
        signal="rpm",
        time_s=trace.time_s,
        motion_mm=trace.motion_mm,
        is_on=trace.is_on,
    )


def _described(day: _Day, request: SimulationRequest, session_id: str, actor: str, confirmed_by: str) -> Simulation:
    from service.exchange.four_d_ct import breaths_of  # with scipy, which nothing else of a running service needs

    breaths = breaths_of(day.time_s, day.motion_mm)
    low, high = (float(np.nanmedian(day.motion_mm[at])) for at in (breaths.exhale, breaths.inhale))
    if not low < high:
        raise InvalidValueError("motion_mm", f"{low:.2f} to {high:.2f} mm", "breaths that are measured at their ends")
    lower, upper, source = _edges(day, low, high)
    return Simulation(
        of_session=session_id,
        origin=day.origin,
        session_id=request.session_id,
        file_sha256=None if request.content is None else hashlib.sha256(request.content).hexdigest(),
        begun_at=day.begun_at,
        signal=day.signal,
        peak_to_peak_mm=round(float(np.nanmax(day.motion_mm) - np.nanmin(day.motion_mm)), 2),
        end_exhale_mm=round(low, 2),
        end_inhale_mm=round(high, 2),
        period_s=round(float(np.median(np.diff(day.time_s[breaths.inhale]))), 2),
        lower_percent=lower,
        upper_percent=upper,
        window_from=source,
        has_position=day.has_position,
        trace=_shown(day),
        signed_by=actor,
        signed_at=datetime.now(UTC),
        confirmed_by="login" if confirmed_by == "login" else "password",
    )


def _refusal(field: str, value: str, bound: str) -> BoundError:
    return BoundError(f"{field} must be {bound}", field=field, value=value, bound=bound)


def _edges(day: _Day, low: float, high: float) -> tuple[float | None, float | None, Literal["window", "beam", "none"]]:
    """Return the window in per cent of the breath, and what says so: one condition of the session, or the beam."""
    conditions = [] if day.window is None else [one for _, one in day.window.conditions()]
    if len(conditions) == 1 and conditions[0].kind == "amplitude" and conditions[0].signal == day.signal:
        (one,) = conditions
        if one.lower_percent is not None and one.upper_percent is not None:
            return one.lower_percent, one.upper_percent, "window"
        if one.lower_mm is not None and one.upper_mm is not None:
            return _percent(one.lower_mm, low, high), _percent(one.upper_mm, low, high), "window"
    known = day.motion_mm[day.is_on & np.isfinite(day.motion_mm)]
    if len(known) == 0:
        return None, None, "none"
    lower, upper = (_percent(float(edge), low, high) for edge in np.percentile(known, LEVELS))
    return lower, upper, "beam"


def _percent(level_mm: float, low: float, high: float) -> float:
    return round(100.0 * (level_mm - low) / (high - low), 1)


def _shown(day: _Day) -> list[list[float]]:
    """Return the last minute, ten values a second; what was not measured is left out."""
    known = np.isfinite(day.motion_mm)
    time_s, motion_mm = day.time_s[known], day.motion_mm[known]
    at = np.arange(max(float(time_s[0]), float(time_s[-1]) - SHOWN_S), float(time_s[-1]), 1.0 / SHOWN_RATE)
    near = np.unique(np.searchsorted(time_s, at))
    return [[round(float(time_s[i] - at[0]), 2), round(float(motion_mm[i]), 2)] for i in near]
