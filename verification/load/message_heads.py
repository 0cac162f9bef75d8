"""The little that a light client reads of a live message: what kind it is, its number, its frame, its age."""

import re
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

LOOKED_AT_BYTES = 4096
TYPE = re.compile(rb'"type":\s*"(\w+)"')
NUMBERS = {
    name: re.compile(rb'"%s":\s*(-?[\d.]+)' % name.encode())
    for name in ("sequence", "frame_index", "age_ms", "skipped")
}
SENT_AT = re.compile(rb'"sent_at":\s*"([^"]+)"')


@dataclass(frozen=True, slots=True, kw_only=True)
class Head:
    """Of one message; what it does not carry is None.

    Attributes
    ----------
    made_s
        When the frame was in the service's hands, by the wall clock [s]: when it was sent, less its age.
    """

    kind: str
    sequence: int | None = None
    frame_index: int | None = None
    made_s: float | None = None
    skipped: int = 0

    @property
    def age_now_ms(self) -> float | None:
        """Time since the frame was in the service's hands [ms]."""
        return None if self.made_s is None else 1e3 * (time.time() - self.made_s)


def read_head(payload: bytes) -> Head:
    """Read what is needed of a message."""
    kind = TYPE.search(payload, 0, 64) or TYPE.search(payload)
    said: dict[str, Any] = {"type": kind[1].decode() if kind else "none"}
    for name, pattern in NUMBERS.items():
        if found := pattern.search(payload, 0, LOOKED_AT_BYTES):
            said[name] = float(found[1])
    if sent := SENT_AT.search(payload, 0, LOOKED_AT_BYTES):
        said["sent_at"] = sent[1].decode()
    sent, age_ms = said.get("sent_at"), said.get("age_ms")
    made_s = None if sent is None or age_ms is None else _wall_s(sent) - float(age_ms) / 1e3
    return Head(
        kind=str(said.get("type")),
        sequence=_whole(said.get("sequence")),
        frame_index=_whole(said.get("frame_index")),
        made_s=made_s,
        skipped=_whole(said.get("skipped")) or 0,
    )


def _wall_s(sent: str) -> float:
    return datetime.fromisoformat(sent).astimezone(UTC).timestamp()


def _whole(value: object) -> int | None:
    return None if value is None else int(value)
