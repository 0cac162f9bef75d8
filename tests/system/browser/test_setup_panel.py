"""Creating a session: the form speaks the contract, and a refusal points at its field."""

from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from tests.support.browser.fake_service import CALIBRATION, PLAN, RECORDING, FakeService, sample
from tests.support.browser.tab import Tab

pytestmark = [pytest.mark.browser, pytest.mark.verification]


def fill(page: Page) -> None:
    page.fill("[name=patient_reference]", "P-0200")
    page.fill("[name=plan_id]", "PLAN-9")
    page.fill("[name=fraction_id]", "FX-1")
    page.select_option("[name=source]", "recording:demo/recording.oni")


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
                "source": {"kind": "recording", "player": "repeated", "path": "demo/recording.oni"},
                "calibration_id": CALIBRATION["id"],
                "window": {"kind": "amplitude", "signal": "whole", "lower_percent": -10, "upper_percent": 30}
                | {"hysteresis_percent": 2, "dwell_ms": 200},
            },
        )
    ]
    expect(empty.locator("#who-patient")).to_have_text("P-0200")
    expect(empty.locator("#do-start")).to_be_enabled()


def test_only_the_fields_of_the_chosen_source_and_signal_are_asked_and_sent(fake: FakeService, tab: Tab, empty: Page):
    fill(empty)
    empty.click("#more-settings summary")
    expect(empty.locator("[name='source.player']")).to_be_visible()
    empty.select_option("[name=source]", "device:")
    empty.select_option("[name='window.signal']", "region")
    expect(empty.locator("[name='source.player']")).to_be_hidden()
    empty.fill("[name='window.row']", "4")
    empty.click("#new-session [type=submit]")
    expect(empty.locator("#setup")).to_be_hidden()
    body = fake.posts()[0][1]
    assert body["source"] == {"kind": "device"}
    assert (body["window"]["signal"], body["window"]["row"], body["window"]["column"]) == ("region", 4, 0)


def test_a_refusal_points_at_its_field(fake: FakeService, tab: Tab, empty: Page):
    fill(empty)
    problem = {"code": "invalid_value", "detail": "window.lower_percent: below upper_percent (30)"}
    fake.problem = (
        422,
        problem | {"field": "window.lower_percent", "value": "70", "bound": "below upper_percent (30)"},
    )
    empty.click("#new-session [type=submit]")
    expect(empty.locator("#setup-outcome")).to_contain_text("window.lower_percent: below upper_percent (30)")
    expect(empty.locator("[name='window.lower_percent']")).to_have_attribute("aria-invalid", "true")
    expect(empty.locator("[name='window.lower_percent']")).to_be_focused()
    expect(empty.locator("[name='window.upper_percent']")).to_have_attribute("aria-invalid", "false")


def test_a_missing_calibration_is_stated_and_can_be_uploaded(fake: FakeService, tab: Tab, tmp_path: Path):
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
    tab.open_setup()
    panel = page.locator("#setup").bounding_box()
    assert panel is not None
    for name in ("#gate", ".panel.trace", "#do-disarm"):
        box = page.locator(name).bounding_box()
        assert box is not None
        apart = panel["y"] >= box["y"] + box["height"] or panel["x"] >= box["x"] + box["width"]
        assert apart, f"{name} is covered"


def test_a_live_camera_can_be_asked_for_without_a_calibration(fake: FakeService, empty: Page):
    fill(empty)
    empty.select_option("[name=source]", "device:")
    empty.select_option(
        "[name=calibration_id]", label="None: the live camera's own registration or its maker's calibration"
    )
    empty.click("#new-session [type=submit]")
    expect(empty.locator("#setup")).to_be_hidden()
    path, request = fake.posts()[-1]
    assert path == "/sessions"
    assert request["source"] == {"kind": "device"}
    assert "calibration_id" not in request


@pytest.mark.parametrize(
    ("kind", "is_shown"), [("device registration", True), ("device calibration", True), ("uploaded", False)]
)
def test_a_session_that_was_not_calibrated_states_it_all_the_time(
    fake: FakeService, tab: Tab, kind: str, is_shown: bool
):
    fake.mode, fake.sample = "samples", sample() | {"calibration": kind}
    page = tab.open("hold")
    badge = page.locator("#badge-uncalibrated")
    expect(badge).to_be_visible() if is_shown else expect(badge).to_be_hidden()


@pytest.mark.parametrize("warning", ["RECORDING: a played recording gates a REAL beam line", None])
def test_a_session_whose_recording_gates_a_real_line_states_it_all_the_time(fake: FakeService, tab: Tab, warning: str):
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
    empty.click("#more-settings summary")
    empty.select_option("[name='window.kind']", "breath_hold")
    empty.fill("[name^='window.lower_']:visible", "8")
    empty.fill("[name^='window.upper_']:visible", "14")
    empty.click("#add-condition")
    empty.fill("[name='window.further.0.upper_percent']", "70")
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


def test_a_prepared_plan_needs_its_fraction_camera_and_calibration_only(fake: FakeService, tab: Tab):
    """Three fields, each with a proposal: what the plan states cannot be typed."""
    fake.plans, fake.devices = [dict(PLAN)], [{"uri": "usb:1", "name": "Asus Xtion"}]
    page = tab.open("idle")
    page.select_option("[name=plan]", PLAN["id"])
    expect(page.locator("#plan-note")).to_contain_text("prescribes gating")
    for name in ("patient_reference", "plan_id", "fraction_id"):
        expect(page.locator(f"[name={name}]")).to_be_hidden()
    expect(page.locator("#more-settings")).not_to_have_attribute("open", "")
    expect(page.locator("[name=fraction_number]")).to_have_value("3")
    expect(page.locator("[name=source]")).to_have_value("device:usb:1")
    page.click("#new-session [type=submit]")
    expect(page.locator("#setup")).to_be_hidden()
    ((path, sent),) = fake.posts()
    assert path == f"/plans/{PLAN['id']}/sessions"
    assert sent == {
        "operator": "A. Therapist",
        "fraction_number": 3,
        "source": {"kind": "device", "uri": "usb:1"},
        "calibration_id": CALIBRATION["id"],
        "window": {"kind": "amplitude", "signal": "whole", "lower_percent": -10, "upper_percent": 30}
        | {"hysteresis_percent": 2, "dwell_ms": 200},
    }
    expect(page.locator("#who-patient")).to_have_text("P-0300")


def test_the_work_list_shows_each_plan_with_its_next_fraction_and_sets_it_up(fake: FakeService, tab: Tab):
    last = {"id": "77" * 16, "status": "interrupted", "fraction_number": 2, "started_at": "2026-11-22T08:00:00Z"}
    fake.plans = [
        dict(PLAN),
        PLAN | {"id": "9b" * 16, "patient_reference": "P-0301", "next_fraction": 6, "last_session": last},
        PLAN | {"id": "9c" * 16, "patient_reference": "P-0302", "next_fraction": 16},
        PLAN | {"id": "9d" * 16, "patient_reference": "P-0303", "fractions_planned": None},
    ]
    page = tab.open("idle")
    rows = page.locator("#plan-list li")
    expect(rows).to_have_count(4)
    expect(rows.nth(0)).to_contain_text("Fraction 3 of 15No session yet")
    expect(rows.nth(1)).to_contain_text("Fraction 6 of 15Last: interrupted, 22 Nov 2026")
    expect(rows.nth(2)).to_contain_text("All 15 fractions done")
    expect(rows.nth(2).get_by_role("button")).to_have_count(0)
    expect(rows.nth(3)).to_contain_text("Fraction 3No session yet")
    rows.nth(1).get_by_role("button").click()
    expect(page.locator("[name=plan]")).to_have_value("9b" * 16)
    expect(page.locator("[name=fraction_number]")).to_have_value("6")
    expect(page.locator("[name=source]")).to_be_focused()
    expect(page.locator("#setup-outcome")).to_contain_text("P-0301, LUNG_GATED: choose the camera")
    page.click("#work-typed")
    expect(page.locator("[name=plan]")).to_have_value("")
    expect(page.locator("[name=fraction_number]")).to_have_value("")
    expect(page.locator("[name=patient_reference]")).to_be_focused()


def test_a_search_narrows_both_lists_and_leaves_the_form(fake: FakeService, tab: Tab):
    fake.plans = [dict(PLAN), PLAN | {"id": "9b" * 16, "patient_reference": "P-0301"}]
    page = tab.open("idle")
    expect(page.locator("#plan-list li")).to_have_count(2)
    page.fill("[name=fraction_id]", "FX-7")
    page.fill("#work-search", "P-0301")
    expect(page.locator("#plan-list li")).to_have_count(1)
    expect(page.locator("#session-empty")).to_have_text("No session with this.")
    expect(page.locator("[name=plan] option")).to_have_count(3)
    expect(page.locator("[name=fraction_id]")).to_have_value("FX-7")
    page.fill("#work-search", "nobody")
    expect(page.locator("#plan-empty")).to_have_text("No plan with this.")
    page.fill("#work-search", "")
    expect(page.locator("#plan-list li")).to_have_count(2)


def test_the_chosen_plan_and_fraction_survive_a_refresh_of_the_lists(fake: FakeService, tab: Tab):
    fake.plans = [dict(PLAN)]
    page = tab.open("idle")
    page.select_option("[name=plan]", PLAN["id"])
    page.fill("[name=fraction_number]", "7")
    page.select_option("[name=source]", "recording:demo/recording.oni")
    fake.plans.insert(0, PLAN | {"id": "9b" * 16, "label": "NEWER"})
    page.set_input_files("#calibration-file", {"name": "c.json", "mimeType": "application/json", "buffer": b"{}"})
    page.evaluate("document.getElementById('do-setup').click()")
    page.evaluate("document.getElementById('do-setup').click()")
    expect(page.locator("[name=plan] option")).to_have_count(3)
    tab.is_answered()
    assert page.input_value("[name=plan]") == PLAN["id"]
    assert page.input_value("[name=fraction_number]") == "7"
    assert page.input_value("[name=source]") == "recording:demo/recording.oni"


def test_a_plan_of_a_breath_hold_asks_for_a_breath_hold_and_no_edges(fake: FakeService, tab: Tab):
    fake.plans = [PLAN | {"gating": "breath_hold"}]
    page = tab.open("idle")
    page.select_option("[name=plan]", PLAN["id"])
    expect(page.locator("[name='window.kind']")).to_have_value("breath_hold")
    expect(page.locator("[name='window.lower_mm']")).to_have_value("")
    expect(page.locator("#more-settings")).not_to_have_attribute("open", "")


def test_the_technique_of_a_plan_that_was_looked_at_before_is_not_the_next_one_s(fake: FakeService, tab: Tab):
    fake.plans = [PLAN | {"gating": "breath_hold"}, PLAN | {"id": "9b" * 16, "label": "GATED"}]
    page = tab.open("idle")
    for plan in (PLAN["id"], "9b" * 16, PLAN["id"], ""):
        page.select_option("[name=plan]", plan)
        is_hold = plan == PLAN["id"]
        expect(page.locator("[name='window.kind']")).to_have_value("breath_hold" if is_hold else "amplitude")


@pytest.mark.parametrize(
    ("code", "name"),
    [
        ("plan_gating", "overrides_plan_gating"),
        ("fraction_done", "repeats_fraction"),
        ("plan_contradicted", "overrides_contradiction"),
    ],
)
def test_what_the_plan_does_not_provide_for_asks_for_a_reason(fake: FakeService, tab: Tab, code: str, name: str):
    fake.plans = [dict(PLAN)]
    page = tab.open("idle")
    page.select_option("[name=plan]", PLAN["id"])
    page.fill("[name=fraction_number]", "2")
    page.select_option("[name=source]", "recording:demo/recording.oni")
    expect(page.locator("#plan-reason")).to_be_hidden()
    fake.problem = (409, {"code": code, "detail": "Not as planned."})
    page.click("#new-session [type=submit]")
    expect(page.locator("#setup-outcome")).to_have_text("Not as planned.")
    expect(page.locator("#plan-reason input")).to_be_focused()
    fake.problem = None
    page.keyboard.type("Prescribed by Dr. C today")
    page.click("#new-session [type=submit]")
    expect(page.locator("#setup")).to_be_hidden()
    assert fake.posts()[-1][1][name] == "Prescribed by Dr. C today"
    page.click("#do-setup")
    expect(page.locator("#plan-reason")).to_be_hidden()
    assert page.input_value("#plan-reason input") == ""


def test_recordings_are_chosen_from_a_list_and_what_cannot_be_played_states_why(fake: FakeService, tab: Tab):
    fake.recordings.append(RECORDING | {"path": "cut.oni", "seconds": None, "problem": "cut.oni: is empty"})
    fake.recordings.append(RECORDING | {"path": "depth.oni", "has_color": False})
    fake.recordings.append(RECORDING | {"path": "turned.oni", "mirrored": "depth and colour"})
    fake.sessions = []
    page = tab.open("idle")
    options = page.locator("[name=source] option")
    expect(options).to_have_count(6)
    assert options.all_text_contents() == [
        "Choose a camera or recording",
        "First camera found",
        "demo/recording.oni · 40 s",
        "cut.oni: cut.oni: is empty",
        "depth.oni · 40 s · no colour",
        "turned.oni · 40 s (stored mirrored, turned round)",
    ]
    expect(options.nth(3)).to_be_disabled()
    page.fill("[name=patient_reference]", "P-0200")
    page.click("#new-session [type=submit]")
    expect(page.locator("#setup-outcome")).to_have_text("Choose a camera or a recording.")
    expect(page.locator("[name=source]")).to_be_focused()
    assert fake.posts() == []
