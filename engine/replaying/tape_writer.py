"""The thread that writes a session's tape: it spells, packs and hashes, so that the engine's thread does none of it."""

import hashlib
import queue
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from engine.replaying.spelling import Spelling
from engine.replaying.tape_file import TapeFile
from engine.replaying.taping import Taping

WRITE_EVERY_S = 0.1
WRITES_A_SYNC = 10
HASHED_AT_ONCE = 1 << 20
HASH_WAIT_S = 3.0
"""How long a tape's end waits for the hash of a recording: its session may have been shorter than the reading of it."""


class TapeWriter(threading.Thread):
    """Writes one session's tape until the engine is over, or the tape is torn.

    Parameters
    ----------
    recording
        The file whose frames are played; its hash is noted if it is known soon enough.
    """

    def __init__(
        self,
        taping: Taping,
        path: Path,
        head: Callable[[], dict[str, Any]],
        spelling: Spelling,
        *,
        recording: Path | None = None,
    ) -> None:
        super().__init__(name="tidegate-tape", daemon=True)
        self._taping, self._path, self._head, self._spelling = taping, path, head, spelling
        self._recording = recording
        self._found: queue.SimpleQueue[dict[str, object]] = queue.SimpleQueue()
        self.error: str | None = None

    def run(self) -> None:
        """Write."""
        try:
            self._write()
        except Exception as error:  # noqa: BLE001 - a tape that cannot be written is a session that cannot be replayed, no more
            self.error = f"{type(error).__name__}: {error}"
            self._taping.tear(f"the tape cannot be written: {self.error}")

    def _write(self) -> None:
        tape = TapeFile(self._path, self._head(), self._spelling)
        hashing = threading.Thread(target=self._hash, name="tidegate-hash", daemon=True)
        hashing.start()
        writes = 0
        while not self._taping.is_over and self._taping.torn is None:
            self._take(tape)
            tape.write()
            writes += 1
            if writes % WRITES_A_SYNC == 0:
                tape.sync()
        self._await(hashing)
        self._take(tape)
        tape.end(self._taping.torn)

    def _await(self, hashing: threading.Thread) -> None:
        """Wait for the recording's hash; not for long, and not where the tape is torn: it can do without."""
        end_s = time.monotonic() + HASH_WAIT_S
        while hashing.is_alive() and self._taping.torn is None and time.monotonic() < end_s:
            hashing.join(WRITE_EVERY_S)

    def _take(self, tape: TapeFile) -> None:
        self._taping.await_news(WRITE_EVERY_S)
        while not self._found.empty():
            tape.note(**self._found.get())
        turns = self._taping.turns
        while not turns.empty():
            tape.add(turns.get())

    def _hash(self) -> None:
        """Hash the recording beside the session: it may be gigabytes."""
        if self._recording is None:
            return
        try:
            sha256 = sha256_of(self._recording)
        except OSError:
            return  # a recording that cannot be read is the session's trouble, and it says so
        self._found.put({"recording_sha256": sha256, "recording_bytes": self._recording.stat().st_size})


def sha256_of(path: Path) -> str:
    """Hash a file."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while part := file.read(HASHED_AT_ONCE):
            digest.update(part)
    return digest.hexdigest()
