"""The camera's own numbers of its frames may jump, which is a frame lost; they may not go back, nor stand still."""

from dataclasses import replace

import pytest

from engine.core.gate_state import GateState, HoldReason
from tests.support.control.armed_bench import ON, on_bench
from tests.support.control.loop_bench import good


def _numbered(by: int):
    """A good frame in every way, but for the camera's own number of it."""

    def step(source, timeout_s):
        frame = good(source, timeout_s)
        return replace(frame, device_index=frame.device_index + by)

    return step


@pytest.mark.parametrize("back", [1, 2, 500])
def test_a_camera_whose_frame_numbers_go_back_or_stand_still_faults_though_its_times_go_on(back):
    bench = on_bench([_numbered(-back) for _ in range(6)])
    records = bench.run().records()
    assert records[ON].line_on
    later = {(record.gate_state, record.hold_reason, record.line_on) for record in records[ON + 1 :]}
    assert later == {(GateState.FAULT, HoldReason.CLOCK_BACKWARDS, False)}
    (reported,) = [change for change in bench.transitions() if change.reason is HoldReason.CLOCK_BACKWARDS]
    assert reported.detail == f"the camera's frame {ON + 1 - back} after its frame {ON}"


def test_numbers_that_go_on_from_another_one_are_no_disorder():
    records = on_bench([_numbered(7) for _ in range(6)]).run().records()
    assert all(record.line_on for record in records[ON:])
