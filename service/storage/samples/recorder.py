"""Records of a running session, written to its sample stream in sealed batches and synced to the disk."""

import contextlib
import time
from collections.abc import Callable

from engine.control import FrameRecord
from service.storage.samples.figures import Figures
from service.storage.samples.layout import SampleHead
from service.storage.samples.store import SampleStore, Settlement

MOST_IN_A_BATCH = 512


class SampleRecorder:
    """Writes one session's samples; used by one thread.

    Parameters
    ----------
    batch_s
        How long a record waits at most for those it is written with.
    """

    def __init__(
        self,
        store: SampleStore,
        head: SampleHead,
        *,
        batch_s: float,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._store = store
        self._session_id = head.session_id
        self._batch_s = batch_s
        self._now_s = now_s
        self._stream = store.begin(head)
        self._written_at_s = now_s()
        self._unsynced: list[FrameRecord] = []
        self.waiting: list[FrameRecord] = []
        self.figures = Figures()

    @property
    def is_there(self) -> bool:
        """Whether the file is still where it was put."""
        return self._stream.is_there

    def write_due(self, *, is_last: bool) -> list[FrameRecord]:
        """Write the batch that is due; return the records that are on the disk from now on.

        Raises
        ------
        OSError
            The disk did not take them; they are written by the next call.
        """
        if self.waiting and (is_last or self._is_due()):
            self.figures.add(self._stream.append(self.waiting))
            self._unsynced += self.waiting
            self.waiting.clear()
        self._stream.sync()
        if self._unsynced:
            self._written_at_s = self._now_s()
        synced, self._unsynced = self._unsynced, []
        return synced

    def settle(self) -> Settlement:
        """Close the file and make Parquet of it; raise OSError where that cannot be, with the stream as it is."""
        self._stream.finish()
        return self._store.settle(self._session_id)

    def leave_open(self) -> dict[str, object]:
        """Close the file as a stream; return what the audit records until the next start makes its Parquet file."""
        with contextlib.suppress(OSError):
            self._stream.finish()
        stream = self._stream
        return {"rows": stream.rows, "stream_sha256": stream.seal, "detail": "still a stream: see samples.settled"}

    @property
    def rows(self) -> int:
        """How many samples were written."""
        return self._stream.rows

    def forget_stream(self) -> None:
        """Remove the stream, once the audit has the Parquet file."""
        self._store.forget_stream(self._session_id)

    def discard(self) -> None:
        """Take the file away: the session never began."""
        self._stream.discard()

    def _is_due(self) -> bool:
        return len(self.waiting) >= MOST_IN_A_BATCH or self._now_s() - self._written_at_s >= self._batch_s
