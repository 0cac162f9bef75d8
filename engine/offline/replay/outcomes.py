"""The outputs of a turn as rows that two runs can be compared by: every number in full, and a digest of everything."""

import dataclasses
import enum
import hashlib
import json
import struct
from typing import Any

import numpy as np

from engine.control.outputs import FrameRecord, GateTransition

FLOAT = struct.Struct("<d")
DIGEST_BYTES = 12

Row = dict[str, Any]


def row_of(outcome: object) -> Row:
    """Return the row of a record or a transition; raise TypeError for anything else."""
    match outcome:
        case FrameRecord():
            return _record_row(outcome)
        case GateTransition():
            return transition_row(outcome)
    msg = f"a {type(outcome).__name__} is not an output of the engine"
    raise TypeError(msg)


def is_transition(row: Row) -> bool:
    """Whether a row is a transition's."""
    return "to" in row


def same(one: Row, other: Row) -> bool:
    """Whether two rows are equal to the last bit."""
    return text_of(one) == text_of(other)


def text_of(row: Row) -> str:
    """Return a row as one line of JSON; NaN equals NaN there."""
    return json.dumps(row, sort_keys=True)


def transition_row(transition: GateTransition) -> Row:
    """Return a transition's row, with all of its fields."""
    return {
        "from": transition.from_state.value,
        "to": transition.to_state.value,
        "reason": None if transition.reason is None else transition.reason.value,
        "frame": transition.frame_index,
        "operator": transition.operator,
        "detail": transition.detail,
        "captured_us": transition.captured_us,
        "received_ns": transition.received_ns,
        "captured_ns": transition.captured_ns,
        "decided_ns": transition.decided_ns,
        "asserted_ns": transition.asserted_ns,
        "armed_by": transition.armed_by,
    }


def _record_row(record: FrameRecord) -> Row:
    measurement = record.measurement
    motion = measurement.motion
    return {
        "frame": measurement.frame_index,
        "timestamp_us": measurement.timestamp_us,
        "state": measurement.state.value,
        "gate": record.gate_state.value,
        "reason": None if record.hold_reason is None else record.hold_reason.value,
        "whole_mm": None if motion is None else motion.whole_mm,
        "thorax_mm": None if motion is None else motion.thorax_mm,
        "abdomen_mm": None if motion is None else motion.abdomen_mm,
        "volume_l": None if motion is None else motion.volume_l,
        "line_on": record.line_on,
        "decided_ns": record.decided_ns,
        "asserted_ns": record.asserted_ns,
        "digest": digest_of(record),
    }


def digest_of(value: object) -> str:
    """Return a hash over all bits of a value and everything in it, but for fields marked as not part of it."""
    digest = hashlib.blake2b(digest_size=DIGEST_BYTES)
    _add(digest, value)
    return digest.hexdigest()


def _add(digest: "hashlib.blake2b", value: Any) -> None:  # noqa: ANN401
    bits = _bits_of(value)
    if bits is not None:
        digest.update(bits)
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            if not field.metadata.get("is_in_digest", True):
                continue
            digest.update(field.name.encode())
            _add(digest, getattr(value, field.name))
    elif isinstance(value, tuple | list):
        digest.update(b"(%d" % len(value))
        for one in value:
            _add(digest, one)
    else:
        msg = f"a {type(value).__name__} has no digest"
        raise TypeError(msg)


def _bits_of(value: Any) -> bytes | None:  # noqa: ANN401
    """Return the bits of a value that has no parts; None for others."""
    if isinstance(value, float):
        return FLOAT.pack(value)
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{value.shape}".encode() + np.ascontiguousarray(value).tobytes()
    if isinstance(value, enum.Enum):
        return str(value.value).encode() + b";"
    if value is None or isinstance(value, bool | int | str | np.generic):
        return repr(value).encode() + b";"
    return None
