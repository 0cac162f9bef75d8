"""QA on the page: the newest verdicts with their reports, and a badge as long as nobody can arm."""

import re

import pytest
from playwright.sync_api import expect

from tests.support.browser.fake_service import FakeService, qa_run, qa_status, sample
from tests.support.browser.tab import Tab

pytestmark = [pytest.mark.browser, pytest.mark.verification]


def test_the_newest_run_of_each_kind_is_reported_in_words_with_its_report(fake: FakeService, tab: Tab):
    fake.sessions = []
    fake.qa = qa_status(
        daily=qa_run("daily", "pass"),
        monthly=qa_run("monthly", "warn", id="0b" * 16),
        annual=qa_run("annual", None, status="cancelled"),
    )
    page = tab.open("idle")
    expect(page.locator("#setup")).to_be_visible()
    rows = page.locator("#qa-list li")
    expect(rows).to_have_count(3)
    expect(rows.nth(0)).to_contain_text("Dailypassed2026-11-21 06:30 UTC")
    expect(rows.nth(1)).to_contain_text("Monthlywarn")
    expect(rows.nth(2)).to_contain_text("Annualcancelled")
    expect(rows.nth(1).locator("a")).to_have_attribute("href", f"/api/v1/qa/runs/{'0b' * 16}/report.pdf")
    expect(rows.nth(2).locator("a")).to_have_count(0)
    expect(page.locator("#badge-qa")).to_be_hidden()


@pytest.mark.parametrize(
    ("refusal", "word"),
    [
        ("this site asks for a QA every 24 h, and none was ever done: do a daily QA (tidegate qa daily)", "QA due"),
        ("the newest QA (daily, 2026-11-21 06:30 UTC) failed (plate_noise_mm): find out why", "QA failed"),
    ],
)
def test_while_no_one_can_arm_the_page_states_it_all_the_time_and_why(
    fake: FakeService, tab: Tab, refusal: str, word: str
):
    fake.mode, fake.sample = "samples", sample()
    fake.qa = qa_status(refusal, 24.0, daily=qa_run("daily", "fail" if word == "QA failed" else "pass"))
    page = tab.open("hold")
    badge = page.locator("#badge-qa")
    expect(badge).to_be_visible()
    expect(badge).to_have_text(word)
    expect(badge).to_have_attribute("title", re.compile(re.escape(refusal)))
    page.click("#do-setup")
    expect(page.locator("#qa-note")).to_contain_text(f"Arming is refused: {refusal}")


def test_what_the_controller_does_not_tell_is_not_shown_as_if_it_were_known(fake: FakeService, tab: Tab):
    fake.sessions = []
    fake.qa = qa_status(daily=qa_run("daily", "pass"))
    page = tab.open("idle")
    expect(page.locator("#qa-list li").first).to_contain_text("pass")
    fake.qa = {}
    page.reload()
    expect(page.locator("#qa-note")).to_contain_text("The QA status is unknown")
    expect(page.locator("#qa-list li")).to_have_count(0)


def test_a_person_s_name_in_a_run_is_never_taken_for_markup(fake: FakeService, tab: Tab):
    fake.sessions = []
    fake.qa = qa_status("<img src=x onerror=alert(1)>", 24.0, daily=qa_run("daily", "<b>pass</b>"))
    page = tab.open("idle")
    expect(page.locator("#qa-list li").first).to_contain_text("<b>pass</b>")
    expect(page.locator("#qa img")).to_have_count(0)
