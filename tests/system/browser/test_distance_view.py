"""The view from 3 m: large and distinct enough to be read, as quickly grey as the console, and without a way to arm."""

import pytest
from playwright.sync_api import Page, expect

from tests.support.browser import legibility as seen
from tests.support.browser.fake_service import SESSION, FakeService, alarm, sample, summary
from tests.support.browser.stepped_page import SteppedPage
from tests.support.browser.tab import Tab

pytestmark = [pytest.mark.browser, pytest.mark.verification]

VIEW = "/?view=distance"
SINCE = "2026-11-20T08:00:00Z"


def open_distance(fake: FakeService, tab: Tab, state: str, language: str = "en") -> Page:
    width, height = seen.SIZE_PX
    tab.page.set_viewport_size({"width": width, "height": height})
    tab.page.add_init_script(f"localStorage.setItem('tidegate.language', '{language}')")
    fake.mode, fake.sample = "samples", seen.STATES[state]
    gate = {"state": state, "hold_reason": fake.sample["hold_reason"], "state_since": SINCE}
    fake.sessions = [SESSION | {"gate": gate, "summary": summary()}]
    tab.url += VIEW
    page = tab.open(state)
    expect(page.locator("#gate-time")).not_to_have_text("")
    return page


@pytest.mark.parametrize("language", ["en", "de"])
@pytest.mark.parametrize("state", seen.STATES)
def test_state_reason_advice_time_and_lamps_are_read_at_3_m(fake: FakeService, own_tab: Tab, state: str, language: str):
    page = open_distance(fake, own_tab, state, language)
    texts = {one.name: one for one in seen.texts_of(page, state)}
    assert {"word", "reason", "instruction", "time", "gate lamp", "beam lamp"} <= set(texts)
    assert state != "fault" or "call" in texts
    assert {name: one.arcmin for name, one in texts.items() if one.arcmin < seen.LEAST_ARCMIN} == {}
    assert {name: one.contrast for name, one in texts.items() if one.contrast < seen.LEAST_CONTRAST} == {}
    assert {name for name, one in texts.items() if not one.is_inside} == set()
    expect(page.locator("#trace")).to_be_in_viewport(ratio=0.95)


LONGEST = ("operator_lost", "beam_on_limit", "coverage_low", "baseline_drifted", "breath_hold_drifted")


@pytest.mark.parametrize("reason", LONGEST)
def test_the_longest_reasons_and_a_warning_stay_inside(fake: FakeService, own_tab: Tab, reason: str):
    page = open_distance(fake, own_tab, "hold", "de")
    fake.alarms = (alarm(1, "beam_without_permit", "high", "The accelerator reports beam on without a permit"),)
    fake.sample = fake.sample | {"hold_reason": reason}
    expect(page.locator("#gate-warning")).not_to_have_text("")
    assert {one.name for one in seen.texts_of(page, "hold") if not one.is_inside} == set()
    box = page.locator("#trace").bounding_box()
    assert box is not None
    assert box["height"] > 100.0


def test_beam_on_and_fault_differ_for_every_eye_and_in_grey(fake: FakeService, own_tab: Tab):
    page = open_distance(fake, own_tab, "beam_on")
    on = seen.ground_of(page)
    fake.sample = seen.STATES["fault"]
    own_tab.sees("fault")
    fault = seen.ground_of(page)
    ratios = {vision: seen.ratio(seen.as_seen(on, vision), seen.as_seen(fault, vision)) for vision in seen.BLINDNESS}
    assert {vision: ratio for vision, ratio in ratios.items() if ratio < seen.LEAST_LUMINANCE_RATIO} == {}
    apart = {vision: seen.difference(on, fault, vision) for vision in seen.BLINDNESS}
    assert {vision: far for vision, far in apart.items() if far < seen.LEAST_DIFFERENCE} == {}


def test_nothing_there_arms(fake: FakeService, own_tab: Tab):
    page = open_distance(fake, own_tab, "disarmed")
    buttons = page.locator("button:visible").evaluate_all("all => all.map(one => one.id)")
    assert set(buttons) == {"do-hold", "do-disarm", "do-sound", "do-distance"}
    page.locator("#do-distance").click()
    expect(page.locator("#do-arm")).to_be_visible()
    assert "view=" not in page.url


def test_it_is_grey_as_soon_as_the_console_and_its_lamps_claim_nothing(fake: FakeService, stepped: SteppedPage):
    stepped.tab.url += VIEW
    page = stepped.open(seen.STATES["beam_on"])
    assert page.get_attribute("#lamp-gate", "data-state") == "on"
    fake.mode = "silent"
    stepped.advance(400)
    assert stepped.kind == "stale"
    assert page.get_attribute("body", "data-fresh") == "no"
    lamps = [page.get_attribute(f"#lamp-{name}", "data-state") for name in ("gate", "beam")]
    assert lamps == ["unknown", "unknown"]
    expect(page.locator("#gate-time")).to_have_text("")


@pytest.mark.parametrize(("beam", "state"), [("on", "on"), ("off", "off"), ("unknown", "unknown"), (None, "none")])
def test_the_beam_lamp_shows_what_the_accelerator_reports(
    fake: FakeService, own_tab: Tab, beam: str | None, state: str
):
    fake.mode, fake.sample = "samples", sample(accelerator_beam=beam, line_on=False)
    page = own_tab.open("hold")
    expect(page.locator("#lamp-beam")).to_have_attribute("data-state", state)
    expect(page.locator("#lamp-gate")).to_have_attribute("data-state", "off")
