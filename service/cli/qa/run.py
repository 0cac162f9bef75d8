"""A QA run on the command line: the same as the service's, in the service's data folder."""

import uuid
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fastapi.exceptions import RequestValidationError
from pydantic import ValidationError
from sqlalchemy.orm import Session

from engine.calibration.camera_calibration import Calibration, load_calibration
from engine.core.errors import TidegateError
from engine.core.files import write_whole
from engine.verification.qa.results import QaNeed
from service.cli.qa.interruptible import interruptible
from service.cli.qa.tables import print_results
from service.cli.terminal import frame_bar, refused, say
from service.core.errors import BoundError
from service.core.settings.settings import Settings, SettingsError, load_settings
from service.engine_host.site_rules.uncalibrated import refuse_reserved_name
from service.qa import queries, schemas, views
from service.qa.archive import TREND_RUNS, close_interrupted
from service.qa.jobs import Handle, run_job
from service.qa.report.report import report_pdf
from service.qa.rig import EngineRig
from service.qa.roles import QaFiles
from service.qa.runs import check_beam_safety, new_run, permits_real_beam, refuse_open_session
from service.sessions.records.calibrations import ACTION as UPLOAD
from service.sessions.records.calibrations import kept_row
from service.storage.audit import Event
from service.storage.audit import append as append_audit
from service.storage.database.engine import Database
from service.storage.database.startup import prepare
from service.storage.files.folder_lock import alone_in
from service.web.problems.table import problem_of

STAGES = {
    QaNeed.PLATE: "plate, frames",
    QaNeed.PHANTOM: "phantom, frames",
    QaNeed.BEAM: "beam line, drills",
    QaNeed.CAMERA: "camera, frames",
}
CALIBRATION_NAME = "calibration.json"
DEVICE = "device"


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOptions:
    """The options of a run."""

    kind: schemas.Kind
    operator: str
    plate: str | None = None
    phantom: str | None = None
    trace: Path | None = None
    window: str | None = None
    calibration: Path | None = None
    part: float = 0.5
    seconds: float | None = None
    starts_us: int | None = None
    repeats: int = 20
    pulse_ms: float = 200.0
    is_safe: bool = False
    note: str = ""
    out: Path | None = None
    data: Path | None = None
    is_simulated: bool = False
    seed: int = 1
    fault_offset_mm: float = 0.0
    fault_delay_ms: float = 0.0
    fault_duty_percent: float = 0.0


def do_run(options: RunOptions) -> str:
    """Run, print and write the report; return the verdict, ``fail`` if the run was not completed."""
    command = f"qa {options.kind}"
    try:
        settings = load_settings(data_dir=options.data)
        with alone_in(settings.data_dir), closing(Database(settings.database_place)) as database:
            prepare(database, data_dir=settings.data_dir, min_free_disk_mb=settings.min_free_disk_mb)
            run = _carried_out(options, settings, database)
    except (SettingsError, TidegateError) as error:
        raise refused(command, error) from error
    except OSError as error:
        raise refused(command, f"{options.out} cannot be written ({error.strerror or error})") from error
    if run.status != "finished":
        say(f"tidegate {command}: {run.status}: {run.status_detail}", "red")
        return "fail"
    print_results(run)
    return run.verdict or "fail"


def _carried_out(options: RunOptions, settings: Settings, database: Database) -> schemas.QaRunDetail:
    calibration = None if options.is_simulated else _calibration(options)
    request = _request(options, calibration)
    check_beam_safety(request, settings)
    files = _files(options)
    job = EngineRig(settings).job(request, files, calibration)
    run_id = uuid.uuid4().hex
    close_interrupted(database)  # the folder's lock is held, so no other process has a run
    with database.write() as db:
        if permits_real_beam(request, settings):
            refuse_open_session(db)
        if calibration is not None:
            _keep(db, calibration, options)
        queries.begin(db, new_run(request, settings, run_id=run_id, calibration=calibration, files=files))
        baseline = job.own_baseline or queries.baseline_of(queries.newest_baseline(db))

    def end(outcome: queries.QaOutcome) -> None:
        with database.write() as db:
            queries.end(db, run_id, outcome)

    with interruptible(), frame_bar() as bar:
        tasks: dict[QaNeed, Any] = {}

        def show(stage: QaNeed, done: int, total: int | None) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(STAGES[stage], total=total)
            bar.update(tasks[stage], completed=done, total=total)

        run_job(job, Handle(job.line), bounds=settings.qa_bounds, baseline=baseline, on_end=end, also=show)
    return _kept(database, run_id, options)


def _kept(database: Database, run_id: str, options: RunOptions) -> schemas.QaRunDetail:
    """Read the run from the database, print it and write its report if one is requested."""
    with database.read() as db:
        row = queries.run_row(db, run_id)
        run = views.run_detail(db, row, is_under_way=False)
        if options.out is not None and run.status == "finished":
            trends = [views.trend_answer(db, one.code, TREND_RUNS, before=row) for one in run.results]
            options.out.parent.mkdir(parents=True, exist_ok=True)
            write_whole(options.out, report_pdf(run, trends))
            say(f"Written to {options.out}")
    return run


def _request(options: RunOptions, calibration: Calibration | None) -> schemas.QaRunRequest:
    """Build the request of the API from the options, so that the same bounds apply."""
    fields: dict[str, Any] = {
        "kind": options.kind,
        "operator": options.operator,
        "beam": {"repeats": options.repeats, "pulse_ms": options.pulse_ms},
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
    try:
        return schemas.QaRunRequest.model_validate(fields)
    except ValidationError as error:
        # Reported as in the API: the field and its bound.
        details = [{**one, "loc": ("body", *one["loc"])} for one in error.errors()]
        problem = problem_of(RequestValidationError(details))
        raise BoundError(problem.detail, field=problem.field, bound=problem.bound) from error


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
