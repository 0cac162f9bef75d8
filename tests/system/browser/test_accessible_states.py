"""Every state of the page: axe-core finds nothing, and what it does not check is right as well (ADR 0042)."""

import pytest
from playwright.sync_api import Browser, BrowserContext, Page, expect

from tests.support.browser.accessibility import (
    SIZES,
    axe_findings,
    findings,
    focus_findings,
    layout_findings,
    settled,
    tint,
)
from tests.support.browser.page_states import STATES, make_fake
from tests.support.browser.served_tab import Door, opened_tab
from tests.support.browser.tab import Tab

pytestmark = [pytest.mark.long, pytest.mark.browser, pytest.mark.verification]

BORDER = 3.0
SMALL = (320, 640)
LEAST_TABS = 3


def at(page: Page, size: tuple[int, int]) -> Page:
    page.set_viewport_size({"width": size[0], "height": size[1]})
    settled(page)
    return page


@pytest.mark.parametrize("name", STATES)
def test_a_state_is_accessible(shared_context: BrowserContext, door: tuple[Door, str], name: str):
    """One page for all checks of a state: loading it takes longer than they do."""
    state, fake = STATES[name], make_fake()
    state.apply(fake)
    with opened_tab(fake, shared_context, door) as tab:
        page = tab.page
        state.open(page, tab.url)
        found = {"axe": axe_findings(page), f"borders below {BORDER}:1": findings(page, "borders", BORDER)}
        in_theme(page, "bright")
        # Neither colours nor sizes change what axe finds of names, roles and order.
        found["bright, contrast"] = axe_findings(page, "color-contrast")
        found["bright, borders"] = findings(page, "borders", BORDER)
        in_theme(page, "dark")
        count, found["focus"] = focus_findings(page)
        assert count >= LEAST_TABS, "Tab did not go through the page"
        for size in SIZES:
            found[str(size)] = layout_findings(at(page, size))
        found[str(SMALL)] = layout_findings(at(page, SMALL)) + small_findings(page)
        at(page, (1280, 800))
    assert {check: what for check, what in found.items() if what} == {}


def in_theme(page: Page, theme: str) -> None:
    page.evaluate("theme => document.documentElement.dataset.theme = theme", theme)
    settled(page)


def small_findings(page: Page) -> list[str]:
    """A treatment on a small screen: the page says so, shows state, Hold and Disarm, and nothing that arms."""
    if page.get_attribute("#gate", "data-kind") == "out":
        return []
    missing = [one for one in ("#too-small", "#gate-word", "#do-hold", "#do-disarm") if not page.is_visible(one)]
    beside = [one for one in ("#do-arm", "#do-arm-now", "#trace-frame") if page.is_visible(one)]
    return [f"{one} is not shown" for one in missing] + [f"{one} is shown" for one in beside]


def test_a_desk_s_screen_is_not_called_too_small(tab: Tab):
    for size in (*SIZES, (700, 900)):
        tab.page.goto(tab.url)
        at(tab.page, size)
        expect(tab.page.locator("#too-small")).to_be_hidden()


class TestForcedColours:
    """A person's own colours in place of the page's."""

    def test_each_state_of_the_gate_is_reported_by_word_and_shape(
        self, shared_context: BrowserContext, door: tuple[Door, str]
    ):
        words, shapes = {}, {}
        for name in ("idle", "hold", "dwell", "disarmed", "beam-on", "fault", "stale"):
            fake = make_fake()
            STATES[name].apply(fake)
            with opened_tab(fake, shared_context, door) as tab:
                tab.page.emulate_media(forced_colors="active")
                tab.page.set_viewport_size({"width": 1280, "height": 800})
                STATES[name].open(tab.page, tab.url)
                settled(tab.page)
                words[name] = tab.page.inner_text("#gate-word")
                shapes[name] = tab.page.locator(".gate .shape").screenshot()
                assert tint(tab.page, ".gate .shape").spread > 100, f"{name}: the shape is not seen"
        assert len(set(words.values())) == len(words), words
        assert len(set(shapes.values())) == len(shapes)

    @pytest.mark.parametrize("canvas", ["#trace", "#picture", "#grid"])
    def test_what_is_drawn_stays_drawn(self, shared_context: BrowserContext, door: tuple[Door, str], canvas: str):
        fake = make_fake()
        STATES["hold"].apply(fake)
        with opened_tab(fake, shared_context, door) as tab:
            tab.page.emulate_media(forced_colors="active", color_scheme="light")
            tab.page.set_viewport_size({"width": 1920, "height": 1080})  # the map has its place on a large screen
            STATES["hold"].open(tab.page, tab.url)
            tab.page.evaluate("document.documentElement.dataset.theme = 'dark'")
            tab.draws(fake)
            found = tint(tab.page, canvas)
        assert found.median < 130, "the drawing's ground is dark, as its colours need"
        assert found.spread > 100


def test_a_desk_s_text_twice_as_large_fits(chromium: Browser, door: tuple[Door, str]):
    """1280x800 zoomed to 200 %: half as many CSS pixels."""
    context = chromium.new_context(viewport={"width": 640, "height": 400}, color_scheme="dark", device_scale_factor=2)
    fake = make_fake()
    STATES["hold"].apply(fake)
    with opened_tab(fake, context, door) as tab:
        STATES["hold"].open(tab.page, tab.url)
        assert findings(tab.page, "outside") == []
        assert findings(tab.page, "clipped") == []
    context.close()
