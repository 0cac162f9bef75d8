"""The whole live path with each maker's camera: a real service, the SDK in its own process, a real line's receiver.

RealSense is librealsense's software device; Orbbec is OrbbecSDK's playback device with frames of its own making. The
virtual Xtion feeds both, and has the faults. Bounds and judgement are those of `test_live_session`.
"""

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.support.orbbec import camera as orbbec
from tests.support.realsense import camera as realsense
from tests.support.scheduling_monitor import Watchman
from tests.support.virtual_camera.beam_off import off_in_time
from tests.support.virtual_camera.block import Streams
from tests.support.virtual_camera.camera import VirtualXtion
from tests.support.virtual_camera.treatment_room import room

pytestmark = pytest.mark.alone


@dataclass(frozen=True, slots=True, kw_only=True)
class Kind:
    """A kind of cameras: its address, what its SDK and its camera are called, and how it is seen and plugged in."""

    uri: str
    sdk: str
    hint: str
    names: str
    seen_as: Callable[[VirtualXtion, Path], dict[str, str]]
    cable: Callable[[VirtualXtion, Path], Path]

    @property
    def serial(self) -> str:
        return self.uri.partition(":")[2]


KINDS = {
    "realsense": Kind(
        uri=realsense.URI,
        sdk="the RealSense SDK",
        hint="pip install 'tidegate[realsense]'",
        names="Virtual D435",
        seen_as=lambda camera, _folder: realsense.environment(camera),
        cable=lambda camera, _folder: realsense.cable(camera),
    ),
    "orbbec": Kind(
        uri=orbbec.URI,
        sdk="the Orbbec SDK",
        hint="pip install --no-deps pyorbbecsdk2",
        names="Orbbec Femto Bolt(Playback)",
        seen_as=orbbec.fed,
        cable=lambda _camera, folder: orbbec.cable(folder),
    ),
}


@pytest.fixture(scope="module", params=KINDS)
def kind(request):
    return KINDS[request.param]


@pytest.fixture(scope="module")
def folder(kind, tmp_path_factory):
    return tmp_path_factory.mktemp("room")


@pytest.fixture(scope="module")
def held(kind, folder):
    seen_as = lambda camera: kind.seen_as(camera, folder)  # noqa: E731
    with room(folder, seen_as=seen_as, camera_uri=kind.uri.partition(":")[0] + ":") as one:
        yield one


@pytest.fixture(scope="module")
def watchman():
    one = Watchman()
    yield one
    one.end()


@pytest.fixture
def live(held):
    """A room with a session that runs, on a model that was learned once."""
    if held.model_id is None:
        held.begin()
        held.turn_on()
        held.stop()
        model, *_ = held.client.get(f"/api/v1/sessions/{held.session_id}/models").json()["items"]
        held.model_id = model["id"]
        held.begin()
    elif held.detail["status"] != "running":
        held.begin()
    else:
        held.camera.undo()
    return held


def streaming_process() -> int:
    """The id of the camera's process that streams."""
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        words = path.read_bytes().split(b"\0")
        if b"engine.capture.camera_process" in words and b"stream" in words:
            return int(path.parent.name)
    pytest.fail("no process streams")


def test_the_camera_and_the_kinds_are_listed(held, kind):
    listed = held.client.get("/api/v1/devices").json()
    assert [one["uri"] for one in listed["items"]] == [kind.uri], listed
    kinds = {one["label"]: one for one in listed["kinds"]}
    assert kinds[kind.sdk]["is_installed"]
    assert kinds[kind.sdk]["install_hint"] == kind.hint


FAULTS = {
    "depth stalls": lambda camera: camera.stall(Streams.DEPTH),
    "both stall": lambda camera: camera.stall(),
    "a covered marker": lambda camera: camera.cover(0),
    "a hand": lambda camera: camera.hand(),
    "depth of nothing": lambda camera: camera.flat(0),
    "late frames": lambda camera: camera.late(300.0),
    "a clock that goes back": lambda camera: camera.clock(-1_000_000),
    "a clock that jumps by three minutes": lambda camera: camera.clock(203_000_000),
    "a clock that stands": lambda camera: camera.stuck_clock(),
    "the same picture again": lambda camera: camera.repeat(),
}


@pytest.mark.parametrize("name", FAULTS)
def test_the_beam_is_off_in_time_and_stays_off_while_it_lasts(live, watchman, name):
    bound_ms = 300.0 if name == "the same picture again" else 100.0
    receipt = off_in_time(live, watchman, lambda: FAULTS[name](live.camera), bound_ms)
    time.sleep(0.5)
    assert live.ons(receipt.raised_ns) == []


def test_a_camera_whose_process_is_killed_with_the_beam_on_comes_back_in_the_same_session(live):
    live.turn_on()
    session_id = live.session_id
    killed_ns = time.monotonic_ns()
    os.kill(streaming_process(), 9)
    live.until(lambda: not live.is_on, "an off")
    live.until(lambda: live.gate["state"] == "fault", "a fault")
    assert live.gate["hold_reason"] == "source_lost"
    assert "was killed (signal 9)" in live.gate["hold_detail"]
    live.turn_on()
    assert live.session_id == session_id
    assert live.ons(killed_ns)


def test_a_camera_that_is_unplugged_with_the_beam_on_is_back_when_it_is_plugged_in(live, kind, folder):
    live.turn_on()
    pulled_ns = time.monotonic_ns()
    kind.cable(live.camera, folder).unlink()
    live.until(lambda: not live.is_on, "an off")
    live.until(lambda: is_lost(live), "its cause")
    assert live.act("arm").status_code == 409
    assert live.ons(pulled_ns) == []
    kind.cable(live.camera, folder).touch()
    live.turn_on()


def is_lost(live):
    """Whether the fault is the camera's; another one, of a busy machine, is acknowledged."""
    if (gate := live.gate)["state"] == "fault" and gate["hold_reason"] != "source_lost":
        live.act("acknowledge")
    return gate["hold_reason"] == "source_lost"


def test_without_a_calibration_the_makers_is_used_and_every_result_carries_a_warning(live, kind):
    live.stop()
    live.begin(calibration_id=None, model_id=None)
    detail = live.detail
    assert detail["calibration"] == "device calibration"
    assert "by its maker" in detail["calibration_warning"]
    live.until(lambda: live.detail["measurement_state"] == "measuring", "a model")
    (stored, *_) = live.client.get("/api/v1/calibrations").json()["items"]
    document = live.client.get(f"/api/v1/calibrations/{stored['id']}").json()["document"]
    assert (document["camera"], document["serial"]) == (f"device calibration: {kind.names}", kind.serial)
    live.stop()
