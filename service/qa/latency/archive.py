"""The cameras' latencies as the API and the command line list them."""

from dataclasses import fields
from datetime import UTC, datetime

from sqlalchemy.orm import Session

from service.core.settings.settings import Settings
from service.qa.latency import schemas
from service.qa.latency.records import newest_latencies
from service.qa.latency.requirement import unfit


def latency_list(db: Session, settings: Settings) -> schemas.CameraLatencyList:
    """Return the newest latency of each camera and mode, each with why clinical mode would refuse it."""
    now = datetime.now(UTC)
    return schemas.CameraLatencyList(
        configured_ms=settings.camera_latency_ms,
        max_age_days=settings.qa_latency_max_age_days,
        items=[
            schemas.CameraLatency(
                **{field.name: getattr(one, field.name) for field in fields(one)},
                counted_ms=one.counted_ms,
                refusal=unfit(one, settings, now),
            )
            for one in newest_latencies(db)
        ],
    )
