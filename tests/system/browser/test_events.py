"""The events: sentences, one a pulse, each with its time on the trace."""

from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from playwright.sync_api import expect

from tests.support.browser.fake_service import SESSION, FakeService, sample
from tests.support.browser.tab import Tab

pytestmark = pytest.mark.browser

START = datetime(2026, 11, 21, 3, 0, tzinfo=UTC)


def moved(to: str, seconds: float, reason: str | None = None, start: datetime = START) -> dict[str, Any]:
    at = (start + timedelta(seconds=seconds)).isoformat().replace("+00:00", "Z")
    detail = {"from_state": "hold", "to_state": to, "reason": reason}
    row = {"actor": "tidegate", "action": "gate.transition", "outcome": "done", "session_id": SESSION["id"]}
    return row | {"sequence": round(100 + 10 * seconds), "at": at, "detail": detail}


def test_a_pulse_is_one_line_and_a_hold_of_another_cause_its_own(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", sample()
    fake.audit = [
        moved("hold", 12.0, "frame_missing"),
        moved("beam_on", 10.0),
        moved("hold", 5.5, "outside_window"),
        moved("beam_on", 4.0),
        moved("hold", 1.0, "outside_window"),
    ]
    page = tab.open("hold")
    rows = page.locator("#events li")
    expect(rows).to_have_count(4)
    assert [one.replace("\n", "") for one in rows.all_inner_texts()] == [
        "03:00:12Beam heldA camera frame is missing",
        "03:00:10Beam on",
        "03:00:04Beam on 1.5 s, then offOutside the window",
        "03:00:01Beam heldOutside the window",
    ]


def test_a_chosen_event_stands_on_the_trace_and_the_keys_go_through_the_list(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", sample()
    page = tab.open("hold")
    frame = page.locator("#trace-frame")
    fake.audit = [moved("beam_on", 0.0, start=datetime.now(UTC)), moved("hold", -3600.0, "dwell")]
    tab.draws(fake)
    rows = page.locator("#events li")
    expect(rows).to_have_count(2)
    rows.nth(1).click()
    expect(frame).to_have_attribute("data-live", "yes")  # an hour ago: no longer kept
    page.focus("#events")
    page.keyboard.press("ArrowDown")
    expect(rows.nth(0).get_by_role("link")).to_be_focused()
    page.keyboard.press("Enter")
    expect(frame).to_have_attribute("data-live", "no")
