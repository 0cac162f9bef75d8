"""The list of interlocks: complete, in plain words, with this site's numbers and their bounds."""

from engine.core.gate_state import INTERLOCKS, HoldReason
from service.core.settings.settings import Settings
from service.sessions.views.interlocks import InterlockTable
from service.web.app import create_app
from tests.support.service.accounts import PeopleClient


def listed(**site):
    return {one.code: one for one in InterlockTable(Settings(**site)).interlocks().items}


def test_every_reason_that_is_not_the_gate_s_own_work_is_listed_once():
    assert set(listed()) == {reason.value for reason in HoldReason if reason.is_interlock}
    assert len(listed()) == len(INTERLOCKS)


def test_each_states_in_words_what_it_is_and_whether_it_latches():
    for code, one in listed().items():
        assert one.text
        assert one.trips
        assert one.source
        assert one.latches == HoldReason(code).is_fault


def test_numbers_are_the_site_s_with_the_bounds_that_a_site_has():
    (latency, _camera) = listed(max_latency_ms=300.0)["latency_high"].settings
    assert latency.model_dump() == {
        "name": "max_latency_ms",
        "variable": "TIDEGATE_MAX_LATENCY_MS",
        "value": 300.0,
        "low": 100.0,
        "high": 1000.0,
    }


def test_what_is_no_number_is_reported_as_it_is():
    found = listed(holding_events=("cough", "apnoea"), beam_without_calibration=False)
    events, *_rates = found["breathing_irregular"].settings
    assert (events.value, events.low, events.high) == (["cough", "apnoea"], None, None)
    (may,) = found["calibration_missing"].settings
    assert may.value is False


def test_the_list_is_one_call(settings, engine):
    site = settings.model_copy(update={"max_shift_mm": 9.5})
    with PeopleClient(create_app(site, lambda _settings: engine)) as client:
        answer = client.get("/api/v1/interlocks")
    assert answer.status_code == 200
    (shift,) = [one for one in answer.json()["items"] if one["code"] == "patient_shifted"]
    assert shift["text"] == "The patient has moved on the couch"
    assert [one["value"] for one in shift["settings"]] == [9.5, 6.0, 3.0, 3.0]
