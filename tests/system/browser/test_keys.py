"""Keys: Esc disarms what is or may be armed at once and otherwise closes first; two presses acknowledge and arm."""

import pytest
from playwright.sync_api import expect

from tests.support.browser.arming import ACCEPTS
from tests.support.browser.fake_coach import FakeConsole
from tests.support.browser.fake_service import FakeService, over, sample
from tests.support.browser.stepped_page import STEP_MS, SteppedPage
from tests.support.browser.tab import Tab

pytestmark = [pytest.mark.browser, pytest.mark.verification]

DISARMED = sample(gate="disarmed", is_armed=False, hold_reason="disarmed", hold_text="Not armed", hold_detail="")
FAULT = sample(gate="fault", is_armed=False, hold_reason="source_lost", hold_text="The camera is lost", hold_detail="")
PANELS = {"#setup": "#do-setup", "#keys": "#do-keys"}


def sent(fake: FakeService, action: str) -> list[str]:
    return [path for path, _ in fake.posts() if path.endswith(f"/{action}")]


@pytest.mark.parametrize("panel", ["#setup", "#keys", "#window-editor"])
def test_escape_closes_what_is_open_first_where_the_gate_is_known_not_to_be_armed(
    fake: FakeService, tab: Tab, panel: str
):
    fake.mode, fake.sample = "samples", DISARMED
    page = tab.open("disarmed")
    page.click(PANELS.get(panel, "#do-window"))
    expect(page.locator(panel)).to_be_visible()
    page.keyboard.press("Escape")
    expect(page.locator(panel)).to_be_hidden()
    assert sent(fake, "disarm") == []
    page.keyboard.press("Escape")
    expect(page.locator("#outcome")).to_have_text("Disarmed.")


@pytest.mark.parametrize("panel", ["#setup", "#keys"])
def test_escape_disarms_an_armed_gate_at_once_whatever_is_open(fake: FakeService, tab: Tab, panel: str):
    fake.mode, fake.sample = "samples", sample()
    page = tab.open("hold")
    page.click(PANELS[panel])
    expect(page.locator(panel)).to_be_visible()
    page.keyboard.press("Escape")
    expect(page.locator("#outcome")).to_have_text("Disarmed.")
    expect(page.locator(panel)).to_be_visible()
    assert len(sent(fake, "disarm")) == 1


def test_escape_disarms_at_once_where_the_state_is_not_known(fake: FakeService, stepped: SteppedPage):
    page = stepped.open(DISARMED)
    page.click("#do-setup")
    stepped.advance(STEP_MS)
    fake.mode = "silent"
    stepped.advance_until(lambda: stepped.kind == "stale")
    page.keyboard.press("Escape")
    stepped.advance(STEP_MS)
    assert len(sent(fake, "disarm")) == 1


def test_escape_disarms_at_once_while_an_arming_is_on_its_way(fake: FakeService, stepped: SteppedPage):
    page = stepped.open_settled(DISARMED)
    page.click("#do-arm")
    stepped.advance_until(lambda: page.locator(ACCEPTS).count())
    page.click("#do-arm-now")
    stepped.advance(STEP_MS)
    page.click("#do-keys")
    page.keyboard.press("Escape")
    stepped.advance(STEP_MS)
    assert len(sent(fake, "disarm")) == 1, "the page still shows the gate as it was before"
    expect(page.locator("#keys")).to_be_visible()


def test_escape_closes_the_patient_screen_s_panel(console: FakeConsole, console_tab: Tab):
    page = console_tab.open("idle")
    page.evaluate("document.querySelector('#setup-close').click()")
    page.click("#do-coach")
    expect(page.locator("#coach")).to_be_visible()
    page.keyboard.press("Escape")
    expect(page.locator("#coach")).to_be_hidden()


def test_escape_closes_the_topmost_first_and_the_summary_last(fake: FakeService, tab: Tab):
    fake.mode, fake.sessions[:] = "idle", [over()]
    page = tab.open("idle")
    expect(page.locator("#report")).to_be_visible()
    expect(page.locator("#setup")).to_be_visible()
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press("?")
    for panel in ("#keys", "#setup", "#report"):
        expect(page.locator(panel)).to_be_visible()
        page.keyboard.press("Escape")
        expect(page.locator(panel)).to_be_hidden()
    assert sent(fake, "disarm") == []


def test_a_question_mark_lists_the_keys_but_not_in_a_field(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", sample()
    page = tab.open("hold")
    page.keyboard.press("?")
    expect(page.locator("#keys-heading")).to_be_focused()
    expect(page.locator("#keys")).to_contain_text("Disarm at once while the gate is armed")
    page.keyboard.press("?")
    expect(page.locator("#keys")).to_be_hidden()
    page.click("#do-setup")
    page.focus("[name=patient_reference]")
    page.keyboard.press("?")
    expect(page.locator("#keys")).to_be_hidden()
    expect(page.locator("[name=patient_reference]")).to_have_value("?")


def test_a_fault_is_acknowledged_by_two_presses_with_the_focus_kept(fake: FakeService, stepped: SteppedPage):
    page = stepped.open_settled(FAULT)
    page.focus("#do-acknowledge")
    page.keyboard.press("Enter")
    stepped.advance(STEP_MS)
    expect(page.locator("#do-acknowledge")).to_have_text("Press again")
    page.keyboard.press("Enter")
    assert sent(fake, "acknowledge") == [], "too soon after the first to be meant"
    stepped.advance(3 * STEP_MS)
    page.keyboard.press("Enter")
    stepped.advance(STEP_MS)
    assert len(sent(fake, "acknowledge")) == 1


@pytest.mark.parametrize("lapse", ["time", "focus", "state"])
def test_the_first_press_is_forgotten(fake: FakeService, stepped: SteppedPage, lapse: str):
    page = stepped.open_settled(FAULT)
    page.focus("#do-acknowledge")
    page.keyboard.press("Enter")
    stepped.advance(STEP_MS)
    if lapse == "time":
        stepped.advance(4_000)
    elif lapse == "focus":
        page.focus("#do-setup")
        page.focus("#do-acknowledge")
    else:
        stepped.shows(DISARMED)
        stepped.shows(FAULT)
        page.focus("#do-acknowledge")
    stepped.advance(3 * STEP_MS)
    expect(page.locator("#do-acknowledge")).to_have_text("Acknowledge fault")
    page.keyboard.press("Enter")
    stepped.advance(STEP_MS)
    assert sent(fake, "acknowledge") == []


def test_the_summary_arms_by_two_presses_and_not_by_the_first_after_it_changed(fake: FakeService, stepped: SteppedPage):
    page = stepped.open_settled(DISARMED)
    page.click("#do-arm")
    stepped.advance_until(lambda: page.locator(ACCEPTS).count())
    page.focus("#do-arm-now")
    page.keyboard.press("Enter")
    stepped.advance(3 * STEP_MS)
    expect(page.locator("#do-arm-now")).to_have_text("Press again to arm")
    fake.arming["items"][0]["text"] = "P-0118"
    fake.arming_etag = '"another"'
    stepped.advance_until(lambda: page.locator("#arming-patient").inner_text() == "P-0118")
    expect(page.locator("#do-arm-now")).to_have_text("Arm now")
    stepped.advance(STEP_MS)
    stepped.advance_until(lambda: page.locator(ACCEPTS).count())
    page.keyboard.press("Enter")
    stepped.advance(3 * STEP_MS)
    assert sent(fake, "arm") == []
    page.keyboard.press("Enter")
    stepped.advance(STEP_MS)
    assert len(sent(fake, "arm")) == 1
