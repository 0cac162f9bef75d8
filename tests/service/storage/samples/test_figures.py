"""A session's figures, counted batch by batch."""

from dataclasses import replace

import pytest

from engine.core.gate_state import GateState
from service.storage.samples.figures import Figures
from service.storage.samples.rows import batch_of
from tests.support.samples.records import HEAD, record


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
