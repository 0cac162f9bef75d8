"""Nothing old is shown as new: silence, delay, a lost connection and a hung page all end the claim to know the gate."""

import re
import time

import pytest
from playwright.sync_api import Page, expect

from tests.support.browser.fake_service import FakeService, sample
from tests.support.browser.tab import Tab

pytestmark = pytest.mark.browser

NONE = "\N{EN DASH}"
BEAM_ON = sample(gate="beam_on", hold_reason=None, hold_text=None, line_on=True)


def age_s(page: Page) -> float:
    found = re.search(r"([\d.]+) s", page.inner_text("#gate-age"))
    assert found is not None
    return float(found[1])


def test_silence_turns_beam_on_into_stale_with_an_age_that_counts_up(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", BEAM_ON
    page = tab.open("beam_on")
    fake.mode = "silent"
    tab.sees("stale")
    expect(page.locator("#gate-word")).to_have_text("Stale")
    expect(page.locator("body")).to_have_attribute("data-fresh", "no")
    first_s = age_s(page)
    assert first_s >= 0.5
    expect(page.locator("#gate-age")).not_to_have_text(f"Last message {first_s:.1f} s ago")
    assert age_s(page) > first_s


def test_stale_hides_the_numbers_and_refuses_to_arm_but_not_to_disarm(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", sample(gate="disarmed", is_armed=False)
    page = tab.open("disarmed")
    expect(page.locator("#do-arm")).to_be_enabled()
    fake.mode = "silent"
    tab.sees("stale")
    expect(page.locator("#do-arm")).to_be_disabled()
    expect(page.locator("#figure-whole")).to_have_text(NONE)
    expect(page.locator("#figure-line")).to_have_text(NONE)
    page.click("#do-disarm")
    expect(page.locator("#outcome")).to_have_text("Disarmed.")
    assert fake.posts()[-1][0].endswith("/disarm")


def test_news_after_silence_clears_stale(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", BEAM_ON
    tab.open("beam_on")
    fake.mode = "silent"
    tab.sees("stale")
    fake.mode, fake.sample = "samples", sample(gate="hold")
    tab.sees("hold")


def test_a_fresh_message_about_an_old_frame_is_stale(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", BEAM_ON | {"age_ms": 900.0}
    page = tab.open("stale")
    expect(page.locator("#gate-reason")).to_contain_text("too old")


def test_messages_that_queued_up_on_the_way_are_stale(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", BEAM_ON
    tab.open("beam_on")
    fake.lag_s = 2.0
    tab.sees("stale")


def test_a_latched_fault_stays_visible_while_the_camera_is_silent(fake: FakeService, tab: Tab):
    fake.mode = "samples"
    fake.sample = sample(gate="fault", hold_reason="source_lost", hold_text="The camera is disconnected", age_ms=8100.0)
    page = tab.open("fault")
    expect(page.locator("#gate-age")).to_contain_text("Camera data 8.")
    expect(page.locator("#figure-whole")).to_have_text(NONE)
    expect(page.locator("#do-acknowledge")).to_be_visible()


def test_a_lost_connection_says_so_and_comes_back_by_itself(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", BEAM_ON
    page = tab.open("beam_on")
    fake.is_up = False
    tab.sees("offline")
    expect(page.locator("#gate-word")).to_have_text("No connection")
    expect(page.locator("#gate-age")).to_contain_text("Last message")
    fake.is_up, fake.sample = True, sample(gate="dwell")
    tab.sees("dwell")
    assert fake.connections == 2


def test_nothing_from_before_is_current_after_a_reconnection(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", BEAM_ON
    page = tab.open("beam_on")
    fake.is_up, fake.mode = False, "silent"
    tab.sees("offline")
    fake.is_up = True
    deadline_s = time.monotonic() + 10.0
    while fake.connections < 2:
        assert time.monotonic() < deadline_s
        page.wait_for_timeout(20)
    page.wait_for_timeout(300)
    tab.sees("offline")
    expect(page.locator("#figure-whole")).to_have_text(NONE)


def test_another_version_of_the_stream_is_not_guessed_at(fake: FakeService, tab: Tab):
    fake.mode, fake.sample, fake.schema = "samples", BEAM_ON, "tidegate.live/9"
    page = tab.open("offline")
    expect(page.locator("#gate-reason")).to_contain_text("tidegate.live/9")


def test_a_hidden_tab_claims_nothing_in_its_title(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", BEAM_ON
    page = tab.open("beam_on")
    expect(page).to_have_title("BEAM ON · Tidegate")
    page.evaluate("Object.defineProperty(document, 'hidden', {value: true, configurable: true})")
    expect(page).to_have_title("Tidegate (not watched)")


def test_pictures_are_not_fetched_while_the_page_is_hidden(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", BEAM_ON
    page = tab.open("beam_on")
    page.evaluate("Object.defineProperty(document, 'hidden', {value: true, configurable: true})")
    page.wait_for_timeout(400)
    before = fake.pictures
    page.wait_for_timeout(1000)
    assert fake.pictures == before
    page.evaluate("Object.defineProperty(document, 'hidden', {value: false})")
    deadline_s = time.monotonic() + 5.0
    while fake.pictures == before:
        assert time.monotonic() < deadline_s
        page.wait_for_timeout(20)


def test_a_session_that_ended_is_not_called_running(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", sample(gate="disarmed", is_armed=False)
    page = tab.open("disarmed")
    expect(page.locator("#who-patient")).to_have_text("P-0117")
    fake.mode = "idle"
    tab.sees("idle")
    expect(page.locator("#gate-reason")).to_contain_text("The beam is held.")
    fake.sessions[0]["status"] = "ended"
    expect(page.locator("#who-status")).to_have_text("ended")
