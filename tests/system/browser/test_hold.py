"""Hold and release: whoever may holds at once, and one releases in their own name; who armed is heard of."""

import pytest
from playwright.sync_api import expect

from service.core.permissions import Role
from tests.support.browser.arming import press_arm_stepped
from tests.support.browser.fake_service import SESSION_ID, FakeService, person, sample
from tests.support.browser.stepped_page import SteppedPage
from tests.support.browser.tab import Tab

pytestmark = pytest.mark.browser

BEAM_ON = sample(gate="beam_on", hold_reason=None, hold_text=None, hold_detail="", line_on=True)
HELD = sample(
    hold_reason="operator_hold",
    hold_text="Held by an operator",
    hold_detail="held by C. Nurse",
    operator_hold="C. Nurse",
)
DISARMED = sample(gate="disarmed", is_armed=False, hold_reason="disarmed", hold_text="Not armed", hold_detail="")


ADA = person("Ada L.")
LOOKED_AT_AGAIN = "document.dispatchEvent(new Event('visibilitychange'))"


def calls_to(fake: FakeService, path: str) -> list[object]:
    return [body for called, body in fake.posts() if called == f"/sessions/{SESSION_ID}/{path}"]


def test_hold_is_one_click_without_a_question(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", BEAM_ON
    page = tab.open("beam_on")
    page.click("#do-hold")
    expect(page.locator("#outcome")).to_have_text("Held until released.")
    assert calls_to(fake, "hold") == [{}]


def test_a_hold_that_fails_states_what_else_stops_the_beam(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", BEAM_ON
    fake.problem = (503, {"code": "engine_timeout", "detail": "The engine did not answer in time."})
    page = tab.open("beam_on")
    page.click("#do-hold")
    expect(page.locator("#outcome")).to_contain_text("The page could not hold: use the room's interlock.")


def release_of_another(stepped: SteppedPage) -> None:
    """Another person's hold asks once more; the button came to its place just now."""
    stepped.advance(2_000)
    stepped.page.click("#do-release")
    stepped.advance(1_000)
    stepped.page.click("#do-release")
    stepped.advance(200)


def test_only_what_is_held_is_released_and_by_name(fake: FakeService, stepped: SteppedPage):
    fake.person = ADA
    page = stepped.open_settled(sample())
    expect(page.locator("#do-release")).to_be_disabled()
    fake.sample = HELD
    stepped.advance(2_000)
    expect(page.locator("#gate-reason")).to_have_text("Held by an operator")
    release_of_another(stepped)
    expect(page.locator("#outcome")).to_contain_text("Released")
    assert calls_to(fake, "release") == [{"operator": "Ada L."}]


def test_release_is_never_where_hold_was(fake: FakeService, tab: Tab):
    """A second click on Hold must not let go what the first one held."""
    fake.mode, fake.sample = "samples", BEAM_ON
    page = tab.open("beam_on")
    tab.draws(fake)
    before = page.locator("#do-hold").bounding_box()
    fake.sample = HELD
    tab.sees("hold")
    expect(page.locator("#do-release")).to_be_enabled()
    tab.draws(fake)
    assert page.locator("#do-hold").bounding_box() == before
    page.click("#do-hold")
    expect(page.locator("#outcome")).to_have_text("Held until released.")
    assert calls_to(fake, "release") == []


def test_who_holds_is_stated_also_where_another_reason_is_reported(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", HELD
    page = tab.open("hold")
    expect(page.locator("#gate-detail")).to_have_text("held by C. Nurse")
    fake.sample = sample(operator_hold="C. Nurse", hold_detail="4.10 mm is not inside -1 to 3 mm")
    expect(page.locator("#gate-detail")).to_have_text("4.10 mm is not inside -1 to 3 mm · Also held by C. Nurse.")


def test_the_page_of_anyone_who_armed_reports_every_second_that_they_are_there(fake: FakeService, stepped: SteppedPage):
    fake.person = ADA
    page = stepped.open_settled(DISARMED)
    press_arm_stepped(stepped)
    stepped.shows(BEAM_ON | {"armed_by": "Ada L."})
    before = len(calls_to(fake, "presence"))
    stepped.advance(5_000)
    heard = calls_to(fake, "presence")
    assert 4 <= len(heard) - before <= 5
    assert set(map(str, heard)) == {"{'operator': 'Ada L.'}"}
    fake.person = person("B. Other")
    page.evaluate(LOOKED_AT_AGAIN)
    stepped.advance(400)
    expect(page.locator("#person-name")).to_have_text("B. Other")
    told = len(calls_to(fake, "presence"))
    stepped.advance(3_000)
    assert len(calls_to(fake, "presence")) == told, "another person at the page is not the one who armed"


def test_presence_is_kept_over_a_reload(fake: FakeService, stepped: SteppedPage):
    fake.person = ADA
    page = stepped.open_settled(DISARMED)
    press_arm_stepped(stepped)
    stepped.shows(BEAM_ON | {"armed_by": "Ada L."})
    page.reload()
    stepped.advance_until(lambda: stepped.kind == "beam_on")
    before = len(calls_to(fake, "presence"))
    stepped.advance(1_600)
    assert len(calls_to(fake, "presence")) > before


@pytest.mark.parametrize("armed_by", ["Ada L.", "C. Nurse"])
def test_a_page_that_did_not_arm_speaks_for_no_one_while_a_person_s_gate_is_armed(
    fake: FakeService, stepped: SteppedPage, armed_by: str
):
    fake.person = ADA
    stepped.open(BEAM_ON | {"armed_by": armed_by})
    stepped.advance(3_000)
    assert calls_to(fake, "presence") == [], "also where the same person armed at another page"


def test_who_armed_at_another_page_takes_over_here_by_a_press_that_is_meant(fake: FakeService, stepped: SteppedPage):
    fake.person = ADA
    lost = {"hold_reason": "operator_lost", "hold_text": "No page of a person who answers for the armed gate responds"}
    page = stepped.open(HELD | lost | {"operator_hold": None, "armed_by": "C. Nurse"})
    expect(page.locator("#do-take-over")).to_be_hidden()  # another person's gate
    stepped.shows(HELD | lost | {"operator_hold": None, "armed_by": "Ada L."})
    stepped.advance_until(lambda: page.locator("#do-take-over").is_visible())
    expect(page.locator("#gate .advice")).to_contain_text("You armed at another page.")
    page.click("#do-take-over")  # just appeared: the click may have been meant for another button
    stepped.advance(2_500)
    assert calls_to(fake, "presence") == []
    page.click("#do-take-over")
    stepped.advance(2_000)
    assert calls_to(fake, "presence")
    expect(page.locator("#do-take-over")).to_be_hidden()


@pytest.mark.parametrize("sample", [DISARMED, BEAM_ON | {"armed_by": "key:planning"}], ids=["disarmed", "by a program"])
def test_a_screen_in_the_distance_view_is_no_one_who_is_there(fake: FakeService, stepped: SteppedPage, sample: dict):
    fake.person = ADA
    stepped.open(sample)
    stepped.page.evaluate("document.body.dataset.view = 'distance'")
    stepped.advance(400)
    told = len(calls_to(fake, "presence"))
    stepped.advance(3_000)
    assert len(calls_to(fake, "presence")) == told


@pytest.mark.parametrize("sample", [DISARMED, BEAM_ON | {"armed_by": "key:planning"}], ids=["disarmed", "by a program"])
def test_where_no_person_answers_for_the_gate_each_page_of_who_may_arm_reports_that_they_are_there(
    fake: FakeService, stepped: SteppedPage, sample: dict
):
    fake.person = ADA
    stepped.open(sample)
    stepped.advance(3_000)
    assert len(calls_to(fake, "presence")) >= 2
    fake.person = person("V. Viewer", Role.VIEWER)
    stepped.page.evaluate(LOOKED_AT_AGAIN)
    stepped.advance(400)
    told = len(calls_to(fake, "presence"))
    stepped.advance(3_000)
    assert len(calls_to(fake, "presence")) == told, "who may not arm answers for no gate"


def test_the_page_of_anyone_who_released_answers_from_then_on(fake: FakeService, stepped: SteppedPage):
    fake.person = ADA
    stepped.open_settled(HELD | {"armed_by": "C. Nurse"})
    release_of_another(stepped)
    stepped.shows(BEAM_ON | {"armed_by": "Ada L."})
    before = len(calls_to(fake, "presence"))
    stepped.advance(3_000)
    assert len(calls_to(fake, "presence")) - before >= 2


def test_who_armed_is_shown(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", BEAM_ON | {"armed_by": "C. Nurse"}
    expect(tab.open("beam_on").locator("#gate-by")).to_have_text("Armed by C. Nurse")
