"""Whether there is room for another session, before one begins; while one runs, the writer holds as the disk fills."""

import contextlib
import os
import shutil
from collections.abc import Callable
from pathlib import Path

from service.core.errors import StorageLowError
from service.core.settings.settings import Settings

MIB = 1024 * 1024
GIB = 1024 * MIB
FRAMES_A_MINUTE = 30 * 60
BYTES_A_FRAME = 1700
"""A sample in its stream and in the Parquet file beside it, with room to spare."""


def session_bytes(settings: Settings) -> int:
    """Disk space of a session of the site's length [bytes]; raw recordings check the disk themselves."""
    return int(settings.session_room_min * FRAMES_A_MINUTE * BYTES_A_FRAME)


def refuse_without_room(settings: Settings, make_room: Callable[[], object]) -> None:
    """Raise StorageLowError if disk or quota have no room for a session, after removing old files."""
    if _shortage(settings) is None:
        return
    with contextlib.suppress(OSError):  # a remaining shortage is reported below
        make_room()
    shortage = _shortage(settings)
    if shortage is not None:
        raise shortage


def folder_bytes(folder: Path) -> int:
    """Add up a folder's files; those that vanish meanwhile do not count."""
    total = 0
    for root, _, names in os.walk(folder):
        for name in names:
            try:
                total += os.lstat(os.path.join(root, name)).st_size  # noqa: PTH118 - a path object a file is too slow
            except FileNotFoundError:
                continue
    return total


def _shortage(settings: Settings) -> StorageLowError | None:
    needed = session_bytes(settings)
    free = shutil.disk_usage(settings.data_dir).free - settings.min_free_disk_mb * MIB
    if free < needed:
        bound = f"at least {needed / MIB:.0f} MiB beyond the {settings.min_free_disk_mb:g} MiB that stay free"
        msg = "the disk has no room for a session: make some, or let old samples be removed (docs/3-operate/samples.md)"
        return StorageLowError(msg, field="disk", value=f"{max(free, 0) / MIB:.0f} MiB", bound=bound)
    if settings.data_quota_gb:
        held = folder_bytes(settings.data_dir)
        if held + needed > settings.data_quota_gb * GIB:
            bound = f"at most {settings.data_quota_gb:g} GiB with the {needed / MIB:.0f} MiB that a session takes"
            msg = "the data folder's quota leaves no room for a session"
            return StorageLowError(msg, field="data_quota_gb", value=f"{held / GIB:.3f} GiB held", bound=bound)
    return None
