"""Memory that the service and its engine process share: cancellation flags of commands, and the newest pictures.

It has no name in any folder, so none of it remains after the processes. Flags are single bytes. Pictures are written in
turn to a few places, each with an ascending number: the reader takes the newest, and checks after the copy that the
number is still there. Neither side waits for the other.
"""

import math
import mmap
import os
import struct
import time

import numpy as np

from engine.core.frames import ColorImage

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
