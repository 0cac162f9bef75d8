"""A corpus made small: the fewest and shortest inputs that go every way which all inputs together go.

Ways are pairs of lines of our own code that follow each other; the same on every machine, other than a fuzzer's counts.
"""

import hashlib
import sys
from collections.abc import Iterable, Iterator, Mapping
from types import FrameType, MappingProxyType
from typing import Any

from tests.support.repository import ROOT
from verification.fuzz.target import Target

OURS = tuple(f"{ROOT / package}/" for package in ("engine", "service", "lab"))
Way = tuple[str, int, int]


def ways_of(target: Target, content: bytes) -> set[Way]:
    """Which ways an input goes."""
    found: set[Way] = set()
    last: dict[int, int] = {}

    def trace(frame: FrameType, event: str, _argument: Any) -> Any:
        file = frame.f_code.co_filename
        if not file.startswith(OURS):
            return None
        if event == "line":
            found.add((file, last.get(id(frame), 0), frame.f_lineno))
            last[id(frame)] = frame.f_lineno
        elif event == "call":
            last[id(frame)] = 0
        return trace

    sys.settrace(trace)
    try:
        target.try_one(content)
    finally:
        sys.settrace(None)
    return found


def minimised(target: Target, inputs: Iterable[bytes]) -> Iterator[bytes]:
    """Yield, shortest first, the inputs that go a way which none before went."""
    seen: set[Way] = set()
    for content in sorted(set(inputs), key=lambda one: (len(one), one)):
        ways = ways_of(target, content)
        if not ways <= seen:
            seen |= ways
            yield content


def name_of(content: bytes) -> str:
    """Name an input by what it is."""
    return hashlib.sha256(content).hexdigest()[:16]


def keep(
    target: Target, inputs: Iterable[bytes], always: Mapping[str, bytes] = MappingProxyType({})
) -> dict[str, bytes]:
    """Keep the minimised corpus in place of the one that is there, and those in ``always``; return what is kept."""
    chosen = {**always, **{name_of(content): content for content in minimised(target, inputs)}}
    target.keep(chosen)
    return chosen
