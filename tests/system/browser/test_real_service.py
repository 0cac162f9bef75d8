"""End to end: a real `tidegate serve`, people who log in, a volunteer played in real time, gated on the page.

The volunteer is gated over the service's own TLS, as in a clinic; the first start is on this machine, without.
"""

import contextlib
import json
import os
import re
import shutil
import socket
import ssl
import subprocess
import sysconfig
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, BrowserContext, Page, Playwright, TimeoutError as BrowserTimeoutError, expect

from tests.support.access.tls_certificate import make_certificate
from tests.support.browser.chromium import launch_chromium, trust
from tests.support.browser.newcomer import Keyboard, Newcomer
from tests.support.browser.tab import Tab
from tests.support.planning.api_calls import DICOM
from tests.support.planning.dicom_plans import motion, photon_plan, setup, written
from tests.support.service.accounts import EVERY_ROLE, provision
from tests.support.waiting import PATIENCE_S, eventually

pytestmark = [pytest.mark.browser, pytest.mark.slow, pytest.mark.waiting, pytest.mark.verification]

COMMAND = Path(sysconfig.get_path("scripts")) / "tidegate"
OPERATOR = "A. Therapist"
PASSWORD = "a password of a therapist"
# Around the reference, where every breath comes by, and narrower than any breath.
WINDOW = {"signal": "whole", "lower_mm": -2.0, "upper_mm": 2.0, "hysteresis_mm": 0.1, "dwell_ms": 200.0}

# As patient as a site may be: this test is about the page, and runs beside others.
PATIENCE = {
    "TIDEGATE_MAX_FRAME_AGE_MS": "200",
    "TIDEGATE_MAX_GAP_MS": "200",
    "TIDEGATE_MAX_LAG_MS": "500",
    "TIDEGATE_MAX_SILENCE_MS": "2000",
    "TIDEGATE_WATCHDOG_MS": "500",
    "TIDEGATE_LEASE_MS": "200",
}
WANTED = {("hold", "Hold", "hold"), ("dwell", "Dwell", "dwell"), ("beam_on", "Beam permitted", "beam_on")}
MOST_TABS = 10
START_S = 140.0

# Notes each state of the gate as it is drawn, and whether one can arm in each phase of the learning: a dwell may be
# over before a test looks again, and on a slow machine all of the learning.
REMEMBER_STATES = """() => {
  const gate = document.querySelector('#gate');
  const learning = document.querySelector('#learning');
  window.seen = [];
  window.armable = {};
  const learn = () => { window.armable[learning.dataset.phase] = !document.querySelector('#do-arm').disabled; };
  new MutationObserver(learn).observe(learning, {attributes: true, attributeFilter: ['data-phase']});
  const note = () => {
    const shape = [...gate.querySelectorAll('[data-shape]')].filter(e => getComputedStyle(e).display !== 'none');
    window.seen.push([gate.dataset.kind, gate.querySelector('#gate-word').textContent, shape[0].dataset.shape]);
  };
  new MutationObserver(note).observe(gate, {attributes: true, attributeFilter: ['data-kind']});
}"""


class Controller:
    """A `tidegate serve` process with one person, and its HTTP API as the planning software calls it."""

    def __init__(
        self, data: Path, recordings: Path, *, is_new: bool = False, tls: tuple[Path, Path] | None = None
    ) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        self.url = f"{'http' if tls is None else 'https'}://127.0.0.1:{port}"
        self._trusted = None if tls is None else ssl.create_default_context(cafile=tls[0])
        spoken = {} if tls is None else {"TIDEGATE_TLS_CERT": str(tls[0]), "TIDEGATE_TLS_KEY": str(tls[1])}
        self._key = {} if is_new else self._let_in(data)
        self.log = data.with_name("log")
        command = [COMMAND, "serve", "--port", str(port), "--data", data, "--recordings", recordings]
        self._command, self._environment = [str(word) for word in command], os.environ | PATIENCE | spoken
        self._start()

    def _start(self) -> None:
        with self.log.open("ab") as log:
            self._process = subprocess.Popen(self._command, env=self._environment, stdout=log, stderr=log)

    def kill_and_start_again(self) -> None:
        self._process.kill()
        self._process.wait(PATIENCE_S)
        self._start()
        self.wait_until_up()

    def _let_in(self, data: Path) -> dict[str, str]:
        return provision(data, people={OPERATOR: EVERY_ROLE}, origin=self.url, password=PASSWORD).key

    def call(self, method: str, path: str, body: object = None) -> Any:
        request = urllib.request.Request(
            f"{self.url}/api/v1{path}",
            method=method,
            data=None if body is None else json.dumps(body).encode(),
            headers={"Content-Type": "application/json", **self._key},
        )
        with urllib.request.urlopen(request, timeout=PATIENCE_S, context=self._trusted) as response:
            return json.load(response)

    def import_plan(self, plan: bytes) -> None:
        request = urllib.request.Request(
            f"{self.url}/api/v1/plans", method="POST", data=plan, headers={**DICOM, **self._key}
        )
        urllib.request.urlopen(request, timeout=PATIENCE_S, context=self._trusted).close()

    def wait_until_up(self) -> None:
        eventually(self._answers, within_s=START_S, pause_s=0.05, detail=lambda: "tidegate serve does not answer")

    def _answers(self) -> bool:
        assert self._process.poll() is None, "tidegate serve ended"
        with (
            contextlib.suppress(urllib.error.URLError),
            urllib.request.urlopen(f"{self.url}/healthz", timeout=PATIENCE_S, context=self._trusted),
        ):
            return True
        return False

    def end(self) -> int:
        self._process.terminate()
        try:
            return self._process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            raise


@pytest.fixture(scope="module")
def chromium(
    playwright: Playwright, tls: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Browser]:
    """The whole browser, as in a clinic, which trusts the service's certificate."""
    home = tmp_path_factory.mktemp("home")
    trust(home, tls[0])
    browser = launch_chromium(playwright, is_shell=False, home=home)
    yield browser
    browser.close()


@pytest.fixture(scope="module")
def tls(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return make_certificate(tmp_path_factory.mktemp("tls"))


@pytest.fixture
def controller(tmp_path: Path, calm_volunteer: Path, tls: tuple[Path, Path]) -> Iterator[Controller]:
    controller = Controller(tmp_path / "data", calm_volunteer.parent, tls=tls)
    try:
        controller.wait_until_up()
        yield controller
    finally:
        assert controller.end() == 0
        shutil.rmtree(tmp_path / "data")


@pytest.fixture
def new_controller(tmp_path: Path) -> Iterator[Controller]:
    """A service that is started for the first time: nobody can log in yet but whom it tells of on its terminal."""
    controller = Controller(tmp_path / "data", tmp_path, is_new=True)
    try:
        controller.wait_until_up()
        yield controller
    finally:
        assert controller.end() == 0


def create_session(controller: Controller, volunteer: Path) -> str:
    """Upload the calibration and create the session, as the planning software would."""
    document = json.loads((volunteer / "calibration.json").read_text())
    calibration = controller.call("POST", "/calibrations?operator=B.+Physicist", document)
    request = {
        "patient_reference": "P-0001",
        "plan_id": "PLAN-1",
        "fraction_id": "FX-1",
        "operator": OPERATOR,
        "source": {"kind": "recording", "path": f"{volunteer.name}/recording.oni", "player": "repeated"},
        "calibration_id": calibration["id"],
        "window": WINDOW,
    }
    return str(controller.call("POST", "/sessions", request)["id"])


def log_in(page: Page, password: str, name: str = OPERATOR) -> None:
    page.locator("#log-in").get_by_label("Name", exact=True).fill(name)
    page.locator("#log-in").get_by_label("Password", exact=True).fill(password)
    page.keyboard.press("Enter")


def seen_on(page: Page) -> set[tuple[str, str, str]]:
    return {tuple(one) for one in page.evaluate("window.seen")}


READ_TO_THE_END = "() => { const one = document.getElementById('arming'); one.scrollTop = one.scrollHeight; }"
"""On a busy machine more lines need a look, and the last one lies below."""


def press_what_is_offered(page: Page) -> None:
    """Set the reference once it is asked for, arm, and acknowledge a busy machine's fault: a frame may well be late."""
    is_reference_asked = "Set the reference" in page.locator("#gate-reason").inner_text()
    step = "reference" if is_reference_asked else "arm-now" if page.locator("#arming").is_visible() else "arm"
    if step == "arm-now":
        page.evaluate(READ_TO_THE_END)
    for action in ("acknowledge", step):
        button = page.locator(f"#do-{action}")
        if button.is_visible() and button.is_enabled():
            # What was offered a moment ago may be gone with the next frame.
            with contextlib.suppress(BrowserTimeoutError):
                button.click(timeout=3_000)


def gate_one_recording(tab: Tab) -> set[tuple[str, str, str]]:
    """Start the waiting session, let it learn, arm, and watch until all states were seen or the recording is over."""
    page = tab.page
    expect(page.locator("#who-status")).to_have_text("created")
    page.evaluate(REMEMBER_STATES)
    page.click("#do-start")
    tab.await_that(lambda: page.evaluate("'training' in window.armable"), "it does not learn")
    assert page.evaluate("window.armable.training") is False, "nothing can be armed while it learns"
    while not seen_on(page) >= WANTED and page.get_attribute("#gate", "data-kind") != "idle":
        press_what_is_offered(page)
        page.wait_for_timeout(50)
    return seen_on(page) & WANTED


def test_a_volunteer_is_gated_on_the_page(controller: Controller, calm_volunteer: Path, context: BrowserContext):
    tab = Tab(page=context.new_page(), url=controller.url)
    tab.watch()
    page = tab.open("out")
    log_in(page, "not the password")
    expect(page.locator("#log-in-outcome")).to_have_text("Name or password is wrong.")
    log_in(page, PASSWORD)
    tab.sees("idle")
    expect(page.locator("#person-name")).to_have_text(OPERATOR)
    session_id = create_session(controller, calm_volunteer)
    expect(page.locator("#who-patient")).to_have_text("P-0001")
    assert gate_one_recording(tab) == WANTED
    page.keyboard.press("Escape")
    tab.sees("disarmed")
    page.reload()
    tab.sees("disarmed")
    page.click("#do-tables")
    expect(page.locator("#table-trace tr").nth(12)).to_be_attached(timeout=8_000)  # before it was loaded again
    page.click("#tables-close")
    rows = controller.call("GET", f"/audit?session_id={session_id}&limit=200")["items"]
    assert {"beam_on", "hold", "dwell"} <= {row["detail"].get("to_state") for row in rows}
    armed = [row for row in rows if row["action"] == "session.arm" and row["outcome"] == "done"]
    assert {row["actor"] for row in armed} == {OPERATOR}
    controller.call("POST", f"/sessions/{session_id}/stop", {"operator": OPERATOR})
    tab.sees("idle")
    page.click("#do-log-out")
    tab.sees("out")
    page.reload()
    tab.sees("out")
    page.close()
    assert tab.complaints == []


def test_a_session_of_a_killed_service_is_announced_and_continued_with_what_was_delivered(
    controller: Controller, calm_volunteer: Path, context: BrowserContext
):
    tab = Tab(page=context.new_page(), url=controller.url)
    tab.watch()
    page = tab.open("out")
    log_in(page, PASSWORD)
    tab.sees("idle")
    session_id = create_session(controller, calm_volunteer)
    expect(page.locator("#who-patient")).to_have_text("P-0001")
    assert gate_one_recording(tab) == WANTED
    path = f"/sessions/{session_id}"
    eventually(lambda: controller.call("GET", path)["summary"]["beam_on_s"] > 0.0, detail=lambda: "no beam-on time")
    controller.kill_and_start_again()
    expect(page.locator("#report-heading")).to_have_text("Interrupted: P-0001")
    delivered_s = controller.call("GET", path)["summary"]["beam_on_s"]
    assert delivered_s > 0.0
    page.click("#report-continue")
    expect(page.locator("#gate-word")).to_have_text("Ready")
    page.click("#do-start")
    expect(page.locator("#treatment-on")).to_contain_text("before")
    (newest, *_) = controller.call("GET", "/sessions")["items"]
    detail = controller.call("GET", f"/sessions/{newest['id']}")
    assert (detail["continues"], detail["delivered_before_s"]) == (session_id, delivered_s)
    assert detail["model_id"] is not None
    assert detail["gate"]["is_armed"] is False
    assert detail["has_reference"] is False
    controller.call("POST", f"/sessions/{newest['id']}/stop", {"operator": OPERATOR})
    expect(page.locator("#report-heading")).to_have_text("Summary: P-0001")
    page.close()
    assert tab.complaints == []


def test_a_fraction_of_a_plan_is_set_up_and_gated_by_keyboard_alone(
    controller: Controller, calm_volunteer: Path, context: BrowserContext
):
    document = json.loads((calm_volunteer / "calibration.json").read_text())
    controller.call("POST", "/calibrations?operator=B.+Physicist", document)
    controller.import_plan(written(photon_plan(PatientSetupSequence=[setup(1, motion("GATING"))])))
    page, hands = context.new_page(), Keyboard()
    page.goto(controller.url)
    person = Newcomer(page, OPERATOR, PASSWORD, hands)
    while not person.gates():
        assert not page.is_visible("#report"), "the recording is over"
    # One detour: a late frame closes the window editor by itself, and the way begins at the head of the page.
    assert len([one for one in hands.tabs if one[1] > MOST_TABS]) <= 1, hands.tabs
    assert person.wrong_turns == []
    page.keyboard.press("F8")
    expect(page.locator("#gate-reason")).to_contain_text("Held by")
    page.keyboard.press("Escape")
    expect(page.locator("#gate")).to_have_attribute("data-kind", "disarmed")
    look_at_it_again_and_sign(page, controller)
    page.close()


def look_at_it_again_and_sign(page: Page, controller: Controller) -> None:
    """Stop the session, find it in the office, follow it to its review, sign the report, and take the report away."""
    (session, *_) = controller.call("GET", "/sessions")["items"]
    try:
        page.click("#do-stop", timeout=3_000)
        page.get_by_role("button", name="Confirm stop").click(timeout=3_000)
    except BrowserTimeoutError:
        assert page.is_visible("#report"), "not stopped, and not over"  # on a busy machine the recording ends first
    expect(page.locator("#report-heading")).to_contain_text(session["patient_reference"])
    page.goto(f"{controller.url}/office/")
    page.get_by_role("link", name=session["fraction_id"]).click()
    expect(page.locator("#review-signatures")).to_contain_text("Not signed yet.")
    page.get_by_label("Meaning").select_option("Checked")
    page.locator("#review-password input").fill(PASSWORD)
    page.get_by_role("button", name="Sign report").click()
    expect(page.locator("#review-signatures li")).to_have_text([re.compile(f"^Checked and signed by {OPERATOR}")])
    with page.expect_download() as report:
        page.get_by_role("link", name="Report, PDF").click()
    assert Path(report.value.path()).read_bytes().startswith(b"%PDF")
    (signature,) = controller.call("GET", f"/sessions/{session['id']}/report")["signatures"]
    assert (signature["name"], signature["is_signed"]) == (OPERATOR, True)


def choose_password(page: Page, password: str) -> None:
    """After a log-in with a password for once: the old one is known to the page already."""
    expect(page.get_by_role("heading", name="Change password")).to_be_visible()
    page.fill("[name=new_password]", password)
    page.fill("[name=repeated]", password)
    page.keyboard.press("Enter")


def test_from_the_first_start_to_a_therapist_who_is_logged_in(new_controller: Controller, context: BrowserContext):
    told = re.search(r"first log-in:\s+(\S+)", new_controller.log.read_text())
    assert told is not None
    tab = Tab(page=context.new_page(), url=new_controller.url)
    tab.watch()
    page = tab.open("out")
    log_in(page, told[1], "admin")
    choose_password(page, "a password of an admin")
    expect(page.locator("#people-next")).to_be_visible()
    page.fill("#new-person [name=name]", OPERATOR)
    page.check("#new-person-roles [value=therapist]")
    page.click("#new-person [type=submit]")
    expect(page.locator("#once-secret")).not_to_have_text("")
    one_time = page.locator("#once-secret").inner_text()
    page.fill("#new-key [name=name]", "Planning")
    page.check("#new-key-scopes [value='sessions.read']")
    page.click("#new-key [type=submit]")
    expect(page.locator("#once-secret")).to_have_text(re.compile("^tg_"))
    secret = page.locator("#once-secret").inner_text()
    page.click("#once-done")
    new_controller._key = {"Authorization": f"Bearer {secret}"}
    assert new_controller.call("GET", "/sessions")["items"] == []
    page.locator("#key-list").get_by_role("button", name="Revoke").click()
    page.locator("#key-list").get_by_role("button", name="Confirm revoke").click()
    expect(page.locator("#key-list")).to_contain_text("revoked")
    with pytest.raises(urllib.error.HTTPError, match="401"):
        new_controller.call("GET", "/sessions")
    page.get_by_role("link", name="To the treatment console").click()
    tab.sees("idle")
    page.click("#do-log-out")
    tab.sees("out")
    log_in(page, one_time)
    choose_password(page, PASSWORD)
    tab.sees("idle")
    expect(page.locator("#person-roles")).to_have_text("therapist")
    page.close()
    assert tab.complaints == []
    log = new_controller.log.read_text()
    assert not [one for one in (one_time, secret, PASSWORD) if one in log]
