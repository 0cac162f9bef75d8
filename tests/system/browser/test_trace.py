"""The trace: never a line across a gap, live unless it says otherwise, and the value under the pointer."""

from typing import Any

import pytest
from playwright.sync_api import Page, expect

from tests.support.browser.fake_service import NOTHING_MEASURED, FakeService, motion_at, sample
from tests.support.browser.legibility import COUNT_COLOR
from tests.support.browser.node import in_node
from tests.support.browser.stepped_page import SteppedPage
from tests.support.browser.tab import Tab

pytestmark = [pytest.mark.browser, pytest.mark.verification]

OTHER = "99" * 16
FRAME = "#trace-frame"
LINE_RGB = (143, 211, 255)

# Draws a signal with a gap, or with a change of zero, in a chart of its own; returns the columns that hold its line,
# and how many of its pixels lie at half height, where only a line across would be.
CHART = """async ([count, from, to, kind]) => {
  const { Chart } = await import('/js/drawing/chart.js');
  const host = document.createElement('div');
  Object.assign(host.style, { position: 'fixed', left: '0', top: '0', width: '640px', height: '240px' });
  document.body.append(host);
  const nothing = () => {};
  const isJoined = (i) => !(kind === 'step' && i === from);
  const acts = { hasLabels: () => true, onPress: () => true, onSelect: nothing, onRelease: nothing };
  const chart = new Chart(host, ['#8fd3ff'], { below: nothing, above: nothing, times: () => [], isJoined, ...acts });
  const times = Array.from({ length: count }, (_, i) => i / 30);
  const values = times.map((_, i) => (i >= from && i < to && kind === 'gap' ? null : i < from ? 0 : 10));
  chart.draw([times, values], [0, count / 30], [-1, 11]);
  const { canvas } = chart;
  const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
  const isLine = (x, y) => {
    const i = 4 * (y * canvas.width + x);
    return data[i + 2] > 200 && data[i + 3] > 150 && data[i] < 180;
  };
  const columns = new Set();
  let atHalf = 0;
  for (let x = 60; x < canvas.width; x += 1) for (let y = 0; y < canvas.height; y += 1) if (isLine(x, y)) {
    columns.add(x);
    if (Math.abs(y - (canvas.height - 24 + 12) / 2) < 40) atHalf += 1;
  }
  host.remove();
  return { columns: [...columns].sort((a, b) => a - b), atHalf };
}"""
SAMPLES = """async (messages) => {
  const { TraceSamples } = await import('/js/stream/trace_samples.js');
  const kept = new TraceSamples();
  for (const message of messages) kept.add(message, 0);
  return {
    joined: kept.all.map(({ isJoined }) => isJoined), steps: kept.steps, judged: kept.ofPresentZero(60).length,
    gaps: kept.gaps('whole', 0, 100, 100), holds: kept.holds(0, 100), states: kept.states(0, 100),
    count: kept.times.length, nearest: kept.nearest(0.52)?.t ?? null,
  };
}"""


def message(t_s: float, **changes: Any) -> dict[str, Any]:
    return sample(timestamp_us=round(t_s * 1e6), sent_at="2026-11-21T03:00:00Z") | changes


def at_reference(number: int | None) -> dict[str, Any]:
    check = {"status": "first_fraction", "text": "", "reference_number": number, "degrees": [], "signed_by": None}
    return {"position_check": check}


def judged(messages: list[dict[str, Any]]) -> dict[str, Any]:
    return in_node(SAMPLES, messages)


@pytest.fixture
def breathing(fake: FakeService, tab: Tab) -> Page:
    """A page that has drawn some breathing; 30 messages, one second of the camera, come in less."""
    fake.mode, fake.is_breathing, fake.period_s, fake.sample = "samples", True, 0.01, sample()
    page = tab.open("beam_on")
    tab.draws(fake, 150)
    return page


def go_back(page: Page) -> None:
    """Zoom in by the keyboard, to less than there is, and move back."""
    for key in (*["+"] * 8, "ArrowLeft"):
        page.keyboard.press(key)


def point_at(page: Page, from_right_px: float) -> None:
    box = page.locator("#trace").bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + box["width"] - 14 - from_right_px, box["y"] + 60)


@pytest.mark.parametrize("count", [300, 30_000], ids=["few samples", "many samples a pixel"])
def test_no_line_crosses_a_gap_or_a_new_reference(fake: FakeService, tab: Tab, count: int):
    page = tab.open("idle")
    half = count // 2
    gap = page.evaluate(CHART, [count, half, half + count // 10, "gap"])
    assert gap["atHalf"] == 0
    assert max(b - a for a, b in zip(gap["columns"], gap["columns"][1:], strict=False)) > 40
    step = page.evaluate(CHART, [count, half, half, "step"])
    assert step["atHalf"] == 0
    whole = page.evaluate(CHART, [count, half, half, "none"])
    assert whole["atHalf"] > 0, "without a gap the line is drawn, or nothing was proved"


def test_a_new_reference_cuts_the_curve_is_marked_and_ends_what_is_judged():
    first = [message(i / 30, **at_reference(None)) for i in range(30)]
    second = [message(1 + i / 30, **at_reference(1)) for i in range(15)]
    found = judged([*first, *second])
    assert [i for i, joined in enumerate(found["joined"]) if not joined] == [0, 30]
    assert found["steps"] == [{"t": 1, "text": "new reference"}]
    assert found["judged"] == 15, "another window is predicted from samples against the present zero only"
    removed = judged([*second, message(2, **at_reference(None))])
    assert removed["steps"] == [{"t": 2, "text": "no reference"}]


def test_what_is_missing_and_why_the_beam_was_held_is_known_by_time():
    lost = NOTHING_MEASURED | {"gate": "hold", "hold_reason": "marker_lost"}
    messages = [message(i / 30) for i in range(30)] + [message(1 + i / 30, **lost) for i in range(15)]
    fault = {"gate": "fault", "hold_reason": "source_lost"}
    messages += [message(3 + i / 30, **fault) for i in range(6)]
    found = judged(messages)
    assert found["gaps"] == [[pytest.approx(29 / 30, abs=1e-3), 3], [pytest.approx(3 + 5 / 30, abs=1e-3), 100]]
    assert [(one["text"], one["gate"]) for one in found["holds"]] == [("marker lost", "hold"), ("source lost", "fault")]
    assert [one["gate"] for one in found["states"]] == ["hold", "fault"]
    assert found["states"][0]["to"] < 1.5, "no state is shown for a time without samples"
    assert found["nearest"] == pytest.approx(0.533, abs=0.04)


def test_of_a_long_session_the_last_minutes_are_kept():
    many = "Array.from({ length: 7000 }, (_, i) => ({ ...one, timestamp_us: i * 1e5 }))"
    script = f"async (one) => ({SAMPLES})({many})"
    found = in_node(script, message(0.0))
    assert 6_000 <= found["count"] <= 6_501


@pytest.mark.parametrize(("minute", "seconds"), [(13, 31), (14, 10)])
def test_a_page_opened_in_a_session_has_its_last_minutes_since_the_present_zero(
    fake: FakeService, tab: Tab, minute: int, seconds: int
):
    fake.mode, fake.sample, fake.frame_index, fake.period_s = "samples", sample(), 9_000, 1.0
    kept = {key: sample()[key] for key in ("session_id", "gate", "hold_reason", "whole_mm", "signal_mm")}
    kept |= {"type": "sample", "form": "recorded", "state": "measuring", "line_on": False}
    at = [f"2026-11-21T09:{10 + i // 300}:{i // 5 % 60:02d}Z" for i in range(1_500)]
    fake.recorded = [
        kept | {"frame_index": i, "timestamp_us": i * 200_000, "received_at": one} for i, one in enumerate(at)
    ]
    zero = {"action": "session.reference", "actor": "A. Therapist", "outcome": "done", "detail": {}}
    # As many transitions of the gate since then as some minutes of breathing have.
    moved = {"action": "gate.transition", "actor": "tidegate", "outcome": "done", "detail": {"to_state": "hold"}}
    fake.audit = [moved | {"sequence": 400 - i, "at": "2026-11-21T09:14:58Z"} for i in range(200)]
    fake.audit.append(zero | {"sequence": 9, "at": f"2026-11-21T09:{minute}:50Z"})
    page = tab.open("hold")
    page.click("#do-tables")
    expect(page.locator("#table-trace tr")).to_have_count(seconds + 1)


def test_the_value_under_the_pointer_is_reported_with_time_and_gate(breathing: Page):
    readout = breathing.locator("#trace-readout")
    expect(readout).to_have_text("")
    point_at(breathing, 15)
    expect(readout).to_contain_text("s ago")
    expect(readout).to_contain_text(" mm · ")
    point_at(breathing, 480)
    expect(readout).to_have_text("no sample")
    breathing.mouse.move(5, 5)
    expect(readout).to_have_text("")


def test_a_part_that_is_dragged_stands_still_states_it_and_goes_back(breathing: Page, fake: FakeService, tab: Tab):
    frame, held = breathing.locator(FRAME), breathing.locator("#trace-held")
    expect(frame).to_have_attribute("data-live", "yes")
    point_at(breathing, 80)
    breathing.mouse.down()
    point_at(breathing, 20)
    breathing.mouse.up()
    expect(frame).to_have_attribute("data-live", "no")
    expect(held).to_have_text("Not live")
    breathing.click("#trace-live")
    expect(frame).to_have_attribute("data-live", "yes")
    expect(held).to_have_text("")
    point_at(breathing, 80)
    breathing.mouse.down()
    expect(held).to_have_text("Not live")
    breathing.mouse.up()
    expect(frame).to_have_attribute("data-live", "yes")


def test_the_wheel_zooms_about_the_newest_sample_and_stays_live(breathing: Page, fake: FakeService, tab: Tab):
    before = breathing.evaluate(COUNT_COLOR, LINE_RGB)
    point_at(breathing, 100)
    breathing.mouse.wheel(0, -200)
    breathing.mouse.wheel(0, -200)
    expect(breathing.locator("#trace-live")).to_be_visible()
    expect(breathing.locator(FRAME)).to_have_attribute("data-live", "yes")
    tab.draws(fake)
    assert breathing.evaluate(COUNT_COLOR, LINE_RGB) > 1.2 * before
    breathing.click("#trace-live")
    expect(breathing.locator("#trace-live")).to_be_hidden()


def test_the_keyboard_zooms_moves_and_returns(breathing: Page):
    breathing.focus(FRAME)
    breathing.keyboard.press("+")
    expect(breathing.locator("#trace-live")).to_be_visible()
    go_back(breathing)
    expect(breathing.locator(FRAME)).to_have_attribute("data-live", "no")
    for _ in range(100):  # the newest sample goes on meanwhile
        if breathing.get_attribute(FRAME, "data-live") == "yes":
            break
        breathing.keyboard.press("ArrowRight")
    expect(breathing.locator(FRAME)).to_have_attribute("data-live", "yes")
    for key in ("ArrowLeft", "l"):
        breathing.keyboard.press(key)
    expect(breathing.locator(FRAME)).to_have_attribute("data-live", "yes")
    expect(breathing.locator("#trace-live")).to_be_hidden()


def test_the_reference_is_named_on_the_trace_as_confirmed_and_not_after_another_one(
    fake: FakeService, stepped: SteppedPage
):
    named = """() => new Promise((resolve) => {
      const original = CanvasRenderingContext2D.prototype.fillText;
      const found = [];
      CanvasRenderingContext2D.prototype.fillText = function (text, ...place) {
        found.push(text);
        return original.call(this, text, ...place);
      };
      window.drawnTexts = found;
      resolve();
    })"""
    page = stepped.open(sample(**at_reference(1)))
    page.evaluate(named)
    stepped.advance(2_000)
    named_so = "Gated on whole, \N{MINUS SIGN}1.0 to 3.0 mm · end of exhale of 4 breaths, scatter 0.21 mm"
    expect(page.locator("#trace-name")).to_have_text(named_so)
    fake.arming["items"] = [one for one in fake.arming["items"] if one["code"] != "reference"]
    stepped.shows(sample(**at_reference(2)))
    stepped.advance(400)
    page.evaluate("window.drawnTexts.length = 0")
    stepped.advance(2_000)
    assert "new reference" in page.evaluate("window.drawnTexts")
    expect(page.locator("#trace-name")).to_have_text("Gated on whole, \N{MINUS SIGN}1.0 to 3.0 mm")


def test_it_does_not_move_beyond_the_oldest_sample():
    moved = in_node(
        """async () => {
      const { TraceView } = await import('/js/panels/trace_view.js');
      const view = new TraceView();
      for (let i = 0; i < 9; i += 1) view.move(-0.25, 5, 100, 0);
      return view.range(100);
    }""",
        None,
    )
    assert moved == [5, 35]


def test_it_is_live_again_after_a_minute(stepped: SteppedPage):
    page = stepped.open(sample())
    stepped.advance(20_000)
    page.focus(FRAME)
    go_back(page)
    stepped.leap(58_000)
    expect(page.locator(FRAME)).to_have_attribute("data-live", "no")
    stepped.advance(3_000)
    expect(page.locator(FRAME)).to_have_attribute("data-live", "yes")


def test_another_session_is_live_and_holds_nothing_of_the_one_before(fake: FakeService, breathing: Page, tab: Tab):
    breathing.focus(FRAME)
    go_back(breathing)
    expect(breathing.locator("#trace-held")).to_have_text("Not live")
    fake.is_breathing = False
    fake.sample = sample(session_id=OTHER, **(NOTHING_MEASURED | {"state": "lost"}))
    expect(breathing.locator("#trace")).to_have_attribute("data-session", OTHER)
    tab.draws(fake)
    expect(breathing.locator("#trace-held")).to_have_text("")
    assert breathing.evaluate(COUNT_COLOR, LINE_RGB) == 0


def test_a_picture_of_the_trace_does_not_survive_its_session(fake: FakeService, breathing: Page):
    fake.mode = "idle"
    fake.sessions[:] = [fake.sessions[0] | {"id": OTHER, "status": "created"}]
    expect(breathing.locator("#trace-none")).to_be_visible()
    assert breathing.evaluate(COUNT_COLOR, LINE_RGB) == 0


def test_the_present_and_an_earlier_value_are_those_of_the_samples(fake: FakeService, tab: Tab):
    fake.mode, fake.period_s, fake.sample = "samples", 0.02, sample(**motion_at(1.0))
    page = tab.open("hold")
    tab.draws(fake, 60)
    point_at(page, 6)
    expect(page.locator("#trace-readout")).to_contain_text("4.1 mm · hold: outside window")
