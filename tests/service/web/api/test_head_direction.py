"""The head direction over the API: it fits the room, it reaches the engine, and who arms confirms it."""

import pytest

from engine.core.commands import Arm
from engine.core.errors import HeadDirectionError
from engine.core.signals import HeadDirection
from engine.motion.settings import PipelineSettings
from service.core.errors import BoundError
from service.core.schemas.sessions import Regions
from service.core.schemas.windows import Window
from service.core.settings.settings import Settings, SettingsError, load_settings
from service.engine_host.site_limits.window_limits import check_head_direction, gate_limits, head_of, measuring_with
from tests.support.service.api_calls import WINDOW, act, audit_rows

URL = "/api/v1/sessions"
TOP, BOTTOM, LEFT, RIGHT = HeadDirection.TOP, HeadDirection.BOTTOM, HeadDirection.LEFT, HeadDirection.RIGHT


@pytest.mark.both_databases
@pytest.mark.parametrize("head", [*HeadDirection, None])
def test_the_head_direction_is_kept_with_the_session_and_given_to_its_engine(client, session_body, engine, head):
    session = client.post(URL, json=session_body | {"head_direction": head}).json()
    assert session["head_direction"] == head
    act(client, session["id"], "start")
    assert engine.running.plan.head_direction is head
    assert client.get(f"{URL}/{session['id']}").json()["head_direction"] == head


@pytest.mark.parametrize("head", ["up", "TOP", "", 1, True])
def test_no_other_side_is_taken(client, session_body, head):
    answer = client.post(URL, json=session_body | {"head_direction": head})
    assert (answer.status_code, answer.json()["field"]) == (422, "head_direction")


def test_a_session_without_one_is_created_and_has_none(client, session_body):
    del session_body["head_direction"]
    assert client.post(URL, json=session_body).json()["head_direction"] is None


def test_arming_gives_the_confirmed_side_to_the_engine_and_the_audit(client, session_id, running):
    body = {"operator": "A. Therapist", "head_direction": "top"}
    assert client.post(f"{URL}/{session_id}/arm", json=body).status_code == 200
    assert running.commands == [Arm(operator="A. Therapist", head_direction=TOP)]
    rows = [(row["outcome"], row["actor"], row["detail"]) for row in audit_rows(client, "session.arm")]
    assert rows == [(outcome, "A. Therapist", {"head_direction": "top"}) for outcome in ("requested", "done")]


def test_arming_without_a_side_confirms_none(client, session_id, running):
    assert client.post(f"{URL}/{session_id}/arm", json={"operator": "A. Therapist"}).status_code == 200
    assert running.commands == [Arm(operator="A. Therapist")]
    assert audit_rows(client, "session.arm")[-1]["detail"] == {}


def test_the_engine_s_refusal_has_a_code_of_its_own(client, session_id, running):
    running.refuse_with = HeadDirectionError("the head is unknown")
    answer = act(client, session_id, "arm")
    assert (answer.status_code, answer.json()["code"]) == (409, "head_direction_missing")
    assert audit_rows(client, "session.arm")[-1]["outcome"] == "refused"


def test_the_gate_and_the_pipeline_of_a_session_have_its_head_direction():
    settings, window = Settings(), Window.model_validate(WINDOW | {"signal": "thorax"})
    assert gate_limits(window, settings).head_direction is None
    assert gate_limits(window, settings, head_direction=BOTTOM).head_direction is BOTTOM
    assert measuring_with(PipelineSettings(), Regions(), window).superior_px is None
    assert measuring_with(PipelineSettings(), Regions(), window, BOTTOM).superior_px == (0.0, 1.0)


# -- the room -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("head", HeadDirection)
@pytest.mark.parametrize("gantry", HeadDirection)
def test_a_patient_lies_along_the_couch(gantry, head):
    settings = Settings(gantry_side=gantry)
    is_along = {gantry, head} in ({gantry}, {TOP, BOTTOM}, {LEFT, RIGHT})
    if is_along:
        check_head_direction(head, settings)
        return
    with pytest.raises(BoundError, match=f"{gantry} \\(head first\\) or {gantry.opposite} \\(feet first\\)") as refused:
        check_head_direction(head, settings)
    assert (refused.value.field, refused.value.value) == ("head_direction", repr(head.value))


@pytest.mark.parametrize(("head", "gantry"), [(None, None), (None, TOP), (LEFT, None)])
def test_what_is_unknown_is_not_compared(head, gantry):
    check_head_direction(head, Settings(gantry_side=gantry))


@pytest.mark.parametrize(
    ("position", "gantry", "head"),
    [
        *(("HFS", TOP, TOP), ("FFS", TOP, BOTTOM), ("HFS", LEFT, LEFT), ("FFS", LEFT, RIGHT)),
        *((None, TOP, None), ("HFS", None, None), (None, None, None)),
    ],
)
def test_the_head_of_a_head_first_patient_lies_at_the_gantry(position, gantry, head):
    assert head_of(position, gantry) is head


def test_the_gantry_s_side_is_a_setting(monkeypatch):
    monkeypatch.setenv("TIDEGATE_GANTRY_SIDE", "left")
    assert load_settings().gantry_side is LEFT
    monkeypatch.setenv("TIDEGATE_GANTRY_SIDE", "north")
    with pytest.raises(SettingsError, match="TIDEGATE_GANTRY_SIDE"):
        load_settings()


class TestOnACouchAlongTheColumns:
    """The gantry is at the top of the picture."""

    @pytest.fixture
    def settings(self, settings: Settings) -> Settings:
        return settings.model_copy(update={"gantry_side": TOP})

    def test_a_session_across_it_is_refused(self, client, session_body):
        answer = client.post(URL, json=session_body | {"head_direction": "left"})
        assert (answer.status_code, answer.json()["field"]) == (422, "head_direction")
        assert "TIDEGATE_GANTRY_SIDE" in answer.json()["bound"]

    def test_a_session_along_it_is_created(self, client, session_body):
        assert client.post(URL, json=session_body | {"head_direction": "bottom"}).status_code == 201
