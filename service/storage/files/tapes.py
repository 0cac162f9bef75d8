"""Where a session's tape and its raw recording are stored: one file each, named after the session."""

from pathlib import Path

from engine.offline.replay.tape_file import SUFFIX

TAPES_FOLDER, RAW_FOLDER = "replays", "raw"


def tape_path(data_dir: Path, session_id: str) -> Path:
    """Return the path of a session's tape, whether or not it exists."""
    return data_dir / TAPES_FOLDER / f"{session_id}{SUFFIX}"


def raw_path(data_dir: Path, session_id: str) -> Path:
    """Return the path of a session's raw camera recording; only sites with ``record_raw`` have one."""
    return data_dir / RAW_FOLDER / f"{session_id}.oni"
