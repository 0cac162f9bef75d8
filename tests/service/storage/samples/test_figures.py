"""A session's figures, counted batch by batch."""

from dataclasses import replace

import pytest

from engine.core.gate_state import GateState
from service.storage.samples.figures import Figures
from service.storage.samples.layout import batch_of
from tests.support.samples.records import HEAD, PERIOD_NS, record


def test_the_duty_cycle_is_of_the_armed_frames_alone_and_latency_counts_from_the_capture():
    figures = Figures()
    for gate, line_on in ((GateState.DISARMED, True), (GateState.HOLD, False), (GateState.BEAM_ON, True)):
        figures.add(batch_of(HEAD.schema, [replace(record(index, gate=gate), line_on=line_on) for index in (1, 2)]))
    summary = figures.summary()
    assert (summary.frames, summary.duty_cycle) == (6, 0.5)
    assert summary.latency.max_ms == pytest.approx(6.001)
    assert summary.latency.p50_ms == pytest.approx(6.001), "the frames without a capture count from the reception"


def test_latencies_of_a_second_and_more_are_reported_as_they_were():
    figures = Figures()
    late = record(0)
    figures.add(batch_of(HEAD.schema, [replace(late, asserted_ns=late.received_ns + 3_000_000_000)]))
    assert figures.summary().latency.max_ms == 3000.0


def test_without_a_frame_there_is_no_latency():
    assert Figures().summary().latency.p50_ms is None


def lit(index: int, *, is_on: bool = True):
    return replace(record(index), line_on=is_on)


def test_the_beam_on_time_is_from_frame_to_frame_over_the_batches_too():
    figures = Figures()
    for batch in ([lit(0), lit(1)], [lit(2), lit(3, is_on=False)], [], [lit(4, is_on=False), lit(5)]):
        figures.add(batch_of(HEAD.schema, batch))
    assert figures.summary().beam_on_s == pytest.approx(3 * PERIOD_NS / 1e9, abs=0.001)
    figures.add(batch_of(HEAD.schema, [lit(6, is_on=False)]))
    assert figures.summary().beam_on_s == pytest.approx(4 * PERIOD_NS / 1e9, abs=0.001)


def test_a_long_gap_with_the_line_on_counts_a_second():
    figures = Figures()
    figures.add(batch_of(HEAD.schema, [lit(0), lit(3000, is_on=False)]))
    assert figures.summary().beam_on_s == 1.0


def test_reasons_of_holds_come_with_their_sentence_the_most_frequent_first():
    figures = Figures()
    figures.holds.update({"marker_lost": 2, "outside_window": 40, "of_another_version": 2})
    found = [(one.reason, one.text, one.count) for one in figures.summary().holds]
    assert found[0] == ("outside_window", "Outside the window", 40)
    assert found[1:] == [("marker_lost", "A marker is not visible", 2), ("of_another_version", "of_another_version", 2)]
