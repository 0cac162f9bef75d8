"""The memory that Arrow writes a stream to, before it is written to the file."""

import pyarrow as pa


class WrittenBytes:
    """Bytes that Arrow has written and that were not taken yet; pass ``sink`` to Arrow."""

    closed = False

    def __init__(self) -> None:
        self.held = bytearray()
        self.sink = pa.PythonFile(self, mode="w")

    def write(self, piece: bytes) -> int:
        """Append a piece; called by Arrow."""
        self.held += memoryview(piece).cast("B")
        return len(piece)

    def flush(self) -> None:
        """Do nothing; Arrow's side."""

    def close(self) -> None:
        """Do nothing; Arrow's side."""

    def take(self) -> bytes:
        """Return the bytes and clear the memory."""
        taken = bytes(self.held)
        self.held.clear()
        return taken
