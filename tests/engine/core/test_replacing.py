"""`replace` of the frame path does what the standard library's does, in both forms."""

import dataclasses
import gc
import pickle
import weakref

import pytest

from engine.core import compiled
from engine.core.breath import GateSignal, SignalChoice
from engine.core.gate_state import GateState, HoldReason
from engine.core.replacing import constructed, replace as quick
from engine.gating.gate import Gate

FUNCTIONS = compiled.FramePath.kernels


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Bounded:
    low: float
    high: float
    width: float = dataclasses.field(init=False)

    def __post_init__(self) -> None:
        if self.high < self.low:
            raise ValueError("high")
        object.__setattr__(self, "width", self.high - self.low)


@dataclasses.dataclass(frozen=True)
class WithoutSlots:
    first: int
    second: int


@dataclasses.dataclass(frozen=True, slots=True, weakref_slot=True)
class Pair:
    first: object
    second: object


@pytest.fixture(params=[quick, constructed], ids=["quick", "constructed"])
def replace(request):
    return request.param


def test_the_changed_fields_change_and_the_others_stay(replace):
    gate = Gate(state=GateState.DWELL, reason=HoldReason.DWELL, since_ns=5, good_frames=3, armed_by="a")
    changes = {"good_frames": 4, "since_ns": 9}
    changed = replace(gate, **changes)
    assert changed == dataclasses.replace(gate, **changes)
    assert type(changed) is Gate
    assert gate.good_frames == 3
    assert replace(gate) == gate
    assert replace(gate) is not gate
    with pytest.raises(dataclasses.FrozenInstanceError):
        changed.good_frames = 5


def test_the_constructor_checks_a_changed_value(replace):
    assert replace(Bounded(low=1.0, high=2.0), high=4.0).width == 3.0
    with pytest.raises(ValueError, match="high"):
        replace(Bounded(low=1.0, high=2.0), high=0.0)


@pytest.mark.parametrize(("value", "name"), [(Bounded(low=1.0, high=2.0), "width"), (Gate(), "unknown")])
def test_a_name_that_the_constructor_does_not_take_is_refused(replace, value, name):
    with pytest.raises(TypeError, match=name):
        replace(value, **{name: 1.0})


def test_values_without_slots_are_replaced_too(replace):
    assert replace(WithoutSlots(1, 2), second=3) == WithoutSlots(1, 3)


def test_a_copy_keeps_no_more_alive_than_its_fields(replace):
    kept, dropped = Pair(1, 2), Pair(3, 4)
    copy = replace(Pair(kept, dropped), second=None)
    alive, gone = weakref.ref(kept), weakref.ref(dropped)
    del kept, dropped
    gc.collect()
    assert copy.first is alive()
    assert gone() is None
    del copy
    gc.collect()
    assert alive() is None


def test_names_that_the_interpreter_does_not_share_are_found():
    name = "".join(["good", "_", "frames"])
    assert quick(Gate(), **{name: 3}) == Gate(good_frames=3)


def test_another_number_of_values_is_refused(replace):
    with pytest.raises(TypeError):
        replace(Gate(), Gate())
    with pytest.raises(TypeError):
        replace(good_frames=1)


@pytest.mark.skipif(FUNCTIONS is None, reason="the compiled path is not built")
@pytest.mark.parametrize(
    "fields",
    [(("first",), (Pair.first, Pair.second)), (["first"], (Pair.first,)), (("first",), (1,)), ("first",), "first"],
)
def test_fields_that_are_no_slots_of_the_class_are_refused(fields):
    changed = FUNCTIONS.replacer({Pair: fields, Gate: (("first",), (Pair.first,))}, constructed)
    with pytest.raises((TypeError, SystemError)):
        changed(Pair(1, 2), first=1)
    with pytest.raises(TypeError):
        changed(Gate(), first=1)


@pytest.mark.skipif(FUNCTIONS is None, reason="the compiled path is not built")
def test_a_replacer_is_made_of_a_dict_and_a_function():
    for arguments in [({},), ([], constructed), ({}, 1)]:
        with pytest.raises(TypeError):
            FUNCTIONS.replacer(*arguments)


def test_what_a_signal_remembers_does_not_go_to_another_process_with_each_sample():
    fresh, read = SignalChoice(signal=GateSignal.THORAX), SignalChoice(signal=GateSignal.THORAX)
    assert (read.unit, read.is_wide) == ("mm", True)
    assert read.value_in is not None
    assert pickle.dumps(read) == pickle.dumps(fresh)
    assert pickle.loads(pickle.dumps(read)) == fresh
