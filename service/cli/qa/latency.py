"""``tidegate qa latency``: measure a camera's latency and store it with the other QA results."""

import secrets
import uuid
from typing import Any

from engine.capture import SourceDescription
from engine.qa import QaBaseline, QaKind, opened
from engine.qa.latency import SECONDS_BOUNDS
from service.cli.qa.options import LatencyOptions
from service.cli.qa.stored_run import BegunRun, carry_out, checked
from service.core.errors import BoundError
from service.core.settings.settings import Settings
from service.qa import queries
from service.qa.latency.rig import LatencyJob, LatencyRig
from service.qa.latency.schemas import CameraMode, LatencyRunRequest
from service.qa.queries import NewQaRun
from service.qa.runs import refuse_open_session
from service.qa.virtual_setups import virtual_setups
from service.storage.database.engine import Database

COMMAND = "qa latency"
MAX_VIRTUAL_DELAY_MS = 500.0


def measure_camera(options: LatencyOptions) -> str:
    """Measure, store, print and write the report; return the verdict, ``fail`` if the run was not completed."""

    def begin(settings: Settings, database: Database) -> BegunRun:
        _refuse_options(options, settings)
        request, job = _virtual(options) if options.is_simulated else _real(options, settings)
        run_id = uuid.uuid4().hex
        with database.write() as db:
            refuse_open_session(db)
            queries.begin(db, _new_run(run_id, request, options, settings))
        return BegunRun(run_id=run_id, job=job, baseline=QaBaseline())

    return carry_out(COMMAND, begin, data=options.data, out=options.out)


def _refuse_options(options: LatencyOptions, settings: Settings) -> None:
    """Refuse a simulation in clinical mode, a real beam that is not declared safe, and a light without a real line."""
    if options.is_simulated:
        if settings.mode == "clinical":
            raise _broken("simulated", "given", "omitted: clinical mode permits no simulation")
        if not 0.0 <= options.fault_delay_ms <= MAX_VIRTUAL_DELAY_MS:
            raise _broken("fault_delay_ms", options.fault_delay_ms, f"0 to {MAX_VIRTUAL_DELAY_MS:g}")
        return
    if not settings.has_real_beam:
        raise _broken("simulated", "missing", "given: a simulated beam line switches no light")
    if not options.is_safe:
        lines = " and ".join(settings.beam_lines)
        bound = (
            f"given: the light hangs on the output that permits the real beam ({lines}). Give it when the treatment "
            "room is empty and the accelerator is in a safe state"
        )
        raise _broken("yes-the-beam-is-safe", "missing", bound)


def _virtual(options: LatencyOptions) -> tuple[LatencyRunRequest, LatencyJob]:
    seed = 1 if options.seed is None else options.seed
    setups = virtual_setups("simulated")
    job = setups.latency_job(seed=seed, seconds=_seconds(options.seconds), delay_ms=options.fault_delay_ms)
    return _request(options, job.camera, seed, output_delay_ms=0.0), job


def _real(options: LatencyOptions, settings: Settings) -> tuple[LatencyRunRequest, LatencyJob]:
    rig = LatencyRig(settings)
    source = rig.camera(options.camera)
    with opened(source) as camera:
        pass
    seed = secrets.randbelow(2**31) if options.seed is None else options.seed
    request = _request(options, camera, seed, output_delay_ms=options.output_delay_ms)
    return request, rig.light_job(request, source, camera)


def _request(
    options: LatencyOptions, camera: SourceDescription, seed: int, *, output_delay_ms: float | None
) -> LatencyRunRequest:
    """Check the options by the schema, so that a refusal names the field and its bound."""
    fields: dict[str, Any] = {
        "operator": options.operator,
        "camera": CameraMode.of(camera).model_dump(),
        "seconds": options.seconds,
        "is_beam_safe": options.is_safe,
        "seed": seed,
        "note": options.note,
    }
    stated = {} if output_delay_ms is None else {"output_delay_ms": output_delay_ms}
    return checked(LatencyRunRequest, fields | stated)


def _seconds(seconds: float) -> float:
    low, high = SECONDS_BOUNDS
    if not low <= seconds <= high:
        raise _broken("seconds", seconds, f"{low:g} to {high:g}")
    return seconds


def _new_run(run_id: str, request: LatencyRunRequest, options: LatencyOptions, settings: Settings) -> NewQaRun:
    recorded = request.model_dump(mode="json", exclude_none=True, exclude={"operator"})
    return NewQaRun(
        run_id=run_id,
        kind=QaKind.LATENCY,
        operator=request.operator,
        request={**recorded, "beam_place": settings.beam_place},
        site=settings.site_name,
        machine=settings.machine_name,
        bounds=settings.qa_bounds,
        is_simulated=options.is_simulated,
        is_simulated_beam=settings.is_simulated_beam or options.is_simulated,
    )


def _broken(field: str, value: object, bound: str) -> BoundError:
    return BoundError(f"--{field.replace('_', '-')} must be {bound}", field=field, value=value, bound=bound)
