"""Arms as a person does: opens the summary, waits until it may be confirmed, and confirms it."""

from playwright.sync_api import Page, expect

from tests.support.browser.stepped_page import SteppedPage

ACCEPTS = "#do-arm-now:enabled:not([aria-disabled])"


def press_arm(page: Page) -> None:
    """Arm on a page whose time runs."""
    page.click("#do-arm")
    expect(page.locator(ACCEPTS)).to_be_visible()
    page.click("#do-arm-now")


def press_arm_stepped(stepped: SteppedPage) -> None:
    """Arm on a page whose time the test moves."""
    stepped.page.click("#do-arm")
    stepped.advance_until(lambda: stepped.page.locator(ACCEPTS).count())
    stepped.page.click("#do-arm-now")
