"""Channels between the service and its engine process: pickled values over a socket pair that the child inherits.

Both ends are this program, run by one user, and one started the other; no socket listens. Arrays and errors are encoded
specially: arrays arrive read-only, large ones without being copied; an error arrives as its class with its fields,
although its constructor takes other arguments than its message.

Linux signals an engine process when the thread ends that started it: the one that keeps the standby process.

The shared page is memory for cancellation flags of commands and the newest pictures. It has no name in any folder, so
none of it remains after the processes. Flags are single bytes. Pictures are written in turn to a few places, each with
an ascending number: the reader takes the newest, and checks after the copy that the number is still there. Neither side
waits for the other.
"""

import io
import math
import mmap
import os
import pickle
import signal
import socket
import struct
import threading
import time
from contextlib import suppress
from typing import Any

import numpy as np
import numpy.typing as npt

from engine.core.errors import TidegateError
from engine.core.frames import ColorImage
from engine.core.native_process import signal_at_parent_death

LARGE_BYTES = 65_536
"""Smaller arrays are copied into the message; larger ones follow it."""
MOST_BYTES = 1 << 30
LARGEST_CONTROL_BYTES = 65_536

_HEAD = struct.Struct("<QI")
_SIZE = struct.Struct("<Q")
SLOTS = 64
"""Flags of commands in progress; the engine's command queue has fewer places."""
PICTURES = 3
PICTURE_BYTES = 4 << 20
"""A colour picture of 1280 x 1024 pixels fits; unused pages of memory are never allocated."""
READ_S = 2.0
"""Longest time for one reading. A copy fails only where its thread stood still for two frames of the camera."""
_NUMBER = struct.Struct("q")
"""Native, so that it is written as a whole; 0 where there was no picture yet."""
_FRAME = struct.Struct("4q")
"""Index of the frame, and the shape."""
_HEAD_BYTES = _NUMBER.size + _FRAME.size
_FIRST = mmap.PAGESIZE
_STEP = _FIRST + PICTURE_BYTES
SIZE = _FIRST + PICTURES * _STEP
NOT_WHOLE = -1


class ChannelClosedError(Exception):
    """The other process has ended or closed the channel."""


class BulkChannel:
    """Messages of any size, in order; one thread receives, any may send."""

    def __init__(self, end: socket.socket) -> None:
        self._end = end
        self._sending = threading.Lock()

    def send(self, message: object) -> None:
        """Send, and wait as long as the other process takes to read; raise ChannelClosedError without it."""
        body, arrays = pack(message)
        sizes = b"".join(_SIZE.pack(array.nbytes) for array in arrays)
        try:
            with self._sending:
                self._end.sendall(_HEAD.pack(len(body), len(arrays)) + sizes + body)
                for array in arrays:
                    self._end.sendall(array)
        except OSError as error:
            raise ChannelClosedError from error

    def receive(self) -> Any:  # noqa: ANN401 - the receiver matches on the type
        """Wait for the next message; raise ChannelClosedError when the channel closes."""
        size, count = _HEAD.unpack(self._read(_HEAD.size))
        sizes = [_SIZE.unpack(self._read(_SIZE.size))[0] for _ in range(count)]
        if size + sum(sizes) > MOST_BYTES:
            raise ChannelClosedError
        body = self._read(size)
        return pickle.loads(body, buffers=[self._read(one) for one in sizes])  # noqa: S301 - see the module # nosec B301

    def set_timeout(self, seconds: float | None) -> None:
        """Wait at most so long for each piece [s], then raise ChannelClosedError; None waits without limit."""
        self._end.settimeout(seconds)

    def close(self) -> None:
        """Close: the other end is woken at once."""
        _close(self._end)

    def _read(self, size: int) -> memoryview:
        found = np.empty(size, np.uint8).data  # np.empty: filling it with zeros would hold the interpreter lock
        at = 0
        while at < size:
            try:
                count = self._end.recv_into(found[at:])
            except OSError as error:
                raise ChannelClosedError from error
            if count == 0:
                raise ChannelClosedError
            at += count
        return found


class ControlChannel:
    """Small messages, sent without waiting: each arrives whole and in order, or is not sent."""

    def __init__(self, end: socket.socket) -> None:
        self._end = end

    def send(self, message: object) -> bool:
        """Send; return False when the buffer is full because the other process does not read, or it has ended."""
        try:
            self._end.send(pickle.dumps(message, protocol=pickle.HIGHEST_PROTOCOL), socket.MSG_DONTWAIT)
        except OSError:
            return False
        return True

    def receive(self) -> Any:  # noqa: ANN401 - the receiver matches on the type
        """Wait for the next message; raise ChannelClosedError when the channel closes."""
        try:
            found = self._end.recv(LARGEST_CONTROL_BYTES)
        except OSError as error:
            raise ChannelClosedError from error
        if not found:
            raise ChannelClosedError
        return pickle.loads(found)  # noqa: S301 - see the module # nosec B301

    def send_file(self, file: int) -> None:
        """Pass an open file, with its locks, to the other process."""
        try:
            socket.send_fds(self._end, [b"file"], [file])
        except OSError as error:
            raise ChannelClosedError from error

    def receive_file(self) -> int:
        """Receive a file that the other process passed."""
        _, files, _, _ = socket.recv_fds(self._end, LARGEST_CONTROL_BYTES, 1)
        if not files:
            raise ChannelClosedError
        return files[0]

    def close(self) -> None:
        """Close: the other end is woken at once."""
        _close(self._end)


def _close(end: socket.socket) -> None:
    """Close a socket that may be closed already; a thread that waits on it is woken."""
    with suppress(OSError):
        end.shutdown(socket.SHUT_RDWR)
    end.close()


def pack(message: object) -> tuple[bytes, list[memoryview]]:
    """Pickle a message; return it and, separately, its large arrays as they are in memory."""
    arrays: list[memoryview] = []

    def leave_out(buffer: pickle.PickleBuffer) -> bool:
        raw = buffer.raw()
        if raw.nbytes < LARGE_BYTES:
            return True
        arrays.append(raw)
        return False

    written = io.BytesIO()
    _Pickler(written, protocol=pickle.HIGHEST_PROTOCOL, buffer_callback=leave_out).dump(message)
    return written.getvalue(), arrays


class _Pickler(pickle.Pickler):
    def reducer_override(self, value: Any) -> Any:  # noqa: ANN401 - the base's
        if type(value) is np.ndarray:
            whole = np.ascontiguousarray(value)
            return _array, (pickle.PickleBuffer(whole.data), whole.dtype.str, value.shape)
        if isinstance(value, TidegateError):
            return _error, (type(value), value.args, dict(value.__dict__))
        return NotImplemented


def _array(content: Any, kind: str, shape: tuple[int, ...]) -> npt.NDArray[Any]:  # noqa: ANN401 - any buffer
    array = np.frombuffer(content, dtype=kind).reshape(shape)
    array.setflags(write=False)
    return array


def _error(kind: type[TidegateError], args: tuple[object, ...], fields: dict[str, object]) -> TidegateError:
    error = kind.__new__(kind)
    error.args = args
    error.__dict__.update(fields)
    return error


def end_with_the_service() -> None:
    """Request SIGKILL: no line is open yet, and a camera driver that hangs would keep the camera."""
    signal_at_parent_death(signal.SIGKILL)


def wake_without_the_service() -> None:
    """Request SIGCONT: a stopped process continues, to hold its session's line and complete its journal before it ends.

    The kernel also continues orphaned process groups; whether it does depends on the group's parents.
    """
    signal_at_parent_death(signal.SIGCONT)


class SharedPage:
    """The mapped memory; both processes open it by the same file."""

    def __init__(self, file: int) -> None:
        self._memory = mmap.mmap(file, SIZE)
        self._written = 0

    @staticmethod
    def make() -> int:
        """Create the memory; return its open file descriptor."""
        file = os.memfd_create("tidegate-engine", os.MFD_CLOEXEC)
        os.ftruncate(file, SIZE)
        return file

    def mark_cancelled(self, slot: int) -> None:
        """Cancel the command of this slot: it must not be executed any more."""
        self._memory[slot] = 1

    def clear(self, slot: int) -> None:
        """Reset a slot for a new command."""
        self._memory[slot] = 0

    def is_cancelled(self, slot: int) -> bool:
        """Whether the command of this slot was cancelled."""
        return self._memory[slot] == 1

    def write_picture(self, frame_index: int, picture: ColorImage) -> bool:
        """Write the newest picture; return False where it is too large."""
        if picture.nbytes > PICTURE_BYTES:
            return False
        self._written += 1
        at = _place(self._written)
        _NUMBER.pack_into(self._memory, at, NOT_WHOLE)
        _FRAME.pack_into(self._memory, at + _NUMBER.size, frame_index, *picture.shape)
        whole = np.ascontiguousarray(picture).reshape(-1)
        self._memory[at + _HEAD_BYTES : at + _HEAD_BYTES + picture.nbytes] = whole.data
        _NUMBER.pack_into(self._memory, at, self._written)
        return True

    def read_picture(self) -> tuple[int, ColorImage] | None:
        """Copy the newest picture, with its frame's index; None before there is one.

        What is newest is read here and not from the engine's messages: these may be late, and a picture is overwritten
        once there are newer ones in all other places.
        """
        end_s = time.monotonic() + READ_S
        while (number := self._newest_number()) > 0:
            found = self._copy(number)
            if found is not None or time.monotonic() > end_s:
                return found
        return None

    def _newest_number(self) -> int:
        return max(self._number_at(place) for place in range(PICTURES))

    def _number_at(self, number: int) -> int:
        found: int = _NUMBER.unpack_from(self._memory, _place(number))[0]
        return found

    def _copy(self, number: int) -> tuple[int, ColorImage] | None:
        """Copy a picture; None where a newer one has replaced it meanwhile."""
        at = _place(number)
        frame_index, *shape = _FRAME.unpack_from(self._memory, at + _NUMBER.size)
        copied = self._memory[at + _HEAD_BYTES : at + _HEAD_BYTES + math.prod(shape)]
        if self._number_at(number) != number:
            return None
        return frame_index, np.frombuffer(copied, np.uint8).reshape(shape)

    def close(self) -> None:
        """Unmap the memory."""
        self._memory.close()


def _place(number: int) -> int:
    return _FIRST + number % PICTURES * _STEP
