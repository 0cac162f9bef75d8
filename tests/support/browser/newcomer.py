"""A newcomer at the console: does only what the page says, on a prepared plan, by mouse or by keyboard alone.

It logs in, sets up the first plan of the work list, fills fields that are empty, presses the button that is marked as
the next one, and looks at window and summary.
"""

from dataclasses import dataclass, field
from typing import Protocol

from playwright.sync_api import Page, expect

LOOK_MS = 250
ACCEPTS = "#do-arm-now:visible:enabled:not([aria-disabled=true])"
FAILED = ".outcome[data-kind=failed]:visible:not(:empty)"


class Hands(Protocol):
    """How a newcomer reaches what the page shows."""

    def press(self, page: Page, selector: str) -> None:
        """Press a button."""

    def fill(self, page: Page, selector: str, text: str) -> None:
        """Type a text into a field."""

    def choose(self, page: Page, selector: str, value: str) -> None:
        """Choose an option of a list."""


class Mouse:
    """Real clicks, and the page's own lists."""

    def press(self, page: Page, selector: str) -> None:
        """Click."""
        page.click(selector)

    def fill(self, page: Page, selector: str, text: str) -> None:
        """Click and type."""
        page.fill(selector, text)

    def choose(self, page: Page, selector: str, value: str) -> None:
        """Choose in the list."""
        page.select_option(selector, value)


@dataclass
class Keyboard:
    """Tab to everything, and only forwards; notes how many Tabs each thing took."""

    tabs: list[tuple[str, int]] = field(default_factory=list)
    most: int = 60

    def press(self, page: Page, selector: str) -> None:
        """Tab to it, then Enter."""
        self._reach(page, selector)
        page.keyboard.press("Enter")

    def fill(self, page: Page, selector: str, text: str) -> None:
        """Tab to it and type."""
        self._reach(page, selector)
        page.keyboard.type(text)

    def choose(self, page: Page, selector: str, value: str) -> None:
        """Tab to it, and down until the option is chosen."""
        self._reach(page, selector)
        for _ in range(self.most):
            if page.input_value(selector) == value:
                return
            page.keyboard.press("ArrowDown")
        raise AssertionError(f"{value} is not reached in {selector}")

    def _reach(self, page: Page, selector: str) -> None:
        """Tab on; a Tab while a late frame has it disabled passes it by, so that way is not counted."""
        passed_by = 0
        for count in range(2 * self.most):
            state = page.locator(selector).first.evaluate(
                "(element) => [element === document.activeElement, Boolean(element.disabled)]"
            )
            if state[0]:
                self.tabs.append((selector, 0 if passed_by else count))
                return
            passed_by += state[1]
            page.keyboard.press("Tab")
        focus = page.evaluate("document.activeElement.outerHTML.slice(0, 200)")
        raise AssertionError(f"{2 * self.most} Tabs do not reach {selector}; the focus is on {focus}")


@dataclass
class Newcomer:
    """Reads the page and counts what it had to do."""

    page: Page
    name: str
    password: str
    hands: Hands = field(default_factory=Mouse)
    fields: list[str] = field(default_factory=list)
    presses: list[str] = field(default_factory=list)
    decisions: list[str] = field(default_factory=list)
    wrong_turns: list[str] = field(default_factory=list)

    def gates(self) -> bool:
        """Do the next thing; return whether the beam is permitted."""
        page = self.page
        if page.get_attribute("#gate", "data-kind") == "beam_on":
            return True
        if page.is_visible("#log-in"):
            self._log_in()
        elif page.is_visible("#new-session"):
            self._set_up()
        elif page.is_visible("#arming"):
            self._arm()
        elif page.locator("button[data-next=yes]:enabled").count() == 1:
            self._press_next(page.get_attribute("button[data-next=yes]", "id") or "")
        page.wait_for_timeout(LOOK_MS)
        return False

    def _log_in(self) -> None:
        self.hands.fill(self.page, "#log-in [name=name]", self.name)
        self.hands.fill(self.page, "#log-in [name=password]", self.password)
        self._press("#log-in [type=submit]")
        self.page.wait_for_selector("#access", state="hidden")

    def _set_up(self) -> None:
        """Take the first plan of the work list, and choose what the form has no proposal for."""
        page = self.page
        self._press("#plan-list li:first-child button")
        self.decisions.append("plan")
        expect(page.locator("[name=fraction_number]")).not_to_have_value("")
        for name in ("source", "calibration_id"):
            if page.input_value(f"[name={name}]") == "":
                self._choose(name)
        self._press("#new-session [type=submit]")
        assert not self.wrong_turns, (self.wrong_turns, self.presses)
        page.wait_for_selector("#setup", state="hidden")

    def _choose(self, name: str) -> None:
        values = self.page.eval_on_selector_all(
            f"[name={name}] option:not(:disabled)", "all => all.map((one) => one.value)"
        )
        wanted = next(one for one in values if one and one not in {"device:", "built-in"})
        self.hands.choose(self.page, f"[name={name}]", wanted)
        self.fields.append(name)

    def _press_next(self, button: str) -> None:
        if button == "do-reference":
            if self.page.inner_text("#reference-proposal").startswith("Two breaths"):
                return
            self.decisions.append("reference")
        self._press(f"#{button}")
        if button == "do-window":
            self.decisions.append("window")
            # On a busy machine the recording may end first.
            self.page.locator("#window-forecast:not(:empty)").or_(self.page.locator("#report:visible")).wait_for(
                state="attached"
            )
            if self.page.is_visible("#window-cancel"):  # it closes by itself where frames are late
                self._press("#window-cancel")

    def _arm(self) -> None:
        """Read the summary; the button ignores presses until it has been shown for 2 s. By keyboard it takes two."""
        self.page.locator("#arming").evaluate("one => { one.scrollTop = one.scrollHeight; }")
        if self.page.locator(ACCEPTS).count() == 0:
            return
        self.decisions.append("arming")
        self._press("#do-arm-now")
        if self.page.locator(ACCEPTS).count() > 0:
            self._press("#do-arm-now")

    def _press(self, selector: str) -> None:
        self.hands.press(self.page, selector)
        self.presses.append(selector)
        self.page.wait_for_timeout(LOOK_MS)
        failed = self.page.locator(FAILED)
        if failed.count() > 0:
            self.wrong_turns.append(f"{selector}: {failed.first.inner_text()}")
