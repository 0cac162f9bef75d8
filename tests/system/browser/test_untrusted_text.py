"""The page trusts nobody's text, and asks nobody but its own controller."""

import re

import pytest
from playwright.sync_api import expect

from service.core.schemas import sessions
from tests.support.browser.fake_service import DASHBOARD, SESSION, SESSION_ID, FakeService, sample
from tests.support.browser.tab import Tab

pytestmark = pytest.mark.browser

EVIL = "<img src=x onerror=\"document.title='owned';window.owned=1\"><script>window.owned=1</script>"


def test_markup_in_any_text_of_the_controller_is_only_text(fake: FakeService, tab: Tab):
    names = {"patient_reference": EVIL, "plan_id": EVIL, "fraction_id": EVIL, "status": "created"}
    fake.sessions = [SESSION | names, SESSION | names | {"id": "66" * 16}]
    fake.calibrations[0]["camera"] = EVIL
    row = {
        "sequence": 1,
        "at": "2026-11-21T03:00:00Z",
        "actor": EVIL,
        "action": EVIL,
        "outcome": "done",
        "session_id": SESSION_ID,
    }
    fake.audit = [row | {"detail": {"reason": EVIL}, "previous_hash": "", "hash": ""}]
    lost = {"reason": "marker_lost", "detail": EVIL}
    fake.mode, fake.sample = "samples", sample(hold_reason=EVIL, hold_text=EVIL, state="lost", lost=lost)
    page = tab.open("hold")
    tab.open_setup()
    expect(page.locator("#who-patient")).to_have_text(EVIL)
    expect(page.locator("#gate-reason")).to_have_text(EVIL)
    expect(page.locator("#session-list strong").first).to_have_text(EVIL)
    expect(page.locator("#events li").first).to_contain_text(EVIL)
    fake.problem = (409, {"code": EVIL, "detail": EVIL, "field": EVIL, "value": EVIL, "bound": EVIL})
    page.click("#do-disarm")
    expect(page.locator("#outcome")).to_contain_text(EVIL)
    assert page.locator("img").count() == 0
    assert page.evaluate("window.owned") is None


def test_nothing_is_asked_of_anyone_else(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", sample()
    tab.open("hold")
    tab.open_setup()
    tab.await_that(lambda: fake.pictures > 0, "no picture is asked for")
    tab.draws(fake)
    socket_url = tab.url.replace("http://", "ws://")
    strangers = [url for url in tab.requests if not url.startswith((tab.url + "/", socket_url + "/"))]
    assert strangers == []
    assert any(url.endswith("/picture") for url in tab.requests)
    assert any(url.startswith(socket_url) for url in tab.requests)


def test_the_files_name_no_other_host_and_hold_no_inline_code():
    for file in DASHBOARD.rglob("*"):
        if file.is_dir() or file.suffix == ".woff2":
            continue
        text = file.read_text()
        if "vendor" in file.relative_to(DASHBOARD).parts:
            # What is vendored is as published: the addresses in its comments stay.
            text = re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)
            text = re.sub(r"(^|\s)//.*$", "", text, flags=re.MULTILINE)
        # Names of XML, which are never asked for.
        text = re.sub(r"http://www\.w3\.org/(2000/svg|1999/xhtml)", "", text)
        for scheme in ("http://", "https://", "//cdn", "innerHTML", "outerHTML", "insertAdjacentHTML", "eval("):
            assert scheme not in text, f"{scheme} in {file.name}"
    page = (DASHBOARD / "index.html").read_text()
    for inline in ("<style", "style=", "onclick", "onload", "javascript:"):
        assert inline not in page


def test_the_fake_controller_speaks_the_real_contract():
    """What these tests show the page is what the service promises: else they prove nothing."""
    from service.core.schemas.live_messages import LIVE_MESSAGE

    LIVE_MESSAGE.validate_python(sample(sent_at="2026-11-21T03:00:00Z"))
    sessions.Session.model_validate(SESSION)


def test_every_audit_row_shows_what_who_and_why(fake: FakeService, tab: Tab):
    row = {"at": "2026-11-21T03:00:00Z", "session_id": SESSION_ID, "previous_hash": "", "hash": "", "outcome": "done"}
    moved = {"from_state": "beam_on", "to_state": "hold", "reason": "outside_window", "operator": None, "detail": ""}
    dwelt = moved | {"from_state": "hold", "to_state": "dwell", "reason": "dwell"}
    fake.audit = [
        row | {"sequence": 5, "actor": "tidegate", "action": "gate.transition", "detail": dwelt},
        row | {"sequence": 4, "actor": "tidegate", "action": "gate.transition", "detail": moved},
        row | {"sequence": 3, "actor": "Ada L.", "action": "session.arm", "detail": {}},
        row | {"sequence": 2, "actor": "Ada L.", "action": "session.arm", "outcome": "requested", "detail": {}},
        row
        | {
            "sequence": 1,
            "actor": "Bob",
            "action": "session.arm",
            "outcome": "refused",
            "detail": {"code": "command_refused"},
        },
    ]
    fake.mode, fake.sample = "samples", sample()
    page = tab.open("hold")
    rows = page.locator("#events li")
    expect(rows).to_have_count(3)
    expect(rows.nth(0)).to_contain_text("Beam held")
    expect(rows.nth(0)).to_contain_text("Outside the window")
    expect(rows.nth(1)).to_contain_text("Armedby Ada L.")
    expect(rows.nth(2)).to_contain_text("Armed: refused")
    expect(rows.nth(2)).to_contain_text("command refused")
