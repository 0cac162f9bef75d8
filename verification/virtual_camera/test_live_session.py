"""The whole live path: a real service, the real runtime, a camera that fails on command, and a real line's receiver.

Safety is judged by the receiver's own times against the camera's: the beam is off within a bound of the first frame
that is late, missing or wrong. Reaching the beam takes as long as it takes.
"""

import time

import pytest

from tests.support.scheduling_monitor import Watchman
from tests.support.virtual_camera.beam_off import off_in_time
from tests.support.virtual_camera.block import Call, Field, State, Streams
from tests.support.virtual_camera.treatment_room import room

pytestmark = pytest.mark.alone

BOUND_MS = 100.0
"""What frames show, or do not show, is off within this; it is also more than a lease and what its line takes."""


@pytest.fixture(scope="module")
def held(tmp_path_factory):
    with room(tmp_path_factory.mktemp("room")) as one:
        yield one


@pytest.fixture
def live(held):
    """A room with a session that runs, on a model that was learned once."""
    if held.camera.status.pid:
        held.camera.undo()
    if held.model_id is None:
        if not held.session_id:  # else a test before this one has waited in vain
            held.begin()
        held.turn_on()
        held.stop()
        model, *_ = held.client.get(f"/api/v1/sessions/{held.session_id}/models").json()["items"]
        held.model_id = model["id"]
    if held.detail["status"] != "running":
        held.begin()
    return held


@pytest.fixture(scope="module")
def watchman():
    one = Watchman()
    yield one
    one.end()


@pytest.fixture
def caused(live, watchman):
    """Do something to the camera while the beam is on, and see it off within a bound; returns the receipt."""
    return lambda cause, bound_ms=BOUND_MS: off_in_time(live, watchman, cause, bound_ms)


def test_the_camera_is_found_by_the_service(live):
    listed = live.client.get("/api/v1/devices").json()
    assert listed["is_runtime_available"]
    assert [one["uri"] for one in listed["items"]] == ["virtual/xtion"]


def test_a_session_is_armed_and_turns_the_receiver_on(live):
    live.turn_on()
    assert live.detail["status"] == "running"
    assert live.camera.status.is_mirrored == (False, False)
    assert not live.camera.status.is_registered


FAULTS = {
    "depth stalls": lambda camera: camera.stall(Streams.DEPTH),
    "both stall": lambda camera: camera.stall(),
    "silent unplugging": lambda camera: camera.unplug(is_reported=False),
    "unplugging": lambda camera: camera.unplug(),
    "an error state": lambda camera: camera.state(State.ERROR),
    "a hung read": lambda camera: camera.hang(Call.READ),
    "a covered marker": lambda camera: camera.cover(0),
    "a hand": lambda camera: camera.hand(),
    "depth of nothing": lambda camera: camera.flat(0),
    "depth of noise": lambda camera: camera.noise(),
    "late frames": lambda camera: camera.late(300.0),
    "a clock that goes back": lambda camera: camera.clock(-1_000_000),
    "a clock that stands": lambda camera: camera.stuck_clock(),
}


@pytest.mark.parametrize("name", FAULTS)
def test_the_beam_is_off_in_time_and_stays_off_while_it_lasts(live, caused, name):
    receipt = caused(lambda: FAULTS[name](live.camera))
    time.sleep(0.5)
    assert live.ons(receipt.raised_ns) == []


MALFORMED = {
    "depth with too few bytes": (Field.DATA_SIZE, 100, Streams.DEPTH),
    "depth far wider": (Field.WIDTH, 64_000, Streams.DEPTH),
    "depth without a picture": (Field.NO_DATA, 0, Streams.DEPTH),
    "colour without a picture": (Field.NO_DATA, 0, Streams.COLOR),
    "colour of another format": (Field.FORMAT, 203, Streams.COLOR),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_frames_that_lie_take_the_beam_off_and_the_process_lives(live, caused, name):
    field, value, streams = MALFORMED[name]
    # A colour picture may be 100 ms old: so long the markers of the last sound one count.
    bound_ms = BOUND_MS + (100.0 if streams is Streams.COLOR else 0.0)
    receipt = caused(lambda: live.camera.malform(field, value, streams=streams), bound_ms)
    time.sleep(0.5)
    assert live.ons(receipt.raised_ns) == []
    live.camera.undo(receipt)
    live.turn_on()


def test_a_camera_that_is_unplugged_with_the_beam_on_comes_back_and_goes_on_in_the_same_session(live, caused):
    live.turn_on()
    session_id, model_id = live.session_id, live.detail["active_model_id"]
    receipt = caused(live.camera.unplug)
    live.until(lambda: live.gate["state"] == "fault", "a fault")
    assert live.gate["hold_reason"] == "source_lost"
    assert live.gate["hold_detail"] == "Virtual Xtion was disconnected"
    assert live.act("acknowledge").status_code == 200
    live.until(lambda: live.gate["state"] == "fault", "the same fault while it is away")
    assert live.act("arm").status_code == 409
    live.camera.undo(receipt)
    live.camera.await_streaming()
    live.until(lambda: not live.detail["has_reference"], "frames")
    live.until(lambda: live.detail["likeness"], "a comparison with the patient")
    assert live.ons(receipt.raised_ns) == []
    live.act("acknowledge")
    assert live.detail["has_reference"] is False
    assert live.act("arm").status_code == 409
    live.turn_on()
    assert (live.session_id, live.detail["active_model_id"]) == (session_id, model_id)
    assert "source_lost" in live.reasons()


def test_another_camera_is_not_taken_for_the_one_that_was_pulled(live, caused):
    receipt = caused(lambda: live.camera.unplug(is_swapped=True))
    live.camera.undo(receipt)
    try:
        live.until(lambda: live.act("acknowledge") and "another camera" in live.gate["hold_detail"], "a refusal")
        assert "Virtual Xtion VIRTUAL-2" in live.gate["hold_detail"]
        assert live.act("arm").status_code == 409
        assert live.ons(receipt.raised_ns) == []
    finally:
        live.camera.undo(live.camera.unplug())  # and the right one is plugged in again
    live.turn_on()


def test_a_camera_pulled_without_a_word_comes_back_too(live, caused):
    receipt = caused(lambda: live.camera.unplug(is_reported=False))
    live.until(lambda: live.act("acknowledge") and "no frame for 3 s" in live.gate["hold_detail"], "a loss")
    live.camera.undo(receipt)
    live.turn_on()
    assert live.ons(receipt.raised_ns)[0] > receipt.raised_ns


def test_a_driver_that_hangs_for_long_is_waited_for_and_the_camera_comes_back(live, caused):
    receipt = caused(lambda: live.camera.hang(Call.READ))
    live.until(lambda: live.act("acknowledge") and "hangs in the camera's driver" in live.gate["hold_detail"], "a loss")
    assert live.camera.status.hung_calls == 1, "nobody has tried again beside it"
    live.camera.undo(receipt)
    live.turn_on()


def test_without_a_calibration_the_camera_s_own_registration_is_on_again_when_it_is_back(live):
    live.stop()
    assert live.begin(calibration_id=None, model_id=None)
    live.until(lambda: live.camera.status.is_registered, "registration")
    live.until(lambda: live.detail["measurement_state"] == "measuring", "a model")
    assert live.detail["calibration"] == "device registration"
    receipt = live.camera.unplug()
    live.until(lambda: not live.camera.status.is_open, "a closed camera")
    assert not live.camera.status.is_registered
    live.camera.undo(receipt)
    status = live.camera.await_streaming()
    assert (status.is_registered, status.is_mirrored) == (True, (False, False))
    live.until(lambda: not live.detail["has_reference"], "frames")
    live.until(lambda: live.detail["likeness"], "a comparison")
    assert live.detail["likeness"]["is_accepted"]
    live.stop()
