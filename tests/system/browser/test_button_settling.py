"""Acknowledge, Arm and Release ignore clicks that were meant for another button: a double click never arms.

The clicks and keys are real input of Chromium.
"""

import pytest
from playwright.sync_api import expect

from tests.support.browser.fake_service import SESSION_ID, FakeService, sample
from tests.support.browser.stepped_page import STEP_MS, SteppedPage

pytestmark = [pytest.mark.browser, pytest.mark.verification]

DISARMED = sample(gate="disarmed", is_armed=False, hold_reason="disarmed", hold_text="Not armed", hold_detail="")
HELD = sample(hold_reason="operator_hold", hold_text="Held by an operator", operator_hold="C. Nurse")
FAULT = sample(gate="fault", is_armed=False, hold_reason="source_lost", hold_text="The camera is disconnected")
MINE = HELD | {"operator_hold": FakeService().person["name"], "operator_holds": [FakeService().person["name"]]}
BEAM_ON = sample(gate="beam_on", hold_reason=None, hold_text=None, hold_detail="", line_on=True)


def sent(fake: FakeService) -> list[str]:
    """The calls that changed the session, in order; the page reports its presence besides."""
    paths = [path.removeprefix(f"/sessions/{SESSION_ID}/") for path, _ in fake.posts() if SESSION_ID in path]
    return [path for path in paths if path != "presence"]


class ClickedPage:
    """A page whose buttons are clicked by place, as a hand does that aims before they move."""

    def __init__(self, stepped: SteppedPage) -> None:
        self.fake, self.page = stepped.fake, stepped.page
        self.advance, self.open_settled = stepped.advance, stepped.open_settled

    def point(self, button: str, share: float = 0.5) -> tuple[float, float]:
        box = self.page.locator(button).bounding_box()
        assert box is not None
        return box["x"] + share * box["width"], box["y"] + box["height"] / 2

    def click(self, place: tuple[float, float], *, count: int = 1) -> None:
        """Click; with a count of 2 it is the second click of a double click."""
        self.page.mouse.move(*place)
        self.page.mouse.down(click_count=count)
        self.page.mouse.up(click_count=count)

    def opens_the_summary(self) -> None:
        """Let a step pass, and check that what would be armed is shown, and nothing was armed."""
        self.sends()
        expect(self.page.locator("#arming")).to_be_visible()

    def sends(self, *known: str) -> None:
        """Let a step pass, and check that exactly these calls were sent so far."""
        self.advance(STEP_MS)
        assert sent(self.fake) == list(known)


@pytest.fixture
def clicked(stepped: SteppedPage) -> ClickedPage:
    return ClickedPage(stepped)


STATES = {"disarmed": DISARMED, "fault": FAULT, "held": HELD, "beam on": BEAM_ON}
PERMITTING = ("arm", "release", "acknowledge")


def boxes(clicked: ClickedPage) -> dict[str, dict[str, float]]:
    found = {name: clicked.page.locator(f"#do-{name}").bounding_box() for name in PERMITTING}
    return {name: dict(box) for name, box in found.items() if box is not None}


def test_the_next_button_has_one_place_and_what_comes_there_takes_no_click_before_it_was_seen(clicked: ClickedPage):
    clicked.open_settled(DISARMED)
    clicked.advance(2_000)
    (place,) = boxes(clicked).values()
    spot = clicked.point("#do-arm")
    for message in (HELD, FAULT, DISARMED):
        clicked.fake.sample = message
        clicked.advance(400)
        assert list(boxes(clicked).values()) == [place]
        clicked.click(spot)
        clicked.sends()
        assert not clicked.page.is_visible("#arming")


@pytest.mark.parametrize("after", ["disarmed", "held"])
@pytest.mark.parametrize("count", [1, 2])
def test_a_second_click_on_acknowledge_presses_nothing(clicked: ClickedPage, after: str, count: int):
    """A slow double click is two clicks to the browser (count 1), a quick one is not (count 2)."""
    clicked.open_settled(FAULT)
    clicked.advance(2_000)
    place = clicked.point("#do-acknowledge")
    clicked.click(place)
    clicked.sends("acknowledge")
    clicked.fake.sample = STATES[after]
    clicked.advance(400)
    clicked.click(place, count=count)
    clicked.sends("acknowledge")


def test_a_double_click_acknowledges_once(clicked: ClickedPage):
    clicked.open_settled(FAULT)
    clicked.advance(2_000)
    clicked.page.mouse.dblclick(*clicked.point("#do-acknowledge", 0.25))
    clicked.sends("acknowledge")
    clicked.fake.sample = DISARMED
    clicked.sends("acknowledge")


@pytest.mark.parametrize("name", PERMITTING)
def test_a_click_is_ignored_1_s_after_the_layout_changed_and_accepted_after_2_s(clicked: ClickedPage, name: str):
    clicked.open_settled({"arm": DISARMED, "release": MINE, "acknowledge": FAULT}[name])
    button = f"#do-{name}"
    clicked.page.set_viewport_size({"width": 1100, "height": 760})
    clicked.advance(1_000)
    expect(clicked.page.locator(button)).to_have_attribute("aria-disabled", "true")
    clicked.click(clicked.point(button))
    clicked.sends()
    expect(clicked.page.locator("#outcome")).to_contain_text("Not sent: the buttons moved")
    clicked.advance(1_000)
    expect(clicked.page.locator(button)).to_be_enabled()
    clicked.click(clicked.point(button))
    if name == "arm":
        clicked.opens_the_summary()
    else:
        clicked.sends(name)


def test_another_person_s_hold_is_released_by_two_clicks_a_second_apart(clicked: ClickedPage):
    """The name of the one who holds is on the button; a double click, quick or slow, releases nothing."""
    clicked.open_settled(HELD)
    place = clicked.point("#do-release")
    clicked.click(place)
    clicked.click(place, count=2)
    clicked.sends()
    expect(clicked.page.locator("#do-release")).to_have_text("Release C. Nurse's hold")
    clicked.advance(400)
    clicked.click(place)
    clicked.sends()
    clicked.advance(600)
    clicked.click(place)
    clicked.sends("release")


def test_a_question_about_another_s_hold_ends_with_the_hold(clicked: ClickedPage):
    clicked.open_settled(HELD)
    place = clicked.point("#do-release")
    clicked.click(place)
    clicked.fake.sample = sample(gate="hold")
    clicked.advance(600)
    expect(clicked.page.locator("#do-release")).to_have_text("Release")
    clicked.fake.sample = HELD
    clicked.advance(600)
    clicked.click(place)
    clicked.sends()


def test_the_second_click_of_a_double_click_is_ignored_however_late(clicked: ClickedPage):
    clicked.open_settled(DISARMED)
    clicked.click(clicked.point("#do-arm"), count=2)
    clicked.sends()
    expect(clicked.page.locator("#arming")).to_be_hidden()
    clicked.click(clicked.point("#do-arm"))
    clicked.opens_the_summary()


def test_hold_disarm_and_stop_never_wait(clicked: ClickedPage):
    clicked.open_settled(HELD)
    clicked.page.set_viewport_size({"width": 1100, "height": 760})
    clicked.advance(STEP_MS)
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
    clicked.open_settled(DISARMED)
    clicked.page.keyboard.down(key)
    clicked.page.focus("#do-arm")
    for _ in range(3):
        clicked.page.keyboard.down(key)
    clicked.page.keyboard.up(key)
    clicked.sends()
    expect(clicked.page.locator("#arming")).to_be_hidden()
    clicked.page.keyboard.press(key)
    clicked.opens_the_summary()


def test_a_window_of_another_size_moves_the_buttons(clicked: ClickedPage):
    clicked.open_settled(DISARMED)
    expect(clicked.page.locator("#do-arm")).to_be_enabled()
    clicked.page.set_viewport_size({"width": 1100, "height": 760})
    clicked.click(clicked.point("#do-arm"))
    clicked.sends()


def test_news_of_the_gate_does_not_move_the_buttons(clicked: ClickedPage):
    """Else nobody could release while the patient breathes."""
    clicked.open_settled(HELD)
    long = "thorax: 12.40 mm is not inside -1 to 3 mm; abdomen: 14.10 mm is not inside -2 to 4 mm; 41 % of it fits"
    for message in (
        HELD | {"hold_detail": "", "hold_text": "Held"},
        HELD | {"hold_detail": long, "hold_text": f"{long}. {long}"},
        HELD | {"line_on": True},
        BEAM_ON | {"operator_hold": "C. Nurse", "operator_holds": ["C. Nurse"]},
        DISARMED | {"operator_hold": "C. Nurse", "operator_holds": ["C. Nurse"]},
        sample(gate="dwell", hold_reason="dwell", hold_text="Inside the window", operator_hold="C. Nurse"),
        HELD,
    ):
        clicked.fake.sample = message
        clicked.advance(400)
        assert clicked.page.locator("#do-release").get_attribute("aria-disabled") is None, message["hold_text"]
    expect(clicked.page.locator("#do-release")).to_be_enabled()
