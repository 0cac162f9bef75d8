"""What a view shows of the camera: for the set-up, never under an armed gate."""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from engine.beam.beam_on import BeamOnState
from engine.control.records import BACK_DETAIL
from engine.core.commands import Acknowledge, Disarm, SetReference
from engine.core.errors import SourceAwayError
from engine.core.frames import LostReason, MeasurementState
from engine.core.gate_state import GateState, HoldReason
from engine.core.position_check import CameraView
from engine.gating.interlocks import WATCHDOG_DETAIL
from engine.gating.windows import BreathHoldWindow
from tests.support.control.armed_bench import ARM, LEARNED, armed_bench, lying_at
from tests.support.control.loop_bench import after, good, silent
from tests.support.gating.streams import LIMITS, PERIOD_NS, unmeasured

SEEN = CameraView(
    distance_mm=850.0,
    tilt_deg=2.0,
    coverage=1.0,
    brightness=0.5,
    saturated=0.0,
    running_s=0.0,
    warm_in_s=0.0,
    advice=(),
)


def test_the_camera_is_looked_at_while_disarmed_only():
    looked, shown = [], []

    def look(frame):
        looked.append(frame.index)
        return SEEN

    bench = armed_bench([good] * 6, camera_view=look)
    note = after(lambda: shown.append((bench.loop.status.view.is_armed, bench.loop.status.view.camera_view)))
    bench.source.script += [note, after(bench.ask(Disarm(operator="ada"))), good, note]
    bench.run()
    assert shown == [(True, None), (False, SEEN)]
    gaps = [later - before for before, later in pairwise(looked)]
    assert gaps.count(1) == len(gaps) - 1, "every frame but those under the armed gate"
    assert max(gaps) > 6


def test_a_loop_without_a_meter_shows_nothing_of_the_camera():
    bench = armed_bench([good] * 2)
    bench.run()
    assert bench.loop.status.view.camera_view is None


def test_each_view_that_a_hung_engine_leaves_behind_is_shown_as_the_watchdog_s_fault_of_that_view():
    """The second time the engine hangs, the view of the first is not shown again."""
    seen = []

    def hang_and_look():
        left_behind = bench.loop.status.view
        bench.watchdog.check(bench.clock.now_ns() + 10_000_000_000)
        shown = bench.loop.status.view
        seen.append((left_behind, shown))
        assert bench.loop.status.view is shown

    bench = armed_bench([good] * 6)
    again = [after(bench.ask(Acknowledge(operator="bob"))), good, after(bench.ask(ARM)), *[good] * 6]
    bench.source.script += [after(hang_and_look), *again, after(hang_and_look)]
    bench.run()
    assert [left.armed_by for left, _ in seen] == ["ann", "ann"]
    for left_behind, shown in seen:
        assert shown.frames == left_behind.frames
        assert (shown.record.gate_state, shown.record.hold_reason) == (GateState.FAULT, HoldReason.WATCHDOG)
        assert (shown.is_armed, shown.armed_by, shown.detail) == (False, None, WATCHDOG_DETAIL)
    assert seen[0][1].frames < seen[1][1].frames


def test_only_a_lost_camera_that_delivers_again_is_stated_to_be_back():
    seen = []

    def look():
        seen.append(bench.loop.status.view)

    def away(source, _timeout_s):
        source.clock.advance_ns(PERIOD_NS)
        raise SourceAwayError("unplugged")

    bench = armed_bench([good] * 6)
    bench.source.script += [after(look), after(lambda: bench.loop.report_fault(HoldReason.DISK_LOW, "10 MB left"))]
    bench.source.script += [good, after(look), after(bench.ask(Acknowledge(operator="bob"))), away, good, after(look)]
    bench.run()
    assert [view.detail for view in seen] == ["", "10 MB left", f"unplugged; {BACK_DETAIL}"]


def test_a_view_without_a_frame_has_the_gate_of_now():
    bench = armed_bench([*[good] * 6, silent])
    seen = []
    bench.source.script += [after(lambda: seen.append(bench.loop.status.view))]
    bench.run()
    (view,) = seen
    assert (view.record.gate_state, view.record.hold_reason) == (GateState.HOLD, HoldReason.FRAME_MISSING)
    assert not view.record.line_on


def test_a_view_shows_the_window_s_conditions_the_budget_the_beam_and_what_is_not_seen():
    signal, limits = BeamOnState(), replace(LIMITS, max_reference_distance_mm=3.5)
    cells = np.ones((14, 8))
    cells[2, 3] = 0.1
    bench = armed_bench([good] * 6, limits=limits, beam_on=lambda: signal)
    for index in range(20):
        bench.pipeline.spoil[index] = lambda frame: replace(
            frame, motion=replace(frame.motion, seen=replace(frame.motion.seen, cells=cells))
        )
    bench.run()
    view = bench.loop.status.view
    assert view.beam_on is signal
    assert view.reference_budget_mm == 3.5
    assert view.unseen_cells == ((2, 3),)
    assert len(view.conditions) == 1


def test_a_view_counts_the_breath_holds():
    window = BreathHoldWindow(level=LIMITS.window, settle_ms=100.0, max_drift=1.0, still=0.5)
    bench = armed_bench([good] * 20, limits=replace(LIMITS, window=window)).run()
    assert bench.loop.status.view.breath_holds == 1


def test_a_view_of_a_frame_that_was_not_measured_shows_no_movement():
    bench = armed_bench([])
    lying_at(bench, 100, 0.0)
    hidden = bench.source.frames + LEARNED + 4
    bench.pipeline.spoil[hidden] = lambda frame: unmeasured(frame, MeasurementState.LOST, LostReason.MARKER_LOST)
    seen = {}
    note = after(lambda: seen.update({bench.source.frames - 1: bench.loop.status.view.movement is None}))
    bench.source.script += [note] * 8
    bench.run()
    assert [seen[hidden + offset] for offset in (-1, 0, 1)] == [False, True, False]


def test_a_camera_that_goes_silent_at_a_new_reference_ends_nothing():
    """No frame has been compared with it yet: nothing is known of the movement."""
    shown = []
    bench = armed_bench([good] * 6)
    lying_at(bench, 0, 0.0)

    def note():
        shown.append(bench.loop.status.view.marker_travel_mm)

    def reference_and_silence(source, timeout_s):
        note()
        bench.ask(SetReference(operator="ada", reason="a test"))()
        return silent(source, timeout_s)

    bench.source.script += [reference_and_silence, silent, after(note), good]
    bench.run()
    assert bench.loop.status.error is None
    assert shown == [0.0, None]
