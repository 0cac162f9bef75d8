"""A session whose markers are found in the infrared picture, for a room without light: with a real service and line."""

from functools import partial

import pytest
from typer.testing import CliRunner

from service.cli import app
from tests.support.realsense.camera import URI, environment
from tests.support.service.api_calls import upload
from tests.support.virtual_camera.treatment_room import room

pytestmark = pytest.mark.alone

ADDRESS = f"{URI}/infrared"


def test_a_session_on_infrared_pictures_reaches_the_beam_and_says_that_colours_are_not_compared(tmp_path):
    seen_as = partial(environment, infrared=True)
    with room(tmp_path, seen_as=seen_as, camera_uri=ADDRESS) as held:
        out = tmp_path / "infrared.json"
        runner = CliRunner(env={**seen_as(held.camera), "TIDEGATE_LOG_LEVEL": "error"})
        answer = runner.invoke(app, ["devices", "calibration", "--source", ADDRESS, "--out", str(out)])
        assert answer.exit_code == 0, answer.output
        held.calibration_id = upload(held.client, out.read_bytes()).json()["id"]
        listed = held.client.get("/api/v1/devices").json()["items"]
        assert [(one["uri"], one["name"]) for one in listed] == [(ADDRESS, "Intel Virtual D435, infrared")]
        held.begin()
        held.turn_on()
        detail = held.detail
        assert detail["camera"]["name"].startswith("Virtual D435, infrared")
        works = {one["name"]: one["state"] for one in detail["checks"]}
        assert (works["surface"], works["color"]) == ("on", "never")
