"""Commands that rest on the gated signal are refused while the camera does not see it."""

from dataclasses import replace

import pytest

from engine.core.commands import SetReference
from engine.core.errors import CommandRefusedError
from engine.core.gate_state import GateState, HoldReason
from tests.support.control.armed_bench import LEARNED, ON, armed_bench, on_bench
from tests.support.control.loop_bench import after, good
from tests.support.gating.streams import SEEN, motion_of

HIDDEN = replace(SEEN, whole=0.55)


def hide(bench, *indices, **changes):
    """Make frames in which the gated signal, the whole, is half seen."""
    for index in indices:
        bench.pipeline.spoil[index] = lambda frame: replace(frame, motion=motion_of(**(changes or {"seen": HIDDEN})))


def refusal(bench):
    error = bench.answers[-1].exception(timeout=0)
    assert isinstance(error, CommandRefusedError)
    return str(error)


def test_arming_is_refused_while_the_gated_signal_is_not_seen():
    bench = armed_bench([good] * 8)
    hide(bench, LEARNED)
    assert "whole: 0.55 of its area seen, 0.90 needed" in refusal(bench.run())
    assert not bench.beam.permits


def test_a_reference_is_refused_while_the_gated_signal_is_not_seen_and_changes_nothing():
    bench = on_bench([])
    hide(bench, ON + 1)
    bench.source.script += [after(bench.ask(SetReference(operator="ann"))), *[good] * 6]
    text = refusal(bench.run())
    assert text.startswith("the camera does not see the gated motion (whole: 0.55")
    assert bench.records()[-1].gate_state is GateState.BEAM_ON


def test_a_reference_that_did_not_show_the_gated_signal_holds_until_it_is_set_again():
    bench = on_bench([good] * 3)
    hide(bench, ON + 1, ON + 2, reference_seen=HIDDEN)
    records = bench.run().records()
    held = [record for record in records if record.hold_reason is HoldReason.COVERAGE_LOW]
    assert len(held) == 2
    assert "when the reference was set" in next(
        one.detail for one in bench.transitions() if one.reason is HoldReason.COVERAGE_LOW
    )


@pytest.mark.parametrize("share", [float("nan"), 0.0, 0.89])
def test_the_line_is_held_in_the_frame_that_does_not_show_the_signal(share):
    bench = on_bench([good] * 2)
    hide(bench, ON + 1, seen=replace(SEEN, whole=share))
    records = {record.measurement.frame_index: record for record in bench.run().records()}
    assert records[ON].line_on
    assert not records[ON + 1].line_on
