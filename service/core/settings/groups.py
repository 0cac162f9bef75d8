"""Small groups of settings: connections, plans, the room, replay, idempotency keys, the live stream, audit, disk.

Monitoring is log format and level, certificate warning and readiness cache; limits of connections are times, sizes and
numbers.
"""

import os
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import Field, SecretStr, StringConstraints, field_validator, model_validator
from pydantic_settings import NoDecode

from engine.capture import CameraOptions
from engine.core.signals import HeadDirection
from service.core.settings.database_place import place_of
from service.core.settings.names import Env, In, Section

if TYPE_CHECKING:  # the engine's process does without SQLAlchemy
    from sqlalchemy import URL

MAX_NAME = 80
SHORTEST_KEY_BYTES = 32
LONGEST_KEY_BYTES = 4_096
RoomName = Annotated[str, StringConstraints(max_length=32, pattern=r"^([A-Za-z0-9][A-Za-z0-9-]*)?$")]
"""1 to 32 letters, digits and dashes; empty is a room without a name."""
ANCHOR_NAME = "audit-anchors.jsonl"
FolderList = Annotated[tuple[Path, ...], NoDecode]
LogFormat = Literal["text", "json"]
LogLevel = Literal["debug", "info", "warning", "error"]
PACS_PLACE = re.compile(r"([!-\[\]-~][ -\[\]-~]{,15})@([A-Za-z0-9._-]{1,253}|\[[0-9A-Fa-f:]+\]):(\d{1,5})")


def _bounded(value: float, what: str) -> Any:  # noqa: ANN401 - a field of any number's type
    """Declare a limit of every connection, with what it bounds."""
    return field(default=value, metadata={"what": what})


@dataclass(frozen=True, slots=True, kw_only=True)
class ConnectionLimits:
    """Limits of every connection: no site's settings, since what they bound is the same everywhere.

    A request's first time runs from the connection's begin, or from a further request's first byte. Beyond a number of
    connections the one goes that has been waited for longest: for a request, the rest of one, or for its client to
    read. One with a request in progress is never closed for another.
    """

    header_s: float = _bounded(10.0, "A request's headers have to be complete within this time")
    body_s: float = _bounded(30.0, "A request's body has to be complete within this time behind its headers")
    keep_alive_s: float = _bounded(5.0, "A connection without a request is closed after this time")
    write_s: float = _bounded(20.0, "A client that reads nothing for this time is disconnected")
    handshake_s: float = _bounded(10.0, "The TLS handshake has to be complete within this time")
    max_connections: int = _bounded(
        2048,
        "Beyond this number the connection whose client was waited for longest is closed; unauthenticated ones first",
    )
    max_connections_per_address: int = _bounded(512, "The same per address; trusted proxies are not limited")
    max_header_bytes: int = _bounded(16_384, "Size of a request's headers")
    max_headers: int = _bounded(64, "Number of header lines of a request")
    max_url_bytes: int = _bounded(4_096, "Size of path and query")


# Settings of RT Plans: their largest size, and the patient's reference.
class PlanSettings(Section):
    """Settings of RT Plans (docs/4-integrate/plans.md)."""

    SECTION = "plans"

    plan_patient: Literal["id", "hash"] = Field(
        default="id", description="Patient reference of a plan: the Patient ID, or a keyed hash of it"
    )
    plan_patient_key: Env[Path | None] = Field(
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
class RoomSettings(Section):
    """The room; see docs/2-clinical/motion.md."""

    SECTION = "site"

    room: Env[RoomName] = Field(
        default="",
        description="The room's name, 1 to 32 letters, digits and dashes: on the page, in stream, metrics, log, audit, "
        "backups and the names of cookies",
    )
    recordings_dirs: Env[FolderList] = Field(
        default=(), description="Folders from which recordings may be opened, colon-separated"
    )
    recordings_may_gate: Env[bool] = Field(
        default=False, description="A played recording may gate a real beam line: for test benches and phantoms only"
    )
    frame_path: Env[Literal["auto", "compiled", "numpy"]] = Field(
        default="auto",
        description="Form of the frame path: the compiled one where it is built, only that, or numpy's; the engine "
        "reads it from the environment, also for commands such as `tidegate measure`",
    )
    site_name: Env[str] = Field(default="", max_length=MAX_NAME, description="On QA reports")
    machine_name: Env[str] = Field(default="", max_length=MAX_NAME, description="On QA reports: accelerator or room")
    camera_uri: Env[str] = Field(
        default="",
        max_length=255,
        description="The room's camera, as `GET /devices` names it or the beginning of that, e.g. 1d27/0609@1: "
        "sessions open no other one; default: the session's choice, the first one where it makes none",
    )
    gantry_side: Env[HeadDirection | None] = Field(
        default=None,
        description="Side of the camera's picture towards the gantry, where the head of a head-first patient lies: "
        "top, bottom, left or right. A session's head direction and a plan's Patient Position are compared with it",
    )

    @field_validator("recordings_dirs", mode="before")
    @classmethod
    def _split_folders(cls, value: object) -> object:
        return tuple(part for part in value.split(os.pathsep) if part) if isinstance(value, str) else value

    @field_validator("site_name", "machine_name")
    @classmethod
    def _is_printable(cls, name: str) -> str:
        if not name.isprintable():
            msg = f"{name[:MAX_NAME]!r} must be printable characters"
            raise ValueError(msg)
        return name


# Settings of the camera itself.
class CameraSettings(Section):
    """How the room's camera is set, and how long it runs; see docs/3-operate/cameras.md."""

    SECTION = "camera"

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
class ReplaySettings(Section):
    """Raw recordings of sessions on a camera; see docs/3-operate/replay.md."""

    SECTION = "storage"

    record_raw: Env[bool] = Field(
        default=False, description="Record every frame of a live camera, so that the session can be replayed"
    )
    raw_min_free_mb: float = Field(
        default=2_000.0,
        ge=500.0,
        le=1_000_000.0,
        description="A raw recording ends when less disk space than this is free",
    )


class StreamSettings(Section):
    """Limits of the live stream's clients; see docs/4-integrate/stream.md."""

    SECTION = "web"

    max_live_clients: Env[int] = Field(
        default=256, ge=1, le=1024, description="Maximum number of clients, WebSockets and event streams together"
    )


class AuditSettings(Section):
    """Settings of the audit; a part of :class:`service.core.settings.settings.Settings`."""

    SECTION = "audit"
    KEY_PREFIX = "audit_"

    data_dir: Annotated[Env[Path], In("storage")] = Path("data")
    audit_anchor_file: Env[Path | None] = Field(
        default=None,
        description="File of the audit's anchors, best on another machine's share; default: audit-anchors.jsonl in the "
        "data folder",
    )
    audit_log_dir: Env[Path | None] = Field(
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


class MonitoringSettings(Section):
    """Log and readiness; see docs/3-operate/monitoring.md."""

    SECTION = "site"

    log_format: Env[LogFormat] = Field(
        default="text", description="text for a terminal, json for a collector: one object per line"
    )
    log_level: Env[LogLevel] = Field(
        default="warning",
        description="Lowest level of Tidegate's log records; info has one line per request. Libraries"
        " log from warning on",
    )


# Which database a site uses: the part of the settings that begins with ``database_``.
class DatabaseSettings(Section):
    """The settings of the database; a part of :class:`service.core.settings.settings.Settings`."""

    SECTION = "storage"

    data_dir: Env[Path] = Path("data")
    database_url: Env[SecretStr | None] = Field(
        default=None,
        min_length=1,
        max_length=2048,
        description="postgresql://USER@HOST/DATABASE; the SQLite file tidegate.db in the data folder when left out",
    )
    database_password_file: Env[Path | None] = Field(
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


class ExchangeSettings(Section):
    """Where sessions go when a person sends them, or once their report is signed."""

    SECTION = "exchange"

    pacs: str = Field(
        default="",
        max_length=300,
        description="PACS that takes sessions: TITLE@host:port; empty is none",
    )
    pacs_ca: Path | None = Field(default=None, description="Authorities of the PACS's certificate: with it, TLS")
    pacs_commit_port: int = Field(
        default=0,
        ge=0,
        le=65_535,
        description="Port on which the PACS confirms that it keeps what it took (storage commitment); 0 asks for none",
    )
    pacs_takes_signed: bool = Field(
        default=False, description="A session is sent once its report has all signatures; otherwise by a person alone"
    )

    @field_validator("pacs")
    @classmethod
    def _is_a_pacs(cls, value: str) -> str:
        found = PACS_PLACE.fullmatch(value)
        if value and (found is None or not 1 <= int(found[3]) <= 65_535):
            msg = f"{value[:80]!r} must be TITLE@host:port, a title of 1 to 16 characters"
            raise ValueError(msg)
        return value


class StorageSettings(Section):
    """Retention, quota, and free space for a new session."""

    SECTION = "storage"

    min_free_disk_mb: Env[float] = Field(default=200.0, ge=0.0, le=1_000_000.0)
    journal_dir: Env[Path | None] = Field(
        default=None, description="Folder of the journals of transitions; default: in memory"
    )
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
