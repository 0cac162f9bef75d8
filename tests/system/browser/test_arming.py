"""What would be armed is shown before it is: one button arms it, and only what was looked at."""

import random

import pytest
from playwright.sync_api import Page, expect

from service.core.permissions import Role
from tests.support.browser.arming import ACCEPTS, press_arm_stepped
from tests.support.browser.fake_service import SESSION, FakeService, arming, breath_hold, person, sample, window
from tests.support.browser.stepped_page import STEP_MS, SteppedPage
from tests.support.browser.tab import Tab

pytestmark = [pytest.mark.long, pytest.mark.browser, pytest.mark.verification]

DISARMED = sample(gate="disarmed", is_armed=False, hold_reason="disarmed", hold_text="Not armed", hold_detail="")
HELD = sample(hold_reason="operator_hold", hold_text="Held by an operator", operator_hold="C. Nurse")
FAULT = sample(gate="fault", is_armed=False, hold_reason="source_lost", hold_text="The camera is disconnected")
BEAM_ON = sample(gate="beam_on", hold_reason=None, hold_text=None, hold_detail="", line_on=True)


def armings(fake: FakeService) -> list[object]:
    return [body for path, body in fake.posts() if path.endswith("/arm")]


def signings(fake: FakeService) -> list[object]:
    return [body for path, body in fake.posts() if path.endswith("/countersign")]


def opened(stepped: SteppedPage) -> Page:
    """Show what would be armed, just now."""
    page = stepped.open_settled(DISARMED)
    page.click("#do-arm")
    stepped.advance(STEP_MS)
    expect(page.locator("#arming")).to_be_visible()
    return page


def test_it_names_the_patient_and_every_part_and_arms_what_was_looked_at(fake: FakeService, stepped: SteppedPage):
    page = opened(stepped)
    expect(page.locator("#arming-patient")).to_have_text("P-0117")
    expect(page.locator("#arming-edges")).to_have_text("whole: \N{MINUS SIGN}1.0 to 3.0 mm")
    texts = {one["code"]: one["text"] for one in arming()["items"] if one["code"] != "patient"}
    for code, text in texts.items():
        expect(page.locator(f"#arming-items [data-code={code}] dd")).to_have_text(text)
    stepped.advance(2_000)
    page.click("#do-arm-now")
    stepped.advance(STEP_MS)
    assert armings(fake) == [{"operator": "A. Therapist", "state": "5e" * 16}]
    assert fake.if_match == [fake.arming_etag]
    expect(page.locator("#arming")).to_be_hidden()
    expect(page.locator("#outcome")).to_have_text("Armed: the gate controls the beam.")


def test_nothing_is_armed_before_the_last_line_was_in_view(fake: FakeService, stepped: SteppedPage):
    """Review U9: the last lines were below the fold, and the button was on."""
    for one in fake.arming["items"]:
        one["text"] = f"{one['text']} " * 9
    page = opened(stepped)
    stepped.advance(3_000)
    expect(page.locator("#do-arm-now")).to_be_disabled()
    expect(page.locator("#arming-why")).to_have_text("Read to the last line first")
    page.locator("#arming").evaluate("one => { one.scrollTop = one.scrollHeight; }")
    stepped.advance(STEP_MS)
    stepped.advance(3_000)
    expect(page.locator("#do-arm-now")).to_be_enabled()
    page.locator("#arming").evaluate("one => { one.scrollTop = 0; }")
    stepped.advance(3_000)
    expect(page.locator("#do-arm-now")).to_be_enabled()
    fake.arming["items"][-1]["text"] = "something else"
    stepped.advance(3_000)
    expect(page.locator("#do-arm-now")).to_be_disabled()


def test_what_needs_a_look_comes_first_and_the_rest_is_one_line(fake: FakeService, stepped: SteppedPage):
    fake.arming["items"][-2]["state"] = "attention"
    page = opened(stepped)
    expect(page.locator("#arming-items section").first).to_contain_text("QA and camera latency")
    expect(page.locator("#arming-items summary")).to_have_text("5 more in order: Camera, View, Model, Checks, Gate")
    expect(page.locator("#arming-items [data-code=camera]")).to_be_hidden()
    page.click("#arming-items summary")
    expect(page.locator("#arming-items [data-code=camera]")).to_be_visible()


def test_a_breath_hold_is_named_with_its_level(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", DISARMED | {"window": window(breath_hold())}
    page = tab.open("disarmed")
    page.click("#do-arm")
    expect(page.locator("#arming-edges")).to_have_text("whole, breath hold: 6.0 to 10.0 mm")


def test_its_button_ignores_clicks_for_two_seconds_and_the_second_one_of_two(fake: FakeService, stepped: SteppedPage):
    page = opened(stepped)
    expect(page.locator("#do-arm-now")).to_have_attribute("aria-disabled", "true")
    page.locator("#do-arm-now").click(force=True)
    stepped.advance(1_400)
    page.locator("#do-arm-now").click(force=True)
    stepped.advance(STEP_MS)
    assert armings(fake) == []
    stepped.advance_until(lambda: page.locator(ACCEPTS).count())
    box = page.locator("#do-arm-now").bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + 9, box["y"] + 9)
    page.mouse.down(click_count=2)
    page.mouse.up(click_count=2)
    stepped.advance(STEP_MS)
    assert armings(fake) == []
    page.click("#do-arm-now")
    stepped.advance(STEP_MS)
    assert len(armings(fake)) == 1


def test_what_is_missing_is_marked_and_keeps_it_from_being_armed(fake: FakeService, stepped: SteppedPage):
    fake.arming = arming(reference="not set: set it and look at its level")
    page = opened(stepped)
    stepped.advance(2_400)
    expect(page.locator("#arming-items [data-state=missing] dd")).to_have_text(
        "Missing: not set: set it and look at its level"
    )
    expect(page.locator("#do-arm-now")).to_be_disabled()
    expect(page.locator("#arming-why")).to_have_text("Something is missing.")


@pytest.mark.parametrize("change", ["tag", "text"])
def test_what_changes_while_it_is_looked_at_is_looked_at_again(fake: FakeService, stepped: SteppedPage, change: str):
    page = opened(stepped)
    stepped.advance_until(lambda: page.locator(ACCEPTS).count())
    if change == "tag":
        fake.arming_etag = '"decided-since"'
    else:
        fake.arming = arming() | {"items": [one | {"text": f"{one['text']}."} for one in arming()["items"]]}
    stepped.advance_until(lambda: not page.locator(ACCEPTS).count())
    stepped.advance_until(lambda: page.locator(ACCEPTS).count())
    page.click("#do-arm-now")
    stepped.advance(STEP_MS)
    assert fake.if_match == [fake.arming_etag]


def test_a_summary_that_cannot_be_read_again_arms_nothing(fake: FakeService, stepped: SteppedPage):
    page = opened(stepped)
    stepped.advance_until(lambda: page.locator(ACCEPTS).count())
    page.route("**/arming", lambda route: route.abort())
    stepped.advance_until(lambda: page.locator("#do-arm-now").is_disabled())
    expect(page.locator("#arming-why")).to_have_text("The controller cannot be reached.")


@pytest.mark.parametrize(
    ("after", "kind"),
    [(sample(gate="hold"), "hold"), (DISARMED | {"session_id": "99" * 16}, "disarmed")],
    ids=["armed by another", "another session"],
)
def test_it_closes_where_it_is_no_longer_what_would_be_armed(
    fake: FakeService, stepped: SteppedPage, after: dict, kind: str
):
    page = opened(stepped)
    stepped.advance(2_000)
    fake.sample = after
    stepped.advance_until(lambda: stepped.kind == kind and page.locator("#arming").is_hidden(), within_ms=1_000)
    assert armings(fake) == []


def test_a_late_picture_leaves_it_open_and_has_to_be_looked_at_again(fake: FakeService, stepped: SteppedPage):
    page = opened(stepped)
    stepped.advance(2_000)
    page.focus("#do-arm-now")
    fake.mode = "silent"
    stepped.advance_until(lambda: stepped.kind == "stale" and page.locator("#do-arm-now").is_disabled())
    expect(page.locator("#arming-why")).to_have_text("The picture was late: look again.")
    fake.mode = "samples"
    stepped.advance_until(lambda: stepped.kind == "disarmed")
    stepped.advance(1_500)
    expect(page.locator("#do-arm-now")).to_be_disabled()
    stepped.advance(1_000)
    page.click("#do-arm-now")
    stepped.advance(STEP_MS)
    assert len(armings(fake)) == 1


def test_nothing_arms_while_the_trace_shows_edges_that_are_not_applied(fake: FakeService, stepped: SteppedPage):
    page = stepped.open_settled(DISARMED)
    page.click("#do-window")
    stepped.advance(STEP_MS)
    expect(page.locator("#do-arm")).to_be_enabled()
    page.fill("#window-editor [name=upper]", "2.4")
    stepped.advance(STEP_MS)
    expect(page.locator("#do-arm")).to_be_disabled()
    expect(page.locator("#do-arm")).to_have_attribute(
        "title", "Not now: apply the window on the trace first, or cancel it"
    )
    page.click("#window-cancel")
    stepped.advance(STEP_MS)
    expect(page.locator("#do-arm")).to_be_enabled()
    page.click("#do-window")
    stepped.advance_until(lambda: page.locator("[aria-disabled]").count() == 0)
    page.click("#do-arm")
    stepped.advance(STEP_MS)
    expect(page.locator("#arming")).to_be_visible()
    expect(page.locator("#window-editor")).to_be_hidden()  # over one band only


def test_it_closes_after_a_minute(stepped: SteppedPage):
    page = opened(stepped)
    stepped.advance(58_000)
    expect(page.locator("#arming")).to_be_visible()
    stepped.advance(2_400)
    expect(page.locator("#arming")).to_be_hidden()


def test_escape_closes_it_first_and_disarms_an_armed_gate_at_once(fake: FakeService, stepped: SteppedPage):
    page = opened(stepped)
    page.keyboard.press("Escape")
    stepped.advance(STEP_MS)
    expect(page.locator("#arming")).to_be_hidden()
    assert not [path for path, _ in fake.posts() if path.endswith("/disarm")]
    page.keyboard.press("Escape")
    stepped.advance(STEP_MS)
    assert [path for path, _ in fake.posts() if path.endswith("/disarm")]


def test_a_keyboard_arms_with_the_focus_moved_between_and_two_presses(fake: FakeService, stepped: SteppedPage):
    page = stepped.open_settled(DISARMED)
    page.focus("#do-arm")
    page.keyboard.press("Enter")
    stepped.advance(STEP_MS)
    expect(page.locator("#arming-heading")).to_be_focused()
    stepped.advance(2_000)
    page.keyboard.press("Enter")
    stepped.advance(STEP_MS)
    assert armings(fake) == []
    for _ in range(3):  # Cancel, the lines in order, Arm now
        page.keyboard.press("Tab")
    expect(page.locator("#do-arm-now")).to_be_focused()
    page.keyboard.press("Enter")
    stepped.advance(3 * STEP_MS)
    assert armings(fake) == []
    page.keyboard.press("Enter")
    stepped.advance(STEP_MS)
    assert len(armings(fake)) == 1


def test_who_armed_and_when_stays_visible_while_it_is_armed(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", BEAM_ON | {"armed_by": "Ada L."}
    fake.sessions[0]["gate"] = {"armed_by": "Ada L.", "armed_at": "2026-11-21T09:12:31Z"}
    page = tab.open("beam_on")
    local = page.evaluate(
        "new Date('2026-11-21T09:12:31Z').toLocaleTimeString([], {hour: '2-digit', minute: '2-digit'})"
    )
    expect(page.locator("#gate-by")).to_have_text(f"Armed by Ada L. {local}")
    fake.sample = BEAM_ON | {"armed_by": "B. Other"}
    expect(page.locator("#gate-by")).to_have_text("Armed by B. Other")
    fake.sample = DISARMED
    expect(page.locator("#gate-by")).to_have_text("")


# -- random double clicks ---------------------------------------------------------------------------------------------

CLICKS = 1_000
ROUND = 100
"""Double clicks between two steps of the page's clock."""
STATES = {
    "disarmed": DISARMED,
    "fault": FAULT,
    "held": HELD,
    "beam on": BEAM_ON,
    "training": DISARMED | {"state": "training"},
    "lost": DISARMED | {"state": "lost"},
}
CLICK_ALL = """
([places, detail]) => {
  for (const [index, [x, y]] of places.entries()) {
    const target = document.elementFromPoint(x, y);
    if (target === null || target.closest("#do-log-out, #do-coach, .upload") !== null) continue;
    const sends = "#do-hold, #do-disarm, #do-stop, #do-reference, #do-retrain";
    if (index % 10 !== 0 && target.closest(sends) !== null) continue;
    const place = { bubbles: true, cancelable: true, clientX: x, clientY: y };
    target.dispatchEvent(new MouseEvent("click", { ...place, detail }));
    document.querySelector("#arming-close").click();
  }
}
"""
"""Click each place; a summary that a click has opened is closed, as it would be cancelled: each double click is judged
from a page without one. A log-out would end the test, an upload needs a hand, and the patient's screen has tests of its
own. Of the buttons that send something at once few are clicked, as each call costs as much as a hundred clicks."""


BOXES = """
[...document.querySelectorAll(".buttons button")].filter((one) => one.offsetParent !== null).map((one) => {
  const box = one.getBoundingClientRect();
  return [box.x, box.y, box.width, box.height];
})
"""


def places(page: Page, chance: random.Random) -> list[tuple[float, float]]:
    """Places that a hand may hit: near a button of the session, or anywhere."""
    found, boxes = [], page.evaluate(BOXES)
    for _ in range(ROUND):
        x, y, width, height = chance.choice(boxes) if chance.random() < 0.7 else (8, 8, 1264, 784)
        found.append((x + chance.uniform(-8, width + 8), y + chance.uniform(-8, height + 8)))
    return found


def test_random_double_clicks_never_arm(fake: FakeService, stepped: SteppedPage):
    """Quick ones (the second click says it is one) and slow ones (250 to 700 ms) from every state to every other."""
    chance = random.Random(18)
    page = stepped.open_settled(DISARMED)
    for clicked in range(0, CLICKS, ROUND):
        before, after = chance.choice(list(STATES.values())), chance.choice(list(STATES.values()))
        fake.sample = before
        stepped.advance(chance.choice([200, 400, 2_400]))
        spot = places(page, chance)
        page.evaluate(CLICK_ALL, [spot, 1])
        if clicked % (2 * ROUND):
            fake.sample = after
            stepped.advance(chance.choice([400, 600]))
            page.evaluate(CLICK_ALL, [spot, 1])
        else:
            page.evaluate(CLICK_ALL, [spot, 2])
    stepped.advance(STEP_MS)
    assert armings(fake) == []
    sent = {path.rsplit("/", 1)[1] for path, _ in fake.posts()}
    assert sent & {"hold", "disarm"}, "clicks do reach the buttons"
    assert len(sent) > 2, sent
    fake.sample = DISARMED
    if page.get_attribute("body", "data-view") == "distance":  # one of the clicks opened it
        page.click("#do-distance")
    stepped.advance(2_400)
    page.keyboard.press("Escape")  # or a panel, which covers the summary
    if page.is_visible("#change-cancel"):
        page.click("#change-cancel")
    stepped.advance(2_400)
    press_arm_stepped(stepped)
    stepped.advance(STEP_MS)
    assert len(armings(fake)) == 1, "the same page arms when it is asked to"


REAL_CLICKS = 60
GAPS_MS = [0, 100, 300, 500, 700, 2_400]
CALM_MS = 2_000
"""How long a summary has to be on the screen, unchanged, before its button arms."""
IS_ELSEWHERE = """
([x, y]) => {
  const target = document.elementFromPoint(x, y);
  return target === null || target.closest("#do-log-out, #do-coach, .upload, a, select") !== null;
}
"""

SUMMARY = """() => document.querySelector("#arming").hidden ? null :
  ["patient", "edges", "items"].map((part) => document.querySelector(`#arming-${part}`).innerText).join("; ")"""


class Hand:
    """Real clicks of the mouse at random, and how long the summary under them has been as it is."""

    def __init__(self, fake: FakeService, stepped: SteppedPage, chance: random.Random) -> None:
        self.fake, self.stepped, self.page, self.chance = fake, stepped, stepped.page, chance
        self.summary, self.shown_ms = None, 0
        self.armed = self.refused = 0

    def wait(self, milliseconds: int) -> None:
        for _ in range(0, milliseconds, STEP_MS):
            self.stepped.advance(STEP_MS)
            now = self.page.evaluate(SUMMARY)
            self.shown_ms = self.shown_ms + STEP_MS if now is not None and now == self.summary else 0
            self.summary = now

    def click(self, x: float, y: float, count: int) -> None:
        """Click once; what arms has to be the button, with the summary unchanged for 2 s."""
        if self.page.evaluate(IS_ELSEWHERE, [x, y]):
            return
        box = self.page.locator("#do-arm-now").bounding_box() if self.page.is_visible("#do-arm-now") else None
        is_button = box is not None and box["x"] <= x <= box["x"] + box["width"]
        is_button = is_button and box["y"] <= y <= box["y"] + box["height"]
        before, shown_ms = len(armings(self.fake)), self.shown_ms
        self.page.mouse.move(x, y)
        self.page.mouse.down(click_count=count)
        self.page.mouse.up(click_count=count)
        self.wait(STEP_MS)
        if len(armings(self.fake)) > before:
            assert is_button, (x, y, box)
            assert shown_ms >= CALM_MS - STEP_MS, f"the summary was shown for {shown_ms} ms only"
            assert count == 1, "armed by the second click of two"
            self.armed += 1
        elif is_button:
            self.refused += 1

    def spot(self) -> tuple[float, float]:
        boxes = self.page.evaluate(BOXES)
        if self.page.is_visible("#do-arm-now") and self.chance.random() < 0.5:
            box = self.page.locator("#do-arm-now").bounding_box()
            boxes = [(box["x"], box["y"], box["width"], box["height"])]
        x, y, width, height = self.chance.choice(boxes) if self.chance.random() < 0.8 else (8, 8, 1264, 784)
        return x + self.chance.uniform(-8, width + 8), y + self.chance.uniform(-8, height + 8)

    def open_summary(self) -> None:
        for _ in range(3):
            if self.page.is_visible("#arming"):
                return
            arm = self.page.locator("#do-arm")
            if arm.is_visible() and arm.is_enabled():
                box = arm.bounding_box()
                self.click(box["x"] + 9, box["y"] + 9, 1)
                return
            self.page.keyboard.press("Escape")
            self.wait(400)


def test_random_real_clicks_with_the_summary_open_arm_only_by_its_button_and_only_once_it_could_be_read(
    fake: FakeService, stepped: SteppedPage
):
    chance = random.Random(48)
    stepped.open_settled(DISARMED)
    hand = Hand(fake, stepped, chance)
    open_before = 0
    for _ in range(REAL_CLICKS // 2):
        if chance.random() < 0.2:
            fake.sample = chance.choice(list(STATES.values()))
        elif chance.random() < 0.5:
            fake.sample = DISARMED
        hand.wait(chance.choice(GAPS_MS))
        hand.open_summary()
        hand.wait(chance.choice(GAPS_MS))
        open_before += stepped.page.is_visible("#arming")
        x, y = hand.spot()
        hand.click(x, y, 1)
        pause_ms = chance.choice(GAPS_MS)
        hand.wait(pause_ms)
        hand.click(x, y, 2 if pause_ms < 500 else 1)
    assert open_before > REAL_CLICKS // 8, "the summary is open under many of them"
    assert hand.refused > 0
    assert hand.armed > 1, "the button does arm"


@pytest.mark.parametrize("count", [1, 2])
def test_a_double_click_on_arm_arms_nothing_however_long_the_summary_is_open(
    fake: FakeService, stepped: SteppedPage, count: int
):
    page = stepped.open_settled(DISARMED)
    box = page.locator("#do-arm").bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + 9, box["y"] + 9)
    for click in (1, count):
        page.mouse.down(click_count=click)
        page.mouse.up(click_count=click)
        stepped.advance(2_400)
    assert armings(fake) == []


# -- messages ---------------------------------------------------------------------------------------------------------

DISARMED_SAYS = {
    *("", "Disarmed.", "Reference set.", "Fault acknowledged.", "Training again in the background."),
    "Held until released.",
}
ALLOWED = {
    "disarmed": DISARMED_SAYS,
    "armed": {
        "",
        "Armed: the gate controls the beam.",
        "Held until released.",
        "Released: the beam needs a full dwell.",
    },
    "fault": {"", "Held until released.", "Disarmed."},
    "idle": {"", "Session stopped."},
}
"""What the line below the buttons may say under each state, once the state has lasted."""
ACTS = {
    "disarm": BEAM_ON,
    "hold": BEAM_ON,
    "reference": DISARMED,
    "acknowledge": FAULT,
    "retrain": DISARMED,
    "arm": DISARMED,
    "stop": DISARMED,
}
AFTERWARDS = {"disarmed": DISARMED, "armed": BEAM_ON, "fault": FAULT, "idle": None}


@pytest.mark.parametrize("action", ACTS)
def test_every_message_belongs_to_the_state_it_is_shown_under(fake: FakeService, stepped: SteppedPage, action: str):
    page = stepped.open_settled(ACTS[action])
    for name, message in AFTERWARDS.items():
        if action == "stop" and name == "disarmed":
            continue  # a session that was stopped does not go on
        fake.mode = "samples"
        stepped.shows(ACTS[action])
        stepped.advance(2_400)
        if action == "arm":
            press_arm_stepped(stepped)
        else:
            page.click(f"#do-{action}")
            if action == "stop":
                page.click("#do-stop")
        if message is None:
            fake.mode, fake.sessions = "idle", [SESSION | {"status": "ended"}]
            stepped.advance_until(lambda: stepped.kind == "idle")
        else:
            stepped.shows(message)
        stepped.advance(2_600)
        shown = page.locator("#outcome").inner_text()
        assert shown in ALLOWED[name], f"{shown!r} under {name}, after {action}"
        fake.sessions = [dict(SESSION)]


def test_nothing_of_one_patient_stays_under_another_s_name(fake: FakeService, stepped: SteppedPage):
    first = DISARMED | {"reference": None}
    page = stepped.open_settled(first)
    page.click("#do-window")
    page.click("#do-arm")
    stepped.advance(400)
    other = SESSION | {"id": "99" * 16, "patient_reference": "P-0222", "plan_id": "PLAN-2", "fraction_id": "FX-01"}
    fake.sessions = [other | {"reference_proposals": []}]
    fake.sample = DISARMED | {"session_id": "99" * 16}
    stepped.advance_until(lambda: page.locator("#who-patient").inner_text() == "P-0222")
    for gone in ("P-0117", "PLAN-LUNG-4", "FX-03"):
        assert gone not in page.locator("body").inner_text()
    expect(page.locator("#arming")).to_be_hidden()
    expect(page.locator("#window-editor")).to_be_hidden()
    assert page.locator("#arming-patient").text_content() == ""


def test_a_person_who_may_not_arm_sees_no_summary(fake: FakeService, tab: Tab):
    fake.mode, fake.sample, fake.person = "samples", DISARMED, person("V. Iewer", Role.VIEWER)
    page = tab.open("disarmed")
    expect(page.locator("#do-arm")).to_be_disabled()
    expect(page.locator("#do-window")).to_be_disabled()


def test_a_second_person_countersigns_with_name_and_password(fake: FakeService, stepped: SteppedPage):
    fake.arming = arming(countersignature="a second person looks at window and reference, and signs")
    page = opened(stepped)
    expect(page.locator("#do-arm-now")).to_be_disabled()
    page.fill("#countersign-name", "B. Therapist")
    page.fill("#countersign-password", "a password for the tests")
    fake.problem = (422, {"title": "The second person was refused", "detail": "the second person's name is wrong"})
    page.click("#do-countersign")
    stepped.advance(STEP_MS)
    expect(page.locator("#countersign-result")).to_contain_text("the second person's name is wrong")
    expect(page.locator("#countersign-password")).to_have_value("")
    fake.problem = None
    page.fill("#countersign-password", "a password for the tests")
    page.click("#do-countersign")
    stepped.advance(STEP_MS)
    body = {"name": "B. Therapist", "password": "a password for the tests"}
    assert signings(fake)[-1] == {"operator": "A. Therapist", "state": "5e" * 16, **body}
    fake.arming = arming()
    fake.arming["items"].append(
        {"code": "countersignature", "state": "ok", "text": "B. Therapist; another person arms"}
    )
    stepped.advance(2_000)
    expect(page.locator("#countersign")).to_be_hidden()
    stepped.advance_until(lambda: page.locator(ACCEPTS).count())
    page.click("#do-arm-now")
    stepped.advance(STEP_MS)
    assert len(armings(fake)) == 1


def test_the_second_person_signs_from_an_own_log_in_without_a_password(fake: FakeService, stepped: SteppedPage):
    fake.arming = arming(countersignature="a second person looks at window and reference, and signs")
    page = opened(stepped)
    page.click("#do-countersign")
    stepped.advance(STEP_MS)
    assert signings(fake) == [{"operator": "A. Therapist", "state": "5e" * 16}]


def test_where_no_second_person_is_needed_none_is_asked_for(stepped: SteppedPage):
    expect(opened(stepped).locator("#countersign")).to_be_hidden()
