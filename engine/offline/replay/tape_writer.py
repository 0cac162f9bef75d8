"""The thread that writes a session's tape: it encodes, compresses and hashes, so that the engine thread need not."""

import hashlib
import queue
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from engine.offline.replay.encoding import TapeEncoding
from engine.offline.replay.recording_tap import RecordingTap
from engine.offline.replay.tape_file import TapeFile

WRITE_EVERY_S = 0.1
WRITES_A_SYNC = 10
HASHED_AT_ONCE = 1 << 20
HASH_WAIT_S = 3.0
"""Longest wait at the end of a tape for the recording's hash: a short session may end before the file is hashed."""


class TapeWriter(threading.Thread):
    """Writes one session's tape until the engine is over, or the tape is torn.

    Parameters
    ----------
    recording
        The file whose frames are played; its hash is noted where it is known in time.
    """

    def __init__(
        self,
        tap: RecordingTap,
        path: Path,
        head: Callable[[], dict[str, Any]],
        encoding: TapeEncoding,
        *,
        recording: Path | None = None,
    ) -> None:
        super().__init__(name="tidegate-tape", daemon=True)
        self._tap, self._path, self._head, self._encoding = tap, path, head, encoding
        self._recording = recording
        self._found: queue.SimpleQueue[dict[str, object]] = queue.SimpleQueue()
        self.error: str | None = None

    def run(self) -> None:
        """Write until the session is over."""
        try:
            self._write()
        except Exception as error:  # noqa: BLE001 - without its tape a session cannot be replayed; nothing else depends on it
            self.error = f"{type(error).__name__}: {error}"
            self._tap.tear(f"the tape cannot be written: {self.error}")

    def _write(self) -> None:
        tape = TapeFile(self._path, self._head(), self._encoding)
        hashing = threading.Thread(target=self._hash, name="tidegate-hash", daemon=True)
        hashing.start()
        writes = 0
        while not self._tap.is_over and self._tap.torn is None:
            self._take(tape)
            tape.write()
            writes += 1
            if writes % WRITES_A_SYNC == 0:
                tape.sync()
        self._await(hashing)
        self._take(tape)
        tape.end(self._tap.torn)

    def _await(self, hashing: threading.Thread) -> None:
        """Wait for the recording's hash for at most ``HASH_WAIT_S``, and not where the tape is torn."""
        end_s = time.monotonic() + HASH_WAIT_S
        while hashing.is_alive() and self._tap.torn is None and time.monotonic() < end_s:
            hashing.join(WRITE_EVERY_S)

    def _take(self, tape: TapeFile) -> None:
        self._tap.await_end(WRITE_EVERY_S)
        while not self._found.empty():
            tape.note(**self._found.get())
        turns = self._tap.turns
        while not turns.empty():
            tape.add(turns.get())

    def _hash(self) -> None:
        """Hash the recording in a thread of its own: it may have gigabytes."""
        if self._recording is None:
            return
        try:
            sha256, size = sha256_of(self._recording), self._recording.stat().st_size
        except OSError:
            return  # the session itself reports a recording that cannot be read
        self._found.put({"recording_sha256": sha256, "recording_bytes": size})


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while part := file.read(HASHED_AT_ONCE):
            digest.update(part)
    return digest.hexdigest()
