"""Memory that the service and its engine process share: cancellation flags of commands, and the newest pictures.

It has no name in any folder, so none of it remains after the processes. Flags are single bytes; a picture's number is
written before and after it and checked by the reader. Neither side waits for the other.
"""

import mmap
import os
import struct

import numpy as np

from engine.core.frames import ColorImage

SLOTS = 64
"""Flags of commands in progress; the engine's command queue has fewer places."""
PICTURES = 3
PICTURE_BYTES = 4 << 20
"""A colour picture of 1280 x 1024 pixels fits; unused pages of memory are never allocated."""
_NUMBER = struct.Struct("<q")
_FIRST = mmap.PAGESIZE
_STEP = _FIRST + PICTURE_BYTES
SIZE = _FIRST + PICTURES * _STEP
NOT_WHOLE = -1


class SharedPage:
    """The mapped memory; both processes open it by the same file."""

    def __init__(self, file: int) -> None:
        self._memory = mmap.mmap(file, SIZE)

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

    def write_picture(self, number: int, picture: ColorImage) -> bool:
        """Write a picture under an ascending number; return False where it is too large."""
        if picture.nbytes > PICTURE_BYTES:
            return False
        at = _place(number)
        _NUMBER.pack_into(self._memory, at, NOT_WHOLE)
        whole = np.ascontiguousarray(picture).reshape(-1)
        self._memory[at + _NUMBER.size : at + _NUMBER.size + picture.nbytes] = whole.data
        _NUMBER.pack_into(self._memory, at, number)
        return True

    def read_picture(self, number: int, shape: tuple[int, ...]) -> ColorImage | None:
        """Copy a picture; None where a newer one has replaced it meanwhile."""
        at = _place(number)
        size = int(np.prod(shape))
        picture = np.frombuffer(self._memory[at + _NUMBER.size : at + _NUMBER.size + size], np.uint8).reshape(shape)
        return picture if _NUMBER.unpack_from(self._memory, at)[0] == number else None

    def close(self) -> None:
        """Unmap the memory."""
        self._memory.close()


def _place(number: int) -> int:
    return _FIRST + number % PICTURES * _STEP
