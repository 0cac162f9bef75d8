"""Nothing old is shown as new: silence, delay, a lost connection and a hung page all end the claim to know the gate."""

import re

import pytest
from playwright.sync_api import Page, expect

from tests.support.browser.fake_service import FakeService, sample
from tests.support.browser.stepped_page import SteppedPage
from tests.support.browser.tab import Tab

pytestmark = [pytest.mark.browser, pytest.mark.verification]

NONE = "\N{EN DASH}"
BEAM_ON = sample(gate="beam_on", hold_reason=None, hold_text=None, line_on=True)
HIDE = "Object.defineProperty(document, 'hidden', {value: true, configurable: true})"
STALE_MS = 300


def age_s(page: Page) -> float:
    found = re.search(r"([\d.]+) s", page.inner_text("#gate-age"))
    assert found is not None
    return float(found[1])


def fall_silent(stepped: SteppedPage) -> None:
    stepped.fake.mode = "silent"
    stepped.advance_until(lambda: stepped.kind == "stale", within_ms=STALE_MS + 200)


def test_silence_turns_beam_on_into_stale_with_an_age_that_counts_up(stepped: SteppedPage):
    page = stepped.open(BEAM_ON)
    fall_silent(stepped)
    expect(page.locator("#gate-word")).to_have_text("Stale")
    expect(page.locator("body")).to_have_attribute("data-fresh", "no")
    first_s = age_s(page)
    assert first_s >= 0.3
    stepped.advance(1_000)
    assert age_s(page) == pytest.approx(first_s + 1.0, abs=0.11)


def test_stale_hides_the_numbers_and_refuses_to_arm_but_not_to_disarm(fake: FakeService, stepped: SteppedPage):
    page = stepped.open_settled(sample(gate="disarmed", is_armed=False))
    expect(page.locator("#do-arm")).to_be_enabled()
    fall_silent(stepped)
    stepped.advance(200)
    expect(page.locator("#do-arm")).to_be_disabled()
    expect(page.locator("#figure-whole")).to_have_text(NONE)
    expect(page.locator("#figure-line")).to_have_text(NONE)
    page.click("#do-disarm")
    expect(page.locator("#outcome")).to_have_text("Disarmed.")
    assert fake.posts()[-1][0].endswith("/disarm")


def test_news_after_silence_clears_stale(stepped: SteppedPage):
    stepped.open(BEAM_ON)
    fall_silent(stepped)
    stepped.shows(sample(gate="hold"))


def test_a_fresh_message_about_an_old_frame_is_stale(stepped: SteppedPage):
    page = stepped.open(BEAM_ON | {"age_ms": 900.0}, "stale")
    expect(page.locator("#gate-reason")).to_contain_text("too old")


def test_messages_that_queued_up_on_the_way_are_stale(fake: FakeService, stepped: SteppedPage):
    stepped.open(BEAM_ON)
    fake.lag_s = 2.0
    stepped.advance_until(lambda: stepped.kind == "stale", within_ms=400)


def test_a_latched_fault_stays_visible_while_the_camera_is_silent(stepped: SteppedPage):
    fault = {"hold_reason": "source_lost", "hold_text": "The camera is disconnected", "age_ms": 8100.0}
    page = stepped.open_settled(sample(gate="fault", **fault))
    expect(page.locator("#gate-age")).to_contain_text("Camera data 8.")
    expect(page.locator("#figure-whole")).to_have_text(NONE)
    expect(page.locator("#do-acknowledge")).to_be_enabled()


def test_a_fault_does_not_give_way_to_stale_while_the_engine_is_replaced(stepped: SteppedPage):
    """Beyond that, nothing is claimed."""
    stepped.open(sample(gate="fault", hold_reason="engine_lost", hold_text="The engine has stopped"))
    stepped.fake.mode = "silent"
    stepped.advance(1_200)
    assert stepped.kind == "fault"
    stepped.advance(600)
    assert stepped.kind == "stale"


def test_a_lost_connection_states_it_and_comes_back_by_itself(fake: FakeService, stepped: SteppedPage):
    page = stepped.open(BEAM_ON)
    fake.is_up = False
    stepped.advance_until(lambda: stepped.kind == "offline")
    expect(page.locator("#gate-word")).to_have_text("No connection")
    expect(page.locator("#gate-age")).to_contain_text("Last message")
    fake.is_up = True
    stepped.shows(sample(gate="dwell"))
    assert fake.connections == 2


def test_nothing_from_before_is_current_after_a_reconnection(fake: FakeService, stepped: SteppedPage):
    page = stepped.open(BEAM_ON)
    fake.is_up, fake.mode = False, "silent"
    stepped.advance_until(lambda: stepped.kind == "offline")
    fake.is_up = True
    stepped.advance_until(lambda: fake.connections == 2)
    stepped.advance(400)
    assert stepped.kind == "offline"
    expect(page.locator("#figure-whole")).to_have_text(NONE)


def test_another_version_of_the_stream_is_not_guessed_at(fake: FakeService, tab: Tab):
    fake.mode, fake.sample, fake.schema = "samples", BEAM_ON, "tidegate.live/9"
    page = tab.open("offline")
    expect(page.locator("#gate-reason")).to_contain_text("tidegate.live/9")


def test_a_hidden_tab_claims_nothing_in_its_title(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", BEAM_ON
    page = tab.open("beam_on")
    expect(page).to_have_title("BEAM PERMITTED · Tidegate")
    page.evaluate(HIDE)
    expect(page).to_have_title("Tidegate (not watched)")


def test_pictures_are_not_fetched_while_the_page_is_hidden(fake: FakeService, stepped: SteppedPage):
    page = stepped.open(BEAM_ON)
    stepped.advance_until(lambda: fake.pictures > 0)
    page.evaluate(HIDE)
    stepped.advance(400)
    before = fake.pictures
    stepped.advance(2_000)
    assert fake.pictures == before
    page.evaluate("Object.defineProperty(document, 'hidden', {value: false})")
    stepped.advance_until(lambda: fake.pictures > before)


def test_a_session_that_ended_is_not_called_running(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", sample(gate="disarmed", is_armed=False)
    page = tab.open("disarmed")
    expect(page.locator("#who-patient")).to_have_text("P-0117")
    fake.mode = "idle"
    tab.sees("idle")
    expect(page.locator("#gate-reason")).to_contain_text("The beam is held.")
    fake.sessions[0]["status"] = "ended"
    expect(page.locator("#who-status")).to_have_text("ended")
