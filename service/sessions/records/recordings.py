"""The recordings that a session may play, as a person chooses them from a list."""

import hashlib
from datetime import UTC, datetime
from pathlib import Path

from engine.capture import OniReader
from engine.core.errors import RecordingError
from service.core.errors import BoundError, NotFoundError
from service.core.schemas.recordings import Recording, RecordingPage
from service.engine_host.site_rules.recording_folders import find_recording, recording_paths

_US_PER_S = 1_000_000
_NOT_READ = dict.fromkeys(("bytes", "modified_at", "seconds", "width_px", "height_px", "fps", "has_color"))


class RecordingList:
    """Lists the files of the site's recording folders, read at each call: files come and go without the service."""

    def __init__(self, folders: tuple[Path, ...]) -> None:
        self._folders = folders

    def page(self, cursor: str | None, limit: int) -> RecordingPage:
        """Return the recordings in order of their paths, after the one whose key is ``cursor``.

        Raises
        ------
        BoundError
            That file has been removed meanwhile: where the page begins is not known.
        """
        paths = recording_paths(self._folders)
        keys = [None, *map(_key, paths)]
        if cursor not in keys:
            msg = "the last recording of the page before was removed: list from the first page again"
            raise BoundError(msg, field="cursor", value=cursor or "", bound="of a recording that exists")
        first = keys.index(cursor)
        end = min(first + limit, len(paths))
        items = [self._described(path) for path in paths[first:end]]
        return RecordingPage(items=items, next_cursor=keys[end] if end < len(paths) else None)

    def _described(self, path: str) -> Recording:
        try:
            return _read(path, find_recording(path, self._folders))
        except (BoundError, NotFoundError, RecordingError, OSError) as error:
            return Recording(path=path, problem=str(error), **_NOT_READ)


def _key(path: str) -> str:
    """Identify a path of any length in a cursor, whose length is bounded."""
    return hashlib.sha256(path.encode()).hexdigest()[:32]


def _read(path: str, file: Path) -> Recording:
    with OniReader(file) as reader:
        depth, last_us = reader.depth, reader.header.last_timestamp_us
        return Recording(
            path=path,
            bytes=reader.file_bytes,
            modified_at=datetime.fromtimestamp(file.stat().st_mtime, UTC),
            seconds=None if last_us is None else last_us / _US_PER_S,
            width_px=depth.size_px[0],
            height_px=depth.size_px[1],
            fps=depth.fps,
            has_color=reader.color is not None,
            problem=None,
        )
