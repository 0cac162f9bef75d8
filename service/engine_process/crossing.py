"""How values cross between the service and its engine's process: pickled, over a pair of sockets that both inherit.

Both ends are this program, of one user, and one started the other; nothing here ever listens. Arrays and errors are
written in ways of their own: arrays come read-only, as all of ours are, and large ones without being copied; an error
comes as its class with its fields, although its constructor takes something else than its message.
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

from engine.errors import TidegateError

LARGE_BYTES = 65_536
"""Smaller arrays are copied into the message; of larger ones the message is only the order."""
MOST_BYTES = 1 << 30
LONGEST_WHISPER_BYTES = 65_536

_HEAD = struct.Struct("<QI")
_SIZE = struct.Struct("<Q")


class CrossingClosedError(Exception):
    """The other process is gone."""


class Speech:
    """Messages of any size, in order; one thread receives, any may send."""

    def __init__(self, end: socket.socket) -> None:
        self._end = end
        self._sending = threading.Lock()

    def send(self, message: object) -> None:
        """Send, however long the other process takes to receive; raise CrossingClosedError when it is gone."""
        body, arrays = pack(message)
        sizes = b"".join(_SIZE.pack(array.nbytes) for array in arrays)
        try:
            with self._sending:
                self._end.sendall(_HEAD.pack(len(body), len(arrays)) + sizes + body)
                for array in arrays:
                    self._end.sendall(array)
        except OSError as error:
            raise CrossingClosedError from error

    def receive(self) -> Any:  # noqa: ANN401 - whoever receives matches on it
        """Wait for the next message."""
        size, count = _HEAD.unpack(self._read(_HEAD.size))
        sizes = [_SIZE.unpack(self._read(_SIZE.size))[0] for _ in range(count)]
        if size + sum(sizes) > MOST_BYTES:
            raise CrossingClosedError
        body = self._read(size)
        return pickle.loads(body, buffers=[self._read(one) for one in sizes])  # noqa: S301 - see the module # nosec B301

    def patience(self, seconds: float | None) -> None:
        """Wait no longer than so for each piece; the other process then counts as gone. None waits for ever."""
        self._end.settimeout(seconds)

    def close(self) -> None:
        """Hang up: the other end hears it at once."""
        _hang_up(self._end)

    def _read(self, size: int) -> memoryview:
        found = np.empty(size, np.uint8).data  # not filled with zeros first: that would hold the interpreter
        at = 0
        while at < size:
            try:
                count = self._end.recv_into(found[at:])
            except OSError as error:
                raise CrossingClosedError from error
            if count == 0:
                raise CrossingClosedError
            at += count
        return found


class Whisper:
    """Small messages that wait for nothing: each arrives whole and in order, or is not sent at all."""

    def __init__(self, end: socket.socket) -> None:
        self._end = end

    def send(self, message: object) -> bool:
        """Send; false when the other process has not read for so long that there is no room, or is gone."""
        try:
            self._end.send(pickle.dumps(message, protocol=pickle.HIGHEST_PROTOCOL), socket.MSG_DONTWAIT)
        except OSError:
            return False
        return True

    def receive(self) -> Any:  # noqa: ANN401 - whoever receives matches on it
        """Wait for the next message."""
        try:
            found = self._end.recv(LONGEST_WHISPER_BYTES)
        except OSError as error:
            raise CrossingClosedError from error
        if not found:
            raise CrossingClosedError
        return pickle.loads(found)  # noqa: S301 - see the module # nosec B301

    def send_file(self, file: int) -> None:
        """Hand over an open file, whose locks go along."""
        try:
            socket.send_fds(self._end, [b"file"], [file])
        except OSError as error:
            raise CrossingClosedError from error

    def receive_file(self) -> int:
        """Take a file that was handed over."""
        _, files, _, _ = socket.recv_fds(self._end, LONGEST_WHISPER_BYTES, 1)
        if not files:
            raise CrossingClosedError
        return files[0]

    def close(self) -> None:
        """Hang up."""
        _hang_up(self._end)


def _hang_up(end: socket.socket) -> None:
    """Hang up an end that may be hung up already; who waits at it is woken."""
    with suppress(OSError):
        end.shutdown(socket.SHUT_RDWR)
    end.close()


def pack(message: object) -> tuple[bytes, list[memoryview]]:
    """Write a message, and beside it its large arrays as they lie in memory."""
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
