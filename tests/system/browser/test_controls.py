"""The buttons: disarm at any time, everything else only where it makes sense, and no way to a beam."""

import re

import pytest
from playwright.sync_api import Page, expect

from service.core.permissions import Role
from tests.support.browser.arming import press_arm, press_arm_stepped
from tests.support.browser.fake_service import SESSION, SESSION_ID, WAITING, FakeService, person, sample
from tests.support.browser.stepped_page import SteppedPage
from tests.support.browser.tab import Tab

pytestmark = pytest.mark.browser

DISARMED = sample(gate="disarmed", is_armed=False, hold_reason="disarmed", hold_text="Not armed")
FAULT = sample(gate="fault", is_armed=False, hold_reason="source_lost", hold_text="The camera is disconnected")
LEARNING = DISARMED | {"state": "training", "hold_reason": "training"}
ACTIONS = ("arm", "reference", "retrain", "start", "stop")


def enabled(page: Page) -> set[str]:
    return {action for action in ACTIONS if page.locator(f"#do-{action}").is_enabled()}


def expect_enabled(page: Page, *actions: str) -> None:
    for action in ACTIONS:
        button = page.locator(f"#do-{action}")
        (expect(button).to_be_enabled if action in actions else expect(button).to_be_disabled)()


def calls_to(fake: FakeService, path: str) -> list[object]:
    return [body for called, body in fake.posts() if called == f"/sessions/{SESSION_ID}/{path}"]


def test_a_viewer_is_offered_nothing_and_reported_why(fake: FakeService, tab: Tab):
    fake.mode, fake.sample, fake.person = "samples", DISARMED, person("V. Iewer", Role.VIEWER)
    page = tab.open("disarmed")
    expect_enabled(page)
    expect(page.locator("#hint")).to_have_text("To arm: your log-in (viewer) does not allow it.")
    for action in ("disarm", "hold", "arm"):
        button = page.locator(f"#do-{action}")
        expect(button).to_be_disabled()
        expect(button).to_have_attribute("title", "Not now: your log-in (viewer) does not allow it")
    expect(page.locator("#events-empty")).to_have_text("Not shown: your log-in does not allow it.")
    page.keyboard.press("F8")
    expect(page.locator("#outcome")).to_contain_text("The page could not hold: use the room's interlock.")
    page.click("#do-setup")
    expect(page.locator("#new-session [type=submit]")).to_be_disabled()
    expect(page.locator("#setup-why")).to_contain_text("your log-in (viewer) does not allow it")
    assert fake.posts() == []
    assert not [path for _, path, _ in fake.calls if path.endswith("/audit")]


def test_an_admin_can_hold_and_disarm_and_arms_nothing(fake: FakeService, tab: Tab):
    fake.mode, fake.sample, fake.person = "samples", DISARMED, person("Grace", Role.ADMIN)
    page = tab.open("disarmed")
    expect_enabled(page, "stop")
    expect(page.locator("#do-hold")).to_be_enabled()
    expect(page.locator("#do-disarm")).to_be_enabled()


def test_each_button_is_offered_only_where_it_makes_sense(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", LEARNING
    page = tab.open("disarmed")
    expect_enabled(page, "stop")
    fake.sample = sample(gate="hold")
    tab.sees("hold")
    expect_enabled(page, "retrain", "stop")
    expect(page.locator("#do-acknowledge")).to_be_disabled()
    fake.sample = FAULT
    tab.sees("fault")
    expect(page.locator("#do-acknowledge")).to_be_enabled()
    expect(page.locator("#do-arm")).to_be_disabled()


@pytest.mark.parametrize(
    ("button", "path", "message"),
    [
        ("reference", "reference", DISARMED),
        ("disarm", "disarm", sample(gate="hold")),
        ("acknowledge", "acknowledge", FAULT),
    ],
)
def test_a_button_sends_its_call_once_and_states_who(
    fake: FakeService, tab: Tab, button: str, path: str, message: dict
):
    fake.mode, fake.sample, fake.person = "samples", message, person("Ada L.")
    page = tab.open(message["gate"])
    page.click(f"#do-{button}")
    expect(page.locator("#outcome")).to_have_attribute("data-kind", "done")
    # Whoever only takes permission away is not asked for a name: the log-in says who.
    confirmed = {"at": "end_exhale", "reason": "", "level_seen": -1.25} if button == "reference" else {}
    assert calls_to(fake, path) == [{} if button == "disarm" else {"operator": "Ada L."} | confirmed]


@pytest.mark.parametrize(
    ("mover", "label", "words"),
    [
        ("couch", "Couch moved by 2.0 mm: confirm", "the floor has not"),
        ("camera", "Camera moved by 2.0 mm: confirm", "Only if that was on purpose"),
        ("camera_or_couch", "Camera or couch moved by 2.0 mm: confirm", "If it was the couch"),
    ],
)
def test_a_moved_couch_is_confirmed_as_the_page_showed_it(
    fake: FakeService, tab: Tab, mover: str, label: str, words: str
):
    moved = {"reason": "camera_moved", "detail": "2.0 mm from where it was", "moved": mover, "moved_mm": 2.04}
    fake.mode, fake.sample, fake.person = "samples", DISARMED | {"lost": moved}, person("Ada L.")
    page = tab.open("disarmed")
    expect(page.locator("#do-reference")).to_have_text(label)
    expect(page.locator("#gate-do")).to_contain_text(words)
    expect(page.locator("#steps [aria-current=step]")).to_contain_text(words)
    expect(page.locator("#do-arm")).to_be_disabled()
    page.click("#do-reference")
    expect(page.locator("#outcome")).to_have_attribute("data-kind", "done")
    shown = {"operator": "Ada L.", "at": "end_exhale", "reason": "", "level_seen": -1.25, "move_seen_mm": 2.04}
    assert calls_to(fake, "reference") == [shown]
    fake.sample = DISARMED
    expect(page.locator("#do-reference")).to_have_text("Set reference")
    expect(page.locator("#gate-do")).to_have_text("Arm when the patient lies ready.")


def test_stop_asks_once_more(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", DISARMED
    page = tab.open("disarmed")
    page.click("#do-stop")
    expect(page.locator("#do-stop")).to_have_text("Confirm stop")
    assert calls_to(fake, "stop") == []
    page.click("#do-stop")
    expect(page.locator("#outcome")).to_have_text("Session stopped.")
    assert len(calls_to(fake, "stop")) == 1


@pytest.mark.parametrize(
    ("key", "said", "called"), [("Escape", "Disarmed.", "disarm"), ("F8", "Held until released.", "hold")]
)
def test_a_key_takes_the_beam_from_anywhere_even_while_typing(fake: FakeService, tab: Tab, key, said, called):
    fake.mode, fake.sample = "samples", sample(gate="beam_on", hold_reason=None, hold_text=None, line_on=True)
    page = tab.open("beam_on")
    page.keyboard.press(key)
    expect(page.locator("#outcome")).to_have_text(said)
    page.click("#do-setup")
    page.focus("[name=patient_reference]")
    page.keyboard.press(key)
    expect(page.locator("#outcome")).to_have_text(said)
    assert calls_to(fake, called) == [{}, {}]


@pytest.mark.parametrize(("key", "called"), [("Escape", "disarm"), ("F8", "hold")])
def test_a_page_that_has_not_seen_a_frame_yet_takes_the_beam_too(fake: FakeService, tab: Tab, key: str, called: str):
    fake.mode, fake.sample = "silent", sample(gate="beam_on", hold_reason=None, hold_text=None, line_on=True)
    page = tab.open("connecting")
    expect(page.locator("body")).to_have_attribute("data-access", "in")  # before, buttons are as written
    page.keyboard.press(key)
    expect(page.locator("#outcome")).to_have_attribute("data-kind", "done")
    assert calls_to(fake, called) == [{}]


def test_a_key_hit_after_arming_does_not_press_the_button_again(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", DISARMED
    page = tab.open("disarmed")
    press_arm(page)
    expect(page.locator("#outcome")).to_have_attribute("data-kind", "done")
    page.keyboard.press("Space")
    page.keyboard.press("Enter")
    tab.draws(fake)
    tab.is_answered()
    assert len(calls_to(fake, "arm")) == 1


def test_a_refusal_shows_the_field_and_the_bound(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", DISARMED
    fake.problem = (
        409,
        {"code": "command_refused", "detail": "no reference", "field": "reference", "value": "None"}
        | {"bound": "set first"},
    )
    page = tab.open("disarmed")
    press_arm(page)
    expect(page.locator("#outcome")).to_have_attribute("data-kind", "failed")
    for part in ("Arm:", "no reference", "None", "set first"):
        expect(page.locator("#outcome")).to_contain_text(part)


def test_a_disarm_that_fails_states_what_else_stops_the_beam(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", sample(gate="hold")
    fake.problem = (503, {"code": "engine_timeout", "detail": "The engine did not answer in time."})
    page = tab.open("hold")
    page.click("#do-disarm")
    expect(page.locator("#outcome")).to_contain_text("room's interlock")


def test_a_waiting_session_is_found_and_started(fake: FakeService, tab: Tab):
    fake.sessions = [SESSION | {"status": "created"}]
    page = tab.open("idle")
    expect(page.locator("#who-patient")).to_have_text("P-0117")
    expect_enabled(page, "start", "stop")
    page.click("#do-start")
    expect(page.locator("#outcome")).to_have_text("Session started.")
    assert calls_to(fake, "start") == [{"operator": "A. Therapist"}]


def test_a_session_made_elsewhere_is_taken_up_by_a_page_that_waits(fake: FakeService, tab: Tab):
    fake.sessions = [SESSION | {"status": "ended", "patient_reference": "P-0099"}]
    page = tab.open("idle")
    expect(page.locator("#setup")).to_be_visible()
    fake.sessions = [SESSION | {"status": "created", "id": "66" * 16}, *fake.sessions]
    expect(page.locator("#who-patient")).to_have_text("P-0117")
    expect(page.locator("#do-start")).to_be_enabled()


def test_nothing_the_page_can_send_names_a_beam(fake: FakeService, tab: Tab):
    """Press everything in every state: the calls are those of the contract, and none of them is "on"."""
    fake.mode = "samples"
    for message in (DISARMED, sample(gate="hold", training=WAITING), FAULT):
        fake.sample = message
        page = tab.open(message["gate"])
        offered = page.locator(".controls button:visible:enabled").evaluate_all("all => all.map((one) => one.id)")
        for button in offered:
            page.click(f"#{button}")
    allowed = re.compile(
        rf"/sessions/{SESSION_ID}/(arm|disarm|hold|release|presence|reference|acknowledge|stop|models/retrain|models/apply)$"
    )
    tab.is_answered()
    paths = [path for path, _ in fake.posts()]
    assert len(set(paths)) >= 4
    assert all(allowed.match(path) for path in paths), paths


@pytest.mark.parametrize(
    "after",
    [sample(gate="fault", is_armed=False), DISARMED, DISARMED | {"session_id": "99" * 16}],
    ids=["fault", "disarmed", "another session"],
)
def test_a_message_ends_with_the_state_it_belongs_to(fake: FakeService, stepped: SteppedPage, after: dict):
    """'Armed' below a fault, or under another patient's name, would contradict what the gate shows."""
    page = stepped.open_settled(DISARMED)
    press_arm_stepped(stepped)
    stepped.shows(sample(gate="hold"))
    expect(page.locator("#outcome")).to_have_text("Armed: the gate controls the beam.")
    stepped.advance(2_400)
    stepped.shows(sample(gate="beam_on", hold_reason=None, hold_text=None, line_on=True))
    expect(page.locator("#outcome")).to_have_text("Armed: the gate controls the beam.")
    stepped.shows(after)
    stepped.advance(200)
    expect(page.locator("#outcome")).to_have_text("")


def test_a_failed_disarm_stays_stated_while_the_state_is_unknown_and_not_longer(
    fake: FakeService, stepped: SteppedPage
):
    page = stepped.open_settled(sample(gate="beam_on", hold_reason=None, hold_text=None, line_on=True))
    fake.problem = (503, {"code": "engine_timeout", "detail": "The engine did not answer in time."})
    page.click("#do-disarm")
    stepped.advance(200)
    fake.mode = "silent"
    stepped.advance(3_000)
    expect(page.locator("#outcome")).to_contain_text("The page could not disarm: use the room's interlock.")
    stepped.shows(sample(gate="hold"))
    expect(page.locator("#outcome")).to_contain_text("The page could not disarm")
    stepped.shows(DISARMED)
    stepped.advance(200)
    expect(page.locator("#outcome")).to_have_text("")


def test_the_trace_of_one_patient_is_not_shown_under_the_next_one_s_name(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", DISARMED
    page = tab.open("disarmed")
    expect(page.locator("#trace")).to_have_attribute("data-session", SESSION_ID)
    fake.sessions.insert(0, fake.sessions[0] | {"id": "77" * 16, "status": "created", "patient_reference": "P-0300"})
    fake.mode = "idle"
    expect(page.locator("#who-patient")).to_have_text("P-0300")
    expect(page.locator("#gate-word")).to_have_text("Ready")
    expect(page.locator("#gate-reason")).to_contain_text("P-0300")
    expect(page.locator("#trace")).to_have_attribute("data-session", "")


def test_in_clinical_mode_stickers_and_chest_are_confirmed_before_the_first_reference(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", DISARMED | {"reference": None}
    fake.sessions = [fake.sessions[0] | {"mode": "clinical", "has_reference": False, "measurement_state": "measuring"}]
    page = tab.open("disarmed")
    expect(page.locator("#do-reference")).to_be_disabled()
    expect(page.locator("#do-reference")).to_have_attribute("title", re.compile("Confirm stickers and chest first"))
    page.check("#setup-confirmed")
    page.click("#do-reference")
    expect(page.locator("#outcome")).to_have_attribute("data-kind", "done")
    assert calls_to(fake, "reference")[0]["setup_confirmed"] is True
    fake.sessions = [fake.sessions[0] | {"has_reference": True}]
    expect(page.locator("#setup-confirmed-field")).to_be_hidden()
