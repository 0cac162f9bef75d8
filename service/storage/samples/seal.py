"""Seals: a SHA-256 over the bytes of a batch in the file, and over the seal before it.

A batch carries its own seal in its metadata. It is taken with a blank of the same length in the seal's place, so every
byte of the file is under a seal: head, batches, what describes them, and padding.
"""

import hashlib

FIRST = ""
"""The seal before the first batch."""
BLANK = "-" * 64


def seal_of(before: str, message: bytes | bytearray | memoryview) -> str:
    """Seal a message that has a blank where its seal belongs."""
    digest = hashlib.sha256(before.encode())
    digest.update(message)
    return digest.hexdigest()


def seal_in_place(written: bytearray, start: int, before: str) -> str:
    """Seal the bytes from ``start`` on, and write the seal into its blank."""
    with memoryview(written) as whole, whole[start:] as message:
        seal = seal_of(before, message)
    place = written.index(BLANK.encode(), start)
    written[place : place + len(BLANK)] = seal.encode()
    return seal


def is_sealed(message: bytes, before: str, seal: str) -> bool:
    """Whether a message from a file carries the seal that its bytes have."""
    blank = message.replace(seal.encode(), BLANK.encode(), 1)
    return len(seal) == len(BLANK) and seal_of(before, blank) == seal
