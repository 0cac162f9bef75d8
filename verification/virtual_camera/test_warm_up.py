"""A cold camera, with a real service: no beam until it is warm, and it runs on until the next session."""

import json
import time

import pytest

from service.engine_host.camera_warmth import NAME
from tests.support.realsense.camera import SERIAL, environment
from tests.support.virtual_camera.treatment_room import PATIENCE_S, room

pytestmark = pytest.mark.alone

WARM_UP_MIN = 0.25


def cold_share(folder) -> float:
    return json.loads((folder / "data" / NAME).read_text())[SERIAL][0]


def test_a_cold_camera_has_no_beam_until_it_is_warm_and_stays_warm_between_two_sessions(tmp_path):
    with room(tmp_path, seen_as=environment, camera_uri="realsense:", warm_up_min=WARM_UP_MIN) as held:
        begun_ns = time.monotonic_ns()
        held.begin()
        on_ns = held.turn_on()
        assert "camera_warming" in held.reasons()
        assert on_ns - begun_ns > 0.9 * 60e9 * WARM_UP_MIN
        held.stop()
        model, *_ = held.client.get(f"/api/v1/sessions/{held.session_id}/models").json()["items"]
        held.model_id = model["id"]
        ended_s = time.clock_gettime(time.CLOCK_BOOTTIME)

        def runs_on() -> bool:
            found = json.loads((tmp_path / "data" / NAME).read_text())[SERIAL]
            cold, _, at_s, used_s, _ = found
            return at_s > ended_s and at_s > used_s and cold < 0.05

        held.until(runs_on, "a camera that runs on", within_s=2 * PATIENCE_S)
        held.begin()
        held.turn_on()
        # The seconds in which the camera passed from one process to the other cost a moment at most.
        assert cold_share(tmp_path) < 0.5
