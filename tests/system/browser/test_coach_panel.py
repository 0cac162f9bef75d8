"""The console's panel of the patient screen: the mirror, pairing, and settings that are sent as they stand there."""

import re

import pytest
from playwright.sync_api import Page, expect

from service.core.permissions import Role
from tests.support.browser.fake_coach import CODE, SCREEN, FakeConsole, guide
from tests.support.browser.fake_service import SESSION_ID, person, sample
from tests.support.browser.tab import Tab

pytestmark = [pytest.mark.browser, pytest.mark.verification]
SETTINGS = f"/api/v1/sessions/{SESSION_ID}/coaching"


def opened(console: FakeConsole, tab: Tab, **changes: object) -> Page:
    """Open the console on a disarmed session, and the panel."""
    console.mode, console.sample = "samples", sample(gate="disarmed", is_armed=False, **changes)
    page = tab.open("disarmed")
    page.click("#do-coach")
    return page


def test_the_mirror_shows_what_the_patient_sees(console, console_tab):
    console.guide = guide(instruction="hold", countdown_s=6.5, level=0.7)
    page = opened(console, console_tab)
    expect(page.locator("#coach .word")).to_have_text("Hold")
    expect(page.locator("#coach .seconds")).to_have_text("7")
    console.guide = None
    expect(page.locator("#coach .wait")).to_have_text("Please wait")
    page.get_by_role("button", name="Close").click()
    expect(page.locator("#coach")).to_be_hidden()
    console_tab.await_that(lambda: console.mirrors == 0, "the mirror's stream stays open")


def test_a_code_is_shown_until_a_screen_has_used_it_and_the_screen_is_ended(console, console_tab):
    page = opened(console, console_tab)
    expect(page.locator(".screens-count")).to_have_text("No screen is paired.")
    page.get_by_role("button", name="Show pairing code").click()
    expect(page.locator(".pairing-code strong")).to_have_text(f"{CODE[:3]} {CODE[3:]}")
    expect(page.locator(".pairing-code")).to_contain_text("/patient/")
    console.screens = [SCREEN]
    expect(page.locator(".screens-count")).to_have_text("1 screen is paired.")
    expect(page.locator(".pairing-code")).to_have_text("")
    expect(page.locator("#do-coach")).to_have_text("Patient screen · 1")
    page.get_by_role("button", name="End screen 1").click()
    assert console.screens, "the first click asks"
    page.get_by_role("button", name="End screen 1").click()
    expect(page.locator(".screens-count")).to_have_text("No screen is paired.")
    assert [path for path, _ in console.posts() if path.startswith("/coach/")] == [
        "/coach/code",
        f"/coach/screens/{SCREEN['id']}/end",
    ]


def test_settings_are_sent_with_the_person_and_a_refusal_is_shown(console, console_tab):
    page = opened(console, console_tab)
    expect(page.locator("[name='rest_s']")).to_be_enabled()
    page.select_option("[name=display]", "curve")
    page.select_option("[name=language]", "de")
    page.fill("[name='band.lower']", "-10")
    page.fill("[name='band.upper']", "110")
    page.check("[name=sounds]")
    page.get_by_role("button", name="Apply").click()
    expect(page.locator(".coaching .outcome")).to_have_text("The screen shows this now.")
    (call,) = [one for one in console.calls if one[0] == "PUT"]
    assert call[1:] == (
        SETTINGS,
        {"operator": "A. Therapist", "display": "curve", "language": "de", "sounds": True, "rest_s": 10}
        | {"band": {"lower_percent": -10, "upper_percent": 110}, "scale": None, "is_practice": False},
    )
    console.problem = (422, {"detail": "the band must be inside the window", "code": "invalid_value"})
    page.get_by_role("button", name="Apply").click()
    expect(page.locator(".coaching .outcome")).to_have_text("the band must be inside the window")


def test_practice_is_started_and_ended_with_what_is_in_use_and_not_while_armed(console, console_tab):
    page = opened(console, console_tab)
    page.fill("[name='band.lower']", "55")
    page.click("#do-practice")
    expect(page.locator("#do-practice")).to_have_text("End practice")
    (call,) = [one for one in console.calls if one[0] == "PUT"]
    assert (call[2]["is_practice"], call[2]["band"]) == (True, None), "what is typed is sent by Apply alone"
    page.click("#do-practice")
    expect(page.locator("#do-practice")).to_have_text("Start practice")
    console.sample = sample(gate="hold", is_armed=True)
    expect(page.locator("#do-practice")).to_be_disabled()
    expect(page.locator(".coaching")).to_contain_text("practice is without beam")


def test_arming_is_seen_to_have_ended_a_practice(console, console_tab):
    console.coaching |= {"is_practice": True}
    page = opened(console, console_tab)
    expect(page.locator("#do-practice")).to_have_text("End practice")
    console.coaching |= {"is_practice": False}
    expect(page.locator("#do-practice")).to_have_text("Start practice")


def test_without_a_running_session_nothing_can_be_set(console, console_tab):
    page = console_tab.open("idle")
    page.click("#do-coach")
    expect(page.locator("#do-practice")).to_be_disabled()
    expect(page.locator("[name=display]")).to_be_disabled()
    expect(page.locator(".coaching")).to_contain_text("No session runs.")


def test_who_may_not_pair_screens_sees_no_button(console, console_tab):
    console.person = person("V. Iewer", Role.VIEWER)
    console.mode = "samples"
    page = console_tab.open("hold")
    expect(page.locator("#do-coach")).to_be_hidden()
    assert not [path for _, path, _ in console.calls if "/coach" in path]


def test_the_settings_of_one_session_do_not_stay_in_the_form_of_the_next(console, console_tab):
    console.coaching |= {"language": "de", "rest_s": 33.0}
    page = opened(console, console_tab)
    expect(page.locator("[name=rest_s]")).to_have_value("33")
    page.fill("[name='band.lower']", "55")
    console.coaching |= {"language": "en", "rest_s": 10.0}
    console.sample = sample(gate="disarmed", is_armed=False, session_id="77" * 16)
    expect(page.locator("[name=rest_s]")).to_have_value("10")
    expect(page.locator("[name='band.lower']")).to_have_value("")


def test_every_control_of_the_panel_has_a_name(console, console_tab):
    console.screens = [SCREEN]
    page = opened(console, console_tab)
    expect(page.locator(".screen-list button")).to_have_count(1)
    names = page.locator("#coach :is(input, select, button)").evaluate_all(
        "all => all.map((one) => one.ariaLabel || one.closest('label')?.textContent || one.textContent)"
    )
    assert all(re.search(r"\w", name) for name in names), names
