"""The colour frames that came last, and the one that belongs to a depth frame."""

from engine.core.frames import ColorImage

KEPT = 8


class RecentColors:
    """Keeps the newest colour frames; a colour frame late by one is paired by its time, never by its order."""

    def __init__(self) -> None:
        self._frames: list[tuple[int, ColorImage]] = []

    def add(self, timestamp_us: int, picture: ColorImage) -> None:
        """Take a colour frame."""
        self._frames = [*self._frames[1 - KEPT :], (timestamp_us, picture)]

    def nearest(self, timestamp_us: int) -> tuple[int, ColorImage] | None:
        """Return time and picture of the frame nearest in time; None before the first."""
        return min(self._frames, key=lambda one: abs(one[0] - timestamp_us), default=None)
