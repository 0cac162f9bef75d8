"""What a view shows of the camera: for the set-up, never under an armed gate."""

from itertools import pairwise

from engine.core.camera_view import CameraView
from engine.core.commands import Acknowledge, Disarm
from engine.core.gate_state import GateState, HoldReason
from engine.gating.interlocks import WATCHDOG_DETAIL
from tests.support.control.armed_bench import ARM, armed_bench
from tests.support.control.loop_bench import after, good

SEEN = CameraView(
    distance_mm=850.0, tilt_deg=2.0, coverage=1.0, brightness=0.5, saturated=0.0, running_s=0.0, advice=()
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
