"""The head direction on the page: drawn on the picture, confirmed by arming, and missing where a part is gated."""

from typing import Any

import pytest
from playwright.sync_api import expect

from tests.support.browser.arming import press_arm
from tests.support.browser.fake_service import FakeService, condition, person, sample, window
from tests.support.browser.tab import Tab

pytestmark = pytest.mark.browser

DISARMED = sample(gate="disarmed", is_armed=False, hold_reason="disarmed", hold_text="Not armed")
ON_THORAX = DISARMED | {"window": window(condition(signal="thorax", label="thorax"))}


def armings(fake: FakeService) -> list[Any]:
    return [body for path, body in fake.posts() if path.endswith("/arm")]


@pytest.mark.parametrize("message", [DISARMED, ON_THORAX], ids=["whole", "thorax"])
def test_arming_confirms_the_side_that_the_picture_shows(fake: FakeService, tab: Tab, message: dict):
    fake.mode, fake.sample, fake.person = "samples", message, person("Ada L.")
    fake.sessions[0]["head_direction"] = "left"
    page = tab.open("disarmed")
    press_arm(page)
    expect(page.locator("#outcome")).to_have_attribute("data-kind", "done")
    assert armings(fake) == [{"operator": "Ada L.", "head_direction": "left", "state": "5e" * 16}]


def test_a_window_on_a_part_cannot_be_armed_without_the_head_direction(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", ON_THORAX
    page = tab.open("disarmed")
    expect(page.locator("#do-arm")).to_be_disabled()
    expect(page.locator("#hint")).to_contain_text("the head direction is unknown")


def test_the_form_sends_the_side_and_leaves_it_out_where_it_is_not_known(fake: FakeService, tab: Tab):
    fake.mode, fake.sessions = "idle", []
    page = tab.open("idle")
    expect(page.locator("#setup")).to_be_visible()
    choice = page.locator("select[name=head_direction]")
    assert choice.locator("option").evaluate_all("all => all.map((one) => one.value)") == [
        *("", "top", "bottom", "left", "right")
    ]
    expect(choice).to_have_value("")
    choice.select_option("bottom")
    page.fill("[name=patient_reference]", "P-1")
    page.select_option("[name=source]", "recording:demo/recording.oni")
    page.click("#new-session [type=submit]")
    page.wait_for_function("() => document.getElementById('setup').hidden")
    (body,) = [body for path, body in fake.posts() if path == "/sessions"]
    assert body["head_direction"] == "bottom"


def test_another_camera_and_another_body_are_shown(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", DISARMED | {"body_warning": "the body differs by 6.0 mm"}
    fake.sessions[0]["camera"] = {
        "name": "Xtion",
        "serial": "B2",
        "code": "camera_mismatch",
        "warning": "the calibration is of A1",
    }
    page = tab.open("disarmed")
    expect(page.locator("#badge-camera")).to_have_text("Another camera than calibrated")
    expect(page.locator("#badge-camera")).to_have_attribute("title", "the calibration is of A1")
    expect(page.locator("#badge-body")).to_be_visible()
    expect(page.locator("#badge-body")).to_have_attribute("title", "the body differs by 6.0 mm")
