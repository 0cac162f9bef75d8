"""One client's place at the hub: the newest that waits for it, the gate's changes, and what had to be left out."""

import asyncio
from collections import deque

from service.stream.spoken import Frame, Shape, Spoken

MOST_CHANGES = 16
"""Changes of the gate that wait for one client; beyond them the oldest is left out, and counted."""
MOST_HELD = 128
"""Frames kept for a client that is being told what it missed: some seconds, in which the recorder gets there."""


class Place:
    """What waits for one client: never more than the newest and a few changes, however slow it is.

    Attributes
    ----------
    skipped, skipped_changes
        Left out since the client was last told.
    busy_since_s
        Since when something is on its way to the client; None where nothing is.
    """

    def __init__(self, shape: Shape, *, rate_hz: float | None, now_s: float) -> None:
        self.shape = shape
        self.period_s = None if rate_hz is None else 1.0 / rate_hz
        self.news = asyncio.Event()
        self.skipped = 0
        self.skipped_changes = 0
        self.left_out = 0
        self.busy_since_s: float | None = None
        self.said_s = now_s
        self._due_s = now_s
        self._changes: deque[Frame] = deque()
        self._newest: Frame | None = None
        self._plain: Spoken | None = None
        self._held: deque[Frame] | None = None

    def offer(self, frame: Frame, now_s: float) -> None:
        """Take the newest frame; what it replaces is not sent any more."""
        if self._held is not None:
            self._held.append(frame)
            return
        if self.period_s is None:
            self._skip(frame.missed)
        if self._newest is not None:
            self._replace(now_s)
        if frame.is_change:
            self._newest = None
            if len(self._changes) == MOST_CHANGES:
                self._changes.popleft()
                self.skipped_changes += 1
                self._skip()
            self._changes.append(frame)
        else:
            self._newest = frame
        self.tick(now_s)

    def say(self, spoken: Spoken) -> None:
        """Say something that is no frame, after what waits."""
        self._plain = spoken
        self.news.set()

    def tick(self, now_s: float) -> None:
        """Let the client know what is due."""
        if self._changes or (self._newest is not None and self._is_due(now_s)):
            self.news.set()

    def take(self, now_s: float) -> Spoken | None:
        """Return what is to be sent next; None where nothing is due."""
        if self._changes:
            if self._is_due(now_s):
                self._go_on(now_s)  # it is the one that was due
            return self._changes.popleft()
        if self._newest is not None and self._is_due(now_s):
            frame, self._newest = self._newest, None
            self._go_on(now_s)
            return frame
        plain, self._plain = self._plain, None
        if plain is None:
            self.news.clear()
        return plain

    def told_skipped(self) -> tuple[int, int]:
        """Return how many were left out, and of them how many changes; from now on it is counted anew."""
        found = (self.skipped, self.skipped_changes)
        self.skipped = self.skipped_changes = 0
        return found

    def forget_skipped(self) -> None:
        """Begin to count anew."""
        self.skipped = self.skipped_changes = self.left_out = 0

    # While the client is told what it missed

    def hold(self) -> None:
        """Keep every frame from now on, up to a bound, instead of the newest alone."""
        self._held = deque(maxlen=MOST_HELD)

    @property
    def first_held(self) -> Frame | None:
        """The oldest frame that is kept."""
        return self._held[0] if self._held else None

    def release(self) -> list[Frame]:
        """Return what was kept, and go on with the newest alone."""
        held, self._held = self._held or deque(), None
        return list(held)

    def _is_due(self, now_s: float) -> bool:
        return self.period_s is None or now_s >= self._due_s

    def _go_on(self, now_s: float) -> None:
        """Set when the next is due: evenly, and never to make up for what is past."""
        if self.period_s is not None:
            self._due_s += self.period_s
            if self._due_s <= now_s:
                self._due_s = now_s + self.period_s

    def _replace(self, now_s: float) -> None:
        """Count the one that waited, unless the asked rate left it out anyway."""
        if self.period_s is None:
            self._skip()
        elif self.busy_since_s is not None and now_s >= self._due_s:
            self._skip()
            self._go_on(now_s)

    def _skip(self, count: int = 1) -> None:
        self.skipped += count
        self.left_out += count
