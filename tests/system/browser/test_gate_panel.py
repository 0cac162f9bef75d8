"""One glance tells the state: every state has its own word, shape and colour, and says its reason in words."""

import re
from typing import Any

import pytest
from playwright.sync_api import expect

from tests.support.browser.fake_service import DASHBOARD, FakeService, sample
from tests.support.browser.stepped_page import SteppedPage
from tests.support.browser.tab import Tab

pytestmark = [pytest.mark.browser, pytest.mark.verification]

STATES = {
    "beam_on": sample(gate="beam_on", hold_reason=None, hold_text=None, line_on=True),
    "hold": sample(gate="hold"),
    "dwell": sample(gate="dwell", hold_reason="dwell", hold_text="Inside the window, dwell time is running"),
    "disarmed": sample(gate="disarmed", is_armed=False, hold_reason="disarmed", hold_text="Not armed"),
    "fault": sample(gate="fault", hold_reason="source_lost", hold_text="The camera is disconnected"),
}
WORDS = {"beam_on": "Beam permitted", "hold": "Hold", "dwell": "Dwell", "disarmed": "Disarmed", "fault": "Fault"}
LOOK = """() => {
  const gate = document.querySelector('#gate');
  const style = getComputedStyle(gate);
  const shapes = [...gate.querySelectorAll('[data-shape]')].filter(e => getComputedStyle(e).display !== 'none');
  return {
    kind: gate.dataset.kind,
    word: document.querySelector('#gate-word').innerText,
    shapes: shapes.map(e => e.dataset.shape),
    colors: [getComputedStyle(gate, '::before').borderColor, style.backgroundColor, style.backgroundImage].join(' '),
  };
}"""


def look(tab: Tab, kind: str) -> dict[str, Any]:
    """What the gate looks like in one glance once it shows `kind`."""
    tab.sees(kind)
    seen: dict[str, Any] = tab.page.evaluate(LOOK)
    assert seen["kind"] == kind
    return seen


@pytest.mark.parametrize("gate", STATES)
def test_each_gate_state_shows_its_word_and_its_shape_alone(fake: FakeService, tab: Tab, gate: str):
    fake.mode, fake.sample = "samples", STATES[gate]
    page = tab.open(gate)
    seen = look(tab, gate)
    assert (seen["word"], seen["shapes"]) == (WORDS[gate].upper(), [gate])
    if STATES[gate]["hold_text"]:
        expect(page.locator("#gate-reason")).to_have_text(STATES[gate]["hold_text"])


def test_beam_without_a_permit_is_for_the_rooms_interlock_and_acknowledged_once_it_is_off(fake: FakeService, tab: Tab):
    beam = STATES["fault"] | {"hold_reason": "beam_without_permit", "accelerator_beam": "on"}
    fake.mode, fake.sample = "samples", beam
    page = tab.open("fault")
    expect(page.locator("#gate-word")).to_have_text("Interlock")
    expect(page.locator("#do-acknowledge")).to_have_attribute("title", re.compile("still reports beam"))
    fake.sample = beam | {"accelerator_beam": "off"}
    expect(page.locator("#do-acknowledge")).to_be_enabled()
    fake.sample = STATES["beam_on"] | {"accelerator_beam": "on"}
    expect(page.locator("#gate-word")).to_have_text("Beam on")


@pytest.mark.parametrize("height", [768, 800, 1080])
def test_a_fault_s_octagon_keeps_its_size_beside_a_cause_of_several_lines(fake: FakeService, tab: Tab, height: int):
    fake.mode = "samples"
    fake.sample = STATES["fault"] | {"hold_detail": "88 MiB are free, and 200 MiB stay free: call the administrator"}
    tab.page.set_viewport_size({"width": 1024 if height < 800 else 1280, "height": height})
    place = tab.open("fault").locator("#gate .shape").bounding_box()
    assert min(place["width"], place["height"]) >= 64
    assert tab.page.evaluate("(g => g.scrollHeight - g.clientHeight)(document.querySelector('#gate'))") <= 0


def test_no_two_states_share_word_shape_or_colour(fake: FakeService, stepped: SteppedPage):
    stepped.open(STATES["hold"])
    seen = []
    for gate, message in STATES.items():
        stepped.shows(message)
        seen.append(look(stepped.tab, gate))
    for mode, kind in (("idle", "idle"), ("silent", "stale")):
        fake.mode = mode
        stepped.advance_until(lambda kind=kind: stepped.kind == kind)
        seen.append(look(stepped.tab, kind))
    for aspect in ("word", "shapes", "colors"):
        shown = [str(one[aspect]) for one in seen]
        assert len(set(shown)) == len(STATES) + 2, shown


def test_the_gate_changes_on_the_page_as_it_changes_in_the_room(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", STATES["disarmed"]
    tab.open("disarmed")
    for gate in ("hold", "dwell", "beam_on", "hold", "fault", "disarmed"):
        fake.sample = STATES[gate]
        tab.sees(gate)


def test_a_state_the_page_does_not_know_is_shown_as_a_fault(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", sample(gate="sideways", line_on=True)
    page = tab.open("fault")
    expect(page.locator("#gate-word")).to_have_text("Unknown")
    expect(page.locator("#gate-reason")).to_contain_text("sideways")


def test_a_permit_without_the_line_is_not_shown_as_beam_on(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", STATES["beam_on"] | {"line_on": False}
    page = tab.open("hold")
    expect(page.locator("#gate-word")).to_have_text("Line off")


def test_a_line_that_reads_on_without_a_permit_is_warned_of(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", STATES["hold"] | {"line_on": True}
    page = tab.open("hold")
    expect(page.locator("#gate-warning")).to_contain_text("reads ON")
    fake.sample = STATES["hold"]
    expect(page.locator("#gate-warning")).to_be_empty()


def test_changes_are_spoken_and_faults_at_once(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", STATES["hold"]
    page = tab.open("hold")
    expect(page.locator("#say-politely[aria-live=polite]")).to_contain_text("Hold. Outside the window")
    fake.sample = STATES["fault"]
    expect(page.locator("#say-now[aria-live=assertive]")).to_contain_text("Fault. The camera is disconnected")


def test_what_this_is_not_is_always_stated(fake: FakeService, tab: Tab):
    page = tab.open("idle")
    expect(page.get_by_text("Research — not for clinical use")).to_be_visible()
    fake.mode = "samples"
    tab.sees("hold")
    expect(page.get_by_text("Simulated beam")).to_be_visible()


CUT_OFF = """() => [...document.querySelectorAll("button, dt, dd, h2, .badge, #gate-reason, #gate-detail")]
  .filter((one) => one.checkVisibility({ visibilityProperty: true }) && one.clientWidth > 1)
  .filter((one) => getComputedStyle(one).overflow !== "visible" || one.tagName === "BUTTON")
  .filter((one) => one.scrollWidth > one.clientWidth + 1
    || (one.tagName === "BUTTON" && one.scrollHeight > one.clientHeight + 1))
  .map((one) => `${one.id || one.tagName}: ${one.textContent.trim()}`)"""
"""What is shown and has more text than room; a scrollbar takes room of its own."""


@pytest.mark.parametrize("language", [path.stem for path in sorted((DASHBOARD / "lang").glob("*.json"))])
@pytest.mark.parametrize(("width", "height"), [(1280, 800), (1920, 1080), (1024, 768)])
def test_everything_fits_on_the_screens_of_a_treatment_room(
    fake: FakeService, own_tab: Tab, width: int, height: int, language: str
):
    tab = own_tab
    tab.page.add_init_script(f"localStorage.setItem('tidegate.language', '{language}')")
    tab.page.set_viewport_size({"width": width, "height": height})
    fake.mode, fake.sample = "samples", STATES["disarmed"]
    page = tab.open("disarmed")
    expect(page.locator("html")).to_have_attribute("lang", language)
    sizes = "[document.documentElement.scrollWidth, document.documentElement.scrollHeight, innerWidth, innerHeight]"
    assert page.evaluate(sizes) == [width, height, width, height]
    for gate, message in STATES.items():
        fake.sample = message
        tab.sees(gate)
        word = page.locator("#gate-word").evaluate(
            "e => [e.scrollWidth - e.clientWidth, parseFloat(getComputedStyle(e).fontSize)]"
        )
        assert word[0] <= 0, f"{gate} is cut off"
        assert word[1] >= 36.0, f"{gate} cannot be read from across the room"
        assert page.evaluate(CUT_OFF) == [], gate
        assert page.evaluate(sizes) == [width, height, width, height]
    for button in ("#do-disarm", "#do-setup", "#do-stop"):
        box = page.locator(button).bounding_box()
        assert box is not None
        assert box["y"] + box["height"] <= height
    trace = page.locator("#trace").bounding_box()
    assert trace is not None
    assert trace["height"] >= 0.25 * height
