"""Where Arrow writes a stream to: bytes in memory, taken from there by whoever brings them on."""

import pyarrow as pa


class WrittenBytes:
    """What Arrow has written and nobody has taken yet; ``sink`` is what Arrow is given."""

    closed = False

    def __init__(self) -> None:
        self.held = bytearray()
        self.sink = pa.PythonFile(self, mode="w")

    def write(self, piece: bytes) -> int:
        """Keep a piece; Arrow's side."""
        self.held += memoryview(piece).cast("B")
        return len(piece)

    def flush(self) -> None:
        """Do nothing; Arrow's side."""

    def close(self) -> None:
        """Do nothing; Arrow's side."""

    def take(self) -> bytes:
        """Return what is held, and hold nothing."""
        taken = bytes(self.held)
        self.held.clear()
        return taken
