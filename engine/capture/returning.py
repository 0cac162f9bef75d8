"""A live camera that is unplugged and comes back within a session: lost at once, looked for, and found again.

What is seen of it from outside is one camera that was away: frames go on being numbered, and device times go on along
the host's, though a camera that was switched off begins its own anew. A camera that merely says nothing is taken for
unplugged after a while, since nobody may be told when a cable is pulled. Another camera is not taken for this one.

It is looked for in a thread of its own, because drivers hang; the engine's thread only asks whether it is back.
"""

import contextlib
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

from engine.capture.source import DepthSource, SourceDescription
from engine.clock import NS_PER_S, NS_PER_US, Clock
from engine.errors import FrameTimeoutError, SourceAwayError, SourceLostError, TidegateError
from engine.frames import RgbdFrame
from engine.trust import CLOCK_DRIFT

SILENT_NS = 3 * NS_PER_S
"""A camera that has shown frames and shows none for so long is lost; the beam has been held for long by then."""

FIRST_FRAME_S = 2.0
LOOK_EVERY_S = 0.5
CLOSE_S = 2.0

HUNG = "a call hangs in the camera's driver"


class LiveSource(DepthSource, Protocol):
    """A source whose driver may hang."""

    @property
    def is_free(self) -> bool:
        """Whether nothing of it hangs in the driver any more, after it was closed."""


Found = tuple[LiveSource, RgbdFrame]


class ReturningSource:
    """A DepthSource over another that may come back.

    Parameters
    ----------
    make
        Makes a source that was not opened yet: the first one, and one for each look at whether the camera is back.
    clock
        The clock that frames are stamped with.
    needs_serial
        Whether a camera that tells no serial number is not waited for: which one comes back could not be known.
    wait
        Waits between two looks; returns whether it was told to stop.
    """

    def __init__(
        self,
        make: Callable[[], LiveSource],
        clock: Clock,
        *,
        needs_serial: bool,
        wait: Callable[[threading.Event, float], bool] = threading.Event.wait,
    ) -> None:
        self._make, self._clock, self._wait = make, clock, wait
        self._needs_serial = needs_serial
        self._source: LiveSource | None = None
        self._search: _Search | None = None
        self._described: SourceDescription | None = None
        self._away = ""
        self._last: RgbdFrame | None = None
        self._least_lag_ns = 0
        self._period_us = 0.0
        self._shift_us = self._shift = 0

    def open(self) -> SourceDescription:
        """Open the camera; raises what it raises: one that is not there at first is not waited for."""
        self.close()
        self._last, self._away, self._shift_us, self._shift = None, "", 0, 0
        source = self._make()
        self._described = source.open()
        self._source = source
        self._period_us = 1e6 / max(self._described.fps, 1.0)
        return self._described

    def read(self, timeout_s: float) -> RgbdFrame:
        """Return the next frame; see :class:`engine.capture.source.DepthSource`.

        Raises
        ------
        SourceAwayError
            The camera is gone and is looked for.
        SourceLostError
            The camera is gone, and could not be known again.
        """
        if self._search is not None:
            return self._look(self._search, timeout_s)
        if self._source is None:
            msg = "the camera is not open"
            raise SourceLostError(msg)
        try:
            frame = self._source.read(timeout_s)
        except SourceLostError as error:
            raise self._lose(str(error)) from error
        except FrameTimeoutError as error:
            silent_ns = 0 if self._last is None else self._clock.now_ns() - self._last.received_ns
            if silent_ns <= SILENT_NS:
                raise
            raise self._lose(f"the camera has shown nothing for {SILENT_NS // NS_PER_S} s") from error
        return self._kept(frame)

    def close(self) -> None:
        """Let go of the camera, and look for it no more; safe to call twice. Waits a little for a look under way."""
        source, search = self._source, self._search
        self._source = self._search = None
        if search is not None:
            search.end(CLOSE_S)
        if source is not None:
            source.close()

    def _lose(self, words: str) -> SourceLostError | SourceAwayError:
        assert self._described is not None
        if self._needs_serial and not self._described.serial:
            return SourceLostError(f"{words}, and it tells no serial number: begin another session")
        lost, self._source = self._source, None
        assert lost is not None
        self._away = words
        self._search = _Search(lost, self._make, self._described, self._wait)
        return SourceAwayError(words)

    def _look(self, search: "_Search", timeout_s: float) -> RgbdFrame:
        found = search.found(timeout_s)
        if found is None:
            raise SourceAwayError(search.words or self._away)
        self._source, frame = found
        self._search = None
        last = self._last
        if last is not None:
            away_us = (frame.received_ns - last.received_ns) // NS_PER_US
            self._shift_us = (frame.received_ns - self._least_lag_ns) // NS_PER_US - frame.timestamp_us
            self._shift = last.index + 1 - frame.index
            missed = max(round(away_us / self._period_us) - 1, 1)
            frame = replace(frame, missed_frames=missed)
        return self._kept(frame)

    def _kept(self, frame: RgbdFrame) -> RgbdFrame:
        """Return a frame as one of the session's."""
        kept = replace(
            frame,
            index=frame.index + self._shift,
            timestamp_us=frame.timestamp_us + self._shift_us,
            color_timestamp_us=frame.color_timestamp_us + self._shift_us,
        )
        self._least_lag_ns = _least_lag_ns(self._least_lag_ns, self._last, kept)
        self._last = kept
        return kept


def _least_lag_ns(before_ns: int, last: RgbdFrame | None, frame: RgbdFrame) -> int:
    """Host time minus device time of the promptest frame: the first one back counts as prompt, not as the last lost."""
    lag_ns = frame.received_ns - frame.timestamp_us * NS_PER_US
    if last is None:
        return lag_ns
    return min(lag_ns, before_ns + round((frame.received_ns - last.received_ns) * CLOCK_DRIFT))


class _Search:
    """Closes what was lost and looks for the camera until it shows a frame, in a thread of its own."""

    def __init__(
        self,
        lost: LiveSource,
        make: Callable[[], LiveSource],
        wanted: SourceDescription,
        wait: Callable[[threading.Event, float], bool],
    ) -> None:
        self._lost, self._make, self._wanted, self._wait = lost, make, wanted, wait
        self._stop = threading.Event()
        self._news = threading.Condition()
        self._found: Found | None = None
        self._left: LiveSource | None = None
        self.words = ""
        self._thread = threading.Thread(target=self._run, name="camera-search", daemon=True)
        self._thread.start()

    def found(self, timeout_s: float) -> Found | None:
        """Return the camera and its first frame, once; None if it is not back in time."""
        with self._news:
            if self._found is None:
                self._news.wait(timeout_s)
            found, self._found = self._found, None
            return found

    def end(self, timeout_s: float) -> None:
        """Look no more; what was found and not taken is closed."""
        self._stop.set()
        self._thread.join(timeout_s)
        with self._news:
            found, self._found = self._found, None
        if found is not None:
            found[0].close()

    def _run(self) -> None:
        self._close(self._lost)
        while not self._wait(self._stop, LOOK_EVERY_S):
            if self._left is not None and not self._left.is_free:
                self.words = HUNG  # another try would hang beside it, and then another
                continue
            found = self._try()
            if found is None:
                continue
            with self._news:
                is_wanted = not self._stop.is_set()
                self._found = found if is_wanted else None
                self._news.notify_all()
            if not is_wanted:
                found[0].close()
            return

    def _try(self) -> Found | None:
        """Open the camera and read a frame; None where it is not there, or is another one."""
        source, words = None, ""
        try:
            source = self._make()
            described = source.open()
            if described == self._wanted:
                return source, source.read(FIRST_FRAME_S)
            words = f"another camera is plugged in: {described.name} {described.serial}".rstrip()
        except TidegateError:
            pass  # not there, or without a picture: away as before
        except Exception as error:  # noqa: BLE001 - a driver that fails in any way is a camera that is not back
            words = f"the camera cannot be opened: {type(error).__name__}"
        self.words = words
        if source is not None:
            self._close(source)
        return None

    def _close(self, source: LiveSource) -> None:
        self._left = source
        with contextlib.suppress(Exception):
            source.close()
