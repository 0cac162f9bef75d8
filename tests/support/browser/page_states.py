"""Every state of the operator's page, by name: what the controller says, and what a person opened.

What each shows does not move, so that a check and a picture see the same page each time.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from playwright.sync_api import Page, expect

from tests.support.browser.fake_coach import FakeConsole
from tests.support.browser.fake_service import (
    BREATH,
    NOTHING_MEASURED,
    PLAN,
    PROPOSAL,
    SESSION,
    FakeService,
    alarm,
    breath_hold,
    over,
    person,
    phase,
    qa_run,
    qa_status,
    sample,
    summary,
    window,
)
from tests.support.browser.models import give_model

OLD_MS = 90_000.0
"""Beyond the limit of a page with relaxed times: the camera's newest frame is too old, and stays so."""
PROPOSALS = [
    PROPOSAL | {"level": -1.0, "percent": 0.0},
    PROPOSAL | {"at": "end_inhale", "level": 9.0, "percent": 100.0},
]
HOLDS = [
    {"reason": "outside_window", "text": "Outside the window", "count": 134},
    {"reason": "breath_hold_settling", "text": "Breath held, waiting until it is stable", "count": 21},
    {"reason": "phase_unknown", "text": "The breathing phase is unknown", "count": 12},
    {"reason": "marker_lost", "text": "A marker is not visible", "count": 2},
]

DISARMED = sample(gate="disarmed", is_armed=False, hold_reason="disarmed", hold_text="Not armed", hold_detail="")
BEAM_ON = sample(
    gate="beam_on",
    hold_reason=None,
    hold_text=None,
    hold_detail="",
    line_on=True,
    signal_mm=1.2,
    whole_mm=1.2,
    armed_by="A. Therapist",
)
FAULT = sample(
    gate="fault",
    is_armed=False,
    hold_reason="beam_line_mismatch",
    hold_text="The beam line's read-back differs from the command",
    hold_detail="commanded off, reads back on for 103 ms",
    latency_ms={"last": 131.0, "p50": 31.2, "p99": 96.0, "max": 131.0, "warned": True},
)
LOST = sample(
    **NOTHING_MEASURED
    | {
        "state": "lost",
        "lost": {"reason": "marker_lost", "detail": "the superior left marker was not found"},
        "hold_reason": "marker_lost",
        "hold_text": "A marker is not visible",
        "hold_detail": "the superior left marker was not found",
    }
)
TRAINING = (
    DISARMED
    | NOTHING_MEASURED
    | {
        "state": "training",
        "training": {"frames": 140, "cycles": 2, "seconds": 7.2, "share": 0.46, "note": "two more breaths"},
        "hold_reason": "no_model",
        "hold_text": "No model yet",
    }
)
HELD_BREATH = {
    "window": window(breath_hold(stage="held", is_inside=True), phase()),
    "breath": BREATH | {"phase_percent": None, "phase_confidence": 0.0, "note": "the breath is held"},
    "breath_hold": {"hold": "inspiration", "stage": "held", "count": 3, "seconds": 11.3}
    | {"settle_s": 1.0, "timeout_s": 25.0},
}
SETTLING = sample(
    signal_mm=8.2,
    whole_mm=8.2,
    hold_reason="breath_hold_settling",
    hold_text="Breath held, waiting until it is stable",
    hold_detail="still for 0.6 s; 1 s needed",
    window=window(breath_hold()),
    breath=HELD_BREATH["breath"],
    breath_hold=HELD_BREATH["breath_hold"] | {"stage": "settling", "count": 2, "seconds": 0.6},
)


@dataclass(frozen=True)
class PageState:
    """A state: the gate's panel shows ``kind``; ``prepare`` changes the controller, ``act`` is done on the page."""

    kind: str
    message: dict[str, Any] | None = None
    prepare: Callable[[FakeService], None] = lambda _fake: None
    act: Callable[[Page], None] = lambda _page: None
    shown: str = "#gate"
    closes_set_up: bool = False

    def apply(self, fake: FakeService) -> None:
        """Let the controller be in this state."""
        fake.sessions[0] |= {"reference_proposals": list(PROPOSALS), "summary": summary(holds=HOLDS), "gate": None}
        fake.mode = "idle" if self.message is None else "samples"
        if self.message is not None:
            fake.sample = self.message
        self.prepare(fake)

    def open(self, page: Page, url: str) -> None:
        """Load the page and bring it into this state."""
        page.goto(url)
        expect(page.locator("#gate")).to_have_attribute("data-kind", self.kind)
        if self.closes_set_up:
            expect(page.locator("#setup")).to_be_visible()
            page.evaluate("document.querySelector('#setup-close').click()")
        self.act(page)
        expect(page.locator(self.shown).first).to_be_visible()


def _sessions(fake: FakeService) -> None:
    created = SESSION | {"id": "88" * 16, "status": "created", "patient_reference": "P-0300", "fraction_id": "FX-01"}
    fake.sessions[:] = [created, over(), over("interrupted") | {"id": "77" * 16}, over() | {"id": "66" * 16}]
    fake.plans = [dict(PLAN)]
    fake.qa = qa_status("no daily QA in 24 h", 24.0, daily=qa_run("daily", "fail"), monthly=qa_run("monthly", "pass"))


def _plans(fake: FakeService) -> None:
    """The plans of a day: one to go on with, one that was interrupted, a new one, one that is done."""
    fake.sessions[:] = [over(), over("interrupted") | {"id": "77" * 16, "patient_reference": "P-0121"}]
    last = {"id": "77" * 16, "status": "stopped", "fraction_number": 2, "started_at": "2026-11-20T09:12:00Z"}
    others = [
        {"patient_reference": "P-0093", "label": "BREAST_DIBH", "next_fraction": 11, "last_session": last},
        {"patient_reference": "P-0121", "label": "LIVER", "last_session": last | {"status": "interrupted"}},
        {"patient_reference": "P-0102", "label": "LUNG_RIGHT", "next_fraction": 16, "last_session": last},
    ]
    fake.plans = [dict(PLAN), *(PLAN | {"id": f"{number}b" * 16} | one for number, one in enumerate(others))]


def _created(fake: FakeService) -> None:
    fake.sessions[:] = [SESSION | {"status": "created"}]


def _alarms(fake: FakeService) -> None:
    beam = alarm(1, "beam_without_permit", "high", "The accelerator reports beam on without a permit", latches=True)
    low = alarm(
        3, "permit_without_beam", "low", "The beam is permitted, and the accelerator delivers none", age_s=190.0
    )
    fake.alarms = (
        beam | {"detail": "beam on 310 ms after the permit ended: at most 250 ms are allowed"},
        alarm(2, "source_lost", "medium", "The camera is disconnected", latches=True, age_s=75.0),
        low | {"acknowledged_by": "B. Physicist"},
    )


def _logged_out(fake: FakeService) -> None:
    fake.person = None


def _locked_out(fake: FakeService) -> None:
    fake.person = None
    fake.locked_s = 42


def _log_in_wrongly(page: Page) -> None:
    page.fill("#log-in [name=name]", "A. Therapist")
    page.fill("#log-in [name=password]", "not the password")
    page.click("#log-in [name=submit]")
    expect(page.locator("#log-in-outcome")).not_to_be_empty()


def _must_change(fake: FakeService) -> None:
    fake.person = person(must_change_password=True)


def _events(fake: FakeService) -> None:
    """The gate was armed, and then followed four breaths; the newest first."""
    armed = {"action": "session.arm", "actor": "A. Therapist", "outcome": "done", "detail": {}}
    states = [("hold", "outside_window"), ("beam_on", None)] * 4
    moved = [
        {"action": "gate.transition", "actor": "tidegate", "outcome": "done"}
        | {"detail": {"from_state": "dwell", "to_state": state, "reason": reason}}
        for state, reason in states
    ]
    fake.audit = [
        one | {"sequence": 40 - i, "session_id": SESSION["id"], "at": f"2026-11-21T03:00:{40 - 2 * i:02}.120Z"}
        for i, one in enumerate([*moved, armed])
    ]


def _open_arming(page: Page) -> None:
    page.locator("#do-arm:enabled:not([aria-disabled])").click()
    expect(page.locator("#arming-items div").first).to_be_visible()


def _open_more(page: Page) -> None:
    page.click("#more-settings summary")
    page.click("#add-condition")
    page.select_option("[name='window.further.0.kind']", "breath_hold")


def _open_quality(page: Page) -> None:
    page.click("#steps .to-quality")
    expect(page.locator("#quality-maps")).to_be_visible()


def _press(selector: str) -> Callable[[Page], None]:
    return lambda page: page.locator(selector).click()


STATES: dict[str, PageState] = {
    "idle": PageState("idle", prepare=lambda fake: fake.sessions.clear(), closes_set_up=True),
    "work-list": PageState("idle", prepare=_plans, shown="#plan-list li"),
    "set-up": PageState("idle", prepare=_sessions, act=_press("#do-setup"), shown="#setup"),
    "set-up-more": PageState(
        "idle", prepare=lambda fake: fake.sessions.clear(), act=_open_more, shown="#more-settings"
    ),
    "created": PageState("idle", prepare=_created, shown="#steps"),
    "summary": PageState(
        "idle",
        prepare=lambda fake: fake.sessions.__setitem__(slice(None), [over()]),
        shown="#report",
        closes_set_up=True,
    ),
    "interrupted": PageState(
        "idle",
        prepare=lambda fake: fake.sessions.__setitem__(
            slice(None), [over("interrupted", status_detail="the service ended while this session ran")]
        ),
        shown="#report",
    ),
    "training": PageState("disarmed", TRAINING, shown="#steps"),
    "disarmed": PageState("disarmed", DISARMED, prepare=_events, shown="#steps"),
    "model-quality": PageState("disarmed", DISARMED, prepare=give_model, act=_open_quality, shown="#quality"),
    "window-editor": PageState("disarmed", DISARMED, act=_press("#do-window"), shown="#window-editor"),
    "arming": PageState("disarmed", DISARMED, act=_open_arming, shown="#arming"),
    "hold": PageState(
        "hold", sample(hold_detail="5.40 mm is not inside -1 to 3 mm", armed_by="A. Therapist"), prepare=_events
    ),
    "operator-hold": PageState(
        "hold",
        sample(
            hold_reason="operator_hold",
            hold_text="Held by an operator",
            hold_detail="held by C. Nurse",
            operator_hold="C. Nurse",
        ),
    ),
    "marker-lost": PageState("hold", LOST),
    "dwell": PageState("dwell", sample(gate="dwell", hold_reason="dwell", hold_text=None, hold_detail="")),
    "beam-on": PageState("beam_on", BEAM_ON, prepare=_events),
    "breath-held": PageState("beam_on", BEAM_ON | HELD_BREATH, shown="#breath-hold"),
    "breath-settling": PageState("hold", SETTLING, shown="#breath-hold"),
    "fault": PageState("fault", FAULT),
    "alarms": PageState("fault", FAULT, prepare=_alarms, shown="#alarms"),
    "stale": PageState("stale", sample(age_ms=OLD_MS)),
    "keys": PageState("hold", sample(), act=_press("#do-keys"), shown="#keys"),
    "logged-out": PageState("out", prepare=_logged_out, shown="#log-in"),
    "log-in-refused": PageState("out", prepare=_logged_out, act=_log_in_wrongly, shown="#log-in"),
    "locked-out": PageState("out", prepare=_locked_out, act=_log_in_wrongly, shown="#log-in"),
    "change-password": PageState("out", prepare=_must_change, shown="#change-password"),
    "patient-screen": PageState(
        "disarmed", DISARMED, act=lambda page: page.locator("#do-coach").click(), shown="#coach"
    ),
}


def make_fake() -> FakeConsole:
    """A controller for these states: with a patient's screen."""
    return FakeConsole()
