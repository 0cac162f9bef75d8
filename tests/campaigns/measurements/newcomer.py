"""A newcomer at the console: does only what the page says, on a prepared plan, until the beam is permitted.

`python -m tests.campaigns.measurements.newcomer` starts `tidegate serve` on a played virtual volunteer with an imported
plan, opens the page in Debian's Chromium, and follows the steps: it logs in, fills fields that are empty, clicks the
button that is marked as the next one, and looks at window and summary. It prints the fields, clicks, decisions and
wrong turns (a click after which the page reports a failure), the time, and where in the breath the reference lies.
"""

import json
import os
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import typer
from playwright.sync_api import Page, expect, sync_playwright

from service.core.permissions import Role
from tests.campaigns.load.recording import volunteer_folder
from tests.support.browser.chromium import launch_chromium
from tests.support.planning.api_calls import DICOM
from tests.support.planning.dicom_plans import motion, photon_plan, setup, written
from tests.support.service.accounts import PASSWORD, provision
from tests.support.service.processes import PeopleOverHttp, free_port, service_process

V1 = "/api/v1"
NEWCOMER = "N. Newcomer"
RECORDING_S = 300.0
LIMIT_S = 240.0
LOOK_MS = 250
EXHALE_PERCENT = 5.0
MOST_FIELDS, MOST_DECISIONS = 4, 3
# As patient as a site may be: a late frame is no fault of the page.
PATIENCE = {
    "TIDEGATE_MAX_FRAME_AGE_MS": "200",
    "TIDEGATE_MAX_GAP_MS": "200",
    "TIDEGATE_MAX_LAG_MS": "500",
    "TIDEGATE_MAX_SILENCE_MS": "2000",
    "TIDEGATE_WATCHDOG_MS": "500",
    "TIDEGATE_LEASE_MS": "200",
}


@dataclass
class Newcomer:
    """Reads the page and counts what it had to do."""

    page: Page
    fields: list[str] = field(default_factory=list)
    clicks: list[str] = field(default_factory=list)
    decisions: list[str] = field(default_factory=list)
    wrong_turns: list[str] = field(default_factory=list)

    def gates(self) -> bool:
        """Do the next thing; return whether the beam is permitted."""
        page = self.page
        if page.get_attribute("#gate", "data-kind") == "beam_on":
            return True
        if page.is_visible("#log-in"):
            page.fill("#log-in [name=name]", NEWCOMER)
            page.fill("#log-in [name=password]", PASSWORD)
            self._click("#log-in [type=submit]")
            page.wait_for_selector("#access", state="hidden")
        elif page.is_visible("#new-session"):
            self._fill_form()
        elif page.is_visible("#arming"):
            self._arm()
        elif page.locator("button[data-next=yes]:enabled").count() == 1:
            self._press(page.get_attribute("button[data-next=yes]", "id") or "")
        page.wait_for_timeout(LOOK_MS)
        return False

    def _fill_form(self) -> None:
        """Choose the plan, and what the form has no proposal for."""
        page = self.page
        page.wait_for_selector("[name=plan] option:nth-child(2)", state="attached")
        self._choose("plan")
        expect(page.locator("[name=fraction_number]")).not_to_have_value("")
        for name in ("source", "calibration_id"):
            if page.input_value(f"[name={name}]") == "":
                self._choose(name)
        self._click("#new-session [type=submit]")
        assert not self.wrong_turns, (self.wrong_turns, self.clicks)
        page.wait_for_selector("#setup", state="hidden")

    def _choose(self, name: str) -> None:
        values = self.page.eval_on_selector_all(
            f"[name={name}] option:not(:disabled)", "all => all.map((one) => one.value)"
        )
        wanted = next(one for one in values if one and one not in {"device:", "built-in"})
        self.page.select_option(f"[name={name}]", wanted)
        self.fields.append(name)

    def _press(self, button: str) -> None:
        if button == "do-reference":
            if self.page.inner_text("#reference-proposal").startswith("Two breaths"):
                return
            self.decisions.append("reference")
        self._click(f"#{button}")
        if button == "do-window":
            self.decisions.append("window")
            self.page.wait_for_selector("#window-forecast:not(:empty)", state="attached")
            if self.page.is_visible("#window-cancel"):  # it closes by itself where frames are late
                self._click("#window-cancel")

    def _arm(self) -> None:
        """Read the summary; the button ignores clicks until it has been shown for 2 s."""
        self.page.wait_for_selector("#do-arm-now:enabled:not([aria-disabled=true])")
        self.decisions.append("arming")
        self._click("#do-arm-now")
        self.page.wait_for_selector("#arming", state="hidden")

    def _click(self, selector: str) -> None:
        self.page.click(selector)
        self.clicks.append(selector)
        self.page.wait_for_timeout(LOOK_MS)
        failed = self.page.locator(".outcome[data-kind=failed]:visible")
        if failed.count() > 0:
            self.wrong_turns.append(f"{selector}: {failed.first.inner_text()}")


def _prepare(http: PeopleOverHttp, folder: Path) -> None:
    """Store the calibration and a gated plan, as physicist and planning system do beforehand."""
    document = json.loads((folder / "calibration.json").read_text())
    _ok(http.post(f"{V1}/calibrations", params={"operator": "A. Physicist"}, json=document))
    plan = photon_plan(RTPlanLabel="LUNG_GATED", PatientSetupSequence=[setup(1, motion("GATING"))])
    _ok(http.post(f"{V1}/plans", content=written(plan), headers=DICOM))


def _ok(answer: Any) -> dict[str, Any]:
    assert answer.is_success, answer.text
    return dict(answer.json())


def _reference_percent(http: PeopleOverHttp) -> float:
    """Where in the learned breath the confirmed reference lies [%], from the audit log."""
    rows = _ok(http.get(f"{V1}/audit", params={"action": "session.reference"}))["items"]
    (row,) = [one for one in rows if one["outcome"] == "done"]
    return float(row["detail"]["proposed"]["percent"])


def main() -> None:
    """Print the counts; end with 1 where a plan takes more than four fields or three decisions, or a turn was wrong."""
    with tempfile.TemporaryDirectory(prefix="tidegate-newcomer-") as name, sync_playwright() as playwright:
        root, port = Path(name), free_port()
        folder = volunteer_folder(root / "recordings", RECORDING_S)
        serve = ("serve", "--port", str(port), "--data", str(root / "data"), "--recordings", str(folder.parent))
        provision(root / "data", people={NEWCOMER: [Role.THERAPIST]}, password=PASSWORD)
        place = {"port": port, "log": root / "log", "data": root / "data", "environment": PATIENCE}
        with service_process("service.cli", *serve, **place) as (_, http):
            _prepare(http, folder)
            browser = launch_chromium(playwright, is_shell=False)
            page = browser.new_page(viewport={"width": 1280, "height": 800})
            newcomer, began_s = Newcomer(page), time.monotonic()
            page.goto(f"http://127.0.0.1:{port}/")
            while not newcomer.gates():
                assert time.monotonic() - began_s < LIMIT_S, page.inner_text("body")
            took_s = time.monotonic() - began_s
            percent = _reference_percent(http)
            browser.close()
    typer.echo(f"log-in: 2 fields, 1 click; then, on a prepared plan, {os.cpu_count()} processors:")
    typer.echo(f"fields chosen: {len(newcomer.fields)} ({', '.join(newcomer.fields)})")
    typer.echo(f"clicks: {len(newcomer.clicks) - 1} ({', '.join(newcomer.clicks[1:])})")
    typer.echo(f"decisions: {len(newcomer.decisions)} ({', '.join(newcomer.decisions)})")
    typer.echo(f"wrong turns: {len(newcomer.wrong_turns)} {newcomer.wrong_turns or ''}")
    typer.echo(f"time from opening the page to the first permitted beam: {took_s:.0f} s, without thinking and reading")
    typer.echo(f"the reference lies at {percent:.1f} % of the breath (0: end of exhale)")
    is_easy = len(newcomer.fields) <= MOST_FIELDS and len(newcomer.decisions) <= MOST_DECISIONS
    if not is_easy or newcomer.wrong_turns or abs(percent) > EXHALE_PERCENT:
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(main)
