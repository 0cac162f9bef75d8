"""Channels between the service and its engine process: pickled values over a socket pair that the child inherits.

Both ends are this program, run by one user, and one started the other; no socket listens. Arrays and errors are encoded
specially: arrays arrive read-only, large ones without being copied; an error arrives as its class with its fields,
although its constructor takes other arguments than its message.
"""

import io
import pickle
import socket
import struct
import threading
from contextlib import suppress
from typing import Any

import numpy as np
import numpy.typing as npt

from engine.core.errors import TidegateError

LARGE_BYTES = 65_536
"""Smaller arrays are copied into the message; larger ones follow it."""
MOST_BYTES = 1 << 30
LARGEST_CONTROL_BYTES = 65_536

_HEAD = struct.Struct("<QI")
_SIZE = struct.Struct("<Q")


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
