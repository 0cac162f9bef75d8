"""The treatment's figures are the service's: beam-on time, duty cycle, elapsed, the gate's state, holds by cause."""

from typing import Any

import pytest
from playwright.sync_api import Page, expect

from service.core.permissions import Role
from tests.support.browser.fake_service import NOTHING_MEASURED, SESSION_ID, FakeService, person, sample, summary
from tests.support.browser.stepped_page import PAUSED, SteppedPage
from tests.support.browser.tab import Tab

pytestmark = [pytest.mark.browser, pytest.mark.verification]

NONE = "\N{EN DASH}"
SHOWN = ("on", "duty", "elapsed", "state", "holds")


def describe(fake: FakeService, **changes: Any) -> None:
    fake.sessions[0] |= {"summary": summary(), "continues": None, "delivered_before_s": None, "gate": None} | changes


def figures(page: Page) -> dict[str, str]:
    return {name: page.locator(f"#treatment-{name}").inner_text() for name in SHOWN}


def test_what_the_service_counted_is_shown_and_is_the_same_after_a_reload(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", sample()
    describe(fake)
    page = tab.open("hold")
    expect(page.locator("#treatment-on")).to_have_text("41.2 s")
    expect(page.locator("#treatment-duty")).to_have_text("38 %")
    expect(page.locator("#treatment-elapsed")).to_have_text("3:07 min")
    expect(page.locator("#treatment-holds")).to_have_text("outside window 34 · marker lost 2")
    before = figures(page)
    page.reload()
    expect(page.locator("#treatment-on")).to_have_text("41.2 s")
    assert figures(page) == before


def test_the_time_of_a_session_that_is_continued_is_beside_its_own(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", sample()
    describe(fake, continues="0c" * 16, delivered_before_s=118.0)
    page = tab.open("hold")
    expect(page.locator("#treatment-on")).to_have_text("41.2 s + 1:58 min before")
    describe(fake, continues="0c" * 16, delivered_before_s=None)
    expect(page.locator("#treatment-on")).to_have_text("41.2 s + unknown before")


def test_the_state_s_age_goes_on_by_the_service_s_clock_and_ends_with_the_state(
    fake: FakeService, stepped: SteppedPage
):
    since = PAUSED.isoformat().replace("+00:00", "Z")
    describe(fake, gate={"state": "hold", "hold_reason": "outside_window", "state_since": since, "armed_by": None})
    page = stepped.open(sample())
    stepped.advance(12_000)
    shown = page.locator("#treatment-state")
    assert 11.0 < float(shown.inner_text().removesuffix(" s")) < 15.0
    expect(page.locator("#treatment-state-name")).to_have_text("Hold for")
    stepped.shows(sample(hold_reason="marker_lost"))
    stepped.advance(400)
    expect(shown).to_have_text(NONE)


def test_figures_of_another_session_or_of_none_are_not_shown(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", sample()
    describe(fake)
    page = tab.open("hold")
    expect(page.locator("#treatment-on")).to_have_text("41.2 s")
    fake.sample = sample(session_id="99" * 16)
    for name in SHOWN:
        expect(page.locator(f"#treatment-{name}")).to_have_text(NONE)


def test_figures_of_a_session_that_was_read_before_belong_to_no_other_sample(fake: FakeService, tab: Tab):
    page = tab.open("idle")
    script = """async ([sample, session]) => {
      const { renderTreatment } = await import('/js/panels/treatment.js');
      renderTreatment(sample, session, Date.now());
      return document.querySelector('#treatment-on').textContent;
    }"""
    session = {"id": SESSION_ID, "summary": summary(), "gate": None, "continues": None}
    assert page.evaluate(script, [sample(), session]) == "41.2 s"
    assert page.evaluate(script, [sample(session_id="99" * 16), session]) == NONE


def test_figures_that_are_old_are_not_shown(fake: FakeService, stepped: SteppedPage):
    describe(fake)
    page = stepped.open(sample())
    stepped.advance(400)
    expect(page.locator("#treatment-on")).to_have_text("41.2 s")
    fake.mode = "silent"
    stepped.advance(1_000)
    expect(page.locator("#treatment-on")).to_have_text(NONE)


def test_the_method_s_figures_are_the_physicist_s_and_everyone_s_where_one_is_bad(fake: FakeService, tab: Tab):
    fake.person, fake.mode, fake.sample = person("T. Herapist", Role.THERAPIST), "samples", sample()
    page = tab.open("hold")
    expect(page.locator("#technical")).to_be_hidden()
    fake.sample = sample(missed_frames=2)
    expect(page.locator("#technical")).to_be_visible()


def test_technical_figures_are_folded_away_and_say_where_one_is_bad(fake: FakeService, tab: Tab):
    position = {"shift_mm": 0.2, "turn_deg": 0.1, "height_mm": 0.1, "tilt_deg": 0.1, "roll_deg": 0.0, "travel_mm": 3.25}
    fake.mode, fake.sample = "samples", sample(unseen_cells=[[0, 0], [3, 4]], position=position)
    page = tab.open("hold")
    expect(page.locator("#figure-seen")).to_have_text("110 of 112")
    expect(page.locator("#figure-travel")).to_have_text("3.3")
    expect(page.locator("#figure-latency")).to_be_hidden()
    expect(page.locator("#technical")).to_have_attribute("data-bad", "no")
    fake.sample = sample(missed_frames=2)
    expect(page.locator("#technical")).to_have_attribute("data-bad", "yes")
    page.click("#technical > summary")
    expect(page.locator("#figure-latency")).to_be_visible()
    fake.sample = sample(**NOTHING_MEASURED)
    expect(page.locator("#figure-seen")).to_have_text(NONE)
