"""The camera's process: opens one camera, and hands its frames over through a ring of pictures in shared memory.

Run: ``python -m engine.capture.camera_process MODULE list`` writes the connected cameras as JSON, ``... MODULE
calibration SERIAL`` a camera's own calibration; ``... MODULE stream FD SERIAL OPTIONS`` streams until the socket FD is
closed. The engine counts the frames that it has taken in the ring's head; where it takes none, frames are dropped, and
their numbers show it.
"""

import contextlib
import ctypes
import importlib
import json
import mmap
import os
import select
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import asdict
from typing import Protocol, cast

import numpy as np
import numpy.typing as npt

from engine.capture.camera_process.native import NativeCamera, NativeFrame
from engine.capture.source import CameraOptions, FactoryCalibration, ListedCamera, SourceDescription
from engine.core.errors import SourceEndedError, TidegateError
from engine.core.native_process import keep_calls_in_their_thread

SLOTS = 16
"""Half a second of frames."""
HEAD_BYTES = mmap.PAGESIZE
FRAME = struct.Struct("<4sqqqqqqq")
"""Mark, number, device times of depth and colour [us], receipt and empty queue [ns], dropped frames before, slot."""
FRAME_MARK, TEXT_MARK = b"FRAM", b"TEXT"
MAX_MESSAGE = 4096
UNKNOWN_NS = -1
READ_S, TEMPERATURE_S = 0.2, 5.0
WAIT_S = 0.005
CLOSING_S = 2.0
"""Time for the SDK to stop its streams once the engine has closed the channel."""


class SdkModule(Protocol):
    """A module that imports an SDK; see :mod:`engine.capture.camera_process.native`."""

    def list_cameras(self) -> list[ListedCamera]:
        """List the connected cameras."""

    def camera(self, serial: str, options: CameraOptions) -> NativeCamera:
        """Return a camera, not opened; it refuses at its opening what it cannot be set to."""

    def factory_calibration(self, serial: str) -> FactoryCalibration:
        """Return the calibration of a camera by its maker."""


class Ring:
    """Slots for a depth and a colour picture each, in memory that two processes map; the head counts what was taken."""

    def __init__(self, file: int, depth_size: tuple[int, int], color_size: tuple[int, int]) -> None:
        self._depth_shape = depth_size[::-1]
        self._color_shape = (*color_size[::-1], 3)
        self._depth_bytes = 2 * depth_size[0] * depth_size[1]
        slot_bytes = self._depth_bytes + 3 * color_size[0] * color_size[1]
        self.slot_bytes = -(-slot_bytes // mmap.PAGESIZE) * mmap.PAGESIZE
        self._memory = mmap.mmap(file, HEAD_BYTES + SLOTS * self.slot_bytes)
        self._taken = ctypes.c_uint64.from_buffer(self._memory)
        self._temperature_c = ctypes.c_double.from_buffer(self._memory, ctypes.sizeof(ctypes.c_uint64))

    @property
    def taken(self) -> int:
        """How many frames the engine has taken."""
        return self._taken.value

    @taken.setter
    def taken(self, count: int) -> None:
        self._taken.value = count

    @property
    def temperature_c(self) -> float | None:
        """The camera's temperature [degrees C]; None where it is not known."""
        return self._temperature_c.value or None

    @temperature_c.setter
    def temperature_c(self, value: float | None) -> None:
        self._temperature_c.value = value or 0.0

    def pictures(self, slot: int) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.uint8]]:
        """Return depth and colour of a slot, as views of the shared memory."""
        at = HEAD_BYTES + slot * self.slot_bytes
        depth = np.frombuffer(self._memory, np.uint16, self._depth_bytes // 2, at)
        count = int(np.prod(self._color_shape))
        color = np.frombuffer(self._memory, np.uint8, count, at + self._depth_bytes)
        return depth.reshape(self._depth_shape), color.reshape(self._color_shape)


def ring_bytes(depth_size: tuple[int, int], color_size: tuple[int, int]) -> int:
    """Return the size of the shared memory for pictures of these sizes (width, height)."""
    slot_bytes = 2 * depth_size[0] * depth_size[1] + 3 * color_size[0] * color_size[1]
    return HEAD_BYTES + SLOTS * (-(-slot_bytes // mmap.PAGESIZE) * mmap.PAGESIZE)


def main(arguments: list[str]) -> int:
    """List the cameras of an SDK, or stream one of them."""
    keep_calls_in_their_thread()
    module = cast("SdkModule", importlib.import_module(arguments[0]))
    if arguments[1] == "list":
        return _answer(lambda: [asdict(one) for one in module.list_cameras()])
    if arguments[1] == "calibration":
        return _answer(lambda: _plain(module.factory_calibration(arguments[2])))
    channel = socket.socket(fileno=int(arguments[2]))
    threading.Thread(target=_end_with, args=(channel.fileno(),), daemon=True).start()
    with contextlib.suppress(BrokenPipeError, ConnectionResetError):
        try:
            _stream(channel, module.camera(arguments[3], CameraOptions(**json.loads(arguments[4]))))
        except SourceEndedError as error:
            _say(channel, {"ended": str(error)})
        except TidegateError as error:
            _say(channel, {"failed": str(error)})
        except Exception as error:  # noqa: BLE001 - an SDK raises anything; the engine is told, and opens it again
            _say(channel, {"failed": f"the camera's driver failed: {' '.join(str(error).split())}"[:1000]})
    return 0


def _answer(ask: Callable[[], object]) -> int:
    """Write the answer as JSON, or what the SDK refused."""
    try:
        content = {"answer": ask()}
    except TidegateError as error:
        content = {"refused": str(error)}
    sys.stdout.write(json.dumps(content))
    return 0


def _plain(given: FactoryCalibration) -> dict[str, object]:
    pose = given.color_from_depth
    cameras = {name: asdict(getattr(given, name)) for name in ("depth", "color")}
    kept = ("width", "height", "fx", "fy", "cx", "cy", "distortion")
    return {
        "camera": given.camera,
        "serial": given.serial,
        **{name: {key: one[key] for key in kept} for name, one in cameras.items()},
        "rotation": pose.rotation.tolist(),
        "translation_mm": pose.translation_mm.tolist(),
    }


def _end_with(channel: int) -> None:
    """End this process with the other side of the channel, whatever the SDK does meanwhile."""
    poll = select.poll()
    poll.register(channel, 0)  # closing alone, not data
    poll.poll()
    threading.Timer(CLOSING_S, os._exit, (1,)).start()


def _stream(channel: socket.socket, camera: NativeCamera) -> None:
    described = camera.open()
    try:
        file = os.memfd_create("tidegate-camera", os.MFD_CLOEXEC)
        os.ftruncate(file, ring_bytes(described.depth_size, described.color_size))
        ring = Ring(file, described.depth_size, described.color_size)
        socket.send_fds(channel, [_text({"opened": asdict(described)})], [file])
        os.close(file)
        _deliver(channel, camera, ring, described)
    finally:
        camera.close()


def _deliver(channel: socket.socket, camera: NativeCamera, ring: Ring, described: SourceDescription) -> None:
    sent = dropped = 0
    asked_s = -TEMPERATURE_S
    while not _is_closed(channel):
        if time.monotonic() - asked_s >= TEMPERATURE_S:
            asked_s, ring.temperature_c = time.monotonic(), camera.temperature_c()
        frame = camera.read(READ_S)
        if frame is None:
            continue
        while sent - ring.taken >= SLOTS and not described.is_live and not _is_closed(channel):
            time.sleep(WAIT_S)  # a recording waits for its reader, a camera does not
        if sent - ring.taken >= SLOTS or not _is_whole(frame, described):
            dropped += 1
            continue
        depth, color = ring.pictures(sent % SLOTS)
        depth[...], color[...] = frame.depth_mm, frame.color
        empty_ns = UNKNOWN_NS if frame.queue_empty_ns is None else frame.queue_empty_ns
        times = (frame.timestamp_us, frame.color_timestamp_us, frame.received_ns, empty_ns)
        channel.sendall(FRAME.pack(FRAME_MARK, frame.number, *times, dropped, sent % SLOTS))
        sent, dropped = sent + 1, 0


def _is_whole(frame: NativeFrame, described: SourceDescription) -> bool:
    return (
        frame.depth_mm.shape == described.depth_size[::-1]
        and frame.color.shape == (*described.color_size[::-1], 3)
        and frame.depth_mm.dtype == np.uint16
        and frame.color.dtype == np.uint8
    )


def _is_closed(channel: socket.socket) -> bool:
    poll = select.poll()
    poll.register(channel.fileno(), 0)
    return bool(poll.poll(0))


def _text(content: dict[str, object]) -> bytes:
    return TEXT_MARK + json.dumps(content).encode()


def _say(channel: socket.socket, content: dict[str, object]) -> None:
    channel.sendall(_text(content)[:MAX_MESSAGE])
