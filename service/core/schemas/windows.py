"""Schemas of the requested gating window: up to four conditions, each an amplitude, a breath hold or a phase.

The first condition's fields are in the window itself, further conditions in the list `further`. The bounds here hold
for all sites. `engine.gating.windows` validates each condition; its errors are mapped to the names of the request's
fields.
"""

from collections.abc import Iterator
from typing import Annotated, Any, Literal, Self

from pydantic import Field, StringConstraints, model_validator

from engine.core.breath import SignalChoice
from engine.core.errors import InvalidValueError
from engine.gating import (
    DWELL_MS,
    HOLD_BOUNDS,
    HYSTERESIS as DEFAULT_HYSTERESIS,
    MAX_CONDITIONS,
    AmplitudeWindow,
    BreathHoldWindow,
    Condition as EngineCondition,
    PhaseWindow,
    Unit,
)
from engine.motion import NAME_PATTERN
from service.core.schemas.base import Request, broken

SignalName = Literal["whole", "thorax", "abdomen", "region", "named", "point", "volume"]
ConditionKind = Literal["amplitude", "breath_hold", "phase"]
HoldName = Literal["inspiration", "expiration"]
JoinName = Literal["and", "or"]

REGION_ROWS, REGION_COLUMNS = 14, 8
LONGEST_STILL_L = 5.0
HYSTERESIS = {unit.value: distance for unit, distance in DEFAULT_HYSTERESIS.items()}
"""Default distance inside the edges that a signal must reach to enter, by unit."""

STILL = {"mm": 1.0, "l": 0.05}
MAX_DRIFT = {"mm": 2.0, "l": 0.1}
EDGES = ("lower", "upper", "hysteresis")
EDGE_FIELDS = frozenset(f"{edge}_{unit}" for unit in HYSTERESIS for edge in EDGES)
HOLD_FIELDS = frozenset({"hold", "settle_ms", "still_mm", "still_l", "max_drift_mm", "max_drift_l", "timeout_s"})
PHASE_FIELDS = frozenset({"from_percent", "to_percent", "min_confidence"})
FIELDS_OF: dict[str, frozenset[str]] = {
    "amplitude": EDGE_FIELDS,
    "breath_hold": EDGE_FIELDS | HOLD_FIELDS,
    "phase": PHASE_FIELDS,
}


def _bounded(name: str, highest: float | None = None) -> Any:  # noqa: ANN401 - a field of any number's type
    low, high = HOLD_BOUNDS[name]
    return Field(default=None, ge=low, le=high if highest is None else highest)


class Condition(Request):
    """A condition that the breathing must meet."""

    kind: ConditionKind = Field(
        default="amplitude",
        description="`amplitude` needs edges, `phase` a range of phases; a `breath_hold` without edges gets them from "
        "a breath that was held (`POST /sessions/{id}/window`), and is not armed before",
    )
    signal: SignalName = "whole"
    row: int | None = Field(
        default=None,
        ge=0,
        le=349,
        description="For `region`: row of the region grid, 0 to 13; for `point`: row of the fine grid",
    )
    column: int | None = Field(
        default=None,
        ge=0,
        le=199,
        description="For `region`: column of the region grid, 0 to 7; for `point`: column of the fine grid",
    )
    name: Annotated[str, StringConstraints(pattern=NAME_PATTERN)] | None = Field(
        default=None, description="Name of one of the session's regions; only for signal `named`"
    )
    lower_mm: float | None = Field(
        default=None,
        ge=-100.0,
        le=100.0,
        examples=[-1.0],
        description="Send both edges in the same unit: mm, l or percent",
    )
    upper_mm: float | None = Field(default=None, ge=-100.0, le=100.0, examples=[3.0])
    hysteresis_mm: float | None = Field(
        default=None,
        ge=0.0,
        le=10.0,
        description="Distance inside the edges that the signal must reach to enter; 0.2 when left out",
    )
    lower_l: float | None = Field(default=None, ge=-20.0, le=20.0, description="Only for signal `volume`")
    upper_l: float | None = Field(default=None, ge=-20.0, le=20.0)
    hysteresis_l: float | None = Field(default=None, ge=0.0, le=10.0, description="0.01 when left out")
    lower_percent: float | None = Field(
        default=None,
        ge=-100.0,
        le=300.0,
        description="Percent of the breathing range during training; 0 is end of exhale",
    )
    upper_percent: float | None = Field(default=None, ge=-100.0, le=300.0)
    hysteresis_percent: float | None = Field(default=None, ge=0.0, le=150.0, description="2 when left out")
    hold: HoldName | None = Field(
        default=None, description="Phase in which the breath is held; `inspiration` when left out"
    )
    settle_ms: float | None = _bounded("settle_ms")
    still_mm: float | None = _bounded("still")
    still_l: float | None = _bounded("still", LONGEST_STILL_L)
    max_drift_mm: float | None = _bounded("max_drift")
    max_drift_l: float | None = _bounded("max_drift", LONGEST_STILL_L)
    timeout_s: float | None = _bounded("timeout_s")
    from_percent: float | None = Field(default=None, ge=0.0, le=100.0, description="Phase; 0 is the end of inhale")
    to_percent: float | None = Field(default=None, ge=0.0, le=100.0)
    min_confidence: float | None = Field(default=None, ge=0.1, le=1.0, description="0.6 when left out")

    @model_validator(mode="before")
    @classmethod
    def _fill_in(cls, given: Any) -> Any:  # noqa: ANN401 - whatever a client sends
        """Insert the defaults of fields that are left out, so that a stored window is complete."""
        if not isinstance(given, dict):
            return given
        values = {name: value for name, value in given.items() if value is not None}
        usual: dict[str, object] = {}
        kind = values.get("kind", "amplitude")
        if kind in ("amplitude", "breath_hold"):
            units = [unit for unit in HYSTERESIS if f"lower_{unit}" in values or f"upper_{unit}" in values]
            usual |= {f"hysteresis_{unit}": HYSTERESIS[unit] for unit in units[:1]}
        if kind == "breath_hold":
            unit = "l" if values.get("signal") == "volume" else "mm"
            usual |= {"hold": "inspiration", "settle_ms": 1_000.0, "timeout_s": 25.0}
            usual |= {f"still_{unit}": STILL[unit], f"max_drift_{unit}": MAX_DRIFT[unit]}
        if kind == "phase":
            usual["min_confidence"] = 0.6
        return {**given, **{name: value for name, value in usual.items() if name not in values}}

    @model_validator(mode="after")
    def _is_one(self) -> Self:
        self._refuse_unrelated_fields()
        self._check_place()
        if self.kind != "phase":
            self._check_edges()
        try:
            self.to_engine()
        except InvalidValueError as error:
            raise broken(self._field(error.field), error.value, error.bound) from error
        return self

    @property
    def unit(self) -> str:
        """Unit of the edges: "mm", "l" or "percent"."""
        return next((unit for unit in HYSTERESIS if getattr(self, f"lower_{unit}") is not None), "mm")

    def choice(self, index: int = 0) -> SignalChoice:
        """Return the signal; ``index`` is the position of a point or named region in the list of measured ones."""
        return SignalChoice(signal=self.signal, row=self.row, column=self.column, name=self.name, index=index)

    def to_engine(self, index: int = 0) -> EngineCondition:
        """Convert to the engine's condition; raise InvalidValueError."""
        choice = self.choice(index)
        if self.kind == "phase":
            for name in ("from_percent", "to_percent"):
                if getattr(self, name) is None:
                    raise InvalidValueError(name, None, "given for kind phase")
            numbers = {name: getattr(self, name) for name in PHASE_FIELDS}
            return PhaseWindow(choice=choice, **numbers)
        if self._awaits_edges:
            level = AmplitudeWindow(choice=choice, unit=Unit.PERCENT, lower=0.0, upper=100.0)
        else:
            edges = {edge: getattr(self, f"{edge}_{self.unit}") for edge in EDGES}
            level = AmplitudeWindow(choice=choice, unit=Unit(self.unit), **edges)
        if self.kind == "amplitude":
            return level
        unit = self._length
        return BreathHoldWindow(
            level=level,
            kind=self.hold or "inspiration",
            still=getattr(self, f"still_{unit}"),
            max_drift=getattr(self, f"max_drift_{unit}"),
            is_level_set=not self._awaits_edges,
            **{name: getattr(self, name) for name in ("settle_ms", "timeout_s")},
        )

    @property
    def _awaits_edges(self) -> bool:
        return self.kind == "breath_hold" and all(getattr(self, name) is None for name in EDGE_FIELDS)

    @property
    def _length(self) -> str:
        return "l" if self.signal == "volume" else "mm"

    def _field(self, engine_field: str) -> str:
        """Return the request's field name for a field of the engine's condition."""
        names = {"still": f"still_{self._length}", "max_drift": f"max_drift_{self._length}", "kind": "hold"}
        return {**names, "unit": f"lower_{self.unit}"}.get(engine_field, engine_field)

    def _refuse_unrelated_fields(self) -> None:
        for name in sorted((EDGE_FIELDS | HOLD_FIELDS | PHASE_FIELDS) - FIELDS_OF[self.kind]):
            if getattr(self, name) is not None:
                raise broken(name, getattr(self, name), f"left out for kind {self.kind}")
        wrong = "mm" if self._length == "l" else "l"
        for name in (f"still_{wrong}", f"max_drift_{wrong}"):
            if getattr(self, name) is not None:
                raise broken(name, getattr(self, name), f"left out for signal {self.signal}: give it in {self._length}")

    def _check_place(self) -> None:
        has_place = self.signal in {"region", "point"}
        for field, value, count in (("row", self.row, REGION_ROWS), ("column", self.column, REGION_COLUMNS)):
            if has_place and value is None:
                raise broken(field, value, f"given for signal {self.signal}")
            if not has_place and value is not None:
                raise broken(field, value, f"left out for signal {self.signal}")
            if self.signal == "region" and value is not None and value >= count:
                raise broken(field, value, f"at most {count - 1} for signal region")
        if (self.name is not None) != (self.signal == "named"):
            bound = "given for signal named" if self.signal == "named" else f"left out for signal {self.signal}"
            raise broken("name", self.name, bound)

    def _check_edges(self) -> None:
        """Require exactly one pair of edges, or none of a breath hold."""
        if self._awaits_edges:
            return
        given = [unit for unit in HYSTERESIS if any(getattr(self, f"{edge}_{unit}") is not None for edge in EDGES)]
        unit = given[0] if given else self._length
        for other in given[1:]:
            name = next(f"{edge}_{other}" for edge in EDGES if getattr(self, f"{edge}_{other}") is not None)
            raise broken(name, getattr(self, name), f"left out: the edges are given in {unit}")
        if unit in {"mm", "l"} and unit != self._length:
            bound = f"left out for signal {self.signal}: give the edges in {self._length} or percent"
            raise broken(f"lower_{unit}", getattr(self, f"lower_{unit}"), bound)
        lower, upper = getattr(self, f"lower_{unit}"), getattr(self, f"upper_{unit}")
        for name, value in ((f"lower_{unit}", lower), (f"upper_{unit}", upper)):
            if value is None:
                raise broken(
                    name, "missing", "given: a window has two edges, in mm, in l for signal volume, or in percent"
                )
        if not lower < upper:
            raise broken(f"lower_{unit}", lower, f"below upper_{unit} ({upper:g})")


class Window(Condition):
    """The gating window; the beam may be on only while the patient stays inside it."""

    dwell_ms: float = Field(
        default=DWELL_MS,
        ge=0.0,
        le=10_000.0,
        description="Time that the signal must stay inside before beam on",
    )
    min_on_ms: float | None = Field(
        default=None,
        ge=0.0,
        le=10_000.0,
        description="After a beam-on shorter than this the next dwell is longer by this time. It "
        "never keeps a beam on. The site's value when left out",
    )
    min_off_ms: float | None = Field(
        default=None,
        ge=0.0,
        le=60_000.0,
        description="Minimum time from beam off to beam on. The site's value when left out",
    )
    max_cycles_per_min: int | None = Field(
        default=None,
        ge=1,
        le=120,
        description="Maximum number of beam-on switches per minute. The site's value when left out",
    )
    join: JoinName = Field(default="and", description="`and`: all conditions must be met; `or`: at least one")
    further: list[Condition] = Field(default=[], max_length=MAX_CONDITIONS - 1)

    def conditions(self) -> Iterator[tuple[str, Condition]]:
        """Yield the conditions, each with the path of its fields in the request."""
        yield "window", self
        for position, condition in enumerate(self.further):
            yield f"window.further.{position}", condition

    @property
    def points(self) -> tuple[tuple[int, int], ...]:
        """The distinct points (row, column) that the conditions use."""
        places = [
            (condition.row, condition.column) for _, condition in self.conditions() if condition.signal == "point"
        ]
        return tuple(dict.fromkeys((row, column) for row, column in places if row is not None and column is not None))
