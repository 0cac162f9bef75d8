"""Logging in and out: the page claims nothing that it may not see, and says at once when it may not any more."""

import json
from typing import Any

import pytest
from playwright.sync_api import Page, Route, expect

from service.core.permissions import Role
from tests.support.browser.arming import press_arm
from tests.support.browser.fake_service import SESSION_ID, FakeService, person, sample
from tests.support.browser.stepped_page import SteppedPage
from tests.support.browser.tab import Tab

pytestmark = [pytest.mark.browser, pytest.mark.verification]

BEAM_ON = sample(gate="beam_on", hold_reason=None, hold_text=None, hold_detail="", line_on=True)
DISARMED = sample(gate="disarmed", is_armed=False, hold_reason="disarmed", hold_text="Not armed", hold_detail="")
ADA = person("Ada L.", Role.THERAPIST)
PASSWORD = "correct horse battery"
NONE = "\N{EN DASH}"


@pytest.fixture
def locked(fake: FakeService, tab: Tab) -> Page:
    """The page as somebody finds it who has not logged in, while a beam is on."""
    fake.mode, fake.sample, fake.person = "samples", BEAM_ON, None
    fake.passwords["Ada L."] = (PASSWORD, ADA)
    return tab.open("out")


def log_in(page: Page, name: str = "Ada L.", password: str = PASSWORD) -> None:
    page.locator("#log-in").get_by_label("Name", exact=True).fill(name)
    page.locator("#log-in").get_by_label("Password", exact=True).fill(password)
    page.keyboard.press("Enter")


def shows_nothing_of_a_session(page: Page) -> None:
    for name in ("#who-patient", "#who-plan", "#figure-whole", "#figure-line", "#trace-value"):
        expect(page.locator(name)).to_have_text(NONE)
    expect(page.locator("#events li")).to_have_count(0)
    expect(page.locator("body")).to_have_attribute("data-fresh", "no")


def test_a_page_without_a_log_in_asks_for_one_and_shows_nothing(fake: FakeService, stepped: SteppedPage):
    fake.mode, fake.sample, fake.person = "samples", BEAM_ON, None
    page = stepped.open(None, "out")
    expect(page.locator("#gate-word")).to_have_text("Logged out")
    expect(page.locator("#log-in").get_by_label("Name", exact=True)).to_be_focused()
    shows_nothing_of_a_session(page)
    stepped.advance(3_000)
    assert {path for _, path, _ in fake.calls} == {"/api/v1/me", "/api/v1/login/ways"}, "it asks for nothing else"
    assert (fake.connections, fake.pictures) == (0, 0)


def test_the_enter_key_logs_in_and_the_header_states_who(fake: FakeService, tab: Tab, locked: Page):
    log_in(locked)
    tab.sees("beam_on")
    expect(locked.locator("#access")).to_be_hidden()
    expect(locked.locator("#person-name")).to_have_text("Ada L.")
    expect(locked.locator("#person-roles")).to_have_text("therapist")
    assert fake.posts() == [("/login", {"name": "Ada L.", "password": PASSWORD})]
    assert locked.evaluate("document.querySelector('#log-in').elements.password.value") == ""
    assert (
        locked.evaluate("[document.cookie, ...Object.values(localStorage), ...Object.values(sessionStorage)].join('')")
        == ""
    )
    assert not [url for url in tab.requests if PASSWORD in url or "Ada" in url]


@pytest.mark.parametrize(("name", "password"), [("Ada L.", "wrong horse"), ("Nobody", PASSWORD)])
def test_a_refused_log_in_states_the_same_whatever_was_wrong(fake: FakeService, locked: Page, name: str, password: str):
    log_in(locked, name, password)
    expect(locked.locator("#log-in-outcome")).to_have_text("Name or password is wrong.")
    expect(locked.locator("#log-in-outcome")).to_have_attribute("role", "alert")
    typed = locked.locator("#log-in [name=password]")
    expect(typed).to_have_value("")
    expect(typed).to_be_focused()
    expect(locked.locator("#gate-word")).to_have_text("Logged out")
    log_in(locked)
    expect(locked.locator("#access")).to_be_hidden()


def test_what_is_missing_is_stated_without_asking_the_controller(fake: FakeService, locked: Page):
    locked.locator("#log-in").get_by_label("Name", exact=True).fill("Ada L.")
    locked.keyboard.press("Enter")
    expect(locked.locator("#log-in-outcome")).to_have_text("Enter your password.")
    expect(locked.locator("#log-in [name=password]")).to_be_focused()
    assert fake.posts() == []


def test_a_lock_out_counts_down_and_then_lets_one_try_again(fake: FakeService, stepped: SteppedPage):
    fake.mode, fake.sample, fake.person, fake.locked_s = "samples", BEAM_ON, None, 2
    fake.passwords["Ada L."] = (PASSWORD, ADA)
    page = stepped.open(None, "out")
    log_in(page)
    expect(page.locator("#log-in-outcome")).to_have_text("Too many attempts.")
    expect(page.locator("#log-in-wait")).to_have_text("Try again in 2 s.")
    expect(page.locator("#log-in [type=submit]")).to_be_disabled()
    log_in(page)
    stepped.advance(1_200)
    assert len(fake.posts()) == 1, "nothing is sent while locked out"
    expect(page.locator("#log-in-wait")).to_have_text("Try again in 1 s.")
    stepped.advance(1_200)
    expect(page.locator("#log-in [type=submit]")).to_be_enabled()
    expect(page.locator("#log-in-wait")).to_have_text("")
    fake.locked_s = 0
    log_in(page)
    stepped.advance_until(lambda: stepped.kind == "beam_on")


def test_a_controller_that_is_away_is_no_wrong_password(fake: FakeService, tab: Tab, locked: Page):
    locked.route("**/api/v1/login", lambda route: route.abort())
    log_in(locked)
    expect(locked.locator("#log-in-outcome")).to_have_text("The controller cannot be reached.")
    locked.unroute("**/api/v1/login")
    log_in(locked)
    tab.sees("beam_on")


def test_the_hospital_s_own_log_in_is_offered_where_there_is_one(fake: FakeService, tab: Tab):
    fake.person, fake.ways = None, {"password": True, "oidc": {"label": "St. Elsewhere"}}
    page = tab.open("out")
    button = page.get_by_role("button", name="Log in with St. Elsewhere")
    expect(button).to_be_visible()
    with page.expect_request("**/api/v1/login/oidc"):
        button.click()


def test_where_only_break_glass_accounts_are_local_a_reason_is_asked_for_and_their_use_shows(
    fake: FakeService, tab: Tab, locked: Page
):
    fake.ways = {"password": True, "local_accounts": "break-glass", "oidc": {"label": "Site", "is_reachable": False}}
    fake.passwords["Ada L."] = (PASSWORD, ADA | {"is_break_glass": True})
    locked.reload()
    expect(locked.locator("#log-in-note")).to_contain_text("Site does not answer.")
    log_in(locked)
    expect(locked.locator("#log-in-outcome")).to_have_text("Enter a reason.")
    expect(locked.locator("#log-in [name=reason]")).to_be_focused()
    locked.fill("#log-in [name=reason]", "the network is down")
    locked.keyboard.press("Enter")
    tab.sees("beam_on")
    assert fake.posts()[-1][1]["reason"] == "the network is down"
    expect(locked.locator("#badge-glass")).to_be_visible()


def test_without_one_only_the_password_is_asked_for(locked: Page):
    expect(locked.locator("#log-in [type=submit]")).to_be_visible()
    expect(locked.locator("#log-in-oidc")).to_be_hidden()


@pytest.mark.parametrize(
    ("old", "new", "repeated", "text"),
    [
        ("", "a longer new one", "a longer new one", "Enter your present password."),
        ("once only 1234", "short", "short", "The new password has 5 characters; it needs 12."),
        ("once only 1234", "once only 1234", "once only 1234", "The new password is the old one."),
        ("once only 1234", "a longer new one", "a longer new two", "The two new passwords differ."),
    ],
)
def test_a_new_password_that_cannot_be_is_refused_at_its_field(
    fake: FakeService, tab: Tab, old: str, new: str, repeated: str, text: str
):
    fake.person = ADA | {"must_change_password": True}
    page = tab.open("out")
    page.fill("[name=old_password]", old)
    page.fill("[name=new_password]", new)
    page.fill("[name=repeated]", repeated)
    page.keyboard.press("Enter")
    expect(page.locator("#change-outcome")).to_have_text(text)
    assert fake.posts() == []


def test_a_one_time_password_has_to_be_changed_before_anything_is_seen(fake: FakeService, tab: Tab, locked: Page):
    fake.passwords["Ada L."] = ("once only 1234", ADA | {"must_change_password": True})
    log_in(locked, password="once only 1234")
    expect(locked.get_by_role("heading", name="Change password")).to_be_visible()
    expect(locked.locator("#gate-word")).to_have_text("Locked")
    expect(locked.locator("[name=new_password]")).to_be_focused()
    expect(locked.locator("#change-cancel")).to_be_hidden()
    shows_nothing_of_a_session(locked)
    assert fake.connections == 0
    locked.fill("[name=new_password]", "a longer new one")
    locked.fill("[name=repeated]", "a longer new one")
    locked.keyboard.press("Enter")
    tab.sees("beam_on")
    assert fake.posts()[-1] == (
        "/me/password",
        {"old_password": "once only 1234", "new_password": "a longer new one"},
    )


def test_a_password_can_be_changed_at_will_and_a_wrong_old_one_ends_nothing(fake: FakeService, tab: Tab):
    fake.mode, fake.sample, fake.person = "samples", BEAM_ON, ADA
    fake.passwords["Ada L."] = (PASSWORD, ADA)
    page = tab.open("beam_on")
    page.click("#do-account")
    page.fill("[name=old_password]", "not this one")
    page.fill("[name=new_password]", "a longer new one")
    page.fill("[name=repeated]", "a longer new one")
    page.keyboard.press("Enter")
    expect(page.locator("#change-outcome")).to_have_text("the old password is wrong")
    tab.sees("beam_on")
    page.click("#change-cancel")
    expect(page.locator("#access")).to_be_hidden()
    page.click("#do-account")
    expect(page.locator("[name=new_password]")).to_have_value("")


def test_logging_out_leaves_nothing_of_the_patient_on_the_page(fake: FakeService, stepped: SteppedPage):
    row = {"at": "2026-11-21T03:00:00Z", "session_id": SESSION_ID, "previous_hash": "", "hash": "", "outcome": "done"}
    fake.audit = [row | {"sequence": 3, "actor": "Ada L.", "action": "session.arm", "detail": {}}]
    fake.person = person()
    page = stepped.open(DISARMED)
    stepped.advance_until(lambda: page.locator("#events li").count() == 1 and fake.pictures > 0)
    stepped.advance_until(lambda: page.locator("#who-patient").inner_text() == "P-0117")
    page.click("#do-log-out")
    stepped.advance_until(lambda: stepped.kind == "out")
    stepped.advance(400)
    expect(page.locator("#access-reason")).to_have_text("You have logged out.")
    shows_nothing_of_a_session(page)
    expect(page.locator("#person")).to_be_hidden()
    pictures = fake.pictures
    stepped.advance(2_000)
    shows_nothing_of_a_session(page)
    assert fake.pictures == pictures
    assert "P-0117" not in page.inner_text("body")


def test_who_armed_the_gate_is_told_that_it_is_held_after_a_log_out(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", sample(armed_by="A. Therapist")
    page = tab.open("hold")
    page.click("#do-log-out")
    page.click("#do-log-out")  # the first click asks
    expect(page.locator("#access-reason")).to_contain_text("The gate that you armed is held until a person releases it")


def test_a_page_that_was_logged_out_tries_no_stream_any_more(stepped: SteppedPage):
    page, requests = stepped.open(DISARMED), stepped.tab.requests
    page.click("#do-log-out")
    stepped.advance_until(lambda: stepped.kind == "out")
    sockets = len([url for url in requests if url.startswith("ws")])  # the stream, and once what was recorded before
    page.clock.fast_forward(20_000)
    stepped.advance(400)
    assert stepped.kind == "out"
    assert len([url for url in requests if url.startswith("ws")]) == sockets == 2


def test_a_log_out_that_is_not_heard_is_stated_and_the_person_stays_logged_in(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", DISARMED
    page = tab.open("disarmed")
    page.route("**/api/v1/logout", lambda route: route.abort())
    page.click("#do-log-out")
    expect(page.locator("#outcome")).to_contain_text("You are still logged in.")
    tab.sees("disarmed")


def test_logging_out_while_a_gate_is_armed_asks_once_more(fake: FakeService, tab: Tab):
    """Whoever armed takes the beam with them, perhaps in the middle of a treatment."""
    fake.mode, fake.sample = "samples", BEAM_ON
    page = tab.open("beam_on")
    page.click("#do-log-out")
    expect(page.locator("#do-log-out")).to_have_text("Confirm: may hold")
    assert fake.posts() == []
    page.click("#do-log-out")
    tab.sees("out")
    assert [path for path, _ in fake.posts()] == ["/logout"]


def test_a_log_in_that_ends_while_the_beam_is_on_is_stated_at_once(fake: FakeService, stepped: SteppedPage):
    """The socket closes with 1008 and every call is refused: nothing that was live stays on the screen."""
    fake.person, fake.is_breathing = ADA, True
    fake.passwords["Ada L."] = (PASSWORD, ADA)
    page = stepped.open(BEAM_ON | {"is_armed": False})
    stepped.advance(400)
    expect(page.locator("#figure-whole")).not_to_have_text(NONE)
    fake.person = None
    stepped.advance_until(lambda: stepped.kind == "out", within_ms=1_000)
    stepped.advance(200)
    expect(page.locator("#gate-word")).to_have_text("Logged out")
    expect(page.locator("#access-reason")).to_contain_text("this page cannot hold the beam: use the room's interlock.")
    expect(page.locator("#say-now")).to_contain_text("Logged out")
    shows_nothing_of_a_session(page)
    for action in ("hold", "disarm", "arm", "start", "stop", "setup"):
        expect(page.locator(f"#do-{action}")).to_be_disabled()
    page.keyboard.press("F8")
    expect(page.locator("#outcome")).to_have_text("Hold: log in. The page could not hold: use the room's interlock.")
    log_in(page)
    stepped.advance_until(lambda: stepped.kind == "beam_on")
    expect(page.locator("#do-hold")).to_be_enabled()


def test_a_closed_stream_alone_is_enough_to_say_that_the_log_in_has_ended(fake: FakeService, stepped: SteppedPage):
    page = stepped.open(BEAM_ON)
    for path in ("sessions**", "sessions/**", "audit**", "qa/**"):
        page.route(f"**/api/v1/{path}", lambda route: route.abort())
    stepped.advance(400)
    fake.person = None
    stepped.advance_until(lambda: stepped.kind == "out", within_ms=1_000)


def test_a_refused_call_ends_the_log_in_also_while_the_stream_goes_on(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", DISARMED
    page = tab.open("disarmed")
    problem = {"status": 401, "content_type": "application/problem+json", "body": "{}"}
    page.route("**/api/v1/sessions/*/arm", lambda route: route.fulfill(**problem))
    press_arm(page)
    tab.sees("out")


def test_a_lost_connection_is_no_lost_log_in(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", BEAM_ON
    page = tab.open("beam_on")
    page.route("**/api/v1/**", lambda route: route.abort())
    fake.is_up = False
    tab.sees("offline")
    expect(page.locator("#access")).to_be_hidden()
    expect(page.locator("#person-name")).to_have_text("A. Therapist")
    page.unroute("**/api/v1/**")
    fake.is_up = True
    tab.sees("beam_on")


def test_less_that_one_may_do_shows_as_soon_as_a_call_is_refused(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", DISARMED
    page = tab.open("disarmed")
    problem = {"code": "forbidden", "detail": "gate.arm is needed"}

    def refuse(route: Route) -> None:
        # Not before: the page also reads the log-in by itself, for example when its tab comes to the front.
        fake.person = person("A. Therapist", Role.VIEWER)
        route.fulfill(status=403, content_type="application/problem+json", body=json.dumps(problem))

    page.route("**/api/v1/sessions/*/arm", refuse)
    press_arm(page)
    expect(page.locator("#outcome")).to_have_text("Arm: gate.arm is needed")
    expect(page.locator("#person-roles")).to_have_text("viewer")
    expect(page.locator("#do-arm")).to_be_disabled()


def test_another_person_s_log_in_in_the_same_browser_shows_when_one_looks_again(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", DISARMED
    page = tab.open("disarmed")
    fake.person = person("B. Other")
    page.evaluate("document.dispatchEvent(new Event('visibilitychange'))")
    expect(page.locator("#person-name")).to_have_text("B. Other")
    press_arm(page)
    expect(page.locator("#outcome")).to_have_attribute("data-kind", "done")
    assert fake.posts()[-1][1]["operator"] == "B. Other"


def test_somebody_without_any_role_sees_who_they_are_and_nothing_else(fake: FakeService, stepped: SteppedPage):
    nobody: dict[str, Any] = person("N. Ew") | {"roles": [], "permissions": []}
    fake.mode, fake.sample, fake.person = "samples", BEAM_ON, nobody
    page = stepped.open(None, "out")
    expect(page.locator("#gate-word")).to_have_text("Not shown")
    expect(page.locator("#access")).to_be_hidden()
    stepped.advance(3_000)
    assert fake.connections == 0
    assert {path for _, path, _ in fake.calls} == {"/api/v1/me"}


def test_a_log_in_panel_never_covers_the_gate(locked: Page):
    panel, gate = locked.locator("#access").bounding_box(), locked.locator("#gate").bounding_box()
    assert panel is not None
    assert gate is not None
    assert panel["x"] >= gate["x"] + gate["width"] or panel["y"] >= gate["y"] + gate["height"]
