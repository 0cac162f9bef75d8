"""Small groups of settings: connections, plans, the room, replay, idempotency keys, the live stream."""

from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, StringConstraints, model_validator
from pydantic_settings import BaseSettings

from engine.core.head_direction import HeadDirection
from service.core.settings.connection_limits import CONNECTION_BOUNDS, LIMIT_NAMES, ConnectionLimits

# Settings of connections: time limits, sizes and numbers; see docs/3-operate/security.md.


def _limit(name: str, description: str) -> Any:  # noqa: ANN401 - a field of any number's type
    low, high = CONNECTION_BOUNDS[name]
    return Field(default=getattr(ConnectionLimits(), name), ge=low, le=high, description=description)


class ConnectionSettings(BaseSettings):
    """Bounds of every connection."""

    http_header_s: float = _limit("header_s", "A request's headers have to be complete within this time")
    http_body_s: float = _limit("body_s", "A request's body has to be complete within this time behind its headers")
    http_keep_alive_s: float = _limit("keep_alive_s", "A connection without a request is closed after this time")
    http_write_s: float = _limit("write_s", "A client that reads nothing for this time is disconnected")
    http_handshake_s: float = _limit("handshake_s", "The TLS handshake has to be complete within this time")
    http_max_connections: int = _limit(
        "max_connections",
        "Beyond this number the connection whose client was waited for longest is closed; unauthenticated ones first",
    )
    http_max_connections_per_address: int = _limit(
        "max_connections_per_address", "The same per address; trusted proxies are not limited"
    )
    http_max_header_bytes: int = _limit("max_header_bytes", "Size of a request's headers")
    http_max_headers: int = _limit("max_headers", "Number of header lines of a request")
    http_max_url_bytes: int = _limit("max_url_bytes", "Size of path and query")

    @property
    def connection_limits(self) -> ConnectionLimits:
        """The limits as one value, for the web server."""
        return ConnectionLimits(**{name: getattr(self, f"http_{name}") for name in LIMIT_NAMES})


# Settings of RT Plans: their largest size, and the patient's reference.

SHORTEST_KEY_BYTES = 32
LONGEST_KEY_BYTES = 4_096


class PlanSettings(BaseSettings):
    """Settings of RT Plans (docs/4-integrate/plans.md)."""

    max_plan_bytes: int = Field(
        default=8_388_608,
        ge=65_536,
        le=67_108_864,
        description="Largest RT Plan; other request bodies have a lower limit",
    )
    plan_patient: Literal["id", "hash"] = Field(
        default="id", description="Patient reference of a plan: the Patient ID, or a keyed hash of it"
    )
    plan_patient_key: Path | None = Field(
        default=None, description="File of 32 bytes or more, the key of the hash; only with hash"
    )

    @model_validator(mode="after")
    def _has_key(self) -> Self:
        if (self.plan_patient == "hash") != (self.plan_patient_key is not None):
            msg = "TIDEGATE_PLAN_PATIENT_KEY must be a file with plans.plan_patient=hash, and left out with id"
            raise ValueError(msg)
        _ = self.plan_patient_secret
        return self

    @property
    def plan_patient_secret(self) -> bytes | None:
        """Key of the hash of Patient IDs, read from its file at each call; None without hash."""
        if self.plan_patient_key is None:
            return None
        try:
            with self.plan_patient_key.open("rb") as file:
                secret = file.read(LONGEST_KEY_BYTES + 1).strip()
        except OSError as error:
            msg = f"TIDEGATE_PLAN_PATIENT_KEY cannot be read: {error.strerror}"
            raise ValueError(msg) from error
        if not SHORTEST_KEY_BYTES <= len(secret) <= LONGEST_KEY_BYTES:
            msg = f"TIDEGATE_PLAN_PATIENT_KEY must hold {SHORTEST_KEY_BYTES} to {LONGEST_KEY_BYTES} bytes"
            raise ValueError(msg)
        return secret


# Settings of the treatment room: its name, and how the camera's picture lies relative to the couch.

RoomName = Annotated[str, StringConstraints(max_length=32, pattern=r"^([A-Za-z0-9][A-Za-z0-9-]*)?$")]
"""1 to 32 letters, digits and dashes; empty is a room without a name."""


class RoomSettings(BaseSettings):
    """The room; see docs/2-clinical/motion.md."""

    room: RoomName = Field(
        default="",
        description="The room's name, 1 to 32 letters, digits and dashes: on the page, in stream, metrics, log, audit, "
        "backups and the names of cookies",
    )
    camera_uri: str = Field(
        default="",
        max_length=255,
        description="The room's camera, as `GET /devices` names it or the beginning of that, e.g. 1d27/0609@1: "
        "sessions open no other one; default: the session's choice, the first one where it makes none",
    )
    gantry_side: HeadDirection | None = Field(
        default=None,
        description="Side of the camera's picture towards the gantry, where the head of a head-first patient lies: "
        "top, bottom, left or right. A session's head direction and a plan's Patient Position are compared with it",
    )


# Settings of raw recordings.


class ReplaySettings(BaseSettings):
    """Raw recordings of sessions on a camera; see docs/3-operate/replay.md."""

    record_raw: bool = Field(
        default=False, description="Record every frame of a live camera, so that the session can be replayed"
    )
    raw_min_free_mb: float = Field(
        default=2_000.0,
        ge=500.0,
        le=1_000_000.0,
        description="A raw recording ends when less disk space than this is free",
    )


# Settings of the HTTP contract.


class ContractSettings(BaseSettings):
    """Lifetime of Idempotency-Keys."""

    idempotency_days: float = Field(
        default=7.0,
        ge=1.0,
        le=365.0,
        description="Lifetime of an Idempotency-Key; after it the key is treated as new",
    )


class StreamSettings(BaseSettings):
    """Limits of the live stream's clients; see docs/4-integrate/stream.md."""

    max_live_clients: int = Field(
        default=256, ge=1, le=1024, description="Maximum number of clients, WebSockets and event streams together"
    )
    live_stall_s: float = Field(
        default=5.0, ge=0.5, le=60.0, description="A client that reads nothing for this time is disconnected"
    )
    live_resume_s: float = Field(
        default=600.0,
        ge=0.0,
        le=600.0,
        description="Longest part of the record that is resent to a client that reconnects",
    )
