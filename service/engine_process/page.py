"""A page of memory that the service and its engine's process share: who has given up, and the newest pictures.

It has no name in any folder, so nothing is left of it. Both sides write single bytes, or numbers that are read again
afterwards; nobody waits for anybody.
"""

import mmap
import os
import struct

import numpy as np

from engine.frames import ColorImage

SLOTS = 64
"""More orders than this are never under way; the engine's own mailbox takes fewer."""
PICTURES = 3
PICTURE_BYTES = 4 << 20
"""A colour picture of 1280 x 1024 fits; memory that no picture touches is not taken."""
_NUMBER = struct.Struct("<q")
_FIRST = mmap.PAGESIZE
_STEP = _FIRST + PICTURE_BYTES
SIZE = _FIRST + PICTURES * _STEP
NOT_WHOLE = -1


class Page:
    """See the module."""

    def __init__(self, file: int) -> None:
        self._memory = mmap.mmap(file, SIZE)

    @staticmethod
    def make() -> int:
        """Make the memory; returns its open file."""
        file = os.memfd_create("tidegate-engine", os.MFD_CLOEXEC)
        os.ftruncate(file, SIZE)
        return file

    def give_up(self, slot: int) -> None:
        """Say that nobody waits for the order of this slot any more: it must not be carried out."""
        self._memory[slot] = 1

    def begin(self, slot: int) -> None:
        """Take a slot for an order."""
        self._memory[slot] = 0

    def is_given_up(self, slot: int) -> bool:
        """Whether its asker has given up."""
        return self._memory[slot] == 1

    def show(self, number: int, picture: ColorImage) -> bool:
        """Leave a picture under a rising number; false where it is too large."""
        if picture.nbytes > PICTURE_BYTES:
            return False
        at = _place(number)
        _NUMBER.pack_into(self._memory, at, NOT_WHOLE)
        whole = np.ascontiguousarray(picture).reshape(-1)
        self._memory[at + _NUMBER.size : at + _NUMBER.size + picture.nbytes] = whole.data
        _NUMBER.pack_into(self._memory, at, number)
        return True

    def look(self, number: int, shape: tuple[int, ...]) -> ColorImage | None:
        """Copy a picture; None when a newer one has come over it meanwhile."""
        at = _place(number)
        size = int(np.prod(shape))
        picture = np.frombuffer(self._memory[at + _NUMBER.size : at + _NUMBER.size + size], np.uint8).reshape(shape)
        return picture if _NUMBER.unpack_from(self._memory, at)[0] == number else None

    def close(self) -> None:
        """Give the memory back."""
        self._memory.close()


def _place(number: int) -> int:
    return _FIRST + number % PICTURES * _STEP
