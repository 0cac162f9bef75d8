"""Targets: files of our own that may come back damaged or forged: models, tapes, journals, samples, backups."""

import contextlib
import hashlib
import io
import json
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from engine.control.journal.format import (
    HEADER_BYTES,
    SLOT_BYTES,
    JournalFormatError,
    JournalHeader,
    file_size,
    pack_slot,
    read_journal,
    slot_offset,
)
from engine.core.errors import ModelError, RecordingError
from engine.core.input_tap import InputKind
from engine.gating.limits import GateLimits
from engine.gating.windows import amplitude_window
from engine.motion.learning.model_file import ARRAYS, header_text, load_model
from engine.motion.settings import PipelineSettings
from engine.offline.replay.encoding import TapeEncoding
from engine.offline.replay.header import Frames, TapeHeader, read_head, this_software
from engine.offline.replay.tape_file import OtherReadingError, TapeFile, read_tape
from service.storage.backup.archive import opened
from service.storage.backup.layout import BackupError
from service.storage.samples.walk import NoSamplesError, StreamWalk
from tests.support.calibration.foreign_calibrations import CAMERAS
from tests.support.control.transitions import transition
from tests.support.replay.scripted_tape import NO_MODELS
from tests.support.repository import DATA
from tests.support.samples.records import write_stream
from tests.support.service.fake_engine import make_model
from verification.fuzz.target import Target, as_file

HEADER_FIELDS = 4 + 8 + 4 + 4 + 64 + 48 + 16
SEED_TURNS = 12
JOURNAL_SLOTS = 2
ROWS, FILE = b"[]\n", b"model"


def read_model(content: bytes) -> None:
    """The first byte decides whether the rest is a file, or the header's text for arrays that are as they should be."""
    if content[:1] == b"h":
        arrays = {name: _plain_array(name) for name in ARRAYS}
        out = io.BytesIO()
        np.savez(out, allow_pickle=False, header=np.frombuffer(content[1:], np.uint8), **arrays)
        content = b"f" + out.getvalue()
    load_model(as_file(content[1:], "model.npz"))


def _plain_array(name: str) -> np.ndarray:
    shapes = {"mean_mm": (350, 200), "components": (1, 350, 200), "eigenvalues_mm2": (4,), "known": (350, 200)}
    return np.full(shapes[name], 1000 if name == "mean_mm" else 1, dtype=ARRAYS[name])


def models() -> Iterator[bytes]:
    yield b"h" + header_text(make_model()).encode()
    out = io.BytesIO()
    np.savez_compressed(out, header=np.frombuffer(b"{}", np.uint8), known=np.ones((2, 2), np.bool_))
    yield b"f" + out.getvalue()


def read_any_tape(content: bytes) -> None:
    """The first byte decides whether the rest is a file, or its text."""
    packed = content[1:] if content[:1] == b"f" else zlib.compress(content[1:], 1)
    tape = read_tape(as_file(packed, "fuzz.tape"))
    encoding = TapeEncoding(name_of=lambda _model: "m", model_of=_no_model)
    read_head(tape.head, encoding)
    for turn in tape.turns():
        for _kind, reading in turn.observed:
            encoding.decode(reading)
        readings = turn.readings(encoding.decode)
        for kind in InputKind:
            with contextlib.suppress(OtherReadingError):
                readings.take(kind)


def _no_model(name: str) -> None:
    msg = f"there is no model {name!s:.20}"
    raise RecordingError(msg)


def tapes() -> Iterator[bytes]:
    limits = GateLimits(window=amplitude_window(lower_mm=-1.0, upper_mm=3.0), dwell_ms=100.0)
    head = TapeHeader(
        session_id="5e55" * 8,
        limits=limits,
        measuring=PipelineSettings(),
        calibration=CAMERAS,
        model=None,
        frames=Frames(kind="recording", path=Path("a.oni")),
        software=this_software(),
        machine={},
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.tape"
        file = TapeFile(path, head.encoded(NO_MODELS), NO_MODELS)
        file.end(None)
        content = path.read_bytes()
        text = zlib.decompress(content)
        yield b"t" + text
        yield b"f" + content
    own_head, end = (json.loads(line) for line in text.splitlines())
    kept = (DATA / "tapes" / "scripted.tape").read_bytes()
    head, *turns = (json.loads(line) for line in zlib.decompress(kept).splitlines())
    lines = [own_head | {"tape": head["tape"]}, *turns[:SEED_TURNS], end]
    yield b"t" + "".join(json.dumps(line) + "\n" for line in lines).encode()


def try_journal(content: bytes) -> None:
    """An odd first byte has header and slots sealed anew, so that what is behind a checksum is reached."""
    is_sealed_anew, body = bool(content[:1] and content[0] & 1), content[1:]
    file = bytearray(file_size(JOURNAL_SLOTS))
    file[:HEADER_FIELDS] = body[:HEADER_FIELDS].ljust(HEADER_FIELDS, b"\0")
    slots = body[HEADER_FIELDS:].ljust(JOURNAL_SLOTS * SLOT_BYTES, b"\0")[: JOURNAL_SLOTS * SLOT_BYTES]
    file[HEADER_BYTES:] = slots
    if is_sealed_anew:
        struct.pack_into("<I", file, 0, zlib.crc32(file[4:HEADER_FIELDS]))
        for index in range(JOURNAL_SLOTS):
            begin = HEADER_BYTES + index * SLOT_BYTES
            if any(file[begin : begin + SLOT_BYTES]):
                struct.pack_into("<I", file, begin, zlib.crc32(file[begin + 4 : begin + SLOT_BYTES]))
    kept = read_journal(bytes(file))
    assert len(kept.entries) <= JOURNAL_SLOTS
    assert len(kept.missing_numbers) <= JOURNAL_SLOTS


def journals() -> Iterator[bytes]:
    header = JournalHeader(
        session_id="s1", boot_id="b1", anchor_utc_us=1_000_000, anchor_ns=5, slots=JOURNAL_SLOTS
    ).pack()
    assert len(header) == HEADER_FIELDS
    slots = bytearray(JOURNAL_SLOTS * SLOT_BYTES)
    for number, prepared in ((1, 0), (2, 1)):
        begin = slot_offset(number, JOURNAL_SLOTS) - HEADER_BYTES
        slots[begin : begin + SLOT_BYTES] = pack_slot(
            number, transition(number), prepared=prepared, is_committed=number == 2
        )
    for first in (b"\x00", b"\x01"):
        yield first + header + bytes(slots)


def read_samples(content: bytes) -> None:
    with StreamWalk(as_file(content, "fuzz.samples")) as walk:
        for batch in walk:
            batch.to_pydict()
        assert walk.ending is not None


def samples() -> Iterator[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        yield write_stream(Path(folder), rows=2, a_batch=2).path.read_bytes()


def read_backup(content: bytes) -> None:
    """The first byte decides whether the rest is a file, or its manifest, beside one table and one file."""
    if content[:1] == b"m":
        out = io.BytesIO()
        with zipfile.ZipFile(out, "w") as archive:
            archive.writestr("tables/users.jsonl", ROWS)
            archive.writestr("models/a.npz", FILE)
            archive.writestr("manifest.json", content[1:])
        content = b"f" + out.getvalue()
    with opened(as_file(content[1:], "fuzz.backup")) as backup:
        for table in backup.manifest.tables:
            for _line in backup.lines(table):
                pass
        for part in backup.manifest.files:
            backup.copy(part, io.BytesIO())


def backups() -> Iterator[bytes]:
    rows, file = (hashlib.sha256(content).hexdigest() for content in (ROWS, FILE))
    part = {"name": "users", "columns": ["id"], "rows": 1, "sha256": rows}
    manifest = {
        "schema": "tidegate.backup/1",
        "made_at": "2026-11-22T00:00:00Z",
        "software": "tidegate",
        "database": "sqlite",
        "revision": "0001",
        "audit_rows": 0,
        "audit_head": "0" * 64,
        "tables": [part],
        "files": [{"path": "models/a.npz", "bytes": len(FILE), "sha256": file}],
        "left_out": [],
    }
    yield b"m" + json.dumps(manifest).encode()
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("manifest.json", json.dumps(manifest))
    yield b"f" + out.getvalue()


TARGETS = (
    Target(
        name="model",
        reads="motion models, `.npz` (`engine.motion.learning.model_file`)",
        read=read_model,
        refusals=(ModelError,),
        seeds=models,
    ),
    Target(
        name="tape",
        reads="tapes of sessions, to their last word (`engine.offline.replay`)",
        read=read_any_tape,
        refusals=(RecordingError,),
        seeds=tapes,
        max_bytes=8192,
    ),
    Target(
        name="journal",
        reads="what a killed process kept of its transitions (`engine.control.journal.format`)",
        read=try_journal,
        refusals=(JournalFormatError,),
        seeds=journals,
    ),
    Target(
        name="samples",
        reads="a session's open sample stream (`service.storage.samples.walk`)",
        read=read_samples,
        refusals=(NoSamplesError,),
        seeds=samples,
        max_bytes=24_576,
    ),
    Target(
        name="backup",
        reads="backup files (`service.storage.backup.archive`)",
        read=read_backup,
        refusals=(BackupError,),
        seeds=backups,
    ),
)
