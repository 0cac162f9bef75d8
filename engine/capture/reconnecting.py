"""Reconnect a live camera that was unplugged within a session.

The source continues as one camera: frame numbers continue, and device times continue along the host's clock, although a
camera that was switched off restarts its own. A camera that delivers nothing for `SILENT_NS` counts as unplugged,
because a driver may not report a pulled cable. A different camera is not accepted.

The search has a thread of its own, because drivers hang; the engine thread only polls its result.

A camera that is checked by its description whenever it is opened: at the start, and when it returns.
"""

import contextlib
import threading
from collections.abc import Callable
from dataclasses import replace

from engine.capture.source import LiveSource, SourceDescription
from engine.core.clock import CLOCK_DRIFT, NS_PER_S, NS_PER_US, Clock
from engine.core.errors import CameraMismatchError, FrameTimeoutError, SourceAwayError, SourceLostError, TidegateError
from engine.core.frames import RgbdFrame

SILENT_NS = 3 * NS_PER_S
"""Time without frames after which a camera counts as lost; the beam is held long before."""

FIRST_FRAME_S = 2.0
SEARCH_PERIOD_S = 0.5
CLOSE_S = 2.0

HUNG = "a call hangs in the camera's driver"


Found = tuple[LiveSource, RgbdFrame]


class ReturningSource:
    """A DepthSource that reconnects the source it wraps.

    Parameters
    ----------
    make
        Makes a source that is not open yet: the first one, and one for each attempt to reconnect.
    clock
        The clock of the frames' time stamps.
    needs_serial
        Whether a camera without a serial number is not searched for: it could not be identified.
    wait
        Waits between two attempts; returns whether a stop was requested.
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
        self._cause = ""
        self._last: RgbdFrame | None = None
        self._least_lag_ns = 0
        self._period_us = 0.0
        self._shift_us = self._shift = 0

    def open(self) -> SourceDescription:
        """Open the camera; a camera that is absent at first is not searched for, and its error is raised."""
        self.close()
        self._last, self._cause, self._shift_us, self._shift = None, "", 0, 0
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
            The camera is disconnected, and the search runs.
        SourceLostError
            The camera is disconnected and could not be identified again.
        """
        if self._search is not None:
            return self._poll(self._search, timeout_s)
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
            raise self._lose(f"the camera has delivered no frame for {SILENT_NS // NS_PER_S} s") from error
        return self._continued(frame)

    def close(self) -> None:
        """Close the camera and end the search; safe to call twice. Waits up to 2 s for an attempt under way."""
        source, search = self._source, self._search
        self._source = self._search = None
        if search is not None:
            search.end(CLOSE_S)
        if source is not None:
            source.close()

    def _lose(self, words: str) -> SourceLostError | SourceAwayError:
        assert self._described is not None
        if self._needs_serial and not self._described.serial:
            return SourceLostError(f"{words}, and it has no serial number: start another session")
        lost, self._source = self._source, None
        assert lost is not None
        self._cause = words
        self._search = _Search(lost, self._make, self._described, self._wait)
        return SourceAwayError(words)

    def _poll(self, search: "_Search", timeout_s: float) -> RgbdFrame:
        found = search.found(timeout_s)
        if found is None:
            raise SourceAwayError(search.problem or self._cause)
        self._source, frame = found
        self._search = None
        last = self._last
        if last is not None:
            away_us = (frame.received_ns - last.received_ns) // NS_PER_US
            self._shift_us = (frame.received_ns - self._least_lag_ns) // NS_PER_US - frame.timestamp_us
            self._shift = last.index + 1 - frame.index
            missed = max(round(away_us / self._period_us) - 1, 1)
            frame = replace(frame, missed_frames=missed)
        return self._continued(frame)

    def _continued(self, frame: RgbdFrame) -> RgbdFrame:
        """Return a frame with the session's numbers and device times."""
        continued = replace(
            frame,
            index=frame.index + self._shift,
            timestamp_us=frame.timestamp_us + self._shift_us,
            color_timestamp_us=frame.color_timestamp_us + self._shift_us,
        )
        self._least_lag_ns = _least_lag_ns(self._least_lag_ns, self._last, continued)
        self._last = continued
        return continued


def _least_lag_ns(before_ns: int, last: RgbdFrame | None, frame: RgbdFrame) -> int:
    """Return the least host time minus device time [ns]; the first frame after a reconnection has no excess lag."""
    lag_ns = frame.received_ns - frame.timestamp_us * NS_PER_US
    if last is None:
        return lag_ns
    return min(lag_ns, before_ns + round((frame.received_ns - last.received_ns) * CLOCK_DRIFT))


class _Search:
    """Closes the lost source and tries to open the camera until it delivers a frame, in a thread of its own."""

    def __init__(
        self,
        lost: LiveSource,
        make: Callable[[], LiveSource],
        expected: SourceDescription,
        wait: Callable[[threading.Event, float], bool],
    ) -> None:
        self._lost, self._make, self._expected, self._wait = lost, make, expected, wait
        self._stop = threading.Event()
        self._change = threading.Condition()
        self._found: Found | None = None
        self._left: LiveSource | None = None
        self.problem = ""
        self._thread = threading.Thread(target=self._run, name="camera-search", daemon=True)
        self._thread.start()

    def found(self, timeout_s: float) -> Found | None:
        """Return the camera and its first frame, once; None if there is none within the timeout."""
        with self._change:
            if self._found is None:
                self._change.wait(timeout_s)
            found, self._found = self._found, None
            return found

    def end(self, timeout_s: float) -> None:
        """End the search; a camera that was found and not taken is closed."""
        self._stop.set()
        self._thread.join(timeout_s)
        with self._change:
            found, self._found = self._found, None
        if found is not None:
            found[0].close()

    def _run(self) -> None:
        self._close(self._lost)
        while not self._wait(self._stop, SEARCH_PERIOD_S):
            if self._left is not None and not self._left.is_free:
                self.problem = HUNG  # every further attempt would hang as well
                continue
            found = self._try()
            if found is None:
                continue
            with self._change:
                is_running = not self._stop.is_set()
                self._found = found if is_running else None
                self._change.notify_all()
            if not is_running:
                found[0].close()
            return

    def _try(self) -> Found | None:
        """Open the camera and read a frame; None where it is absent or a different one."""
        source, problem = None, ""
        try:
            source = self._make()
            described = source.open()
            if described == self._expected:
                return source, source.read(FIRST_FRAME_S)
            problem = f"another camera is plugged in: {described.name} {described.serial}".rstrip()
        except CameraMismatchError as error:
            problem = str(error)
        except TidegateError:
            pass  # absent, or without a picture
        except Exception as error:  # noqa: BLE001 - any failure of the driver means no camera
            problem = f"the camera cannot be opened: {type(error).__name__}"
        self.problem = problem
        if source is not None:
            self._close(source)
        return None

    def _close(self, source: LiveSource) -> None:
        self._left = source
        with contextlib.suppress(Exception):
            source.close()


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
