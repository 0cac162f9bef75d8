"""The sounds of alarms: by priority, never quieter than can be heard, silenced for a limited time and visibly."""

import itertools
from typing import Any

import pytest
from playwright.sync_api import Page

from tests.support.browser.fake_service import FakeService, alarm, sample
from tests.support.browser.stepped_page import SteppedPage

pytestmark = [pytest.mark.browser, pytest.mark.verification]

HIGH = alarm(1, "beam_without_permit", "high", "The accelerator reports beam on without a permit", latches=True)
MEDIUM = alarm(2, "patient_shifted", "medium", "The patient has moved on the couch")
MEDIUM_TOO = alarm(5, "camera_moved", "medium", "The camera or the couch has moved")
LOW = alarm(3, "marker_lost", "low", "A marker is not visible")
# An audio context that plays nothing and notes what it is asked to play; `allowed` is the browser's policy.
STUB = """(() => {
  window.audio = { allowed: true, pulses: [], stopped: 0 };
  const param = (set) => ({ set value(to) { set(to); }, setValueAtTime(v, at) { set(v, at); },
    linearRampToValueAtTime(v, at) { set(v, at); } });
  window.AudioContext = class {
    constructor() { this.isRunning = window.audio.allowed; this.destination = {}; }
    get state() { return this.isRunning ? "running" : "suspended"; }
    get currentTime() { return performance.now() / 1000; }
    resume() { this.isRunning = true; return Promise.resolve(); }
    createPeriodicWave(real, imag) { return { harmonics: imag.length - 1 }; }
    createGain() {
      const gain = { peak: 0, connect() {} };
      gain.gain = param((v) => { gain.peak = Math.max(gain.peak, v); });
      return gain;
    }
    createOscillator() {
      const pulse = { hz: 0, gain: null, from: 0, to: 0, harmonics: 0 };
      let hasBegun = false;
      return {
        frequency: param((v) => { pulse.hz = v; }),
        setPeriodicWave(wave) { pulse.harmonics = wave.harmonics; },
        connect(gain) { pulse.gain = gain; },
        addEventListener() {},
        start(at) { hasBegun = true; pulse.from = at; window.audio.pulses.push(pulse); },
        stop(at) { if (at === undefined) window.audio.stopped += 1; else pulse.to = at; },
      };
    }
  };
})()"""


def pulses(page: Page) -> list[dict[str, Any]]:
    """Return what was played since the last call."""
    found: list[dict[str, Any]] = page.evaluate(
        "() => window.audio.pulses.splice(0).map(one => ({...one, gain: one.gain.peak}))"
    )
    return found


def open_page(stepped: SteppedPage, *, allowed: bool = True) -> Page:
    stepped.page.add_init_script(STUB)
    if not allowed:
        stepped.page.add_init_script("window.audio.allowed = false")
    return stepped.open(sample())


def test_no_alarm_no_sound(stepped: SteppedPage):
    page = open_page(stepped)
    stepped.advance(2000)
    assert pulses(page) == []


@pytest.mark.parametrize(("one", "count", "hz"), [(HIGH, 10, 660), (MEDIUM, 3, 440), (LOW, 2, 330)])
def test_each_priority_has_its_own_pulses_and_pitch(
    fake: FakeService, stepped: SteppedPage, one: dict[str, Any], count: int, hz: int
):
    page = open_page(stepped)
    fake.alarms = (one,)
    stepped.advance(600)
    played = pulses(page)
    assert [(pulse["hz"], pulse["harmonics"]) for pulse in played] == [(hz, 5)] * count
    assert all(0.1 < pulse["to"] - pulse["from"] < 0.25 for pulse in played)
    assert all(after["from"] > before["to"] for before, after in itertools.pairwise(played))
    assert page.locator("#alarms li").count() == 1


def test_the_sound_comes_again_until_a_person_acknowledges(fake: FakeService, stepped: SteppedPage):
    page = open_page(stepped)
    fake.alarms = (HIGH,)
    stepped.advance(13_000)
    assert len(pulses(page)) == 30
    fake.alarms = (HIGH | {"acknowledged_by": "A. Therapist"},)
    stepped.advance(400)
    pulses(page)
    stepped.advance(7000)
    assert pulses(page) == []


def test_a_more_urgent_alarm_sounds_at_once(fake: FakeService, stepped: SteppedPage):
    page = open_page(stepped)
    fake.alarms = (LOW,)
    stepped.advance(1000)
    pulses(page)
    fake.alarms = (HIGH, LOW)
    stepped.advance(400)
    assert {pulse["hz"] for pulse in pulses(page)} == {660}


def test_silence_is_shown_and_ends_by_itself(fake: FakeService, stepped: SteppedPage):
    stepped.step_ms = 200
    page = open_page(stepped)
    fake.alarms = (MEDIUM,)
    stepped.advance(600)
    page.locator("#do-silence").click()
    pulses(page)
    stepped.advance(10_000)
    assert pulses(page) == []
    assert page.locator("#do-sound").inner_text().startswith("Silenced 1:")
    assert page.get_attribute("body", "data-sound") == "silenced"
    stepped.page.clock.fast_forward(115_000)
    stepped.page.clock.run_for(200)
    assert pulses(page) != []


@pytest.mark.parametrize(("second", "is_heard"), [(LOW, False), (MEDIUM_TOO, True), (HIGH, True)])
def test_a_new_alarm_as_urgent_ends_the_silence(
    fake: FakeService, stepped: SteppedPage, second: dict[str, Any], is_heard: bool
):
    page = open_page(stepped)
    fake.alarms = (MEDIUM,)
    stepped.advance(600)
    page.locator("#do-silence").click()
    pulses(page)
    fake.alarms = (second, MEDIUM)
    stepped.advance(10_000)
    assert (pulses(page) != []) is is_heard


def test_what_the_browser_does_not_play_is_stated(fake: FakeService, stepped: SteppedPage):
    page = open_page(stepped, allowed=False)
    fake.alarms = (HIGH,)
    stepped.advance(1000)
    assert pulses(page) == []
    assert page.locator("#do-sound").inner_text() == "Sound is off until you click"
    page.locator("#do-sound").click()
    stepped.advance(6400)
    assert page.locator("#do-sound").inner_text() == "Sound 80 %"
    assert pulses(page) != []


@pytest.mark.parametrize(("stored", "percent"), [("0", 40), ("-5", 40), ("60", 60), ("900", 100), ("loud", 80)])
def test_the_volume_is_kept_and_never_below_what_is_heard(
    fake: FakeService, stepped: SteppedPage, stored: str, percent: int
):
    stepped.page.add_init_script(f"localStorage.setItem('tidegate.volume', '{stored}')")
    page = open_page(stepped)
    fake.alarms = (HIGH,)
    stepped.advance(600)
    assert {round(pulse["gain"], 3) for pulse in pulses(page)} == {round(percent / 200, 3)}


def test_each_priority_can_be_tested(stepped: SteppedPage):
    page = open_page(stepped)
    page.locator("#do-sound").click()
    for priority, count in (("high", 10), ("medium", 3), ("low", 2)):
        page.locator(f"#sound-test-{priority}").click()
        assert len(pulses(page)) == count


def test_a_page_that_loses_an_armed_gate_sounds_and_one_that_lost_no_armed_one_does_not(
    fake: FakeService, stepped: SteppedPage
):
    page = open_page(stepped)
    fake.mode = "silent"
    stepped.advance(600)
    assert {pulse["hz"] for pulse in pulses(page)} == {440}
    stepped.shows(sample(gate="disarmed", is_armed=False, hold_reason="disarmed"))
    pulses(page)
    fake.mode = "silent"
    stepped.advance(10_000)
    assert pulses(page) == []
