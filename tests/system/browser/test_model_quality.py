"""The model's quality on the page: its deepest breath measured beside reconstructed, their difference, and figures."""

import pytest
from playwright.sync_api import Page, expect

from tests.support.browser.fake_service import FakeService, over, sample
from tests.support.browser.models import MODEL_ID, give_model
from tests.support.browser.tab import Tab

pytestmark = [pytest.mark.browser, pytest.mark.verification]

DISARMED = sample(gate="disarmed", is_armed=False, hold_reason="disarmed", hold_text="Not armed", hold_detail="")
COLORS = """(id) => {
  const canvas = document.getElementById(id);
  const pixels = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  const colors = new Set();
  for (let i = 0; i < pixels.length; i += 4) colors.add(pixels.slice(i, i + 4).join());
  return colors.size;
}"""


def opened(fake: FakeService, tab: Tab) -> Page:
    fake.mode, fake.sample = "samples", DISARMED
    page = tab.open("disarmed")
    page.click("#steps .to-quality")
    expect(page.locator("#quality-heading")).to_be_focused()
    return page


def test_the_panel_shows_the_figures_and_both_breaths(fake: FakeService, tab: Tab):
    give_model(fake)
    page = opened(fake, tab)
    figures = page.locator("#quality-figures")
    for text in ("412 frames", "7.5 mm", "0.31 mm", "98.5 %", "0.62 mm", "2 %", "95.1, 2.1, 0.8, 0.5 %"):
        expect(figures).to_contain_text(text)
    expect(page.locator("#quality-height-range")).to_contain_text("0 to 10 mm")
    expect(page.locator("#quality-residual-range")).to_contain_text("0 to 2 mm")
    assert page.evaluate(COLORS, "quality-reconstructed") > 20, "a breath"
    assert page.evaluate(COLORS, "quality-measured") > page.evaluate(COLORS, "quality-reconstructed"), "with noise"
    assert page.evaluate(COLORS, "quality-residual") >= 3, "the ground, the corner and a hole"
    page.click("#quality summary")
    cells = page.locator("#quality-table tr").nth(1).locator("td")
    expect(cells.nth(0)).to_have_text("not measured")
    expect(cells.nth(1)).to_have_text("0.40")
    expect(page.locator("#quality-table tr").nth(14).locator("td").nth(7)).to_have_text("2.50")


def test_a_model_without_maps_shows_its_figures_and_states_it(fake: FakeService, tab: Tab):
    give_model(fake, measured_mm=None, reconstructed_mm=None, residual_mm=None)
    page = opened(fake, tab)
    expect(page.locator("#quality-note")).to_have_text("An earlier version made this model: it has no maps.")
    expect(page.locator("#quality-figures")).to_contain_text("412 frames")
    expect(page.locator("#quality-maps")).to_be_hidden()


def test_a_model_that_cannot_be_read_is_stated_and_shows_nothing(fake: FakeService, tab: Tab):
    give_model(fake)
    del fake.of_model[f"/models/{MODEL_ID}/quality-maps"]
    page = opened(fake, tab)
    expect(page.locator("#quality-note")).to_contain_text("could not be read: ")
    expect(page.locator("#quality-figures dd")).to_have_count(0)
    expect(page.locator("#quality-maps")).to_be_hidden()


def test_esc_closes_it_before_it_disarms_and_the_focus_goes_back(fake: FakeService, tab: Tab):
    give_model(fake)
    page = opened(fake, tab)
    page.keyboard.press("Escape")
    expect(page.locator("#quality")).to_be_hidden()
    expect(page.locator("#steps .to-quality")).to_be_focused()
    assert not [path for path, _ in fake.posts() if path.endswith("/disarm")]


def test_without_a_model_there_is_no_button_and_with_the_session_its_model_leaves_the_page(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", DISARMED
    page = tab.open("disarmed")
    expect(page.locator("#steps .to-quality")).to_be_hidden()
    give_model(fake)
    page.click("#steps .to-quality")
    expect(page.locator("#quality-figures dd")).not_to_have_count(0)
    fake.sessions[0] |= {"status": "ended", "active_model_id": None}
    fake.sample = over()
    expect(page.locator("#quality")).to_be_hidden()
    expect(page.locator("#quality-figures dd")).to_have_count(0)
