"""What is drawn can be read: window, trace, motion of each region and holds by cause, as tables."""

import pytest
from playwright.sync_api import expect

from tests.support.browser.fake_service import COLUMNS, ROWS, FakeService, over, sample, summary
from tests.support.browser.stepped_page import SteppedPage
from tests.support.browser.tab import Tab

pytestmark = [pytest.mark.browser, pytest.mark.verification]

DISARMED = sample(gate="disarmed", is_armed=False, hold_reason="disarmed", hold_text="Not armed", hold_detail="")


def test_the_tables_say_what_the_drawings_show(fake: FakeService, tab: Tab):
    regions = [[float(r - c) for c in range(COLUMNS)] for r in range(ROWS)]
    regions[2][3] = None
    fake.mode, fake.sample = "samples", DISARMED | {"regions_mm": regions, "unseen_cells": [[1, 0]], "whole_mm": 4.25}
    fake.sessions[0]["summary"] = summary()
    page = tab.open("disarmed")
    page.click("#do-tables")
    expect(page.locator("#tables-heading")).to_be_focused()
    expect(page.locator("#table-window tr").nth(1)).to_contain_text("amplitude")
    for text in ("-1 mm", "3 mm", "no"):
        expect(page.locator("#table-window tr").nth(1)).to_contain_text(text)
    rows = page.locator("#table-map tr")
    expect(rows).to_have_count(ROWS + 1)
    assert page.locator("#table-map tr").nth(1).locator("th, td").count() == COLUMNS + 1
    expect(rows.nth(3).locator("td").nth(3)).to_have_text("not measured")
    expect(rows.nth(2).locator("td").nth(0)).to_have_text("+1.0, not seen")
    expect(rows.nth(1).locator("td").nth(2)).to_have_text("\N{MINUS SIGN}2.0")
    expect(page.locator("#table-trace tr").nth(1)).to_contain_text("+4.3")
    expect(page.locator("#table-trace tr").nth(1)).to_contain_text("disarmed")
    expect(page.locator("#table-holds tr").nth(1)).to_have_text("Outside the window34")


def test_what_is_not_present_is_not_listed_and_the_table_states_it(fake: FakeService, stepped: SteppedPage):
    page = stepped.open_settled(DISARMED)
    page.click("#do-tables")
    stepped.advance(8_000)
    assert page.locator("#table-map td").count() == ROWS * COLUMNS
    assert page.locator("#table-trace tr").count() >= 3, "one line a second"
    fake.mode = "silent"
    stepped.advance_until(lambda: stepped.kind == "stale")
    stepped.advance_until(lambda: page.locator("#tables td").count() == 0)
    expect(page.locator("#tables-note")).to_have_text("No present measurement.")


def test_esc_closes_them_and_leaves_nothing_in_them(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", DISARMED
    page = tab.open("disarmed")
    page.click("#do-tables")
    expect(page.locator("#table-map td").first).to_be_attached()
    page.keyboard.press("Escape")
    expect(page.locator("#tables")).to_be_hidden()
    expect(page.locator("#do-tables")).to_be_focused()
    assert page.locator("#tables td").count() == 0
    assert not [path for path, _ in fake.posts() if path.endswith("/disarm")]


def test_what_lies_under_a_form_takes_no_focus_but_hold_and_disarm_do(fake: FakeService, tab: Tab):
    fake.mode, fake.sessions[:] = "idle", [over()]
    page = tab.open("idle")
    expect(page.locator("#setup")).to_be_visible()
    inert = "[...document.querySelectorAll('.room > [inert]')].map((one) => one.id || one.className)"
    tab.await_that(lambda: "report" in page.evaluate(inert), "the summary under the form takes the focus")
    assert not {"panel controls", "gate", "alarms"} & set(page.evaluate(inert))
    page.click("#setup-close")
    tab.await_that(lambda: "report" not in page.evaluate(inert), "the summary stays inert")
