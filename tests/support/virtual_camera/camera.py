"""The virtual Xtion's controller: tells the driver, in whatever process it is, what to do, and when it was done.

Every order is answered with a :class:`Receipt`. Its ``raised_ns`` is the host's monotonic time at which the first frame
it befell was handed to the runtime, or would have been: the moment a fault is there to be seen.
"""

import ctypes
import mmap
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path
from typing import Self

import numpy as np

from tests.support.virtual_camera import block
from tests.support.virtual_camera.block import Call, Field, Kind, State, Streams
from tests.support.virtual_camera.driver_build import redist
from tests.support.virtual_camera.film import COLOR_LAG, FPS, Film, baked

URI = "virtual/xtion"
PATIENCE_S = 20.0
WHOLE = (0, 0, 0, 0)
"""A rectangle that is the whole picture."""

SKIN_RGB, CLOTH_RGB = 0xE0AC8C, 0x2A2A2E
_POLL_S = 0.002
_TRUNK_PX = 24
_STICKER_PX = 16
_REACH_MM = 850.0

Rect = tuple[int, int, int, int]
"""Left, top, width and height in a stream's own full-size picture [px]."""


class CameraSilentError(AssertionError):
    """The driver did not do as requested in time: no process has loaded it, or no one streams."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Receipt:
    """What came of an order; times are the host's monotonic clock, None where a stream was not affected."""

    numbers: tuple[int, ...]
    kind: Kind
    begun_ns: int
    depth_index: int | None
    depth_ns: int | None
    color_index: int | None
    color_ns: int | None

    @property
    def raised_ns(self) -> int:
        """When the first affected frame was raised, or would have been; when it began, where no frame was affected."""
        raised = [when for when in (self.depth_ns, self.color_ns) if when is not None]
        return min(raised, default=self.begun_ns)

    @property
    def frame_index(self) -> int | None:
        """The first affected frame's number, the depth frame's if there is one."""
        return self.color_index if self.depth_index is None else self.depth_index


@dataclass(frozen=True, slots=True, kw_only=True)
class Status:
    """How the camera stands; pairs are depth, colour."""

    pid: int
    ticks: int
    is_plugged: bool
    is_open: bool
    is_registered: bool
    is_running: tuple[bool, bool]
    raised: tuple[int, int]
    index: tuple[int, int]
    timestamp_us: tuple[int, int]
    raised_ns: tuple[int, int]
    is_mirrored: tuple[bool, bool]
    width_px: tuple[int, int]
    position: int
    backlog: int
    overruns: int
    hung_calls: int

    @property
    def is_streaming(self) -> bool:
        return any(self.is_running)


def _merged(one: Receipt, other: Receipt) -> Receipt:
    """Depth of one, colour of the other."""
    return replace(
        one,
        numbers=one.numbers + other.numbers,
        begun_ns=min(one.begun_ns, other.begun_ns),
        color_index=other.color_index,
        color_ns=other.color_ns,
    )


class VirtualXtion:
    """A camera in a file: give ``environment`` to the process that is to see it.

    Parameters
    ----------
    folder
        Where the file is put; one camera a folder, one process at a time owns it.
    film
        What it shows.
    is_plugged
        Whether it is there when a process starts the runtime.
    can_register
        Whether it can move depth into the colour camera's view.
    """

    def __init__(
        self, folder: Path, film: Film | None = None, *, is_plugged: bool = True, can_register: bool = True
    ) -> None:
        self.film = film or baked()
        self.path = folder / "virtual-xtion"
        self._redist = redist()
        self._marked: list[int] = []
        head = block.Block(
            magic=block.MAGIC,
            version=block.VERSION,
            size=ctypes.sizeof(block.Block),
            ring_path=str(self.film.ring_path).encode(),
            starts_plugged=int(is_plugged),
            can_register=int(can_register),
            fps=FPS,
            color_lag=COLOR_LAG,
        )
        self.path.write_bytes(bytes(head))
        with self.path.open("r+b") as file:
            self._map = mmap.mmap(file.fileno(), ctypes.sizeof(block.Block))
        self._block = block.Block.from_buffer(self._map)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_failure: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the file; the driver keeps its own view of it. Safe to call twice."""
        if hasattr(self, "_block"):
            del self._block
            with suppress(BufferError):
                self._map.close()

    @property
    def environment(self) -> dict[str, str]:
        """What makes a process see this camera, and no other."""
        return {"OPENNI2_REDIST": str(self._redist), "VIRTUAL_XTION": str(self.path)}

    @property
    def status(self) -> Status:
        """How the camera stands now."""
        words = self._block.status
        return Status(
            pid=words.pid,
            ticks=words.ticks,
            is_plugged=bool(words.is_plugged),
            is_open=bool(words.is_open),
            is_registered=bool(words.registration),
            is_running=(bool(words.is_running[0]), bool(words.is_running[1])),
            raised=tuple(words.raised),
            index=tuple(words.index),
            timestamp_us=tuple(words.timestamp_us),
            raised_ns=tuple(words.raised_ns),
            is_mirrored=(bool(words.mirrored[0]), bool(words.mirrored[1])),
            width_px=tuple(words.width_px),
            position=words.position,
            backlog=words.backlog,
            overruns=words.overruns,
            hung_calls=words.hung,
        )

    # -- telling it ---------------------------------------------------------------------------------------------

    def order(
        self,
        kind: Kind,
        *,
        n: Sequence[int] = (),
        x: Sequence[float] = (),
        streams: Streams = Streams.BOTH,
        from_frame: int = 0,
        for_frames: int = 0,
    ) -> int:
        """Put an order where the driver finds it, and return its number.

        ``from_frame`` is the number of the depth frame that is affected first, 0 the next; ``for_frames`` how many are,
        0 all until it is undone.
        """
        number = self._block.asked + 1
        slot = self._block.commands[number % block.SLOTS]
        slot.kind, slot.streams, slot.from_frame, slot.for_frames = int(kind), int(streams), from_frame, for_frames
        slot.n[:] = [*n, *[0] * (8 - len(n))]
        slot.x[:] = [*x, *[0.0] * (4 - len(x))]
        self._block.asked = number  # the last: what it points at is whole by now
        return number

    def receipt(self, number: int, kind: Kind, *, streams: Streams = Streams.BOTH, timeout_s: float = PATIENCE_S):
        """Wait until an order has befallen the streams it is for, or has begun while no one streams."""
        words = self._block.receipts[number % block.SLOTS]
        deadline_s = time.monotonic() + timeout_s
        while not self._is_done(words, number, kind, streams):
            if time.monotonic() > deadline_s:
                msg = f"the virtual Xtion did not do order {number} ({kind.name}): {self.status}"
                raise CameraSilentError(msg)
            time.sleep(_POLL_S)
        return Receipt(
            numbers=(number,),
            kind=kind,
            begun_ns=words.begun_ns,
            depth_index=words.depth_index or None,
            depth_ns=words.depth_ns or None,
            color_index=words.color_index or None,
            color_ns=words.color_ns or None,
        )

    def _is_done(self, words: block.ReceiptWords, number: int, kind: Kind, streams: Streams) -> bool:
        if words.number != number or words.begun_ns == 0:
            return False
        if kind is Kind.HANG:
            return words.depth_ns != 0 or not self.status.is_streaming
        if not self.status.is_streaming:
            return True
        is_seen = (not streams & Streams.DEPTH or words.depth_ns, not streams & Streams.COLOR or words.color_ns)
        return all(is_seen)

    def tell(
        self,
        kind: Kind,
        *,
        n: Sequence[int] = (),
        x: Sequence[float] = (),
        streams: Streams = Streams.BOTH,
        from_frame: int = 0,
        for_frames: int = 0,
    ) -> Receipt:
        """Order, and wait until it is done."""
        number = self.order(kind, n=n, x=x, streams=streams, from_frame=from_frame, for_frames=for_frames)
        return self.receipt(number, kind, streams=streams)

    def undo(self, receipt: Receipt | None = None) -> Receipt:
        """End what an order began, or all that goes on."""
        return [self.tell(Kind.UNDO, n=(number,)) for number in (receipt.numbers if receipt is not None else (0,))][-1]

    # -- delivery -----------------------------------------------------------------------------------------------

    def stall(self, streams: Streams = Streams.BOTH, **when: int) -> Receipt:
        """Deliver nothing; numbers and times go on."""
        return self.tell(Kind.STALL, streams=streams, **when)

    def skip(self, frames: int, streams: Streams = Streams.BOTH, from_frame: int = 0) -> Receipt:
        """Lose so many frames."""
        return self.stall(streams, from_frame=from_frame, for_frames=frames)

    def repeat(self, streams: Streams = Streams.BOTH, **when: int) -> Receipt:
        """Show the same picture again, with new numbers and times."""
        return self.tell(Kind.REPEAT, streams=streams, **when)

    def again(self, streams: Streams = Streams.BOTH, **when: int) -> Receipt:
        """Deliver the same frame again: its picture, number and time."""
        return self.tell(Kind.AGAIN, streams=streams, **when)

    def late(self, late_ms: float, *, growing_ms: float = 0.0, streams: Streams = Streams.BOTH, **when: int) -> Receipt:
        """Deliver so much later, and that much more each frame; device times are kept."""
        return self.tell(Kind.LATE, x=(late_ms, growing_ms), streams=streams, **when)

    def rate(self, fps: float, **when: int) -> Receipt:
        """Take so many frames a second; the patient breathes as before."""
        return self.tell(Kind.RATE, x=(fps,), **when)

    def clock(self, jump_us: int, streams: Streams = Streams.BOTH, **when: int) -> Receipt:
        """Add to device times."""
        return self.tell(Kind.CLOCK, n=(jump_us,), streams=streams, **when)

    def stuck_clock(self, streams: Streams = Streams.BOTH, **when: int) -> Receipt:
        """Let device times stand still."""
        return self.tell(Kind.STUCK_CLOCK, streams=streams, **when)

    def timestamp(self, us: int, streams: Streams = Streams.BOTH, **when: int) -> Receipt:
        """Give this time to every frame."""
        return self.tell(Kind.TIMESTAMP, n=(us,), streams=streams, **when)

    def index(self, jump: int, streams: Streams = Streams.BOTH, **when: int) -> Receipt:
        """Add to frame numbers."""
        return self.tell(Kind.INDEX, n=(jump,), streams=streams, **when)

    def malform(self, field: Field, value: int = 0, streams: Streams = Streams.BOTH, **when: int) -> Receipt:
        """Say something wrong in each frame's head; NO_DATA hands out frames without a picture."""
        return self.tell(Kind.MALFORM, n=(field, value), streams=streams, **when)

    # -- the device ---------------------------------------------------------------------------------------------

    def state(self, state: State, *, goes_on: bool = False, **when: int) -> Receipt:
        """Tell a device state, and deliver on or not, until undone."""
        return self.tell(Kind.STATE, n=(state, int(goes_on)), **when)

    def unplug(
        self, *, is_reported: bool = True, streams_go_on: bool = False, is_swapped: bool = False, **when: int
    ) -> Receipt:
        """Pull the cable, until undone; a runtime that is not reported hears nothing but silence.

        What comes back has another address, where that is reported, and another serial number, where it was swapped.
        ``streams_go_on`` says whether streams opened before deliver again then, without a new start.
        """
        return self.tell(Kind.UNPLUG, n=(int(is_reported), int(streams_go_on), int(is_swapped)), **when)

    def hang(self, calls: Call) -> Receipt:
        """Let these calls of the runtime hang until undone; ``raised_ns`` is when the first one hung."""
        return self.tell(Kind.HANG, n=(calls,))

    # -- what frames show ---------------------------------------------------------------------------------------

    def fill(
        self,
        *,
        depth_rect: Rect | None = None,
        depth_mm: int = 0,
        color_rect: Rect | None = None,
        rgb: int = CLOTH_RGB,
        **when: int,
    ) -> Receipt:
        """Fill a rectangle of either picture, or of both from the same frame on."""
        orders = []
        if depth_rect is not None:
            orders.append((Streams.DEPTH, (*depth_rect, depth_mm, -1)))
        if color_rect is not None:
            orders.append((Streams.COLOR, (*color_rect, -1, rgb)))
        numbers = [(self.order(Kind.FILL, n=n, streams=streams, **when), streams) for streams, n in orders]
        receipts = [self.receipt(number, Kind.FILL, streams=streams) for number, streams in numbers]
        return reduce(_merged, receipts)

    def cover(self, marker: int = 0, **when: int) -> Receipt:
        """Lay a dark cloth on a marker, for the colour camera alone."""
        return self.fill(color_rect=self.marker_rect(marker), **when)

    def hand(self, *, depth_mm: int = 700, share: float = 0.5, **when: int) -> Receipt:
        """Hold something over the middle of the region, so much of its width and height; undo all to take it away."""
        color_rect = _shrunk(self.region_rect, share)
        return self.fill(
            depth_rect=self.depth_rect(color_rect, depth_mm),
            depth_mm=depth_mm,
            color_rect=color_rect,
            rgb=SKIN_RGB,
            **when,
        )

    def offset(self, mm: float, *, rect: Rect = WHOLE, mm_a_frame: float = 0.0, **when: int) -> Receipt:
        """Add to depth, within the sensor's steps; negative is towards the camera."""
        return self.tell(Kind.OFFSET, n=rect, x=(mm, mm_a_frame), streams=Streams.DEPTH, **when)

    def warm(self, mm_a_metre: float, *, mm_a_frame: float = 0.0, **when: int) -> Receipt:
        """Read in proportion to the distance too far, as a camera does that becomes warm."""
        return self.tell(Kind.OFFSET, n=(*WHOLE, 1), x=(mm_a_metre, mm_a_frame), streams=Streams.DEPTH, **when)

    def lift(self, mm: float, *, mm_a_frame: float = 0.0, **when: int) -> Receipt:
        """Move the trunk, but neither couch nor floor; positive is towards the camera."""
        left, top, width, height = self.depth_rect(self.region_rect)
        trunk = (left - _TRUNK_PX, top - _TRUNK_PX, width + 2 * _TRUNK_PX, height + 2 * _TRUNK_PX)
        return self.offset(-mm, rect=trunk, mm_a_frame=mm_a_frame, **when)

    def flat(self, depth_mm: int = 0, *, rect: Rect = WHOLE, **when: int) -> Receipt:
        """Read one depth everywhere: 0 is no reading, 65535 what no sensor says."""
        return self.fill(depth_rect=rect, depth_mm=depth_mm, **when)

    def dropout(self, share: float, *, rect: Rect = WHOLE, is_same: bool = False, **when: int) -> Receipt:
        """Read nothing in this share of pixels; the same ones in each frame, or others."""
        return self.tell(Kind.DROPOUT, n=(*rect, int(is_same)), x=(share,), streams=Streams.DEPTH, **when)

    def noise(
        self,
        low_mm: int = 400,
        high_mm: int = 4000,
        *,
        rect: Rect = WHOLE,
        streams: Streams = Streams.DEPTH,
        **when: int,
    ) -> Receipt:
        """Read anything between two depths, and where asked any colour."""
        return self.tell(Kind.NOISE, n=(*rect, low_mm, high_mm), streams=streams, **when)

    def shift(self, right_px: int, down_px: int, **when: int) -> Receipt:
        """Move the picture, as a patient who slides on the couch."""
        return self.tell(Kind.SHIFT, n=(*WHOLE, right_px, down_px), **when)

    def slide(self, marker: int, right_px: int, down_px: int, **when: int) -> Receipt:
        """Move a marker on the skin, for the colour camera alone."""
        left, top, width, height = self.marker_rect(marker)
        both = (left + min(right_px, 0), top + min(down_px, 0), width + abs(right_px), height + abs(down_px))
        return self.tell(Kind.SHIFT, n=(*both, right_px, down_px), streams=Streams.COLOR, **when)

    def tear(self, row: int, frames: int, **when: int) -> Receipt:
        """Show from a row on the pictures of so many frames before, as where a transfer mixes two buffers."""
        return self.tell(Kind.TORN, n=(row, frames), **when)

    def average(self, frames: int, **when: int) -> Receipt:
        """Show the mean of the last depths, as a driver's filter in time does."""
        return self.tell(Kind.AVERAGED, n=(frames,), streams=Streams.DEPTH, **when)

    def breathe(self, speed: float, *, position: int = -1, **when: int) -> Receipt:
        """Let the patient breathe so many times as fast; 0 is a held breath, at ``position`` of the film or here.

        Pixels are then taken from two neighbouring frames by chance, so that no picture comes twice.
        """
        return self.tell(Kind.SPEED, n=(position,), x=(speed,), **when)

    # -- where things are ---------------------------------------------------------------------------------------

    def marker_rect(self, marker: int) -> Rect:
        """Where a marker is in the colour picture, wherever the breath stands."""
        return _around(self.film.truth["markers_px"][:, marker], _STICKER_PX)

    @property
    def region_rect(self) -> Rect:
        """Where the region between the markers is in the colour picture."""
        return _around(self.film.truth["markers_px"].reshape(-1, 2), 0)

    def depth_rect(self, color_rect: Rect, depth_mm: float = _REACH_MM) -> Rect:
        """Where something in the colour picture, at this depth, is in the depth picture."""
        calibration = self.film.calibration
        left, top, width, height = color_rect
        corners = np.array(
            [[left, top], [left + width, top], [left + width, top + height], [left, top + height]], float
        )
        points = calibration.color.rays(corners) * depth_mm
        return _around(calibration.depth.project(calibration.color_from_depth.inverse.apply(points)), 0)

    def await_streaming(self, timeout_s: float = PATIENCE_S) -> Status:
        """Wait until both streams deliver."""
        return self.await_status(lambda status: all(status.is_running) and min(status.raised) > 0, timeout_s)

    def await_status(self, condition, timeout_s: float = PATIENCE_S) -> Status:
        """Wait for the camera to stand so."""
        deadline_s = time.monotonic() + timeout_s
        while not condition(status := self.status):
            if time.monotonic() > deadline_s:
                raise CameraSilentError(str(status))
            time.sleep(_POLL_S)
        return status


def _around(points_px: np.ndarray, margin_px: float) -> Rect:
    low = np.floor(points_px.min(axis=0) - margin_px).astype(int)
    high = np.ceil(points_px.max(axis=0) + margin_px).astype(int)
    return int(low[0]), int(low[1]), int(high[0] - low[0] + 1), int(high[1] - low[1] + 1)


def _shrunk(rect: Rect, share: float) -> Rect:
    left, top, width, height = rect
    wide, high = round(width * share), round(height * share)
    return left + (width - wide) // 2, top + (height - high) // 2, wide, high
