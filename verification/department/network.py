"""The hub in a network namespace of its own, with one cable to each room: a cable is cut by taking it down."""

import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

NET = "198.18"
"""Addresses that are set aside for measurements of networks (RFC 2544)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cable:
    """One room's end of a cable to the hub."""

    device: str
    address: str

    def cut(self) -> None:
        """Take the cable away: nothing passes, and nobody answers."""
        _ip("link", "set", self.device, "down")

    def mend(self) -> None:
        """Put it back."""
        _ip("link", "set", self.device, "up")

    def bytes_passed(self) -> int:
        """Count what has passed, both ways, with Ethernet's heads."""
        counters = Path("/sys/class/net", self.device, "statistics")
        return sum(int((counters / f"{way}_bytes").read_text(encoding="ascii")) for way in ("rx", "tx"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Network:
    """The hub's namespace and its cables."""

    name: str
    cables: tuple[Cable, ...]

    @property
    def words(self) -> list[str]:
        """The words before a command that run it at the hub."""
        return ["ip", "netns", "exec", self.name]


@contextmanager
def network(rooms: int) -> Iterator[Network]:
    """Make the namespace and the cables; remove them at the end. Needs root."""
    name = f"tghub{os.getpid()}"
    _ip("netns", "add", name)
    try:
        _ip("-n", name, "link", "set", "lo", "up")
        yield Network(name=name, cables=tuple(_cable(name, number) for number in range(1, rooms + 1)))
    finally:
        _ip("netns", "del", name)  # the cables end with it


def _cable(name: str, number: int) -> Cable:
    here, there = f"tgr{os.getpid() % 100_000}-{number}", f"tgh{os.getpid() % 100_000}-{number}"
    _ip("link", "add", here, "type", "veth", "peer", "name", there, "netns", name)
    _ip("address", "add", f"{NET}.{number}.1/24", "dev", here)
    _ip("-n", name, "address", "add", f"{NET}.{number}.2/24", "dev", there)
    _ip("link", "set", here, "up")
    _ip("-n", name, "link", "set", there, "up")
    return Cable(device=here, address=f"{NET}.{number}.1")


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True)
