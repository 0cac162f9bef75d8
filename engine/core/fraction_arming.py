"""What a fraction was armed with first, and what a second person signed, as a document that its sessions share.

Edges are mm of the patient against the fraction's first reference (of a phase per cent of the breath), so they are
compared over sessions, programs and references.
"""

import json
import math
from dataclasses import asdict, dataclass
from typing import NamedTuple

from engine.core.errors import InvalidValueError
from engine.core.strict_json import ROOT, StrictJson

SCHEMA = "tidegate.fraction-arming/1"
MAX_CONDITIONS = 4
MAX_EDGE = 10_000.0
_JSON = StrictJson(max_bytes=16 * 1024)
_CONDITION = ("kind", "lower", "upper", "set_lower", "set_upper", "unit")
PHASE = "percent of the breath"
MAX_ROUNDING = 1e-6


class PlacedCondition(NamedTuple):
    """A condition of a window, where it lies in the patient, and as it was set.

    Attributes
    ----------
    kind
        Kind of condition, its signal, and how the window joins its conditions.
    lower, upper
        Edges against the fraction's first reference [mm]; of a phase [% of the breath].
    set_lower, set_upper, unit
        Edges as they were set, against the reference of then, without a baseline correction.
    """

    kind: str
    lower: float
    upper: float
    set_lower: float
    set_upper: float
    unit: str

    @property
    def is_phase(self) -> bool:
        """Whether its edges are phases, which run in a circle."""
        return self.unit == PHASE


PlacedWindow = tuple[PlacedCondition, ...]
"""The conditions of a window, in their order."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FractionArming:
    """What a fraction was armed with.

    Attributes
    ----------
    first
        The window of the fraction's first arming, or of the last one that went beyond it with a person's reason: the
        budget counts from it.
    armed_by
        The operator who armed with it.
    signed
        The last window that was armed with a second person's signature; None where none was.
    signed_by, signed_for
        Who signed it, and the operator who armed with it; empty where none was.
    """

    first: PlacedWindow
    armed_by: str
    signed: PlacedWindow | None = None
    signed_by: str = ""
    signed_for: str = ""

    def to_json(self) -> str:
        """Return the document."""
        return json.dumps(
            {
                "schema": SCHEMA,
                **asdict(self),
                "first": [one._asdict() for one in self.first],
                "signed": None if self.signed is None else [one._asdict() for one in self.signed],
            },
            allow_nan=False,
        )


def read_fraction_arming(text: str) -> FractionArming:
    """Read a document; raise InvalidValueError, with the field, for one that is damaged."""
    required = ("schema", "first", "armed_by", "signed", "signed_by", "signed_for")
    fields = _JSON.fields(ROOT, _JSON.parse(text.encode()), required=required)
    if fields["schema"] != SCHEMA:
        raise InvalidValueError("schema", fields["schema"], SCHEMA)
    is_signed = fields["signed"] is not None
    if is_signed is not bool(fields["signed_by"]):
        raise InvalidValueError("signed_by", fields["signed_by"], "a name exactly where a window was signed")
    return FractionArming(
        first=_window("first", fields["first"]),
        armed_by=_JSON.name("armed_by", fields["armed_by"]),
        signed=_window("signed", fields["signed"]) if is_signed else None,
        signed_by=_JSON.name("signed_by", fields["signed_by"]) if is_signed else "",
        signed_for=_JSON.name("signed_for", fields["signed_for"]) if is_signed else "",
    )


def _window(field: str, found: object) -> PlacedWindow:
    conditions = enumerate(_JSON.items(field, found, 1, MAX_CONDITIONS))
    return tuple(_condition(f"{field}[{number}]", one) for number, one in conditions)


def _condition(field: str, found: object) -> PlacedCondition:
    fields = _JSON.fields(field, found, required=_CONDITION)
    numbers = {
        name: _JSON.number(f"{field}.{name}", fields[name], -MAX_EDGE, MAX_EDGE)
        for name in ("lower", "upper", "set_lower", "set_upper")
    }
    kind, unit = (_JSON.name(f"{field}.{name}", fields[name]) for name in ("kind", "unit"))
    return PlacedCondition(kind=kind, unit=unit, **numbers)


def reach_beyond(before: PlacedWindow | None, now: PlacedWindow) -> float:
    """Return how far ``now`` reaches beyond ``before`` in the patient [mm]; 0 where it lies inside, or for None.

    Infinite for other conditions, and for a phase that reaches beyond the earlier one.
    """
    if before is None:
        return 0.0
    if [one.kind for one in before] != [one.kind for one in now]:
        return math.inf
    return max(0.0, *(_beyond(*pair) for pair in zip(before, now, strict=True)))


def is_set_beyond(before: PlacedWindow, now: PlacedWindow) -> bool:
    """Whether a window was set to reach beyond an earlier one at all: in other units it cannot be compared."""
    if [(one.kind, one.unit) for one in before] != [(one.kind, one.unit) for one in now]:
        return True
    return reach_beyond(_as_set(before), _as_set(now)) > MAX_ROUNDING


def _as_set(window: PlacedWindow) -> PlacedWindow:
    return tuple(one._replace(lower=one.set_lower, upper=one.set_upper) for one in window)


def _beyond(before: PlacedCondition, now: PlacedCondition) -> float:
    if now.is_phase:
        width, offset = _arc(before.lower, before.upper), _arc(before.lower, now.lower)
        return 0.0 if offset + _arc(now.lower, now.upper) <= width else math.inf
    return max(before.lower - now.lower, now.upper - before.upper)


def _arc(start: float, end: float) -> float:
    """Return the way from one phase to another [%], onwards."""
    return (end - start) % 100.0
