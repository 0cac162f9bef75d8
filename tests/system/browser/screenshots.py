"""Pictures of the page for people to look at.

Run: ``python -m tests.system.browser.screenshots OUT`` holds for different reasons.

Not a test: what is wrong with a picture is for eyes. Each shows the page some seconds into a calm breath.
"""

import sys
from pathlib import Path
from typing import Any

from playwright.sync_api import Page, sync_playwright

from tests.support.browser.chromium import launch_chromium
from tests.support.browser.fake_service import (
    BREATH,
    NOTHING_MEASURED,
    FakeService,
    ServerThread,
    alarm,
    breath_hold,
    checks,
    condition,
    phase,
    sample,
    window,
)

SETTLE_MS = 3_000
SIZES = {"": (1280, 800), "-tablet": (1024, 768), "-wide": (1920, 1080)}


def held(**changes: Any) -> dict[str, Any]:
    return BREATH | {"phase_percent": None, "phase_confidence": 0.0} | changes


def event(kind: str, since_s: float, **changes: Any) -> dict[str, Any]:
    return {"kind": kind, "confidence": 0.86, "since_s": since_s, "detail": ""} | changes


BEAM_ON = sample(
    gate="beam_on", hold_reason=None, hold_text=None, hold_detail="", line_on=True, signal_mm=1.2, whole_mm=1.2
)
PICTURES: dict[str, tuple[str, dict[str, Any]]] = {
    "beam-on": ("beam_on", BEAM_ON),
    "outside-window": (
        "hold",
        sample(
            signal_mm=5.4,
            whole_mm=5.4,
            hold_text="Outside the window",
            hold_detail="5.40 mm is not inside -1 to 3 mm",
            breath=BREATH | {"drift": 1.74, "drift_per_s": 0.11, "events": [event("drift", 21.0)]},
        ),
    ),
    "check-missing": (
        "hold",
        sample(
            hold_reason="check_missing",
            hold_text="A check of the measurement cannot work",
            hold_detail="camera, for 4.2 s: too little of couch and floor is seen",
            checks=checks(camera="off", color="never"),
        ),
    ),
    "couch-moved": (
        "disarmed",
        sample(
            gate="disarmed",
            is_armed=False,
            hold_reason="disarmed",
            hold_text="Not armed",
            lost={
                "reason": "camera_moved",
                "detail": "the couch is 2.0 mm from where it was at the reference, the floor has not moved: the couch"
                " has moved, set the reference again",
                "moved": "couch",
                "moved_mm": 2.04,
            },
        ),
    ),
    "breath-hold-settling": (
        "hold",
        sample(
            signal_mm=8.2,
            whole_mm=8.2,
            hold_reason="breath_hold_settling",
            hold_text="Breath held, waiting until it is stable",
            hold_detail="still for 0.6 s; 1 s needed",
            window=window(breath_hold()),
            breath=held(note="the breath is held"),
            breath_hold={"hold": "inspiration", "stage": "settling", "count": 2, "seconds": 0.6}
            | {"settle_s": 1.0, "timeout_s": 25.0},
        ),
    ),
    "breath-held": (
        "beam_on",
        BEAM_ON
        | {
            "signal_mm": 8.2,
            "window": window(breath_hold(stage="held", is_inside=True)),
            "breath": held(note="the breath is held"),
            "breath_hold": {"hold": "inspiration", "stage": "held", "count": 3, "seconds": 11.3}
            | {"settle_s": 1.0, "timeout_s": 25.0},
        },
    ),
    "phase-unknown": (
        "hold",
        sample(
            hold_reason="phase_unknown",
            hold_text="The breathing phase is unknown",
            hold_detail="the breathing is irregular",
            window=window(phase(), condition(lower=-1.0, upper=4.0)),
            breath=held(
                note="the breathing is irregular",
                regularity=0.41,
                events=[event("cough", 0.9), event("irregular", 6.0, detail="breaths of 2.1 to 6.8 s")],
            ),
        ),
    ),
    "beam-line-fault": (
        "fault",
        sample(
            gate="fault",
            is_armed=False,
            hold_reason="beam_line_mismatch",
            hold_text="The beam line's read-back differs from the command",
            hold_detail="told off, reads back on for 103 ms",
            latency_ms={"last": 131.0, "p50": 31.2, "p99": 96.0, "max": 131.0, "warned": True},
        ),
    ),
    "operator-hold": (
        "hold",
        sample(
            hold_reason="operator_hold",
            hold_text="Held by an operator",
            hold_detail="held by C. Nurse",
            operator_hold="C. Nurse",
        ),
    ),
    "operator-hold-too": (
        "hold",
        sample(hold_text="Outside the window", operator_hold="C. Nurse"),
    ),
    "volume": (
        "hold",
        sample(
            window=window(
                condition(signal="volume", label="volume", unit="l", lower=-0.05, upper=0.15, hysteresis=0.01)
            ),
            breath=BREATH | {"signal": "volume", "unit": "l", "amplitude": 0.55, "baseline": -0.02, "drift": 0.08},
            signal_mm=None,
            hold_text="Outside the window",
            hold_detail="0.31 l is not inside -0.05 to 0.15 l",
        ),
    ),
    "nothing-measured": (
        "hold",
        sample(
            **NOTHING_MEASURED
            | {
                "state": "lost",
                "lost": {"reason": "marker_lost", "detail": "the superior left marker was not found"},
                "hold_reason": "marker_lost",
                "hold_text": "A marker is not visible",
                "hold_detail": "the superior left marker was not found",
                "fps": None,
                "latency_ms": dict.fromkeys(("last", "p50", "p99", "max")) | {"warned": False},
            }
        ),
    ),
}


def take(page: Page, fake: FakeService, out: Path, url: str) -> None:
    """Take every picture at the size of a desk, one at others, and the form."""
    for name, (kind, message) in PICTURES.items():
        fake.sample, fake.is_breathing = message, False
        _show(page, url, kind)
        page.screenshot(path=out / f"{name}.png")
    _take_alarms(page, fake, out, url)
    for suffix, (width, height) in SIZES.items():
        page.set_viewport_size({"width": width, "height": height})
        fake.sample = PICTURES["breath-hold-settling"][1]
        _show(page, url, "hold", settle_ms=1_500)
        page.screenshot(path=out / f"size{suffix}.png")
        page.click("#do-setup")
        page.click("#more-settings summary")
        page.click("#add-condition")
        page.select_option("[name='window.further.0.kind']", "breath_hold")
        page.click("#add-condition")
        page.select_option("[name='window.further.1.kind']", "phase")
        page.screenshot(path=out / f"form{suffix}.png")


def _take_alarms(page: Page, fake: FakeService, out: Path, url: str) -> None:
    """A latched fault, and alarms of all three priorities, one of them acknowledged."""
    fake.sample = PICTURES["beam-line-fault"][1] | {
        "hold_reason": "source_lost",
        "hold_text": "The camera is disconnected",
        "hold_detail": "the camera delivers no frames",
    }
    beam = alarm(1, "beam_without_permit", "high", "The accelerator reports beam on without a permit", latches=True)
    fake.alarms = (
        beam | {"detail": "beam on 310 ms after the permit ended: at most 250 ms are allowed"},
        alarm(2, "source_lost", "medium", "The camera is disconnected", latches=True, age_s=75.0),
        alarm(3, "permit_without_beam", "low", "The beam is permitted, and the accelerator delivers none", age_s=190.0)
        | {"acknowledged_by": "B. Physicist"},
    )
    _show(page, url, "fault")
    page.screenshot(path=out / "alarms.png")
    fake.alarms = ()


def _show(page: Page, url: str, kind: str, *, settle_ms: int = SETTLE_MS) -> None:
    page.goto(url)
    page.locator(f"#gate[data-kind={kind}]").wait_for()
    page.wait_for_timeout(settle_ms)


def main(out: Path) -> None:
    """Write the pictures."""
    out.mkdir(parents=True, exist_ok=True)
    fake = FakeService()
    fake.sessions[0]["window"] = None  # each picture has a window of its own
    fake.mode = "samples"
    with ServerThread(fake.app()) as server, sync_playwright() as playwright:
        browser = launch_chromium(playwright, is_shell=False)
        take(browser.new_page(viewport={"width": 1280, "height": 800}), fake, out, server.url)
        fake.is_up = False
        browser.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
