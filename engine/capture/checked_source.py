"""A camera that is checked by its description whenever it is opened: at the start, and when it returns."""

from collections.abc import Callable

from engine.capture.source import LiveSource, SourceDescription
from engine.core.errors import TidegateError
from engine.core.frames import RgbdFrame


class CheckedSource:
    """A DepthSource that opens ``source`` and closes it again where ``check`` raises a TidegateError."""

    def __init__(self, source: LiveSource, check: Callable[[SourceDescription], None]) -> None:
        self._source, self._check = source, check

    @property
    def is_free(self) -> bool:
        """Whether no call hangs in the driver any more, after :meth:`close`."""
        return self._source.is_free

    def open(self) -> SourceDescription:
        """Open and check the camera; raises what the check raises."""
        described = self._source.open()
        try:
            self._check(described)
        except TidegateError:
            self._source.close()
            raise
        return described

    def read(self, timeout_s: float) -> RgbdFrame:
        """Return the next frame; see :class:`engine.capture.source.DepthSource`."""
        return self._source.read(timeout_s)

    def close(self) -> None:
        """Close the camera."""
        self._source.close()
