"""Acknowledge, Arm and Release ignore clicks that were meant for another button: a double click never arms.

The page's clock stands still unless a test moves it on, so no test depends on the speed of the machine. The clicks and
keys are real input of Chromium.
"""

from collections.abc import Callable
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from tests.support.browser.fake_service import SESSION_ID, FakeService, sample
from tests.support.browser.tab import Tab

pytestmark = pytest.mark.browser

DISARMED = sample(gate="disarmed", is_armed=False, hold_reason="disarmed", hold_text="Not armed", hold_detail="")
HELD = sample(hold_reason="operator_hold", hold_text="Held by an operator", operator_hold="C. Nurse")
FAULT = sample(gate="fault", is_armed=False, hold_reason="source_lost", hold_text="The camera is disconnected")
BEAM_ON = sample(gate="beam_on", hold_reason=None, hold_text=None, hold_detail="", line_on=True)
STEP_MS = 200
MESSAGES = 3
"""One may be on its way when the clock moves, and one may still wait in the page."""


def sent(fake: FakeService) -> list[str]:
    """The calls that changed the session, in order."""
    return [path.removeprefix(f"/sessions/{SESSION_ID}/") for path, _ in fake.posts() if SESSION_ID in path]


class SlowRoom:
    """A page whose clock a test moves; the fake service's clock follows, so that no message looks too old."""

    def __init__(self, fake: FakeService, tab: Tab) -> None:
        self.fake = fake
        self.page: Page = tab.page
        self._tab = tab
        self._now_s = 0.0

    def open(self, message: dict[str, Any]) -> None:
        self.fake.mode, self.fake.sample = "samples", message
        self.page.clock.install()
        self._tab.open(message["gate"])
        self.page.clock.pause_at(self.page.evaluate("Date.now()") / 1000 + 0.2)
        self._now_s = self.page.evaluate("Date.now()") / 1000
        self.fake.clock, self.fake.period_s = lambda: self._now_s, 0.01
        self.advance(2 * STEP_MS)
        self._tab.sees(message["gate"])
        self.advance_until(lambda: self.page.locator("[aria-disabled]").count() == 0)

    def advance(self, milliseconds: int) -> None:
        for _ in range(0, milliseconds, STEP_MS):
            self._receive_messages()
            self.page.clock.run_for(STEP_MS)
            self._now_s += STEP_MS / 1000
        self._receive_messages()

    def _receive_messages(self) -> None:
        """Wait until the page has a message that was sent at the present time of its clock."""
        enough = self.fake.sent + MESSAGES
        while self.fake.sent < enough:
            self.page.wait_for_timeout(10)

    def advance_until(self, is_so: Callable[[], bool]) -> None:
        for _ in range(50):
            if is_so():
                return
            self.advance(STEP_MS)
        pytest.fail("did not happen within 10 s of the page's clock")

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

    def sends_nothing_more(self, *known: str) -> None:
        self.page.wait_for_timeout(150)
        assert sent(self.fake) == list(known)

    def sends(self, *known: str) -> None:
        for _ in range(400):
            if len(sent(self.fake)) >= len(known):
                break
            self.page.wait_for_timeout(20)
        self.sends_nothing_more(*known)


@pytest.fixture
def room(fake: FakeService, tab: Tab) -> SlowRoom:
    return SlowRoom(fake, tab)


TAKES_ITS_PLACE = {"#do-arm": (0.25, DISARMED), "#do-release": (0.75, HELD)}


@pytest.mark.parametrize("button", TAKES_ITS_PLACE)
@pytest.mark.parametrize("count", [1, 2])
def test_a_second_click_on_acknowledge_does_not_press_what_takes_its_place(room: SlowRoom, button: str, count: int):
    """A slow double click is two clicks to the browser (count 1), a quick one is not (count 2)."""
    share, after = TAKES_ITS_PLACE[button]
    room.open(FAULT)
    place = room.point("#do-acknowledge", share)
    room.click(place)
    room.sends("acknowledge")
    room.changes_to(after, button)
    assert room.page.evaluate("([x, y]) => '#' + document.elementFromPoint(x, y).id", list(place)) == button
    room.click(place, count=count)
    room.sends_nothing_more("acknowledge")


def test_a_double_click_acknowledges_once(room: SlowRoom):
    room.open(FAULT)
    room.page.mouse.dblclick(*room.point("#do-acknowledge", 0.25))
    room.sends("acknowledge")
    room.changes_to(DISARMED, "#do-arm")
    room.sends_nothing_more("acknowledge")


@pytest.mark.parametrize("button", TAKES_ITS_PLACE)
def test_a_click_is_ignored_1_s_after_the_layout_changed_and_accepted_after_2_s(room: SlowRoom, button: str):
    room.open(FAULT)
    room.changes_to(TAKES_ITS_PLACE[button][1], button)
    room.advance(1_000)
    expect(room.page.locator(button)).to_have_attribute("aria-disabled", "true")
    room.click(room.point(button))
    room.sends_nothing_more()
    expect(room.page.locator("#outcome")).to_contain_text("Not sent: the buttons moved")
    room.advance(1_000)
    expect(room.page.locator(button)).to_be_enabled()
    room.click(room.point(button))
    room.sends(button.removeprefix("#do-"))


def test_acknowledge_too_settles_where_arm_was(room: SlowRoom):
    room.open(DISARMED)
    room.changes_to(FAULT, "#do-acknowledge")
    room.click(room.point("#do-acknowledge"))
    room.sends_nothing_more()
    room.advance(2_000)
    room.click(room.point("#do-acknowledge"))
    room.sends("acknowledge")


def test_the_second_click_of_a_double_click_is_ignored_however_late(room: SlowRoom):
    room.open(DISARMED)
    room.click(room.point("#do-arm"), count=2)
    room.sends_nothing_more()
    room.click(room.point("#do-arm"))
    room.sends("arm")


def test_hold_disarm_and_stop_never_wait(room: SlowRoom):
    room.open(FAULT)
    room.changes_to(HELD, "#do-release")
    for action in ("hold", "disarm", "stop"):
        assert room.page.locator(f"#do-{action}").get_attribute("aria-disabled") is None
    room.click(room.point("#do-hold"), count=2)
    room.sends("hold")
    room.click(room.point("#do-disarm"), count=2)
    room.sends("hold", "disarm")
    room.page.keyboard.press("F8")
    room.page.keyboard.press("Escape")
    room.sends("hold", "disarm", "hold", "disarm")
    room.page.mouse.dblclick(*room.point("#do-stop"))
    room.sends("hold", "disarm", "hold", "disarm", "stop")
    assert room.page.locator("#do-release").get_attribute("aria-disabled") == "true", "all of this while it settles"


@pytest.mark.parametrize("key", ["Enter", "Space"])
def test_a_key_that_is_held_down_presses_nothing(room: SlowRoom, key: str):
    room.open(DISARMED)
    room.page.keyboard.down(key)
    room.page.focus("#do-arm")
    for _ in range(3):
        room.page.keyboard.down(key)
    room.page.keyboard.up(key)
    room.sends_nothing_more()
    room.page.keyboard.press(key)
    room.sends("arm")


def test_a_window_of_another_size_moves_the_buttons(room: SlowRoom):
    room.open(DISARMED)
    expect(room.page.locator("#do-arm")).to_be_enabled()
    room.page.set_viewport_size({"width": 1100, "height": 760})
    room.click(room.point("#do-arm"))
    room.sends_nothing_more()


def test_news_of_the_gate_does_not_move_the_buttons(room: SlowRoom):
    """Else nobody could release while the patient breathes."""
    room.open(HELD)
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
        room.fake.sample = message
        room.advance(400)
        assert room.page.locator("#do-release").get_attribute("aria-disabled") is None, message["hold_text"]
    expect(room.page.locator("#do-release")).to_be_enabled()
