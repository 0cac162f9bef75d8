"""A flat plate whose depth is altered on purpose."""

from dataclasses import replace


class Altered:
    """A source whose depth pictures are changed on the way, or that fails."""

    def __init__(self, source, change=lambda depth, _index: depth, *, fails_at=None, error=None):
        self._source, self._change = source, change
        self._fails_at, self._error = fails_at, error
        self.opened = self.closed = 0

    def open(self):
        self.opened += 1
        if self._fails_at is None and self._error is not None:
            raise self._error
        return self._source.open()

    def read(self, timeout_s):
        frame = self._source.read(timeout_s)
        if self._fails_at is not None and frame.index >= self._fails_at:
            raise self._error
        return replace(frame, depth_mm=self._change(frame.depth_mm.copy(), frame.index))

    def close(self):
        self.closed += 1
        self._source.close()
