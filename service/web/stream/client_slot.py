"""Messages that wait for one client: the newest frame, changes of the gate, and counts of dropped samples."""

import asyncio
from collections import deque

from service.web.stream.encoding import EncodedMessage, Frame, Shape

MAX_CHANGES = 16
"""Largest number of waiting gate changes; beyond it the oldest is dropped and counted."""
MAX_ALARMS = 64
"""Largest number of waiting alarm messages; beyond it the oldest is dropped, and the numbers of the events show it."""
MAX_BUFFERED = 128
"""Largest number of live frames buffered while recorded samples are resent: some seconds."""


class ClientSlot:
    """Bounded queue of one client: the newest frame and a few gate changes, however slow the client is.

    Attributes
    ----------
    skipped, skipped_changes
        Samples dropped since the client was last informed, and how many of them were gate changes.
    busy_since_s
        Start of the send in progress; None if there is none.
    """

    def __init__(self, shape: Shape, *, rate_hz: float | None, now_s: float) -> None:
        self.shape = shape
        self.period_s = None if rate_hz is None else 1.0 / rate_hz
        self.ready = asyncio.Event()
        self.skipped = 0
        self.skipped_changes = 0
        self.total_skipped = 0
        self.busy_since_s: float | None = None
        self.last_sent_s = now_s
        self._due_s = now_s
        self._changes: deque[Frame] = deque()
        self._newest: Frame | None = None
        self._plain: EncodedMessage | None = None
        self._alarms: deque[EncodedMessage] = deque(maxlen=MAX_ALARMS)
        self._buffered: deque[Frame] | None = None

    def offer(self, frame: Frame, now_s: float) -> None:
        """Queue the newest frame; it replaces an older frame that waits."""
        if self._buffered is not None:
            self._buffered.append(frame)
            return
        if self.period_s is None:
            self._skip(frame.missed)
        if self._newest is not None:
            self._replace(now_s)
        if frame.is_change:
            self._newest = None
            if len(self._changes) == MAX_CHANGES:
                self._changes.popleft()
                self.skipped_changes += 1
                self._skip()
            self._changes.append(frame)
        else:
            self._newest = frame
        self.tick(now_s)

    def queue_message(self, message: EncodedMessage) -> None:
        """Queue a message that is not a frame; it is sent after the waiting frames."""
        self._plain = message
        self.ready.set()

    def queue_alarms(self, message: EncodedMessage) -> None:
        """Queue a message about alarms; it is sent before everything else, and none replaces another."""
        self._alarms.append(message)
        self.ready.set()

    def take_alarms(self) -> EncodedMessage | None:
        """Return the oldest waiting message about alarms."""
        return self._alarms.popleft() if self._alarms else None

    def tick(self, now_s: float) -> None:
        """Wake the client's task if a frame is due."""
        if self._changes or (self._newest is not None and self._is_due(now_s)):
            self.ready.set()

    def take(self, now_s: float) -> EncodedMessage | None:
        """Return the next message to send; None if none is due."""
        if self._alarms:
            return self.take_alarms()
        if self._changes:
            if self._is_due(now_s):
                self._schedule_next(now_s)  # it is the one that was due
            return self._changes.popleft()
        if self._newest is not None and self._is_due(now_s):
            frame, self._newest = self._newest, None
            self._schedule_next(now_s)
            return frame
        plain, self._plain = self._plain, None
        if plain is None:
            self.ready.clear()
        return plain

    def take_skipped(self) -> tuple[int, int]:
        """Return and reset the counts: dropped samples, and dropped gate changes among them."""
        found = (self.skipped, self.skipped_changes)
        self.skipped = self.skipped_changes = 0
        return found

    def reset_skipped(self) -> None:
        """Reset all counts."""
        self.skipped = self.skipped_changes = self.total_skipped = 0

    # While recorded samples are resent

    def start_buffering(self) -> None:
        """Buffer all frames from now on, up to MOST_HELD, instead of only the newest."""
        self._buffered = deque(maxlen=MAX_BUFFERED)

    @property
    def first_buffered(self) -> Frame | None:
        """The oldest buffered frame."""
        return self._buffered[0] if self._buffered else None

    def stop_buffering(self) -> list[Frame]:
        """Return the buffered frames and stop buffering."""
        buffered, self._buffered = self._buffered or deque(), None
        return list(buffered)

    def _is_due(self, now_s: float) -> bool:
        return self.period_s is None or now_s >= self._due_s

    def _schedule_next(self, now_s: float) -> None:
        """Set the time of the next frame: evenly spaced, without catching up."""
        if self.period_s is not None:
            self._due_s += self.period_s
            if self._due_s <= now_s:
                self._due_s = now_s + self.period_s

    def _replace(self, now_s: float) -> None:
        """Count the replaced frame, unless the requested rate would have dropped it."""
        if self.period_s is None:
            self._skip()
        elif self.busy_since_s is not None and now_s >= self._due_s:
            self._skip()
            self._schedule_next(now_s)

    def _skip(self, count: int = 1) -> None:
        self.skipped += count
        self.total_skipped += count
