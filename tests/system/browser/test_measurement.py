"""What is measured is shown in mm, what is not is shown as nothing: never zero, never a bridge over a gap."""

from itertools import pairwise

import pytest
from playwright.sync_api import Page, expect

from tests.support.browser.fake_service import NOTHING_MEASURED, ROI_PX, FakeService, checks, motion_at, sample
from tests.support.browser.tab import Tab

pytestmark = [pytest.mark.browser, pytest.mark.verification]

NONE = "\N{EN DASH}"
MINUS = "\N{MINUS SIGN}"
LARGE = {"width": 1920, "height": 1080}
"""A screen with a place for the map."""
NUMBERS = ("whole", "thorax", "abdomen", "volume", "residual", "coverage")

# Columns of the trace that hold a piece of the signal's line, from the left edge of the plot to now.
LINE_COLUMNS = """() => {
  const canvas = document.querySelector('#trace');
  const pixels = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
  const found = [];
  for (let x = 0; x < canvas.width; x += 1) {
    let isLine = false;
    for (let y = 0; y < canvas.height; y += 1) {
      const i = 4 * (y * canvas.width + x);
      isLine ||= pixels[i] < 175 && pixels[i + 1] > 180 && pixels[i + 2] > 225 && pixels[i + 3] > 200;
    }
    if (isLine) found.push(x);
  }
  return found;
}"""


def lost(**changes: object) -> dict[str, object]:
    reason = {"reason": "marker_lost", "detail": "the superior left marker was not found"}
    return sample(**(NOTHING_MEASURED | {"state": "lost", "lost": reason, "hold_reason": "marker_lost"} | changes))


def line_columns(page: Page) -> list[int]:
    return page.evaluate(LINE_COLUMNS)


def test_numbers_are_those_of_the_sample_with_sign(fake: FakeService, tab: Tab):
    fake.mode = "samples"
    fake.sample = sample(whole_mm=1.52, thorax_mm=-1.1, abdomen_mm=1.9, volume_l=-0.21, missed_frames=3)
    page = tab.open("hold")
    shown = {name: page.locator(f"#figure-{name}") for name in (*NUMBERS, "fps", "missed", "latency", "line")}
    expect(shown["whole"]).to_have_text("+1.52")
    expect(shown["thorax"]).to_have_text(f"{MINUS}1.10")
    expect(shown["volume"]).to_have_text(f"{MINUS}0.21")
    expect(shown["coverage"]).to_have_text("98 %")
    expect(shown["fps"]).to_have_text("29.9")
    expect(shown["missed"]).to_have_text("3")
    expect(shown["latency"]).to_have_text("5.2 · 5.0 · 9.1 · 31.4")
    expect(shown["line"]).to_have_text("OFF")


def test_what_the_gate_rests_on_is_shown_with_the_time_of_a_check_that_is_off(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", sample(checks=checks(color="never", camera="off"))
    strip = tab.open("hold").locator("#checks")
    expect(strip.locator("span")).to_have_text(
        ["✓ surface", "✕ colour never on", "✕ couch off 4 s", "✓ markers", "✓ clock"]
    )
    expect(strip.locator("[data-state=off]")).to_have_attribute("title", "camera is off")
    fake.sample = sample(checks=[])
    expect(strip).to_have_text(NONE)


def test_what_was_not_measured_is_a_dash_not_a_zero(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", lost(fps=None, latency_ms=dict.fromkeys(("last", "p50", "p99", "max")))
    page = tab.open("hold")
    expect(page.locator("#learning-detail")).to_have_text("the superior left marker was not found")
    for name in (*NUMBERS, "fps"):
        expect(page.locator(f"#figure-{name}")).to_have_text(NONE)
    expect(page.locator("#figure-latency")).to_have_text(" · ".join([NONE] * 4))
    expect(page.locator("#trace-value")).to_have_text(NONE)


@pytest.fixture
def traced(fake: FakeService, tab: Tab) -> Tab:
    """A tab whose trace is looked at: 30 messages, one second of the camera, come in less."""
    fake.mode, fake.period_s = "samples", 0.01
    return tab


def test_the_trace_draws_no_line_where_nothing_was_measured(fake: FakeService, traced: Tab):
    fake.sample = lost()
    page = traced.open("hold")
    traced.draws(fake, 20)
    assert line_columns(page) == []
    fake.sample = sample()
    traced.await_that(lambda: len(line_columns(page)) > 5, "no line is drawn")


def test_the_trace_leaves_a_gap_open_instead_of_bridging_it(fake: FakeService, traced: Tab):
    fake.sample = sample(**motion_at(1.0))
    page = traced.open("hold")
    traced.draws(fake, 30)
    fake.sample = lost()
    traced.draws(fake, 45)
    fake.sample = sample(**motion_at(1.3))
    traced.draws(fake, 30)
    columns = line_columns(page)
    gaps = [(before, after) for before, after in pairwise(columns) if after - before > 20]
    assert len(gaps) == 1, "one gap of a second and a half, and none beside it"
    assert columns[0] < gaps[0][0]
    assert columns[-1] > gaps[0][1]


def test_frames_the_camera_missed_are_a_gap_too(fake: FakeService, traced: Tab):
    fake.sample = sample()
    page = traced.open("hold")
    traced.draws(fake, 30)
    fake.mode, after_missed = "silent", fake.frame_index + 36
    traced.await_that(lambda: fake.frame_index >= after_missed)
    fake.mode = "samples"
    traced.draws(fake, 30)
    columns = line_columns(page)
    assert max(after - before for before, after in pairwise(columns)) > 15


def test_thorax_and_abdomen_can_be_looked_at_and_the_gated_signal_is_named(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", sample(signal_mm=1.5, thorax_mm=2.5, abdomen_mm=3.5)
    page = tab.open("hold")
    expect(page.locator("#trace-name")).to_have_text("Gated on whole, \N{MINUS SIGN}1.0 to 3.0 mm")
    expect(page.locator("#trace-value")).to_have_text("1.5")
    page.get_by_text("Thorax", exact=True).first.click()
    expect(page.locator("#trace-value")).to_have_text("2.5")
    page.get_by_text("Abdomen", exact=True).first.click()
    expect(page.locator("#trace-value")).to_have_text("3.5")


def test_the_map_reports_each_cell_and_states_which_were_not_measured(fake: FakeService, tab: Tab):
    regions = [[1.0 * row - 2.0 for _ in range(8)] for row in range(14)]
    regions[0][0] = None
    fake.mode, fake.sample = "samples", sample(regions_mm=regions)
    tab.page.set_viewport_size(LARGE)
    page = tab.open("hold")
    box = page.locator("#grid").bounding_box()
    assert box is not None
    cell = min((box["width"] - 32) / 8, (box["height"] - 16) / 14)
    left, top = (box["width"] - 8 * cell) / 2, 16 + (box["height"] - 16 - 14 * cell) / 2
    readout = page.locator("#grid-readout")
    page.mouse.move(box["x"] + left + 0.5 * cell, box["y"] + top + 0.5 * cell)
    expect(readout).to_have_text("row 0, column 0: not measured")
    page.mouse.move(box["x"] + left + 7.5 * cell, box["y"] + top + 13.5 * cell)
    expect(readout).to_have_text("row 13, column 7: +11.0 mm")
    page.mouse.move(box["x"] + left + 3.5 * cell, box["y"] + top + 0.5 * cell)
    expect(readout).to_have_text(f"row 0, column 3: {MINUS}2.0 mm")


def test_the_map_hatches_the_cells_that_the_camera_does_not_see(fake: FakeService, tab: Tab):
    regions = [[5.0] * 8 for _ in range(14)]
    fake.mode, fake.sample = "samples", sample(regions_mm=regions, unseen_cells=[[13, 7]])
    tab.page.set_viewport_size(LARGE)
    page = tab.open("hold")
    readout = page.locator("#grid-readout")
    expect(readout).to_have_text("hatched: not seen")
    box = page.locator("#grid").bounding_box()
    assert box is not None
    cell = min((box["width"] - 32) / 8, (box["height"] - 16) / 14)
    left, top = (box["width"] - 8 * cell) / 2, 16 + (box["height"] - 16 - 14 * cell) / 2
    page.mouse.move(box["x"] + left + 7.5 * cell, box["y"] + top + 13.5 * cell)
    expect(readout).to_have_text("row 13, column 7: not seen (+5.0 mm extrapolated)")
    assert page.locator("#grid").bounding_box() == box, "the longest reading changes the layout"
    page.mouse.move(box["x"] + left + 6.5 * cell, box["y"] + top + 13.5 * cell)
    expect(readout).to_have_text("row 13, column 6: +5.0 mm")
    page.wait_for_function(IS_ONE_CELL_HATCHED)


# Of the last row: column 6 has one colour, column 7 several.
IS_ONE_CELL_HATCHED = """() => {
  const canvas = document.querySelector('#grid');
  const cell = Math.min((canvas.clientWidth - 32) / 8, (canvas.clientHeight - 16) / 14);
  const [left, top] = [(canvas.clientWidth - 8 * cell) / 2, 16 + (canvas.clientHeight - 16 - 14 * cell) / 2];
  const ratio = canvas.width / canvas.clientWidth;
  const colors = (column) => {
    const [x, y] = [left + column * cell + 3, top + 13 * cell + 3].map((v) => Math.round(v * ratio));
    const side = Math.round((cell - 6) * ratio);
    const pixels = canvas.getContext('2d').getImageData(x, y, side, side).data;
    return new Set(Array.from({length: pixels.length / 4}, (_, i) => pixels.slice(4 * i, 4 * i + 4).join())).size;
  };
  return colors(6) === 1 && colors(7) > 1;
}"""


BRIGHTEST_NEAR = """([x, y]) => {
  const canvas = document.querySelector('#picture');
  const zoom = Math.min(canvas.clientWidth / 640, canvas.clientHeight / 480);
  const left = (canvas.clientWidth - 640 * zoom) / 2, top = (canvas.clientHeight - 480 * zoom) / 2;
  const [u, v] = [left + (x + 0.5) * zoom - 2, top + (y + 0.5) * zoom - 2];
  const pixels = canvas.getContext('2d').getImageData(u, v, 5, 5).data;
  return Math.max(...pixels.filter((_, i) => i % 4 === 1));
}"""


MIDDLE = """() => {
  const canvas = document.querySelector('#picture');
  return [...canvas.getContext('2d').getImageData(canvas.width / 2, canvas.height / 2, 1, 1).data];
}"""


def sides(page: Page) -> list[int]:
    """Return the brightness of each side at four places of it."""
    found = []
    for corner, (x, y) in enumerate(ROI_PX):
        next_x, next_y = ROI_PX[(corner + 1) % 4]
        along = [(x + share * (next_x - x), y + share * (next_y - y)) for share in (0.2, 0.35, 0.65, 0.8)]
        found += [page.evaluate(BRIGHTEST_NEAR, place) for place in along]
    return found


def test_the_region_lies_on_the_picture_where_the_markers_are(fake: FakeService, tab: Tab):
    """The four sides run from marker to marker; the picture itself is dark there."""
    fake.mode, fake.sample = "samples", sample()
    page = tab.open("hold")
    page.uncheck("#overlay")
    tab.await_that(lambda: min(sides(page)) > 150, "a side of the region is not where its markers are")
    inside = page.evaluate(BRIGHTEST_NEAR, [323, 250])
    assert inside < 110, "the outline is a line, not a sheet"


def test_a_picture_without_its_region_is_shown_bare(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", lost()
    page = tab.open("hold")
    tab.await_that(lambda: page.evaluate(MIDDLE)[3] > 200, "no picture is drawn")
    assert max(page.evaluate(MIDDLE)[:3]) < 110, "no colour of motion over the patient"


def test_learning_shows_how_far_it_has_come(fake: FakeService, tab: Tab):
    training = {"frames": 214, "cycles": 2, "seconds": 7.1, "share": 0.62, "note": "one more complete breath"}
    fake.mode = "samples"
    fake.sample = lost(
        state="training", lost=None, gate="disarmed", is_armed=False, hold_reason="training", training=training
    )
    page = tab.open("disarmed")
    expect(page.locator("#learning-title")).to_have_text("Training")
    expect(page.locator("#learning-share")).to_have_text("62 %")
    expect(page.locator("#learning-detail")).to_have_text("214 frames · 2 breaths · 7 s · one more complete breath")
    assert page.locator("#learning-bar").evaluate("e => e.value") == pytest.approx(0.62)
