"""The steps of a set-up: one is "now", its button is marked, and the list goes once the gate was armed."""

from typing import Any

import pytest
from playwright.sync_api import Page, expect

from tests.support.browser.fake_service import FakeService, sample
from tests.support.browser.stepped_page import SteppedPage
from tests.support.browser.tab import Tab

pytestmark = [pytest.mark.browser, pytest.mark.verification]

VIEW = {
    "distance_mm": 853.0,
    "tilt_deg": 3.2,
    "coverage": 0.98,
    "brightness": 0.44,
    "saturated": 0.0,
    "running_s": 1240.0,
    "warm_in_s": 0.0,
}
DISARMED = {"is_armed": False, "gate": "disarmed", "hold_reason": "disarmed", "camera_view": VIEW | {"advice": []}}
NO_MOTION = {"signal_mm": None, "whole_mm": None, "thorax_mm": None, "abdomen_mm": None, "volume_l": None}
LOST = {"state": "lost", "lost": {"reason": "marker_lost", "detail": "3 of 4 markers found"}} | NO_MOTION
TRAINING = {
    "state": "training",
    "training": {"frames": 90, "cycles": 1, "seconds": 3.0, "share": 0.3, "note": ""},
} | NO_MOTION
POSITION = {
    "text": "Sign the position.",
    "plan_session_id": None,
    "reference_number": 1,
    "degrees": [],
    "shape_mm": None,
}
POSITION |= {"shape_mm": None, "is_within": True, "shortcomings": [], "signed_by": None, "reason": "", "lapse": ""}


def running(fake: FakeService, *, has_reference: bool | None = None, **changes: Any) -> None:
    fake.mode, fake.sample = "samples", sample(**DISARMED | changes)
    fake.sessions[0] |= {"measurement_state": fake.sample["state"], "has_reference": has_reference}


def now(page: Page) -> str:
    return page.locator("#steps li[data-state=now]").get_attribute("data-code") or ""


def marked(page: Page) -> list[str]:
    return page.locator("button[data-next=yes]").evaluate_all("all => all.map((one) => one.id)")


@pytest.mark.parametrize(
    ("has_reference", "changes", "step", "buttons"),
    [
        (None, LOST, "markers", []),
        (None, TRAINING, "training", []),
        (False, {}, "reference", ["do-reference"]),
        (False, {"gate": "fault", "hold_reason": "beam_line_mismatch"}, "fault", ["do-acknowledge"]),
        (True, {"gate": "fault", "hold_reason": "beam_line_mismatch"}, "fault", ["do-acknowledge"]),
        (True, {"position_check": POSITION | {"status": "unsigned"}}, "position", ["do-sign"]),
        (True, {"position_check": POSITION | {"status": "lapsed"}}, "position", ["do-sign"]),
        (True, {"position_check": POSITION | {"status": "signed", "signed_by": "A"}}, "window", ["do-window"]),
        (True, {}, "window", ["do-window"]),
    ],
)
def test_the_next_step_is_marked_with_its_button(
    fake: FakeService, tab: Tab, has_reference: bool | None, changes: dict[str, Any], step: str, buttons: list[str]
):
    running(fake, has_reference=has_reference, **changes)
    page = tab.open(fake.sample["gate"])
    expect(page.locator("#steps")).to_be_visible()
    tab.await_that(lambda: now(page) == step, f"the step is not {step}")
    assert marked(page) == buttons
    assert page.locator("#steps li[aria-current=step]").count() == 1


def reference_set_by_key(fake: FakeService, tab: Tab) -> Page:
    """Set the reference with Enter; return the page, which does not know yet that there is one."""
    running(fake, has_reference=False)
    page = tab.open("disarmed")
    expect(page.locator("#do-reference")).to_be_enabled()
    page.focus("#do-reference")
    page.keyboard.press("Enter")
    expect(page.locator("#outcome")).to_have_attribute("data-kind", "done")
    return page


def test_the_focus_goes_to_the_next_step_s_button_after_an_act(fake: FakeService, tab: Tab):
    page = reference_set_by_key(fake, tab)
    running(fake, has_reference=True)
    expect(page.locator("#do-window")).to_be_focused()


@pytest.mark.parametrize("elsewhere", [False, True])
def test_the_focus_goes_to_no_button_that_acknowledges_and_stays_where_a_person_put_it(
    fake: FakeService, tab: Tab, elsewhere: bool
):
    page = reference_set_by_key(fake, tab)
    if elsewhere:
        page.focus("#do-setup")
    fault = {"gate": "fault", "hold_reason": "beam_line_mismatch"}
    running(fake, has_reference=True, **({} if elsewhere else fault))
    tab.await_that(lambda: marked(page) in (["do-acknowledge"], ["do-window"]), "the next step is not marked")
    page.wait_for_timeout(300)
    focused = page.evaluate("document.activeElement.id")
    assert focused == "do-setup" if elsewhere else focused != "do-acknowledge"


def test_before_the_start_the_steps_lead_to_it(fake: FakeService, tab: Tab):
    fake.sessions[0] |= {"status": "created"}
    page = tab.open("idle")
    expect(page.locator("#steps li[data-code=patient]")).to_contain_text("P-0117 · PLAN-LUNG-4 · FX-03")
    tab.await_that(lambda: marked(page) == ["do-start"], "Start is not marked")


def test_without_a_session_the_first_step_is_to_choose_one(fake: FakeService, tab: Tab):
    fake.sessions = []
    page = tab.open("idle")
    page.click("#setup-close")
    tab.await_that(lambda: marked(page) == ["do-setup"], "Sessions is not marked")
    assert now(page) == "patient"


def test_while_the_camera_is_opened_no_button_is_marked(fake: FakeService, tab: Tab):
    fake.sessions[0] |= {"status": "created"}
    page = tab.open("idle")
    tab.await_that(lambda: marked(page) == ["do-start"], "Start is not marked")
    fake.sessions[0] |= {"status": "running"}
    expect(page.locator("#steps li[data-code=camera]")).to_contain_text("is being opened")
    assert (now(page), marked(page)) == ("camera", [])


@pytest.mark.parametrize("status", ["stopped", "ended", "failed", "interrupted"])
def test_after_a_session_the_next_one_is_to_be_chosen(fake: FakeService, tab: Tab, status: str):
    fake.sessions[0] |= {"status": status}
    page = tab.open("idle")
    page.click("#setup-close")
    tab.await_that(lambda: marked(page) == ["do-setup"], "Sessions is not marked")
    expect(page.locator("#steps li[data-code=patient]")).not_to_contain_text("P-0117")


def test_after_the_window_was_looked_at_the_summary_is_next_and_after_arming_the_list_goes(fake: FakeService, tab: Tab):
    running(fake, has_reference=True)
    page = tab.open("disarmed")
    expect(page.locator("#steps")).to_be_visible()
    page.click("#do-window")
    page.click("#window-cancel")
    tab.await_that(lambda: marked(page) == ["do-arm"], "Arm is not marked")
    assert now(page) == "summary"
    fake.sample = sample()
    tab.sees("hold")
    expect(page.locator("#steps")).to_be_hidden()
    assert marked(page) == []
    running(fake, has_reference=True)
    tab.sees("disarmed")
    expect(page.locator("#steps")).to_be_hidden()
    expect(page.locator("#steps-show")).to_be_hidden()


def test_the_steps_of_another_session_begin_again(fake: FakeService, tab: Tab):
    running(fake, has_reference=True)
    page = tab.open("disarmed")
    expect(page.locator("#steps")).to_be_visible()
    page.click("#do-window")
    page.click("#window-cancel")
    tab.await_that(lambda: marked(page) == ["do-arm"], "Arm is not marked")
    other = "4e" * 16
    fake.sessions.insert(0, fake.sessions[0] | {"id": other, "patient_reference": "P-0999"})
    fake.sample = fake.sample | {"session_id": other}
    expect(page.locator("#steps li[data-code=patient]")).to_contain_text("P-0999")
    tab.await_that(lambda: marked(page) == ["do-window"], "the other session's window was taken for looked at")


def test_the_camera_s_figures_and_what_to_do_about_them(fake: FakeService, tab: Tab):
    running(fake, **LOST)
    page = tab.open("disarmed")
    camera = page.locator("#steps li[data-code=camera]")
    expect(camera).to_have_attribute("data-state", "done")
    expect(camera).to_contain_text("85 cm · tilt 3° · 98 % with depth · light 44 % · on for 20 min")
    advice = ["too_far", "tilted", "gaps", "too_dark", "too_bright", "too_near", "warming_up"]
    fake.sample = sample(**DISARMED | LOST | {"camera_view": VIEW | {"distance_mm": None, "advice": advice}})
    expect(camera).to_have_attribute("data-state", "attention")
    expect(camera).to_contain_text("no depth · tilt 3°")
    expect(camera).not_to_contain_text("..")
    for text in ("Lower the camera", "Point the camera", "no depth:", "more light", "less light", "Raise", "warms up"):
        expect(camera).to_contain_text(text)
    expect(page.locator("#steps li[data-code=markers]")).to_contain_text("3 of 4 markers found.")


def test_the_list_is_hidden_and_shown_again(fake: FakeService, tab: Tab):
    running(fake, has_reference=False)
    page = tab.open("disarmed")
    page.click("#steps-hide")
    expect(page.locator("#steps")).to_be_hidden()
    page.click("#steps-show")
    expect(page.locator("#steps")).to_be_visible()


def test_stale_data_prove_no_step(fake: FakeService, stepped: SteppedPage):
    running(fake, has_reference=False)
    page = stepped.open_settled(fake.sample)
    stepped.advance_until(lambda: page.locator("#steps").is_visible())
    before = page.locator("#do-hold").bounding_box()
    fake.mode = "silent"
    stepped.advance_until(lambda: stepped.kind == "stale" and marked(page) == [])
    expect(page.locator("#steps")).to_have_attribute("data-stale", "yes")
    assert page.locator("#do-hold").bounding_box() == before  # nothing moves under a hand


def test_a_person_who_may_not_run_sessions_sees_no_steps(fake: FakeService, tab: Tab):
    fake.person = fake.person | {"permissions": ["sessions.read"]}
    running(fake, has_reference=False)
    page = tab.open("disarmed")
    tab.draws(fake)
    expect(page.locator("#steps")).to_be_hidden()
    assert marked(page) == []
