"""Measured latencies of cameras, written down as their runs would have been."""

import json
import uuid
from dataclasses import asdict
from datetime import UTC, datetime, timedelta

from engine.capture.source import SourceDescription
from service.storage.database.tables import QaOutcomeRow, QaResultRow, QaRunRow

NOW = datetime(2026, 11, 21, 12, 0, tzinfo=UTC)
CAMERA = SourceDescription(
    kind="openni", name="Xtion", depth_size=(640, 480), color_size=(640, 480), fps=30.0, is_live=True, serial="A1"
)
MODE = ("name", "serial", "depth_size", "color_size", "fps")


def put(
    database,
    *,
    median_ms=30.0,
    half_ms=5.0,
    age_days=10.0,
    camera=CAMERA,
    verdict="pass",
    status="finished",
    is_simulated=False,
    kind="latency",
    now=NOW,
):
    """Write a measurement down as it would have been so long ago; ``median_ms`` None is one without a number."""
    run_id = uuid.uuid4().hex
    began = now - timedelta(days=age_days)
    mode = {name: value for name, value in asdict(camera).items() if name in MODE}
    with database.write() as db:
        db.add(
            QaRunRow(
                **dict.fromkeys(("operator", "site", "machine"), "me"),
                id=run_id,
                kind=kind,
                request=json.dumps({"camera": mode}),
                bounds="{}",
                is_simulated=is_simulated,
                is_simulated_beam=False,
                plate_sha256=None,
                software="0",
                created_at=began,
            )
        )
        db.flush()
        if status == "finished":
            values = {"": median_ms, "_p95": median_ms, "_worst": median_ms, "_uncertainty": half_ms}
            for position, (end, value) in enumerate(values.items()):
                db.add(
                    QaResultRow(
                        run_id=run_id,
                        position=position,
                        code=f"camera_latency{end}_ms",
                        value=None if median_ms is None else value,
                        unit="ms",
                        warn=1.0,
                        fail=1.0,
                        verdict=verdict,
                        detail="",
                    )
                )
            db.flush()
        if status is not None:
            ended = {"verdict": verdict, "series": "[]", "sha256": "", "ended_at": began}
            db.add(QaOutcomeRow(run_id=run_id, status=status, status_detail="", **ended))
    return run_id
