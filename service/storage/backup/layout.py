"""Format of a backup file: a ZIP archive of tables as JSON lines, files, and a manifest, which is written last."""

import re
from typing import Annotated, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints

from engine.core.errors import TidegateError

SCHEMA: Literal["tidegate.backup/1"] = "tidegate.backup/1"
MANIFEST = "manifest.json"
TABLES = "tables"
ANCHORS = "anchors/audit-anchors.jsonl"
FOLDERS = ("models", "samples", "replays")
RAW_FOLDER = "raw"
"""Raw frames of a live camera; large, so included only on request."""

LEFT_OUT = ("logins",)
"""Tables that are not backed up: after a restore, users log in again."""

UNFINISHED = ".partial"
MAX_MANIFEST_BYTES = 256 * 1024 * 1024
FILE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,199}")

Count = Annotated[int, Field(ge=0)]
Sha256 = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]
TableName = Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9_]{0,62}$")]


class BackupError(TidegateError):
    """The backup cannot be made, read or restored."""

    code: ClassVar[str] = "backup_refused"


class BrokenLogError(BackupError):
    """The audit chain in the backup is broken; all other parts are intact."""

    code: ClassVar[str] = "backup_log_broken"


class OtherRoomError(BackupError):
    """The backup is of another room."""

    code: ClassVar[str] = "backup_other_room"


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


class TablePart(_Part):
    """One table: its rows in the order of its key, each a JSON list of the columns' values."""

    name: TableName
    columns: list[TableName]
    rows: Count
    sha256: Sha256


class FilePart(_Part):
    """One file of the data folder, by its path in the archive."""

    path: str
    bytes: Count
    sha256: Sha256


class Manifest(_Part):
    """Contents and origin of a backup, as in ``manifest.json``."""

    schema_name: Literal["tidegate.backup/1"] = Field(alias="schema")
    made_at: str
    software: str
    database: Literal["sqlite", "postgresql"]
    revision: str
    audit_rows: Count
    audit_head: Sha256
    tables: list[TablePart]
    files: list[FilePart]
    left_out: list[str]
    room: Annotated[str, Field(max_length=32)] = ""
    """Name of the room whose data these are; empty without one, and in backups of versions before 0.2.0."""
    without_samples: list[str] = []
    """Started sessions whose samples are missing although no removal was audited."""

    @property
    def rows(self) -> int:
        """Number of rows of all tables."""
        return sum(table.rows for table in self.tables)


def table_entry(name: str) -> str:
    """Return a table's path in the archive."""
    return f"{TABLES}/{name}.jsonl"


def is_backup_path(path: str) -> bool:
    """Whether a restore may write this path: a plain file name in a known folder, or the anchor file."""
    folder, slash, name = path.partition("/")
    is_ours = bool(slash) and folder in (*FOLDERS, RAW_FOLDER) and FILE_NAME.fullmatch(name) is not None
    return is_ours or path == ANCHORS
