"""Times of the two pages in a browser: from a frame to its picture, and from a silence to a page that claims nothing.

`python -m verification.measurements.page_times` starts `tidegate serve` on a played virtual volunteer, opens the
console and, paired by its code, the patient's screen in Debian's Chromium. It prints the time from the receipt of a
frame in the engine to the end of its drawing on the patient's screen, for bar and curve; and how long each page goes on
after the service, or the engine's process, was stopped. Both pages and the engine share this machine's clock; the
compositor and the display come after what is measured.
"""

import json
import os
import signal
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from playwright.sync_api import Page, sync_playwright

from service.core.permissions import Role
from service.web.app import PATIENT
from tests.support.browser.chromium import launch_chromium
from tests.support.engine_process.process_ids import engine_pid
from tests.support.service.accounts import PASSWORD, provision
from tests.support.service.processes import PeopleOverHttp, free_port, service_process
from tests.support.waiting import eventually
from verification.load.recording import volunteer_folder
from verification.measurements.newcomer import PATIENCE

V1 = "/api/v1"
ENGINE = "service.engine_host"
WATCHER = "W. Watcher"
LEARNED_S = 120.0
DRAWN_MS, CONSOLE_MS, PATIENT_MS = 100.0, 500.0, 300.0
"""Marks: p99 of a drawing, and the longest time for which either page may go on."""
WINDOW = {"kind": "amplitude", "signal": "whole", "lower_mm": -1.0, "upper_mm": 3.0}

# Notes when what the page claims changes, and for each drawn frame how long ago the engine had received it.
NOTE = """(() => {
  const now = () => performance.timeOrigin + performance.now();
  const received = new Map();
  window.drawn = [];
  window.claims = [];
  window.WebSocket = class extends WebSocket {
    constructor(...given) {
      super(...given);
      this.addEventListener("message", (event) => {
        const message = JSON.parse(event.data);
        if (message.type !== "guide" || message.level === null) return;
        received.set(String(message.sequence), Date.parse(message.sent_at) - message.age_ms);
      });
    }
  };
  document.addEventListener("DOMContentLoaded", () => {
    const guide = document.querySelector("#guide");
    const gate = document.querySelector("#gate");
    const isGateKnown = () => document.body.dataset.fresh === "yes" && gate.dataset.kind !== "fault";
    const claim = () => (guide ? guide.dataset.show === "guide" : isGateKnown());
    const attributeFilter = ["data-sequence", "data-show", "data-fresh", "data-kind"];
    let last = false;
    new MutationObserver(() => {
      const atMs = received.get(guide?.dataset.sequence);
      if (guide && claim() && atMs !== undefined) window.drawn.push(now() - atMs);
      received.delete(guide?.dataset.sequence);
      if (claim() !== last) { last = claim(); window.claims.push([last, now()]); }
    }).observe(document.body, { subtree: true, attributes: true, attributeFilter });
  });
})()"""


def _ok(answer: Any) -> dict[str, Any]:
    assert answer.is_success, answer.text
    return dict(answer.json())


def practise(http: PeopleOverHttp, folder: Path) -> str:
    """Start a session of the volunteer, set its reference, and begin a practice; return the session's address."""
    document = json.loads((folder / "calibration.json").read_text())
    made = _ok(http.post(f"{V1}/calibrations", params={"operator": "A. Physicist"}, json=document))
    request = {
        "patient_reference": "P-0001",
        "plan_id": "PLAN-1",
        "fraction_id": "FX-1",
        "source": {"kind": "recording", "path": f"{folder.name}/recording.oni", "player": "reader"},
        "calibration_id": made["id"],
        "window": WINDOW,
    }
    session = f"{V1}/sessions/{_ok(http.post(f'{V1}/sessions', json=request))['id']}"
    _ok(http.post(f"{session}/start", json={}))
    place = {"at": "end_exhale"}
    eventually(lambda: http.post(f"{session}/reference", json=place).is_success, within_s=LEARNED_S, pause_s=0.5)
    eventually(lambda: display(http, session, "bar"), within_s=LEARNED_S, pause_s=0.5)
    return session


def display(http: PeopleOverHttp, session: str, name: str) -> bool:
    """Show a practice as bar or curve."""
    band = {"lower_percent": -10.0, "upper_percent": 110.0}
    return bool(http.put(f"{session}/coaching", json={"display": name, "is_practice": True, "band": band}).is_success)


def opened(http: PeopleOverHttp, port: int, page: Page, *, is_patients: bool) -> Page:
    """Open a page: the patient's, paired by a code, or the console, logged in."""
    page.add_init_script(NOTE)
    page.goto(f"http://127.0.0.1:{port}{PATIENT if is_patients else ''}/")
    if is_patients:
        page.fill("#pair-code", _ok(http.post(f"{V1}/coach/code", json={}))["code"])
    else:
        page.locator("#log-in").get_by_label("Name", exact=True).fill(WATCHER)
        page.locator("#log-in").get_by_label("Password", exact=True).fill(PASSWORD)
    page.keyboard.press("Enter")
    until(page, "claims.length > 0 && claims.at(-1)[0]")
    return page


def until(page: Page, condition: str) -> None:
    """Wait while the page goes on; its policy permits no waiting by a script of text."""
    eventually(lambda: page.evaluate(condition) or page.wait_for_timeout(20), within_s=60.0)


def silences(page: Page, http: PeopleOverHttp, session: str, pid: Callable[[], int], repeats: int) -> list[float]:
    """Stop a process again and again; return for how long the page went on each time [ms]."""
    found = []
    for _ in range(repeats):
        until(page, "claims.at(-1)[0]")
        page.wait_for_timeout(2_000)
        page.evaluate("claims.splice(0)")
        stopped, at_ms = pid(), 1e3 * time.time()
        os.kill(stopped, signal.SIGSTOP)
        until(page, "claims.some(([isClaimed]) => !isClaimed)")
        found.append(page.evaluate("claims.find(([isClaimed]) => !isClaimed)[1]") - at_ms)
        os.kill(stopped, signal.SIGCONT)
        eventually(lambda: _is_calm(http, session), within_s=60.0, pause_s=0.5)
    return found


def _is_calm(http: PeopleOverHttp, session: str) -> bool:
    """Acknowledge the fault that a stopped process has latched; return whether none is left and guidance goes on."""
    if _ok(http.get(session))["gate"]["state"] == "fault":
        http.post(f"{session}/acknowledge", json={})
        return False
    return display(http, session, "bar")


def main(
    seconds: Annotated[float, typer.Option(help="Time of each display [s].", min=1.0, max=600.0)] = 40.0,
    repeats: Annotated[int, typer.Option(help="How often each process is stopped.", min=1, max=50)] = 5,
) -> None:
    """Print the times; end with 1 where one is beyond its mark."""
    rows: list[tuple[str, list[float], float]] = []
    with tempfile.TemporaryDirectory(prefix="tidegate-pages-") as name, sync_playwright() as playwright:
        root, port = Path(name), free_port()
        folder = volunteer_folder(root / "recordings", LEARNED_S + 3.0 * seconds + 60.0 * repeats)
        provision(root / "data", people={WATCHER: [Role.THERAPIST]}, password=PASSWORD)
        serve = ("serve", "--port", str(port), "--data", str(root / "data"), "--recordings", str(folder.parent))
        place = {"port": port, "log": root / "log", "data": root / "data", "environment": PATIENCE}
        with service_process("service.cli", *serve, **place) as (process, http):
            session = practise(http, folder)
            browser = launch_chromium(playwright, is_shell=False)
            patient = opened(http, port, browser.new_page(), is_patients=True)
            for shown in ("bar", "curve"):
                assert display(http, session, shown)
                patient.wait_for_timeout(1_000)
                patient.evaluate("window.drawn = []")
                patient.wait_for_timeout(1_000 * seconds)
                rows.append((f"patient's screen, {shown}: frame to drawing", patient.evaluate("drawn"), DRAWN_MS))
            pages = {
                "patient's screen": (patient, PATIENT_MS),
                "console": (opened(http, port, browser.new_context().new_page(), is_patients=False), CONSOLE_MS),
            }
            stopped = {"service": lambda: process.pid, "engine": lambda: engine_pid(process.pid, ENGINE)}
            for what, pid in stopped.items():
                for which, (page, mark_ms) in pages.items():
                    page.bring_to_front()
                    took_ms = silences(page, http, session, pid, repeats)
                    rows.append((f"{which}: {what} stopped", took_ms, mark_ms))
            browser.close()
    typer.echo("| | times | p50 [ms] | p99 [ms] | longest [ms] | mark [ms] |\n|---|---|---|---|---|---|")
    for text, values, mark_ms in rows:
        figures = " | ".join(f"{one:.0f}" for one in (*np.percentile(values, (50, 99)), max(values), mark_ms))
        typer.echo(f"| {text} | {len(values)} | {figures} |")
    typer.echo(f"{os.cpu_count()} processors, load {os.getloadavg()[0]:.1f}")
    if any(np.percentile(values, 99) > mark_ms for _, values, mark_ms in rows):
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(main)
