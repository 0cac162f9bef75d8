"""What a view shows of the camera: for the set-up, never under an armed gate."""

from itertools import pairwise

from engine.core.camera_view import CameraView
from engine.core.commands import Disarm
from tests.support.control.armed_bench import armed_bench
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
