"""A QA run on the command line: the same as the service's, in the service's data folder."""

import uuid
from pathlib import Path
from typing import Any

from sqlalchemy.orm import Session

from engine.calibration import Calibration, load_calibration
from service.cli.qa.options import RunOptions
from service.cli.qa.stored_run import BegunRun, carry_out, checked
from service.core.errors import BoundError
from service.core.settings.settings import Settings
from service.engine_host.site_limits.calibrations import refuse_reserved_name
from service.qa import queries, schemas
from service.qa.jobs import QaFiles
from service.qa.runs import check_beam_safety, new_run, permits_real_beam, refuse_open_session
from service.qa.virtual_setups import SimulatingRig
from service.sessions.records.calibrations import ACTION as UPLOAD, kept_row
from service.storage.audit import Event, append as append_audit
from service.storage.database.engine import Database

CALIBRATION_NAME = "calibration.json"
DEVICE = "device"


def do_run(options: RunOptions) -> str:
    """Run, print and write the report; return the verdict, ``fail`` if the run was not completed."""

    def begin(settings: Settings, database: Database) -> BegunRun:
        calibration = None if options.is_simulated else _calibration(options)
        request = _request(options, calibration)
        check_beam_safety(request, settings)
        files = _files(options)
        job = SimulatingRig(settings).job(request, files, calibration)
        run_id = uuid.uuid4().hex
        with database.write() as db:
            if permits_real_beam(request, settings):
                refuse_open_session(db)
            if calibration is not None:
                _keep(db, calibration, options)
            queries.begin(db, new_run(request, settings, run_id=run_id, calibration=calibration, files=files))
            baseline = job.own_baseline or queries.baseline_of(queries.newest_baseline(db))
        return BegunRun(run_id=run_id, job=job, baseline=baseline)

    return carry_out(f"qa {options.kind}", begin, data=options.data, out=options.out)


def _request(options: RunOptions, calibration: Calibration | None) -> schemas.QaRunRequest:
    """Build the request of the API from the options, so that the same bounds apply."""
    fields: dict[str, Any] = {
        "kind": options.kind,
        "operator": options.operator,
        "beam": {"repeats": options.repeats, "pulse_ms": options.pulse},
        "is_beam_safe": options.is_safe,
        "note": options.note,
    }
    seconds = {} if options.seconds is None else {"seconds": options.seconds}
    if options.is_simulated:
        faults = {
            "offset_mm": options.fault_offset_mm,
            "delay_ms": options.fault_delay_ms,
            "duty_change_percent": options.fault_duty_percent,
        }
        fields["simulation"] = {"seed": options.seed, "faults": faults}
    if options.plate is not None:
        fields["plate"] = {"source": _source(options.plate), "part": options.part, **seconds}
    if options.phantom is not None:
        fields["phantom"] = {"source": _source(options.phantom), **_trace(options), **_window(options), **seconds}
    if calibration is not None:
        fields["calibration_id"] = calibration.sha256[:32]
    return checked(schemas.QaRunRequest, fields)


def _source(text: str) -> dict[str, Any]:
    if text == DEVICE or text.startswith(f"{DEVICE}:"):
        address = text.removeprefix(DEVICE).removeprefix(":")
        return {"kind": "device", **({"uri": address} if address else {})}
    return {"kind": "recording", "path": text}


def _trace(options: RunOptions) -> dict[str, Any]:
    if options.trace is None:
        msg = "--trace is missing: the motion that the phantom executed"
        raise BoundError(msg, field="trace", bound="given with --phantom")
    return {"trace": str(options.trace), **({} if options.starts_us is None else {"starts_us": options.starts_us})}


def _window(options: RunOptions) -> dict[str, float]:
    try:
        lower, upper = (float(part) for part in (options.window or "").split(":"))
    except ValueError as error:
        msg = f"--window is {options.window!r}: must be LOWER:UPPER, two numbers in mm"
        raise BoundError(msg, field="window", value=options.window, bound="LOWER:UPPER") from error
    return {"window_lower_mm": lower, "window_upper_mm": upper}


def _files(options: RunOptions) -> QaFiles:
    return QaFiles(plate=_path(options.plate), phantom=_path(options.phantom), trace=options.trace)


def _path(text: str | None) -> Path | None:
    return None if text is None or _source(text)["kind"] == "device" else Path(text)


def _calibration(options: RunOptions) -> Calibration | None:
    plate = _path(options.plate)
    if options.calibration is None and plate is None:
        return None
    path = options.calibration if options.calibration is not None else _beside(plate)
    calibration = load_calibration(path)
    refuse_reserved_name(calibration)
    return calibration


def _beside(plate: Path | None) -> Path:
    assert plate is not None, "without a recording the calibration is given"
    return plate.parent / CALIBRATION_NAME


def _keep(db: Session, calibration: Calibration, options: RunOptions) -> None:
    """Store the calibration in the database, so that the results of the run can be recomputed."""
    row, is_known = kept_row(db, calibration, options.operator)
    if not is_known:
        detail = {"calibration_id": row.id, "sha256": row.sha256, "camera": row.camera, "is_new": True}
        append_audit(db, Event(actor=options.operator, action=UPLOAD, detail=detail))
