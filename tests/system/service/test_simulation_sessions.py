"""A session of the simulation day is the reference of the treatment's first fraction: both of a real engine."""

import pytest

from service.core.settings.settings import Settings
from service.web.app import create_app
from tests.support.replay.real_sessions import SOON, make_ready, play
from tests.support.service.accounts import PeopleClient
from tests.support.service.api_calls import audit_rows

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def sessions(tmp_path_factory, regular_volunteer):
    """Simulation day and first fraction of a volunteer, who lies as then, to the end of the recording."""
    data_dir = tmp_path_factory.mktemp("simulated") / "data"
    day = play(data_dir, regular_volunteer, seed=1, window=SOON, person=make_ready)
    return day, play(data_dir, regular_volunteer, seed=2, window=SOON, person=make_ready, simulation=day.session_id)


@pytest.fixture(scope="module")
def client(sessions):
    settings = Settings(data_dir=sessions[0].data_dir, allowed_hosts=("testserver",))
    with PeopleClient(create_app(settings)) as client:
        yield client


def test_its_breath_and_window_are_those_of_the_day(client, sessions):
    day, today = sessions
    found = client.get(f"/api/v1/sessions/{today.session_id}/simulation").json()
    assert (found["session_id"], found["has_position"]) == (day.session_id, True)
    breath = client.get(f"/api/v1/sessions/{day.session_id}/report").json()["figures"]
    assert found["period_s"] == pytest.approx(breath["period_s"]["median"], rel=0.2)
    assert found["end_inhale_mm"] - found["end_exhale_mm"] == pytest.approx(breath["amplitude"]["median"], rel=0.3)
    reach = (found["upper_percent"] - found["lower_percent"]) / 100.0
    assert reach * (found["end_inhale_mm"] - found["end_exhale_mm"]) == pytest.approx(80.0, rel=0.02)


def test_the_position_was_compared_in_six_degrees_and_signed_before_the_beam(client, sessions):
    day, today = sessions
    (started,) = [row for row in audit_rows(client, "session.start") if row["session_id"] == today.session_id]
    assert started["detail"]["position_of_session"] == day.session_id
    signed = [row for row in audit_rows(client, "session.position_check") if row["session_id"] == today.session_id]
    done = [row for row in signed if row["outcome"] == "done"]
    assert done, "who lies as on the simulation day is signed for"
    shown = done[-1]["detail"]["shown"]
    assert shown["plan_session_id"] == day.session_id
    assert [one["name"] for one in shown["degrees"]] == ["lateral", "longitudinal", "vertical", "pitch", "roll", "yaw"]
    known = [one["value"] for one in shown["degrees"][3:] if one["value"] is not None]
    assert all(abs(turn) < 3.0 for turn in known), "the same patient, not turned, at another moment of the breath"
