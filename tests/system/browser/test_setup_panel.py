"""Creating a session: the form speaks the contract, and a refusal points at its field."""

from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from tests.support.browser.fake_service import CALIBRATION, FakeService, sample
from tests.support.browser.tab import Tab

pytestmark = pytest.mark.browser


def fill(page: Page) -> None:
    page.fill("[name=patient_reference]", "P-0200")
    page.fill("[name=plan_id]", "PLAN-9")
    page.fill("[name=fraction_id]", "FX-1")
    page.fill("[name='source.path']", "demo/recording.oni")


@pytest.fixture
def empty(fake: FakeService, tab: Tab) -> Page:
    """The page of a controller that has no session yet."""
    fake.sessions = []
    page = tab.open("idle")
    expect(page.locator("#setup")).to_be_visible()
    return page


def test_without_a_session_the_page_offers_to_create_one(empty: Page):
    expect(empty.locator("#session-empty")).to_have_text("No session yet. Create the first one here.")
    expect(empty.locator("#gate")).to_be_visible()


def test_the_form_sends_what_the_contract_asks_for(fake: FakeService, tab: Tab, empty: Page):
    fill(empty)
    empty.fill("[name=fraction_number]", "2")
    empty.click("#new-session [type=submit]")
    expect(empty.locator("#setup")).to_be_hidden()
    assert fake.posts() == [
        (
            "/sessions",
            {
                "operator": "A. Therapist",
                "patient_reference": "P-0200",
                "plan_id": "PLAN-9",
                "fraction_id": "FX-1",
                "fraction_number": 2,
                "source": {"kind": "recording", "player": "auto", "path": "demo/recording.oni"},
                "calibration_id": CALIBRATION["id"],
                "window": {"kind": "amplitude", "signal": "whole", "lower_mm": -1, "upper_mm": 3}
                | {"hysteresis_mm": 0.2, "dwell_ms": 200},
            },
        )
    ]
    expect(empty.locator("#who-patient")).to_have_text("P-0200")
    expect(empty.locator("#do-start")).to_be_enabled()


def test_only_the_fields_of_the_chosen_source_and_signal_are_asked_and_sent(fake: FakeService, tab: Tab, empty: Page):
    fill(empty)
    empty.select_option("[name='source.kind']", "device")
    empty.select_option("[name='window.signal']", "region")
    expect(empty.locator("[name='source.path']")).to_be_hidden()
    empty.fill("[name='window.row']", "4")
    empty.click("#new-session [type=submit]")
    expect(empty.locator("#setup")).to_be_hidden()
    body = fake.posts()[0][1]
    assert body["source"] == {"kind": "device"}
    assert (body["window"]["signal"], body["window"]["row"], body["window"]["column"]) == ("region", 4, 0)


def test_a_refusal_points_at_its_field(fake: FakeService, tab: Tab, empty: Page):
    fill(empty)
    problem = {"code": "invalid_value", "detail": "window.lower_mm: below upper_mm (3)", "field": "window.lower_mm"}
    fake.problem = (422, problem | {"value": "7", "bound": "below upper_mm (3)"})
    empty.click("#new-session [type=submit]")
    expect(empty.locator("#setup-outcome")).to_contain_text("window.lower_mm: below upper_mm (3)")
    expect(empty.locator("[name='window.lower_mm']")).to_have_attribute("aria-invalid", "true")
    expect(empty.locator("[name='window.lower_mm']")).to_be_focused()
    expect(empty.locator("[name='window.upper_mm']")).to_have_attribute("aria-invalid", "false")


def test_a_missing_calibration_is_said_and_can_be_uploaded(fake: FakeService, tab: Tab, tmp_path: Path):
    fake.sessions, fake.calibrations = [], []
    page = tab.open("idle")
    expect(page.locator("[name=calibration_id]")).to_contain_text("No calibration yet")
    fake.calibrations = [dict(CALIBRATION)]
    document = tmp_path / "calibration.json"
    document.write_text('{"schema": "tidegate.calibration/1"}')
    page.set_input_files("#calibration-file", document)
    expect(page.locator("#setup-outcome")).to_have_text("Calibration of Xtion 03 stored.")
    expect(page.locator("[name=calibration_id]")).to_have_value(CALIBRATION["id"])
    assert fake.posts() == [("/calibrations", {"schema": "tidegate.calibration/1"})]


def test_the_set_up_never_covers_the_gate_or_the_trace(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", sample()
    page = tab.open("hold")
    page.click("#do-setup")
    panel = page.locator("#setup").bounding_box()
    assert panel is not None
    for name in ("#gate", ".panel.trace", "#do-disarm"):
        box = page.locator(name).bounding_box()
        assert box is not None
        apart = panel["y"] >= box["y"] + box["height"] or panel["x"] >= box["x"] + box["width"]
        assert apart, f"{name} is covered"


def test_a_live_camera_can_be_asked_for_without_a_calibration(fake: FakeService, empty: Page):
    fill(empty)
    empty.select_option("[name='source.kind']", "device")
    empty.select_option("[name=calibration_id]", label="None: the live camera's built-in registration")
    empty.click("#new-session [type=submit]")
    expect(empty.locator("#setup")).to_be_hidden()
    path, request = fake.posts()[-1]
    assert path == "/sessions"
    assert request["source"] == {"kind": "device"}
    assert "calibration_id" not in request


@pytest.mark.parametrize(("kind", "is_shown"), [("device registration", True), ("uploaded", False)])
def test_a_session_that_was_not_calibrated_says_so_all_the_time(fake: FakeService, tab: Tab, kind: str, is_shown: bool):
    fake.mode, fake.sample = "samples", sample() | {"calibration": kind}
    page = tab.open("hold")
    badge = page.locator("#badge-uncalibrated")
    expect(badge).to_be_visible() if is_shown else expect(badge).to_be_hidden()


@pytest.mark.parametrize("warning", ["RECORDING: a played recording gates a REAL beam line", None])
def test_a_session_whose_recording_gates_a_real_line_says_so_all_the_time(fake: FakeService, tab: Tab, warning: str):
    fake.mode, fake.sample = "samples", sample() | {"is_simulated_beam": False}
    fake.sessions = [fake.sessions[0] | {"is_simulated_beam": False, "source_warning": warning}]
    badge = tab.open("hold").locator("#badge-played")
    expect(badge).to_be_visible() if warning else expect(badge).to_be_hidden()


def filled(page: Page) -> dict[str, str]:
    return page.evaluate(
        "Object.fromEntries([...document.querySelectorAll('#new-session [name]')]"
        ".filter((one) => !one.closest('[hidden]')).map((one) => [one.name, one.value]))"
    )


def test_nothing_of_one_patient_stays_in_the_form_for_the_next(tab: Tab, empty: Page):
    tab.is_answered()
    untouched = filled(empty)
    fill(empty)
    empty.select_option("[name='window.kind']", "breath_hold")
    empty.click("#add-condition")
    empty.fill("[name='window.further.0.upper_mm']", "7")
    empty.click("#new-session [type=submit]")
    expect(empty.locator("#setup")).to_be_hidden()
    empty.click("#do-setup")
    tab.is_answered()
    expect(empty.locator("#session-list .again")).to_have_count(0)
    assert filled(empty) == untouched


def test_a_new_session_takes_the_values_of_an_earlier_one_where_that_is_asked_for(fake: FakeService, tab: Tab):
    """All but the fraction, which a person enters; the values are shown."""
    earlier = fake.sessions[0]
    earlier |= {"status": "stopped", "head_direction": "top", "regions": {"named": []}}
    earlier["window"] |= {
        "kind": "phase",
        "signal": "thorax",
        "from_percent": 35.0,
        "to_percent": 65.0,
        "dwell_ms": 150.0,
    }
    further = {"kind": "amplitude", "signal": "whole", "lower_percent": -5.0, "upper_percent": 25.0}
    earlier["window"]["further"] = [further | {"hysteresis_percent": 3.0}]
    page = tab.open("idle")
    expect(page.locator("#setup")).to_be_visible()
    page.click("#session-list .again")
    assert page.input_value("[name=fraction_id]") == ""
    page.fill("[name=fraction_id]", "FX-04")
    page.click("#new-session [type=submit]")
    expect(page.locator("#setup")).to_be_hidden()
    ((_, sent),) = fake.posts()
    assert sent["window"].pop("further") == [further | {"hysteresis_percent": 3.0}]
    assert sent == {
        "operator": "A. Therapist",
        "patient_reference": "P-0117",
        "plan_id": "PLAN-LUNG-4",
        "fraction_id": "FX-04",
        "source": {"kind": "recording", "player": "auto", "path": "demo/recording.oni"},
        "calibration_id": CALIBRATION["id"],
        "head_direction": "top",
        "window": {"kind": "phase", "signal": "thorax", "from_percent": 35, "to_percent": 65, "min_confidence": 0.6}
        | {"dwell_ms": 150, "join": "and"},
    }
