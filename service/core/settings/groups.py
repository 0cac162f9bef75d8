"""Small groups of settings: connections, plans, the room, replay, idempotency keys, the live stream, audit, disk.

Monitoring is log format and level, certificate warning and readiness cache; limits of connections are times, sizes and
numbers.
"""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import Field, SecretStr, StringConstraints, model_validator
from pydantic_settings import BaseSettings

from engine.capture import CameraOptions
from engine.core.signals import HeadDirection
from service.core.settings.database_place import place_of

if TYPE_CHECKING:  # the engine's process does without SQLAlchemy
    from sqlalchemy import URL

CONNECTION_BOUNDS = {
    "header_s": (1.0, 60.0),
    "body_s": (1.0, 600.0),
    "keep_alive_s": (1.0, 300.0),
    "write_s": (1.0, 600.0),
    "handshake_s": (1.0, 60.0),
    "max_connections": (64, 16_384),
    "max_connections_per_address": (16, 16_384),
    "max_header_bytes": (4_096, 65_536),
    "max_headers": (16, 256),
    "max_url_bytes": (1_024, 16_384),
}
SHORTEST_KEY_BYTES = 32
LONGEST_KEY_BYTES = 4_096
RoomName = Annotated[str, StringConstraints(max_length=32, pattern=r"^([A-Za-z0-9][A-Za-z0-9-]*)?$")]
"""1 to 32 letters, digits and dashes; empty is a room without a name."""
ANCHOR_NAME = "audit-anchors.jsonl"
LogFormat = Literal["text", "json"]
LogLevel = Literal["debug", "info", "warning", "error"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ConnectionLimits:
    """Limits of every connection.

    Attributes
    ----------
    header_s
        From a connection's begin, or from a further request's first byte, to the end of its headers.
    body_s
        From the end of the headers to the end of the body.
    keep_alive_s
        Between an answer and the next request.
    write_s
        For which a client may leave what was sent to it unread.
    handshake_s
        For TLS.
    max_connections, max_connections_per_address
        Beyond them the connection goes that has been waited for longest: for a request, the rest of one, or for its
        client to read; unauthenticated ones first. One with a request in progress is never closed for another.
    """

    header_s: float = 10.0
    body_s: float = 30.0
    keep_alive_s: float = 5.0
    write_s: float = 20.0
    handshake_s: float = 10.0
    max_connections: int = 2048
    max_connections_per_address: int = 512
    max_header_bytes: int = 16_384
    max_headers: int = 64
    max_url_bytes: int = 4_096


LIMIT_NAMES = tuple(one.name for one in fields(ConnectionLimits))


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


# Settings of the camera itself.
class CameraSettings(BaseSettings):
    """How the room's camera is set, and how long it runs; see docs/3-operate/cameras.md."""

    warm_up_min: float | None = Field(
        default=None,
        ge=0.0,
        le=240.0,
        description="How long a cold camera runs before the beam may be on; by default its kind's: 15 structured "
        "light, 30 active stereo, 45 time of flight. A camera that stops cools down as fast",
    )
    keep_warm_min: float = Field(
        default=60.0,
        ge=0.0,
        le=1_440.0,
        description="How long after a session the camera goes on running, so that the next one need not wait; its "
        "pictures are dropped. 0 stops it with the session",
    )

    depth_preset: str | None = Field(
        default=None,
        max_length=64,
        description="Preset of the camera's maker, such as high-accuracy; by default the camera's own",
    )
    depth_exposure_us: int | None = Field(
        default=None,
        ge=1,
        le=200_000,
        description="Exposure of the depth pictures; by default found by the camera in its first second, and kept",
    )
    laser_percent: float | None = Field(
        default=None, ge=0.0, le=100.0, description="Power of the projector, as a share of its most; by default its own"
    )

    @property
    def camera_options(self) -> CameraOptions:
        """How the camera is set."""
        return CameraOptions(
            preset=self.depth_preset, exposure_us=self.depth_exposure_us, laser_percent=self.laser_percent
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


class AuditSettings(BaseSettings):
    """Settings of the audit; a part of :class:`service.core.settings.settings.Settings`."""

    data_dir: Path = Path("data")
    audit_anchor_file: Path | None = Field(
        default=None,
        description="File of the audit's anchors, best on another machine's share; default: audit-anchors.jsonl in the "
        "data folder",
    )
    audit_anchor_interval_s: float = Field(
        default=60.0, ge=1.0, le=3600.0, description="Longest interval between anchors while rows are added"
    )
    audit_clock_jump_ms: float = Field(
        default=500.0,
        ge=10.0,
        le=60_000.0,
        description="Change of the wall clock against the monotonic clock beyond which the audit records it as set",
    )
    audit_log_dir: Path | None = Field(
        default=None, description="Audit rows also as JSON lines in this folder, for the site's log collector"
    )
    audit_log_max_mb: int = Field(
        default=10, ge=1, le=1000, description="Size beyond which a file is followed by another [MB]"
    )
    audit_log_files: int = Field(default=5, ge=1, le=100, description="Files that are kept")
    audit_log_patients: bool = Field(default=False, description="The files contain details that name a patient")

    @property
    def anchor_file(self) -> Path:
        """The file of anchors."""
        return self.audit_anchor_file or self.data_dir / ANCHOR_NAME


class MonitoringSettings(BaseSettings):
    """Log and readiness; see docs/3-operate/monitoring.md."""

    log_format: LogFormat = Field(
        default="text", description="text for a terminal, json for a collector: one object per line"
    )
    log_level: LogLevel = Field(
        default="warning",
        description="Lowest level of Tidegate's log records; info has one line per request. Libraries"
        " log from warning on",
    )
    certificate_warn_days: int = Field(
        default=30, ge=1, le=365, description="`/readyz` warns this long before the TLS certificate expires"
    )
    readiness_keep_ms: float = Field(
        default=1_000.0, ge=0.0, le=10_000.0, description="Time for which an answer of `/readyz` is cached"
    )


# Which database a site uses: the part of the settings that begins with ``database_``.
class DatabaseSettings(BaseSettings):
    """The settings of the database; a part of :class:`service.core.settings.settings.Settings`."""

    data_dir: Path = Path("data")
    database_url: SecretStr | None = Field(
        default=None,
        min_length=1,
        max_length=2048,
        description="postgresql://USER@HOST/DATABASE; the SQLite file tidegate.db in the data folder when left out",
    )
    database_password_file: Path | None = Field(
        default=None, description="File that holds the password of database_url, in one line"
    )

    @model_validator(mode="after")
    def _is_a_place(self) -> Self:
        _ = self.database_place
        return self

    @property
    def database_place(self) -> "Path | URL":
        """What :class:`service.storage.database.engine.Database` opens; the password is in it, for the driver alone."""
        return place_of(self.database_url, self.database_password_file, self.data_dir)


class StorageSettings(BaseSettings):
    """Retention, quota, and free space for a new session."""

    retain_samples_days: int = Field(
        default=0, ge=0, le=36_500, description="Samples of sessions that ended longer ago are removed; 0 keeps them"
    )
    retain_raw_days: int = Field(
        default=0, ge=0, le=36_500, description="Raw recordings of such sessions are removed; 0 keeps them"
    )
    data_quota_gb: float = Field(
        default=0.0,
        ge=0.0,
        le=1_000_000.0,
        description="A session is refused if the data folder would exceed this size; 0 is no quota",
    )
    session_room_min: float = Field(
        default=30.0,
        ge=1.0,
        le=1440.0,
        description="A session is refused if the free space does not suffice for a session of this length",
    )
