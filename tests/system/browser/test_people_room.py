"""People and keys: for those who manage them, secrets shown once, and what the page offers is what the service has."""

import json
import re
from datetime import UTC, datetime, timedelta

import pytest
from playwright.sync_api import Page, expect

from service.access.request.rules import RULES
from service.core.permissions import KEY_PERMISSIONS, Permission, Role
from tests.support.browser.fake_service import DASHBOARD, ONE_TIME, SECRET, FakeService, api_key, person, user
from tests.support.browser.tab import Tab
from tests.support.waiting import eventually

pytestmark = [pytest.mark.browser, pytest.mark.verification]

ADMIN = person("Grace", Role.ADMIN)
EVIL = "<img src=x onerror=window.owned=1>"
PERMISSIONS = (DASHBOARD / "js" / "people" / "permissions.js").read_text()


@pytest.fixture
def panel(fake: FakeService, own_tab: Tab) -> Page:
    fake.people.append(user("Ada L.", Role.THERAPIST))
    page = room(fake, own_tab)
    expect(page.locator("#people-list li")).to_have_count(2)
    return page


def room(fake: FakeService, tab: Tab) -> Page:
    """The office's room for people, as an administrator sees it."""
    fake.person = fake.person if Role.ADMIN in fake.person["roles"] else ADMIN
    tab.page.goto(f"{tab.url}/office/#people")
    expect(tab.page.locator("#new-person")).to_be_visible()
    return tab.page


def listed(name: str) -> list[str]:
    """The strings of a list in the page's own table."""
    found = re.search(rf"export const {name} = (\[.*?\]);", PERMISSIONS, re.DOTALL)
    assert found is not None
    return list(json.loads(re.sub(r",\s*\]", "]", found[1])))


def test_the_page_s_own_table_is_the_service_s():
    needs = dict(re.findall(r"^  (\w+): \"([a-z.]+)\",$", PERMISSIONS, re.MULTILINE))
    assert len(needs) == 19
    assert set(needs.values()) <= set(Permission)
    for action in ("start", "reference", "arm", "release", "hold", "disarm", "stop", "acknowledge", "window"):
        assert RULES["POST", f"/api/v1/sessions/{{session_id}}/{action}"] == needs[action], action
    assert RULES["POST", "/api/v1/sessions"] == needs["create"]
    assert RULES["POST", "/api/v1/sessions/{session_id}/baseline-correction"] == needs["correct"]
    assert RULES["POST", "/api/v1/sessions/{session_id}/position-check"] == needs["sign"]
    assert RULES["POST", "/api/v1/sessions/{session_id}/models/retrain"] == needs["retrain"]
    assert RULES["POST", "/api/v1/sessions/{session_id}/models/apply"] == needs["apply"]
    assert RULES["POST", "/api/v1/calibrations"] == needs["upload"]
    assert RULES["GET", "/api/v1/audit"] == needs["events"]
    assert RULES["GET", "/api/v1/users"] == RULES["GET", "/api/v1/keys"] == needs["people"]
    assert RULES["POST", "/api/v1/coach/code"] == RULES["GET", "/api/v1/coach/screens"] == needs["coach"]
    assert RULES["WEBSOCKET", "/api/v1/live"] == needs["watch"]
    assert listed("ROLES") == list(Role)
    assert set(listed("KEY_SCOPES")) == KEY_PERMISSIONS


def test_only_those_who_manage_people_are_offered_to(fake: FakeService, tab: Tab):
    page = tab.open("idle")
    expect(page.locator("#person-name")).to_have_text("A. Therapist")
    page.goto(f"{tab.url}/office/#people")
    expect(page.locator("#rooms [aria-current]")).to_have_text("Sessions")
    assert not [path for _, path, _ in fake.calls if path.endswith(("/users", "/keys"))]


def test_an_admin_who_is_alone_is_reported_what_comes_next(fake: FakeService, own_tab: Tab):
    page = room(fake, own_tab)
    expect(page.locator("#people-next")).to_be_visible()
    expect(page.locator("#people-list")).to_contain_text("this is you")
    expect(page.locator("#key-empty")).to_contain_text("No key yet.")


def test_a_person_is_added_and_their_password_shown_once(fake: FakeService, panel: Page):
    panel.fill("#new-person [name=name]", " B. Physicist ")
    panel.check("#new-person-roles [value=physicist]")
    panel.click("#new-person [type=submit]")
    expect(panel.locator("#once-secret")).to_have_text(ONE_TIME)
    expect(panel.locator("#once-title")).to_have_text("One-time password of B. Physicist")
    expect(panel.locator("#people-list")).to_contain_text("must change the password")
    assert fake.posts() == [("/users", {"name": "B. Physicist", "roles": ["physicist"]})]
    panel.click("#once-done")
    expect(panel.locator("#shown-once")).to_be_hidden()
    expect(panel.locator("#people-list li")).to_have_count(3)
    assert ONE_TIME not in panel.content()


def test_a_secret_that_was_not_put_away_is_gone_when_the_room_is_left_or_the_log_in_ends(
    fake: FakeService, panel: Page
):
    for end in ("leaves", "log-in ends"):
        panel.fill("#new-person [name=name]", f"P. {end}")
        panel.click("#new-person [type=submit]")
        expect(panel.locator("#once-secret")).to_have_text(ONE_TIME)
        if end == "leaves":
            panel.get_by_role("link", name="Machine").click()
        else:
            fake.person = None
            panel.evaluate("document.dispatchEvent(new Event('visibilitychange'))")
        expect(panel.locator("#shown-once")).to_have_count(0)
        assert ONE_TIME not in panel.content()
        if end == "leaves":
            panel.get_by_role("link", name="People").click()
    assert "Ada L." not in panel.content()


def test_roles_that_are_ticked_are_changed_by_a_click_that_names_them(fake: FakeService, panel: Page):
    row = panel.locator("#people-list li").nth(1)
    expect(row.locator("[value=therapist]")).to_be_checked()
    row.locator("[value=viewer]").check()
    assert "PATCH" not in [call[0] for call in fake.calls]
    row.locator("[value=viewer]").uncheck()
    expect(row.get_by_role("button", name="Change roles")).to_have_count(0)
    row.locator("[value=viewer]").check()
    row.get_by_role("button", name="Change roles to: viewer, therapist").click()
    expect(panel.locator("#people-outcome")).to_have_text("Roles of Ada L. changed.")
    assert "PATCH" in [call[0] for call in fake.calls]
    assert set(fake.people[1]["roles"]) == {"viewer", "therapist"}


def test_a_refused_change_is_stated_and_the_ticks_state_what_is(fake: FakeService, panel: Page):
    fake.problem = (409, {"code": "last_admin", "detail": "somebody has to be able to administer"})
    row = panel.locator("#people-list li").first
    row.locator("[value=admin]").uncheck()
    row.get_by_role("button", name="Change roles").click()
    expect(panel.locator("#people-outcome")).to_have_text("Grace: somebody has to be able to administer")
    expect(panel.locator("#people-list li").first.locator("[value=admin]")).to_be_checked()


def test_disabling_and_resetting_ask_once_more(fake: FakeService, panel: Page):
    row = panel.locator("#people-list li").nth(1)
    row.get_by_role("button", name="Disable").click()
    expect(row.get_by_role("button", name="Confirm disable")).to_be_visible()
    assert not [one for one in fake.calls if one[0] == "PATCH"]
    row.get_by_role("button", name="Confirm disable").click()
    expect(row.get_by_role("button", name="Enable")).to_be_visible()
    row.get_by_role("button", name="New password").click()
    row.get_by_role("button", name="Confirm reset").click()
    expect(panel.locator("#once-secret")).to_have_text(ONE_TIME)
    bodies = [body for method, _, body in fake.calls if method == "PATCH"]
    assert bodies == [{"is_disabled": True}, {"reset_password": True}]


def test_a_key_is_made_and_its_secret_shown_once(fake: FakeService, panel: Page):
    panel.fill("#new-key [name=name]", "Planning")
    panel.click("#new-key [type=submit]")
    expect(panel.locator("#key-outcome")).to_have_text("Choose the key's permissions.")
    panel.check("#new-key-scopes [value='sessions.read']")
    panel.fill("#new-key [name=days]", "9999")
    panel.click("#new-key [type=submit]")
    expect(panel.locator("#key-outcome")).to_have_text("A key expires after 1 to 365 days.")
    panel.fill("#new-key [name=days]", "30")
    panel.click("#new-key [type=submit]")
    expect(panel.locator("#once-secret")).to_have_text(SECRET)
    ((_, body),) = fake.posts()
    assert (body["name"], body["scopes"]) == ("Planning", ["sessions.read"])
    lasts = datetime.fromisoformat(body["expires_at"]) - datetime.now(UTC)
    assert timedelta(days=29.9) < lasts < timedelta(days=30.1)
    panel.reload()
    expect(panel.locator("#key-list li")).to_have_count(1)
    assert SECRET not in panel.content()


def test_a_key_is_revoked_by_two_clicks_and_ended_ones_offer_nothing(fake: FakeService, own_tab: Tab):
    fake.people.append(user("Ada L."))
    fake.keys = [
        api_key("Planning", "sessions.read"),
        api_key("Old", "sessions.read", expires_at="2026-01-01T00:00:00Z"),
    ]
    page = room(fake, own_tab)
    rows = page.locator("#key-list li")
    expect(rows.nth(1)).to_contain_text("expired 2026-01-01")
    expect(rows.nth(1).get_by_role("button")).to_have_count(0)
    rows.nth(0).get_by_role("button", name="Revoke").click()
    rows.nth(0).get_by_role("button", name="Confirm revoke").click()
    expect(rows.nth(0)).to_contain_text("revoked 2026-11-21")
    assert fake.posts() == [("/keys/plan/revoke", {})]


def test_what_cannot_be_read_is_not_shown_as_if_there_were_no_one(fake: FakeService, own_tab: Tab):
    own_tab.page.route("**/api/v1/users", lambda route: route.abort())
    own_tab.page.route("**/api/v1/keys", lambda route: route.abort())
    page = room(fake, own_tab)
    why = "cannot be read. The controller cannot be reached."
    expect(page.locator("#people-empty")).to_have_text(f"The people {why}")
    expect(page.locator("#key-empty")).to_have_text(f"The keys {why}")
    expect(page.locator("#people-list li")).to_have_count(0)


def test_the_log_ins_of_a_person_are_ended_by_two_clicks(fake: FakeService, own_tab: Tab):
    at = "2026-11-24T07:00:00Z"
    way = {"created_at": at, "seen_at": at, "expires_at": at, "address": "10.0.0.7", "way": "password"}
    fake.logins = [{"id": "ab" * 16, "is_this": False, **way}]
    page = room(fake, own_tab)
    page.locator("#people-list summary").first.click()
    row = page.locator("#people-list tbody tr")
    expect(row).to_contain_text("10.0.0.7")
    row.get_by_role("button").click()
    row.get_by_role("button").click()
    eventually(lambda: [path for path, _ in fake.posts()] == [f"/users/Grace/logins/{'ab' * 16}/end"])


def test_an_administrator_is_led_to_the_office_by_the_log_in(fake: FakeService, own_tab: Tab):
    fake.person = None
    page = own_tab.open("out")
    fake.people = [user("Grace", Role.ADMIN)]
    fake.passwords["Grace"] = ("a password of Grace", ADMIN)
    page.fill("#log-in [name=name]", "Grace")
    page.fill("#log-in [name=password]", "a password of Grace")
    page.keyboard.press("Enter")
    expect(page.locator("#new-person")).to_be_visible()


def test_names_are_never_taken_for_markup(fake: FakeService, own_tab: Tab):
    fake.person = ADMIN | {"name": EVIL}
    fake.people = [user(EVIL, Role.ADMIN), user("Ada L.")]
    fake.keys = [api_key(EVIL, "sessions.read")]
    page = room(fake, own_tab)
    expect(page.locator("#people-list strong").first).to_have_text(EVIL)
    expect(page.locator("#who")).to_contain_text(EVIL)
    assert page.locator("img").count() == 0
    assert page.evaluate("window.owned") is None
