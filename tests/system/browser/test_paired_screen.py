"""A screen on the real service's own page, cookies and sockets; the engine's frames are the test's."""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from playwright.sync_api import Browser, BrowserContext, Page, expect

from engine.core.breath import WHOLE
from engine.core.gate_state import GateState, HoldReason
from engine.gating.windows import ConditionState, HoldStage
from service.web.app import PATIENT
from tests.support.service.guided_patient import HOLD, LEARNED
from tests.support.stream.stream_server import Served, served

pytestmark = [pytest.mark.browser, pytest.mark.verification]


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Served]:
    with served(tmp_path) as one:
        session_id = one.begin_session()
        one.running.window, one.running.learned_ranges = HOLD, {WHOLE: LEARNED}
        yield one
        one.end_session(session_id)


@pytest.fixture
def page(chromium: Browser) -> Iterator[Page]:
    context: BrowserContext = chromium.new_context(viewport={"width": 1280, "height": 800})
    yield context.new_page()
    context.close()


def come(service: Served, level_mm: float, stage: HoldStage) -> None:
    """Let a frame come that was received now."""
    service.running.conditions = (ConditionState(stage=stage),)
    service.running.frame(whole_mm=level_mm)
    view = service.running.latest
    assert view is not None
    service.running.latest = replace(view, record=replace(view.record, received_ns=time.monotonic_ns()))


def await_screen(service: Served, page: Page, is_so: Callable[[], bool], level_mm: float, stage: HoldStage) -> None:
    """Let frames come until the screen shows that."""
    end_s = time.monotonic() + 60.0
    while not is_so():
        assert time.monotonic() < end_s, page.content()
        come(service, level_mm, stage)
        page.wait_for_timeout(20)


def test_a_screen_is_paired_guides_the_armed_patient_and_is_ended(service: Served, page: Page):
    with service.http() as http:
        code = http.post("/api/v1/coach/code", json={}).json()["code"]
        page.goto(f"http://127.0.0.1:{service.port}{PATIENT}")
        page.fill("#pair-code", code)
        page.keyboard.press("Enter")
        expect(page.locator("#guide")).to_have_attribute("data-show", "wait")
        service.running.gate, service.running.reason = GateState.HOLD, HoldReason.BREATH_HOLD_AWAITED
        word = page.locator("#guide .word")
        for level_mm, stage, text in ((5.0, HoldStage.AWAITED, "Breathe in"), (16.0, HoldStage.HELD, "Hold")):
            await_screen(service, page, lambda text=text: word.text_content() == text, level_mm, stage)
        cookies = {one["name"]: one for one in page.context.cookies()}
        assert cookies.keys() == {"tidegate_screen"}
        assert (cookies["tidegate_screen"]["httpOnly"], cookies["tidegate_screen"]["sameSite"]) == (True, "Strict")
        assert page.evaluate("fetch('/api/v1/sessions').then((answer) => answer.status)") == 401
        page.reload()
        await_screen(service, page, lambda: word.text_content() == "Hold", 16.0, HoldStage.HELD)
        (screen,) = http.get("/api/v1/coach/screens").json()["items"]
        assert http.post(f"/api/v1/coach/screens/{screen['id']}/end", json={}).status_code == 200
        expect(page.locator("#pair")).to_be_visible()
        assert "Hold" not in (page.locator("#guide").text_content() or "")
