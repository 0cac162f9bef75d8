"""Time from the receipt of a frame in the engine to its drawn picture on the patient's screen.

`python -m tests.campaigns.measurements.coach_latency` starts `tidegate serve` on a played virtual volunteer, pairs a
screen in Debian's Chromium by its code, lets it practise, and prints the percentiles for bar and curve. The screen's
page and the engine share this machine's clock. "Drawn" is the end of the page's drawing in the browser's animation
frame; composition and the display come after it.
"""

import json
import tempfile
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from playwright.sync_api import Page, sync_playwright

from service.web.app import PATIENT
from tests.campaigns.load.recording import base_folder, write_long
from tests.support.browser.chromium import launch_chromium
from tests.support.service.processes import PeopleOverHttp, free_port, service_process
from tests.support.waiting import eventually

V1 = "/api/v1"
LEARNING_S = 60.0
LEARNED_S = 120.0
WINDOW = {"kind": "amplitude", "signal": "whole", "lower_mm": -1.0, "upper_mm": 3.0}
LIMIT_MS = 100.0

# Notes for each frame that is drawn how long ago the engine had received it.
NOTE_DRAWN = """(() => {
  const received = new Map();
  window.latencies = [];
  window.messages = 0;
  const now = () => performance.timeOrigin + performance.now();
  window.WebSocket = class extends WebSocket {
    constructor(...given) {
      super(...given);
      this.addEventListener("message", (event) => {
        const message = JSON.parse(event.data);
        if (message.type !== "guide" || message.level === null) return;
        window.messages += 1;
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
    """Latencies of the drawn frames [ms], and the number of frames that were sent to the page."""

    latencies_ms: list[float]
    messages: int

    def line(self, name: str) -> str:
        """One row of the table."""
        p50, p95, p99 = np.percentile(self.latencies_ms, (50, 95, 99))
        drawn = f"{len(self.latencies_ms)} of {self.messages}"
        return f"| {name} | {drawn} | {p50:.0f} | {p95:.0f} | {p99:.0f} | {max(self.latencies_ms):.0f} |"


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


def measured(page: Page, seconds: float) -> Measured:
    """Watch for some time."""
    page.wait_for_timeout(1_000)
    page.evaluate("window.latencies = []; window.messages = 0")
    page.wait_for_timeout(1_000 * seconds)
    return Measured(*page.evaluate("[window.latencies, window.messages]"))


def _ok(answer: Any) -> dict[str, Any]:
    assert answer.is_success, answer.text
    return dict(answer.json())


def main(
    seconds: Annotated[float, typer.Option(help="Time of each display, s", min=1.0, max=600.0)] = 60.0,
) -> None:
    """Print the latencies; end with 1 where a p99 is 100 ms or more."""
    with tempfile.TemporaryDirectory(prefix="tidegate-coach-") as name, sync_playwright() as playwright:
        root, port = Path(name), free_port()
        folder = root / "recordings" / "volunteer"
        folder.mkdir(parents=True)
        base = base_folder()
        write_long(base / "recording.oni", LEARNING_S + LEARNED_S + 3.0 * seconds, folder / "recording.oni")
        (folder / "calibration.json").write_bytes((base / "calibration.json").read_bytes())
        serve = ("serve", "--port", str(port), "--data", str(root / "data"), "--recordings", str(folder.parent))
        with service_process("service.cli", *serve, port=port, log=root / "log", data=root / "data") as (_, http):
            coaching = practise(http, folder)
            browser = launch_chromium(playwright, is_shell=False)
            page = browser.new_page(viewport={"width": 1280, "height": 800})
            page.add_init_script(NOTE_DRAWN)
            pair(http, page, port)
            found = {}
            for display in ("bar", "curve"):
                assert _set(http, coaching, display)
                found[display] = measured(page, seconds)
            browser.close()
    typer.echo("| display | frames drawn | p50 [ms] | p95 [ms] | p99 [ms] | longest [ms] |\n|---|---|---|---|---|---|")
    for display, one in found.items():
        typer.echo(one.line(display))
    if max(np.percentile(one.latencies_ms, 99) for one in found.values()) >= LIMIT_MS:
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(main)
