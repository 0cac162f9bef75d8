"""A page whose script hangs shows nothing of before: a cover closes in the browser's own compositor."""

import numpy as np
import numpy.typing as npt
import pytest

from tests.support.browser.fake_coach import FakeCoach, guide
from tests.support.browser.fake_service import FakeService, sample
from tests.support.browser.screencast import HANG, Screencast
from tests.support.browser.tab import Tab

pytestmark = [pytest.mark.browser, pytest.mark.verification]


def green_share(picture: npt.NDArray[np.int_]) -> float:
    """Return the share of the gate panel (the upper left of the screen, beside its frame) that is green."""
    height, width = picture.shape[:2]
    gate = picture[int(0.11 * height) : int(0.48 * height), int(0.02 * width) : int(0.24 * width)]
    blue, green, red = gate[..., 0], gate[..., 1], gate[..., 2]
    return float(np.mean((green > red + 30) & (green > blue + 20)))


def lit_share(picture: npt.NDArray[np.int_]) -> float:
    """Return the share of the screen that is not black."""
    return float(np.mean(picture.max(axis=-1) > 40))


def test_the_cover_closes_over_a_green_gate_when_the_script_hangs(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", sample(gate="beam_on", hold_reason=None, hold_text=None, line_on=True)
    tab.open("beam_on")
    screen = Screencast(tab, green_share)
    screen.await_share(lambda share: share > 0.7, "the gate is not shown")
    fake.is_hung.set()
    try:
        tab.page.evaluate(HANG)
        screen.await_share(lambda share: share < 0.01, "the cover does not close")
        screen.watch(1.0)
        assert screen.share() < 0.01, "it stays closed"
    finally:
        fake.is_hung.clear()
    tab.sees("beam_on")
    screen.await_share(lambda share: share > 0.7, "the cover does not open again once the page is alive")


def test_a_patient_s_screen_is_black_when_its_script_hangs(coach: FakeCoach, patient_tab: Tab):
    coach.is_relaxed, coach.guide = False, guide(level=0.7, instruction="hold", countdown_s=9.0)
    patient_tab.page.goto(patient_tab.url)
    screen = Screencast(patient_tab, lit_share)
    screen.await_share(lambda share: share > 0.05, "the guidance is not shown")
    coach.is_hung.set()
    try:
        patient_tab.page.evaluate(HANG)
        screen.await_share(lambda share: share == 0.0, "the cover does not close")
        screen.watch(1.0)
        assert screen.share() == 0.0, "it stays closed"
    finally:
        coach.is_hung.clear()
    screen.await_share(lambda share: share > 0.05, "the cover does not open again once the page is alive")
