"""Time from the receipt of a frame in the engine to its drawn picture on the patient's screen.

`python -m tests.campaigns.measurements.coach_latency` starts `tidegate serve` on a played virtual volunteer, pairs a
screen in Debian's Chromium by its code, lets it practise, and prints the percentiles for bar and curve. The screen's
page and the engine share this machine's clock. "Drawn" is the end of the page's drawing in the browser's animation
frame; composition and the display come after it.
"""

import json
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from playwright.sync_api import Page, sync_playwright

from service.web.app import PATIENT
from tests.campaigns.load.recording import volunteer_folder
from tests.support.browser.chromium import launch_chromium
from tests.support.service.processes import PeopleOverHttp, free_port, service_process
from tests.support.waiting import eventually

V1 = "/api/v1"
LEARNED_S = 120.0
WINDOW = {"kind": "amplitude", "signal": "whole", "lower_mm": -1.0, "upper_mm": 3.0}
LIMIT_MS = 100.0
# As patient as a site may be: a late frame is part of what is measured here, not a fault that ends it.
PATIENCE = {
    "TIDEGATE_MAX_FRAME_AGE_MS": "200",
    "TIDEGATE_MAX_GAP_MS": "200",
    "TIDEGATE_MAX_LAG_MS": "500",
    "TIDEGATE_MAX_SILENCE_MS": "2000",
    "TIDEGATE_WATCHDOG_MS": "500",
    "TIDEGATE_LEASE_MS": "200",
}

# Notes for each frame that is drawn how long ago the engine had received it.
NOTE_DRAWN = """(() => {
  const received = new Map();
  window.latencies = [];
  window.ages = [];
  const now = () => performance.timeOrigin + performance.now();
  window.WebSocket = class extends WebSocket {
    constructor(...given) {
      super(...given);
      this.addEventListener("message", (event) => {
        const message = JSON.parse(event.data);
        if (message.type !== "guide" || message.level === null) return;
        window.ages.push(message.age_ms);
        received.set(String(message.sequence), Date.parse(message.sent_at) - message.age_ms);
      });
    }
  };
  document.addEventListener("DOMContentLoaded", () => {
    const guide = document.querySelector("#guide");
    new MutationObserver(() => {
      const atMs = received.get(guide.dataset.sequence);
      if (guide.dataset.show === "guide" && atMs !== undefined) window.latencies.push(now() - atMs);
      received.delete(guide.dataset.sequence);
    }).observe(guide, { attributes: true, attributeFilter: ["data-sequence"] });
  });
})()"""


class Measured(NamedTuple):
    """Time to the drawn picture of the drawn frames, and to the message of all frames [ms]; faults on the way."""

    latencies_ms: list[float]
    ages_ms: list[float]
    faults: int

    def lines(self, name: str) -> Iterator[str]:
        """Yield two rows of the table."""
        drawn = f"{len(self.latencies_ms)} of {len(self.ages_ms)}"
        yield f"| {name}: drawn | {drawn} | {_figures(self.latencies_ms)} |"
        yield f"| {name}: message made | {len(self.ages_ms)} | {_figures(self.ages_ms)} |"


def _figures(values_ms: list[float]) -> str:
    return " | ".join(f"{value:.0f}" for value in (*np.percentile(values_ms, (50, 95, 99)), max(values_ms)))


def practise(http: PeopleOverHttp, folder: Path) -> str:
    """Start a session of the volunteer, set its reference, and begin a practice; return its coaching's address."""
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
    proposed = {"at": "end_exhale"}
    eventually(
        lambda: http.post(f"{session}/reference", json=proposed).status_code == 200,
        within_s=LEARNED_S,
        pause_s=0.5,
        detail=lambda: http.get(session).text,
    )
    eventually(lambda: _set(http, f"{session}/coaching", "bar"), within_s=LEARNED_S, pause_s=0.5)
    return f"{session}/coaching"


def _set(http: PeopleOverHttp, coaching: str, display: str) -> bool:
    body = {"display": display, "is_practice": True, "band": {"lower_percent": -10.0, "upper_percent": 110.0}}
    return bool(http.put(coaching, json=body).status_code == 200)


def pair(http: PeopleOverHttp, page: Page, port: int) -> None:
    """Pair the page by a code, as a therapist does."""
    code = _ok(http.post(f"{V1}/coach/code", json={}))["code"]
    page.goto(f"http://127.0.0.1:{port}{PATIENT}/")
    page.fill("#pair-code", code)
    page.keyboard.press("Enter")
    page.locator("#guide[data-show=guide]").wait_for()


def measured(http: PeopleOverHttp, session: str, page: Page, seconds: float) -> Measured:
    """Watch for some time; acknowledge the faults of a busy machine, which end the guidance."""
    page.wait_for_timeout(1_000)
    page.evaluate("window.latencies = []; window.ages = []")
    faults = 0
    for _ in range(round(seconds)):
        page.wait_for_timeout(1_000)
        if _ok(http.get(session))["gate"]["state"] == "fault":
            faults += http.post(f"{session}/acknowledge", json={}).is_success
    return Measured(*page.evaluate("[window.latencies, window.ages]"), faults)


def _ok(answer: Any) -> dict[str, Any]:
    assert answer.is_success, answer.text
    return dict(answer.json())


def main(
    seconds: Annotated[float, typer.Option(help="Time of each display, s", min=1.0, max=600.0)] = 60.0,
) -> None:
    """Print the latencies; end with 1 where a p99 is 100 ms or more."""
    load_before = os.getloadavg()[0]
    with tempfile.TemporaryDirectory(prefix="tidegate-coach-") as name, sync_playwright() as playwright:
        root, port = Path(name), free_port()
        folder = volunteer_folder(root / "recordings", LEARNED_S + 3.0 * seconds)
        serve = ("serve", "--port", str(port), "--data", str(root / "data"), "--recordings", str(folder.parent))
        place = {"port": port, "log": root / "log", "data": root / "data", "environment": PATIENCE}
        with service_process("service.cli", *serve, **place) as (_, http):
            coaching = practise(http, folder)
            browser = launch_chromium(playwright, is_shell=False)
            page = browser.new_page(viewport={"width": 1280, "height": 800})
            page.add_init_script(NOTE_DRAWN)
            pair(http, page, port)
            found = {}
            for display in ("bar", "curve"):
                assert _set(http, coaching, display)
                found[display] = measured(http, coaching.removesuffix("/coaching"), page, seconds)
            browser.close()
    typer.echo("| display | frames | p50 [ms] | p95 [ms] | p99 [ms] | longest [ms] |\n|---|---|---|---|---|---|")
    for display, one in found.items():
        for line in one.lines(display):
            typer.echo(line)
    faults = sum(one.faults for one in found.values())
    load = f"load {load_before:.1f} before and {os.getloadavg()[0]:.1f} after"
    typer.echo(f"{os.cpu_count()} processors, {load}; {faults} faults acknowledged")
    if max(np.percentile(one.latencies_ms, 99) for one in found.values()) >= LIMIT_MS:
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(main)
