"""The page shows how far the reference lies from the fraction's first, and asks for a reason beyond the budget."""

from typing import Any

import pytest
from playwright.sync_api import expect

from service.core.schemas.live_messages import LiveReference
from tests.support.browser.fake_service import PROPOSAL, SESSION, SESSION_ID, FakeService, sample
from tests.support.browser.tab import Tab

pytestmark = [pytest.mark.browser, pytest.mark.verification]


def reference(**changes: Any) -> dict[str, Any]:
    """Return the distance as the stream carries it, held against the contract."""
    shown = {
        "text": "reference 1.5 mm from the fraction's first",
        "distance_mm": 1.5,
        "budget_mm": 2.0,
        "is_beyond": False,
        "moved_mm": 1.5,
        "shift_mm": 0.4,
        "height_mm": -1.42,
        "turn_deg": 0.2,
        "tilt_deg": 0.31,
        "shape_mm": 0.1,
        "uncertainty_mm": 0.09,
        "level": -1.5,
        "correction": 0.0,
        "unit": "mm",
        "unknown": "",
    } | changes
    return LiveReference.model_validate(shown).model_dump()


FAR = reference(text="reference 3.0 mm from the fraction's first", distance_mm=3.0, is_beyond=True)
UNKNOWN = reference(
    text="reference at an unknown distance from the fraction's first",
    **dict.fromkeys(("distance_mm", "shift_mm", "height_mm", "turn_deg", "tilt_deg", "shape_mm", "moved_mm", "level")),
    is_beyond=True,
    unknown="the camera was disconnected since",
)


def test_the_distance_is_shown_beside_the_trace_and_marked_beyond_the_budget(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", sample()
    page = tab.open("hold")
    line = page.locator("#reference-distance")
    expect(line).to_have_text("")
    fake.sample = sample(reference=reference())
    expect(line).to_have_text("Reference 1.5 mm from the fraction's first · height \N{MINUS SIGN}1.4 · shift 0.4")
    expect(line).to_have_attribute("title", "Turn 0.2°, tilt 0.3°, shape 0.1 mm")
    expect(line).to_have_attribute("data-bad", "no")
    fake.sample = sample(reference=FAR)
    expect(line).to_contain_text("Reference 3.0 mm from the fraction's first")
    expect(line).to_have_attribute("data-bad", "yes")
    fake.sample = sample(reference=UNKNOWN)
    expect(line).to_have_text(
        "Reference at an unknown distance from the fraction's first: the camera was disconnected since"
    )


def test_a_proposal_beyond_the_budget_asks_for_a_reason_that_is_sent_once(fake: FakeService, tab: Tab):
    far = PROPOSAL | {"distance": "3.02 mm from the fraction's first", "distance_mm": 3.02, "is_beyond": True}
    fake.sessions = [SESSION | {"measurement_state": "measuring", "has_reference": True, "reference_proposals": [far]}]
    fake.mode, fake.sample = "samples", sample(gate="disarmed", is_armed=False)
    page = tab.open("disarmed")
    expect(page.locator("#reference-proposal")).to_contain_text(
        "Needs a reason: 3.0 mm from the fraction's first. Mean of 4 breaths"
    )
    page.fill("#reference-reason", "re-planned")
    page.click("#do-reference")
    expect(page.locator("#outcome")).to_have_text("Reference set.")
    (body,) = [body for path, body in fake.posts() if path == f"/sessions/{SESSION_ID}/reference"]
    assert body["reason"] == "re-planned"
    expect(page.locator("#reference-reason")).to_have_value("")


def test_a_reference_that_the_stream_shows_is_not_asked_for_again(fake: FakeService, tab: Tab):
    """The session is read every two seconds, and says until then that none is set."""
    fake.sessions = [SESSION | {"has_reference": False, "measurement_state": "measuring"}]
    fake.mode, fake.sample = "samples", sample(gate="disarmed", is_armed=False, hold_reason="disarmed")
    page = tab.open("disarmed")
    expect(page.locator("#gate-reason")).to_have_text("Not armed. Set the reference before arming.")
    fake.sample |= {"reference": reference()}
    expect(page.locator("#gate-reason")).to_have_text("Not armed")
    expect(page.locator("#do-arm")).to_be_enabled()
