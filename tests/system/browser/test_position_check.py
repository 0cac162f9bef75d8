"""The page shows the position against the plan's with its tolerance marks, and a person signs it there by name."""

from typing import Any

import pytest
from playwright.sync_api import expect

from service.core.schemas.live_messages import LivePositionCheck
from tests.support.browser.fake_service import PROPOSAL, SESSION, SESSION_ID, FakeService, sample
from tests.support.browser.tab import Tab

pytestmark = [pytest.mark.browser, pytest.mark.verification]
SHIFTS, TURNS = ("lateral", "longitudinal", "vertical"), ("pitch", "roll", "yaw")


def degree(name: str, value: float | None, tolerance: float) -> dict[str, Any]:
    unit = "mm" if tolerance == 2.0 else "deg"
    is_within = value is not None and abs(value) <= tolerance
    return {
        "name": name, "unit": unit, "value": value, "uncertainty": 0.4, "tolerance": tolerance, "is_within": is_within
    }  # fmt: skip


def check(*, within: bool = False, **changes: Any) -> dict[str, Any]:
    """Return a position check as the stream carries it, held against the contract."""
    values = (0.4, -0.6, 0.9) if within else (None, 2.4, -0.7)
    shown = {
        "status": "unsigned",
        "text": "as the stream says",
        "plan_session_id": "0" * 32,
        "reference_number": 2,
        "degrees": [
            *(degree(name, value, 2.0) for name, value in zip(SHIFTS, values, strict=True)),
            *(degree(name, value, 1.0) for name, value in zip(TURNS, (0.1, -0.4, 0.2), strict=True)),
        ],
        "shape_mm": 0.6,
        "is_within": within,
        "shortcomings": [] if within else ["lateral not determined", "longitudinal +2.4 mm"],
        "signed_by": None,
        "reason": "",
        "lapse": "",
    } | changes
    return LivePositionCheck.model_validate(shown).model_dump()


def disarmed(**changes: Any) -> dict[str, Any]:
    return sample(
        gate="disarmed", is_armed=False, hold_reason="disarmed", hold_text="Not armed", hold_detail="", **changes
    )


@pytest.fixture
def learned(fake: FakeService) -> FakeService:
    fake.mode = "samples"
    fake.sessions = [
        SESSION | {"measurement_state": "measuring", "has_reference": True, "reference_proposals": [PROPOSAL]}
    ]
    return fake


def test_a_first_fraction_shows_no_position(learned: FakeService, tab: Tab):
    learned.sample = disarmed(position_check=check(status="first_fraction", degrees=[]))
    page = tab.open("disarmed")
    expect(page.locator("#position")).to_be_hidden()
    expect(page.locator("#do-arm")).to_be_enabled()


def test_six_figures_with_their_marks_and_none_where_it_is_not_determined(learned: FakeService, tab: Tab):
    learned.sample = disarmed(position_check=check())
    page = tab.open("disarmed")
    figures = page.locator("#position-degrees dd")
    minus = "\N{MINUS SIGN}"
    expect(figures).to_have_text(["?", "+2.4 ✗", f"{minus}0.7 ✓", "+0.1° ✓", f"{minus}0.4° ✓", "+0.2° ✓"])
    expect(page.locator("#position-text")).to_contain_text("lateral not determined, longitudinal +2.4 mm")
    expect(page.locator("#do-arm")).to_be_disabled()
    expect(page.locator("#hint")).to_contain_text("sign the position first")


def test_beyond_the_tolerance_the_page_asks_for_a_reason_and_sends_what_was_shown(learned: FakeService, tab: Tab):
    learned.sample = disarmed(position_check=check())
    page = tab.open("disarmed")
    sign = page.locator("#do-sign")
    expect(sign).to_contain_text("Sign position as ")
    expect(sign).to_be_disabled()
    page.locator("#reference-reason").fill("longitudinal by the lasers")
    expect(sign).to_be_enabled()
    page.wait_for_timeout(2200)  # buttons that moved ignore clicks
    sign.click()
    expect(page.locator("#outcome")).to_contain_text("Position signed")
    (body,) = [body for path, body in learned.posts() if path == f"/sessions/{SESSION_ID}/position-check"]
    assert (body["reference_number"], body["reason"]) == (2, "longitudinal by the lasers")


def test_within_the_tolerance_no_reason_is_needed(learned: FakeService, tab: Tab):
    learned.sample = disarmed(position_check=check(within=True))
    page = tab.open("disarmed")
    expect(page.locator("#do-sign")).to_be_enabled()


def test_a_signed_position_names_the_person_and_may_be_armed(learned: FakeService, tab: Tab):
    learned.sample = disarmed(position_check=check(status="signed", signed_by="A. Therapist", within=True))
    page = tab.open("disarmed")
    expect(page.locator("#position-text")).to_have_text("Position signed by A. Therapist")
    expect(page.locator("#do-sign")).to_be_hidden()
    expect(page.locator("#do-arm")).to_be_enabled()


def test_a_lapse_states_what_to_do(learned: FakeService, tab: Tab):
    learned.sample = disarmed(position_check=check(status="lapsed", lapse="the patient moved"))
    page = tab.open("disarmed")
    expect(page.locator("#position-text")).to_contain_text("taken again: the patient moved")
    expect(page.locator("#do-sign")).to_be_disabled()
    expect(page.locator("#do-arm")).to_be_disabled()
