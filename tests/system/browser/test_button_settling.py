"""Acknowledge, Arm and Release ignore clicks that were meant for another button: a double click never arms.

The clicks and keys are real input of Chromium.
"""

from typing import Any

import pytest
from playwright.sync_api import expect

from tests.support.browser.fake_service import SESSION_ID, FakeService, sample
from tests.support.browser.stepped_page import STEP_MS, SteppedPage

pytestmark = pytest.mark.browser

DISARMED = sample(gate="disarmed", is_armed=False, hold_reason="disarmed", hold_text="Not armed", hold_detail="")
HELD = sample(hold_reason="operator_hold", hold_text="Held by an operator", operator_hold="C. Nurse")
FAULT = sample(gate="fault", is_armed=False, hold_reason="source_lost", hold_text="The camera is disconnected")
BEAM_ON = sample(gate="beam_on", hold_reason=None, hold_text=None, hold_detail="", line_on=True)


def sent(fake: FakeService) -> list[str]:
    """The calls that changed the session, in order; the page reports its presence besides."""
    paths = [path.removeprefix(f"/sessions/{SESSION_ID}/") for path, _ in fake.posts() if SESSION_ID in path]
    return [path for path in paths if path != "presence"]


class ClickedPage:
    """A page whose buttons are clicked by place, as a hand does that aims before they move."""

    def __init__(self, stepped: SteppedPage) -> None:
        self.fake, self.page = stepped.fake, stepped.page
        self.advance, self.advance_until, self.open = stepped.advance, stepped.advance_until, stepped.open_settled

    def changes_to(self, message: dict[str, Any], shown: str) -> None:
        self.fake.sample = message
        self.advance_until(lambda: self.page.locator(shown).is_visible())

    def point(self, button: str, share: float = 0.5) -> tuple[float, float]:
        box = self.page.locator(button).bounding_box()
        assert box is not None
        return box["x"] + share * box["width"], box["y"] + box["height"] / 2

    def click(self, place: tuple[float, float], *, count: int = 1) -> None:
        """Click; with a count of 2 it is the second click of a double click."""
        self.page.mouse.move(*place)
        self.page.mouse.down(click_count=count)
        self.page.mouse.up(click_count=count)

    def sends(self, *known: str) -> None:
        """Let a step pass, and check that exactly these calls were sent so far."""
        self.advance(STEP_MS)
        assert sent(self.fake) == list(known)


@pytest.fixture
def clicked(stepped: SteppedPage) -> ClickedPage:
    return ClickedPage(stepped)


TAKES_ITS_PLACE = {"#do-arm": (0.25, DISARMED), "#do-release": (0.75, HELD)}


@pytest.mark.parametrize("button", TAKES_ITS_PLACE)
@pytest.mark.parametrize("count", [1, 2])
def test_a_second_click_on_acknowledge_does_not_press_what_takes_its_place(
    clicked: ClickedPage, button: str, count: int
):
    """A slow double click is two clicks to the browser (count 1), a quick one is not (count 2)."""
    share, after = TAKES_ITS_PLACE[button]
    clicked.open(FAULT)
    place = clicked.point("#do-acknowledge", share)
    clicked.click(place)
    clicked.sends("acknowledge")
    clicked.changes_to(after, button)
    assert clicked.page.evaluate("([x, y]) => '#' + document.elementFromPoint(x, y).id", list(place)) == button
    clicked.click(place, count=count)
    clicked.sends("acknowledge")


def test_a_double_click_acknowledges_once(clicked: ClickedPage):
    clicked.open(FAULT)
    clicked.page.mouse.dblclick(*clicked.point("#do-acknowledge", 0.25))
    clicked.sends("acknowledge")
    clicked.changes_to(DISARMED, "#do-arm")
    clicked.sends("acknowledge")


@pytest.mark.parametrize("button", TAKES_ITS_PLACE)
def test_a_click_is_ignored_1_s_after_the_layout_changed_and_accepted_after_2_s(clicked: ClickedPage, button: str):
    clicked.open(FAULT)
    clicked.changes_to(TAKES_ITS_PLACE[button][1], button)
    clicked.advance(1_000)
    expect(clicked.page.locator(button)).to_have_attribute("aria-disabled", "true")
    clicked.click(clicked.point(button))
    clicked.sends()
    expect(clicked.page.locator("#outcome")).to_contain_text("Not sent: the buttons moved")
    clicked.advance(1_000)
    expect(clicked.page.locator(button)).to_be_enabled()
    clicked.click(clicked.point(button))
    clicked.sends(button.removeprefix("#do-"))


def test_acknowledge_too_settles_where_arm_was(clicked: ClickedPage):
    clicked.open(DISARMED)
    clicked.changes_to(FAULT, "#do-acknowledge")
    clicked.click(clicked.point("#do-acknowledge"))
    clicked.sends()
    clicked.advance(2_000)
    clicked.click(clicked.point("#do-acknowledge"))
    clicked.sends("acknowledge")


def test_the_second_click_of_a_double_click_is_ignored_however_late(clicked: ClickedPage):
    clicked.open(DISARMED)
    clicked.click(clicked.point("#do-arm"), count=2)
    clicked.sends()
    clicked.click(clicked.point("#do-arm"))
    clicked.sends("arm")


def test_hold_disarm_and_stop_never_wait(clicked: ClickedPage):
    clicked.open(FAULT)
    clicked.changes_to(HELD, "#do-release")
    for action in ("hold", "disarm", "stop"):
        assert clicked.page.locator(f"#do-{action}").get_attribute("aria-disabled") is None
    clicked.click(clicked.point("#do-hold"), count=2)
    clicked.sends("hold")
    clicked.click(clicked.point("#do-disarm"), count=2)
    clicked.sends("hold", "disarm")
    clicked.page.keyboard.press("F8")
    clicked.page.keyboard.press("Escape")
    clicked.sends("hold", "disarm", "hold", "disarm")
    clicked.page.mouse.dblclick(*clicked.point("#do-stop"))
    clicked.sends("hold", "disarm", "hold", "disarm", "stop")
    assert clicked.page.locator("#do-release").get_attribute("aria-disabled") == "true", "all of this while it settles"


@pytest.mark.parametrize("key", ["Enter", "Space"])
def test_a_key_that_is_held_down_presses_nothing(clicked: ClickedPage, key: str):
    clicked.open(DISARMED)
    clicked.page.keyboard.down(key)
    clicked.page.focus("#do-arm")
    for _ in range(3):
        clicked.page.keyboard.down(key)
    clicked.page.keyboard.up(key)
    clicked.sends()
    clicked.page.keyboard.press(key)
    clicked.sends("arm")


def test_a_window_of_another_size_moves_the_buttons(clicked: ClickedPage):
    clicked.open(DISARMED)
    expect(clicked.page.locator("#do-arm")).to_be_enabled()
    clicked.page.set_viewport_size({"width": 1100, "height": 760})
    clicked.click(clicked.point("#do-arm"))
    clicked.sends()


def test_news_of_the_gate_does_not_move_the_buttons(clicked: ClickedPage):
    """Else nobody could release while the patient breathes."""
    clicked.open(HELD)
    long = "thorax: 12.40 mm is not inside -1 to 3 mm; abdomen: 14.10 mm is not inside -2 to 4 mm; 41 % of it fits"
    for message in (
        HELD | {"hold_detail": "", "hold_text": "Held"},
        HELD | {"hold_detail": long, "hold_text": f"{long}. {long}"},
        HELD | {"line_on": True},
        BEAM_ON | {"operator_hold": "C. Nurse"},
        DISARMED | {"operator_hold": "C. Nurse"},
        sample(gate="dwell", hold_reason="dwell", hold_text="Inside the window", operator_hold="C. Nurse"),
        HELD,
    ):
        clicked.fake.sample = message
        clicked.advance(400)
        assert clicked.page.locator("#do-release").get_attribute("aria-disabled") is None, message["hold_text"]
    expect(clicked.page.locator("#do-release")).to_be_enabled()
