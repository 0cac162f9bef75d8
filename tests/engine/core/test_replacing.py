"""`replace` of the frame path does what the standard library's does."""

import dataclasses

import pytest

from engine.core.gate_state import GateState, HoldReason
from engine.core.replacing import replace
from engine.gating.gate import Gate


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class _Bounded:
    low: float
    high: float
    width: float = dataclasses.field(init=False)

    def __post_init__(self) -> None:
        if self.high < self.low:
            raise ValueError("high")
        object.__setattr__(self, "width", self.high - self.low)


def test_the_changed_fields_change_and_the_others_stay():
    gate = Gate(state=GateState.DWELL, reason=HoldReason.DWELL, since_ns=5, good_frames=3, armed_by="a")
    changes = {"good_frames": 4, "since_ns": 9}
    changed = replace(gate, **changes)
    assert changed == dataclasses.replace(gate, **changes)
    assert gate.good_frames == 3
    assert replace(gate) == gate


def test_the_constructor_checks_a_changed_value():
    assert replace(_Bounded(low=1.0, high=2.0), high=4.0).width == 3.0
    with pytest.raises(ValueError, match="high"):
        replace(_Bounded(low=1.0, high=2.0), high=0.0)


@pytest.mark.parametrize("name", ["unknown", "width"])
def test_a_name_that_the_constructor_does_not_take_is_refused(name):
    with pytest.raises(TypeError, match=name):
        replace(_Bounded(low=1.0, high=2.0), **{name: 1.0})
