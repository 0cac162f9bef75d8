"""A backup file is untrusted: its unpacked size is bounded, and every damage is reported."""

import hashlib
import io
import json
import zipfile

import pytest

from service.storage.backup import archive as reading
from service.storage.backup.archive import opened
from service.storage.backup.layout import BackupError

EMPTY = hashlib.sha256(b"").hexdigest()


def write_backup(path, *, tables=(), files=(), entries=None):
    manifest = {
        "schema": "tidegate.backup/1",
        "made_at": "2026-11-22T00:00:00Z",
        "software": "tidegate",
        "database": "sqlite",
        "revision": "0001",
        "audit_rows": 0,
        "audit_head": "0" * 64,
        "tables": list(tables),
        "files": list(files),
        "left_out": [],
    }
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in (entries or {}).items():
            archive.writestr(name, content)
        archive.writestr("manifest.json", json.dumps(manifest))
    return path


class Disk(io.BytesIO):
    """Counts what is written to it."""


def test_of_a_file_that_unpacks_to_more_than_it_states_hardly_more_is_written(tmp_path):
    part = {"path": "models/a.npz", "bytes": 10, "sha256": EMPTY}
    path = write_backup(tmp_path / "bomb", files=[part], entries={"models/a.npz": bytes(64 * 1024 * 1024)})
    assert path.stat().st_size < 100_000
    disk = Disk()
    with opened(path) as backup, pytest.raises(BackupError, match="differs from its manifest"):
        backup.copy(backup.manifest.files[0], disk)
    assert len(disk.getvalue()) <= reading.PIECE_BYTES


def test_of_a_table_with_more_rows_than_it_states_hardly_more_are_read(tmp_path):
    part = {"name": "users", "columns": ["id"], "rows": 2, "sha256": EMPTY}
    path = write_backup(tmp_path / "rows", tables=[part], entries={"tables/users.jsonl": b"[]\n" * 100_000})
    lines = []
    with opened(path) as backup, pytest.raises(BackupError):
        lines.extend(backup.lines(backup.manifest.tables[0]))
    assert len(lines) <= 3


def test_an_archive_of_countless_entries_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(reading, "MAX_ENTRIES", 3)
    path = write_backup(tmp_path / "many", entries={f"models/{i}.npz": b"" for i in range(4)})
    with pytest.raises(BackupError, match="5 entries"), opened(path):
        pass


@pytest.mark.parametrize(
    "place",
    [
        "../a",
        "models/../../a",
        "/etc/passwd",
        "models/a/b",
        "models//a",
        "models/.hidden",
        "models/a\0b",
        "models/a\nb",
        "models/" + "a" * 300,
        "MODELS/a",
        "models\\..\\a",
        "models/ä",
        "raw",
        "",
        "anchors/other.jsonl",
    ],
)
def test_a_place_that_no_backup_writes_to_is_refused(tmp_path, place):
    path = write_backup(tmp_path / "place", files=[{"path": place, "bytes": 0, "sha256": EMPTY}])
    with pytest.raises(BackupError, match="no backup of ours holds"), opened(path):
        pass


def test_a_bent_archive_is_damaged_and_nothing_else(tmp_path):
    part = {"path": "models/a.npz", "bytes": 3000, "sha256": EMPTY}
    content = write_backup(
        tmp_path / "whole", files=[part], entries={"models/a.npz": bytes(range(250)) * 12}
    ).read_bytes()
    for at in range(0, len(content), 3):
        bent = tmp_path / "bent"
        bent.write_bytes(content[:at] + bytes([content[at] ^ 0x5A]) + content[at + 1 :])
        with pytest.raises(BackupError), opened(bent) as backup:
            backup.copy(backup.manifest.files[0], io.BytesIO())


def test_what_the_reader_of_an_entry_fails_with_is_not_called_damage(tmp_path):
    part = {"path": "models/a.npz", "bytes": 3, "sha256": hashlib.sha256(b"abc").hexdigest()}
    path = write_backup(tmp_path / "whole", files=[part], entries={"models/a.npz": b"abc"})

    class FullDisk(io.BytesIO):
        def write(self, _content):
            raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space"), opened(path) as backup:
        backup.copy(backup.manifest.files[0], FullDisk())
