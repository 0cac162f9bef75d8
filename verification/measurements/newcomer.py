"""A newcomer at the console: does only what the page says, on a prepared plan, until the beam is permitted.

`python -m verification.measurements.newcomer` starts `tidegate serve` on a played virtual volunteer with an imported
plan, opens the page in Debian's Chromium, and lets :mod:`tests.support.browser.newcomer` use it, by mouse or, with
`--keyboard`, without one. It prints the fields, presses, decisions and wrong turns (a press after which the page
reports a failure), the time, and where in the breath the reference lies; `--runs` repeats it with the next fractions.
"""

import json
import os
import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

import typer
from playwright.sync_api import Page, sync_playwright

from service.core.permissions import Role
from tests.support.browser.chromium import launch_chromium
from tests.support.browser.newcomer import Hands, Keyboard, Mouse, Newcomer
from tests.support.planning.api_calls import DICOM
from tests.support.planning.dicom_plans import motion, photon_plan, setup, written
from tests.support.service.accounts import PASSWORD, provision
from tests.support.service.processes import PeopleOverHttp, free_port, service_process
from verification.load.recording import volunteer_folder

V1 = "/api/v1"
NEWCOMER = "N. Newcomer"
RECORDING_S = 300.0
LIMIT_S = 240.0
EXHALE_PERCENT = 5.0
MOST_FIELDS, MOST_DECISIONS = 4, 4
# As patient as a site may be: a late frame is no fault of the page.
PATIENCE = {
    "TIDEGATE_MAX_FRAME_AGE_MS": "200",
    "TIDEGATE_MAX_GAP_MS": "200",
    "TIDEGATE_MAX_LAG_MS": "500",
    "TIDEGATE_MAX_SILENCE_MS": "2000",
    "TIDEGATE_WATCHDOG_MS": "500",
    "TIDEGATE_LEASE_MS": "200",
}


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
    row = next(one for one in rows if one["outcome"] == "done")
    return float(row["detail"]["proposed"]["percent"])


def _run(page: Page, http: PeopleOverHttp, hands: Hands) -> tuple[Newcomer, float, float]:
    """One run: what the newcomer did, the time to the first permitted beam [s], and the reference's place [%]."""
    newcomer, began_s = Newcomer(page, NEWCOMER, PASSWORD, hands), time.monotonic()
    page.on("pageerror", lambda error: newcomer.wrong_turns.append(f"exception: {error}"))
    page.goto(f"http://127.0.0.1:{http.base_url.port}/")
    while not newcomer.gates():
        assert time.monotonic() - began_s < LIMIT_S, page.inner_text("body")
    took_s = time.monotonic() - began_s
    percent = _reference_percent(http)
    (session, *_) = _ok(http.get(f"{V1}/sessions", params={"status": "running"}))["items"]
    _ok(http.post(f"{V1}/sessions/{session['id']}/stop", json={"operator": NEWCOMER}))
    page.context.clear_cookies()
    return newcomer, took_s, percent


def main(
    runs: Annotated[int, typer.Option("--runs", min=1, help="How often, each with the plan's next fraction.")] = 1,
    is_by_keyboard: Annotated[bool, typer.Option("--keyboard", help="Without a mouse.")] = False,
) -> None:
    """Print the counts; end with 1 where a plan takes more than four fields or four decisions, or a turn was wrong."""
    found = []
    with tempfile.TemporaryDirectory(prefix="tidegate-newcomer-") as name, sync_playwright() as playwright:
        root, port = Path(name), free_port()
        folder = volunteer_folder(root / "recordings", RECORDING_S)
        serve = ("serve", "--port", str(port), "--data", str(root / "data"), "--recordings", str(folder.parent))
        provision(root / "data", people={NEWCOMER: [Role.THERAPIST]}, password=PASSWORD)
        place = {"port": port, "log": root / "log", "data": root / "data", "environment": PATIENCE}
        with service_process("service.cli", *serve, **place) as (_, http):
            _prepare(http, folder)
            browser = launch_chromium(playwright, is_shell=False)
            for number in range(runs):
                page = browser.new_page(viewport={"width": 1280, "height": 800})
                hands = Keyboard() if is_by_keyboard else Mouse()
                found.append(_run(page, http, hands))
                newcomer, took_s, percent = found[-1]
                tabs = f", Tabs {hands.tabs}" if isinstance(hands, Keyboard) else ""
                typer.echo(
                    f"{number + 1}: {len(newcomer.fields)} fields ({', '.join(newcomer.fields)}), "
                    f"{len(newcomer.presses) - 1} presses, {len(newcomer.decisions)} decisions, "
                    f"{len(newcomer.wrong_turns)} wrong turns {newcomer.wrong_turns or ''}, {took_s:.0f} s, "
                    f"reference at {percent:.1f} %{tabs}"
                )
                page.close()
            browser.close()
    wrong = sum(len(one.wrong_turns) for one, _, _ in found)
    times_s = sorted(took_s for _, took_s, _ in found)
    typer.echo(
        f"{runs} runs on a prepared plan, {os.cpu_count()} processors, log-in included: wrong turns {wrong}; first "
        f"permitted beam after {times_s[len(times_s) // 2]:.0f} s in the middle, {times_s[-1]:.0f} s at most, without "
        f"thinking and reading; reference at {min(one for *_, one in found):.1f} to "
        f"{max(one for *_, one in found):.1f} % of the breath (0: end of exhale)"
    )
    is_easy = all(
        len(one.fields) <= MOST_FIELDS and len(one.decisions) <= MOST_DECISIONS and abs(percent) <= EXHALE_PERCENT
        for one, _, percent in found
    )
    if not is_easy or wrong > 0:
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(main)
