"""How long the page shows the gate's state after the newest frame, when service, engine, network or page stop.

`python -m tests.campaigns.measurements.page_staleness` starts `tidegate serve` on a played virtual volunteer, opens the
page in Debian's Chromium through a relay, and stops one thing at a time. Counted is the time from the receipt of the
newest frame that the page was sent, in the engine, to the page's change to a grey state or to a fault; page and engine
share this machine's clock. Where the page's script hangs, it is the time to the first picture with the closed cover,
taken from outside of the page.
"""

import asyncio
import base64
import contextlib
import json
import os
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import numpy.typing as npt
import typer
from playwright.sync_api import Page, sync_playwright

from tests.campaigns.load.recording import volunteer_folder
from tests.support.browser.chromium import launch_chromium
from tests.support.engine_process.process_ids import engine_pids
from tests.support.service.processes import free_port, service_process
from tests.support.waiting import eventually

V1 = "/api/v1"
RECORDING_S = 600.0
LIMIT_MS, HUNG_LIMIT_MS = 300.0, 400.0
STOPPED_S = 1.5
WINDOW = {"kind": "amplitude", "signal": "whole", "lower_mm": -1.0, "upper_mm": 3.0}
PATIENCE = {"TIDEGATE_MAX_SILENCE_MS": "2000", "TIDEGATE_MAX_LAG_MS": "500", "TIDEGATE_WATCHDOG_MS": "500"}
SHOWS_A_STATE = ("disarmed", "hold", "dwell", "beam_on")

# Notes when the newest frame was received in the engine, and when the gate's panel changes its kind.
NOTE = """(() => {
  const now = () => performance.timeOrigin + performance.now();
  window.newestMs = null;
  window.changes = [];
  window.WebSocket = class extends WebSocket {
    constructor(...given) {
      super(...given);
      this.addEventListener("message", (event) => {
        if (typeof event.data !== "string") return;
        const message = JSON.parse(event.data);
        if (message.type === "sample") window.newestMs = Date.parse(message.sent_at) - message.age_ms;
      });
    }
  };
  document.addEventListener("DOMContentLoaded", () => {
    const gate = document.querySelector("#gate");
    new MutationObserver(() => window.changes.push([gate.dataset.kind, now(), window.newestMs]))
      .observe(gate, { attributes: true, attributeFilter: ["data-kind"] });
  });
})()"""
HANG = """() => setTimeout(() => {
  const end = performance.now() + 1200;
  window.hung = [performance.timeOrigin + performance.now(), window.newestMs];
  while (performance.now() < end);
}, 0)"""
COVERED = 10.0
"""Mean change of brightness of the gate's panel that shows the closed cover; it is about 20."""


class Relay:
    """Passes bytes between the page and the service, in a thread of its own, until it is cut."""

    def __init__(self, target: int) -> None:
        self.port, self._target = free_port(), target
        self._loop = asyncio.new_event_loop()
        self._flows = asyncio.Event()
        threading.Thread(target=self._run, daemon=True).start()

    def set_cut(self, *, is_cut: bool) -> None:
        """Stop passing bytes, with all connections open, or go on."""
        self._loop.call_soon_threadsafe(self._flows.clear if is_cut else self._flows.set)

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        self._flows.set()
        self._loop.run_until_complete(asyncio.start_server(self._serve, "127.0.0.1", self.port))
        self._loop.run_forever()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            to_service, from_service = await asyncio.open_connection("127.0.0.1", self._target)
        except OSError:
            writer.close()
            return
        await asyncio.gather(self._pass(reader, from_service), self._pass(to_service, writer))

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            while data := await reader.read(65_536):
                await self._flows.wait()
                writer.write(data)
                await writer.drain()
        writer.close()


class Trials:
    """One service, one page, and what is stopped."""

    def __init__(self, root: Path, page: Page, relay: Relay, port: int) -> None:
        self.root, self.page, self.relay, self.port = root, page, relay, port
        self._running = contextlib.ExitStack()
        self.serve()

    def serve(self) -> None:
        """Start the service on the data folder; where it was killed, again."""
        self._running.close()
        arguments = ("serve", "--port", str(self.port), "--data", str(self.root / "data"))
        folder = ("--recordings", str(self.root / "recordings"))
        place = {"port": self.port, "log": self.root / "log", "data": self.root / "data", "environment": PATIENCE}
        self.process, self.http = self._running.enter_context(
            service_process("service.cli", *arguments, *folder, **place)
        )

    def open(self) -> None:
        """Open the page through the relay."""
        self.log_in()
        self.page.goto(self._url)

    @property
    def _url(self) -> str:
        return f"http://127.0.0.1:{self.relay.port}"

    def log_in(self) -> None:
        """Give the page the newest log-in of the service's client: a person's oldest ends when there are too many."""
        name, _, token = str(self.http.first["Cookie"]).partition("=")
        self.page.context.add_cookies([{"name": name, "value": token, "url": self._url}])

    def close(self) -> None:
        """End the service."""
        self._running.close()

    def engine(self) -> int:
        """Return the process id of the engine that has the session: of several, the one that has worked most."""
        return max(engine_pids(self.process.pid, "engine_host.process"), key=_ticks)

    def shown(self) -> None:
        """Have a session that the page shows, and nothing noted."""
        if not self._runs():
            self._start_session()
        eventually(self._shows_a_state, within_s=60.0, pause_s=0.05, detail=lambda: f"the page shows {self._kind()}")
        self.page.wait_for_timeout(400)
        self.page.evaluate("window.changes = []")

    def _runs(self) -> bool:
        newest = self.http.get(f"{V1}/sessions", params={"limit": 1}).json()["items"]
        return bool(newest) and newest[0]["status"] == "running"

    def _start_session(self) -> None:
        document = json.loads((self.root / "recordings" / "volunteer" / "calibration.json").read_text())
        made = _ok(self.http.post(f"{V1}/calibrations", params={"operator": "A. Physicist"}, json=document))
        source = {"kind": "recording", "path": "volunteer/recording.oni", "player": "reader"}
        named = {"patient_reference": "P-0001", "plan_id": "PLAN-1", "fraction_id": "FX-1"}
        request = {**named, "source": source, "calibration_id": made["id"], "window": WINDOW}
        session_id = _ok(self.http.post(f"{V1}/sessions", json=request))["id"]
        _ok(self.http.post(f"{V1}/sessions/{session_id}/start", json={}))

    def _kind(self) -> str:
        return str(self.page.get_attribute("#gate", "data-kind"))

    def _shows_a_state(self) -> bool:
        return self._kind() in SHOWS_A_STATE

    def stale_ms(self) -> tuple[float, str]:
        """Return how long after the newest frame the page ceased to show a state, and what it showed then."""
        self.page.wait_for_timeout(1_000 * STOPPED_S)
        changes = self.page.evaluate("window.changes")
        shown = [place for place, (kind, _, _) in enumerate(changes) if kind in SHOWS_A_STATE]
        ceased = changes[shown[-1] + 1 if shown else 0 :]
        assert ceased, f"the page still shows {self._kind()}"
        _, at_ms, newest_ms = ceased[0]
        return at_ms - newest_ms, " then ".join(dict.fromkeys(kind for kind, _, _ in ceased))


def _ticks(pid: int) -> int:
    """Return the processor time of a process in clock ticks."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return int(fields[11]) + int(fields[12])


def _ok(answer: Any) -> dict[str, Any]:
    assert answer.is_success, answer.text
    return dict(answer.json())


def service_killed(trials: Trials) -> tuple[float, str]:
    trials.process.kill()
    found = trials.stale_ms()
    trials.serve()
    trials.log_in()
    return found


def service_stopped(trials: Trials) -> tuple[float, str]:
    trials.process.send_signal(signal.SIGSTOP)
    found = trials.stale_ms()
    trials.process.send_signal(signal.SIGCONT)
    return found


def engine_killed(trials: Trials) -> tuple[float, str]:
    os.kill(trials.engine(), signal.SIGKILL)
    return trials.stale_ms()


def engine_stopped(trials: Trials) -> tuple[float, str]:
    engine = trials.engine()
    os.kill(engine, signal.SIGSTOP)
    found = trials.stale_ms()
    with contextlib.suppress(ProcessLookupError):
        os.kill(engine, signal.SIGCONT)
    return found


def network_cut(trials: Trials) -> tuple[float, str]:
    trials.relay.set_cut(is_cut=True)
    found = trials.stale_ms()
    trials.relay.set_cut(is_cut=False)
    return found


def script_hung(trials: Trials) -> tuple[float, str]:
    """The page's script hangs: the cover closes without it, as pictures from outside of the page show."""
    pictures: list[tuple[float, str]] = []
    unanswered: list[int] = []
    session = trials.page.context.new_cdp_session(trials.page)

    def keep(event: dict[str, Any]) -> None:
        pictures.append((1_000.0 * event["metadata"]["timestamp"], event["data"]))
        unanswered.append(event["sessionId"])

    def watch(seconds: float) -> None:
        for _ in range(round(50 * seconds)):
            while unanswered:
                session.send("Page.screencastFrameAck", {"sessionId": unanswered.pop()})
            trials.page.wait_for_timeout(20)

    session.on("Page.screencastFrame", keep)
    session.send("Page.startScreencast", {"format": "jpeg", "quality": 60, "everyNthFrame": 1})
    watch(0.3)
    trials.page.evaluate(HANG)
    watch(STOPPED_S)
    at_ms, newest_ms = trials.page.evaluate("window.hung")
    session.detach()
    before = [gate_panel(data) for taken_ms, data in pictures if taken_ms <= at_ms][-1]
    covered = [
        taken_ms
        for taken_ms, data in pictures
        if taken_ms > at_ms and np.abs(gate_panel(data) - before).mean() > COVERED
    ]
    assert covered, f"no closed cover on {len(pictures)} pictures"
    return covered[0] - newest_ms, "cover"


def gate_panel(data: str) -> npt.NDArray[np.float64]:
    """Return the gate's panel, the upper left, of a picture in base 64: brightness, shape (rows, columns)."""
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert picture is not None
    height, width = picture.shape
    return picture[int(0.10 * height) : int(0.46 * height), int(0.02 * width) : int(0.30 * width)].astype(float)


KINDS: dict[str, Callable[[Trials], tuple[float, str]]] = {
    "service killed": service_killed,
    "service stopped": service_stopped,
    "engine killed": engine_killed,
    "engine stopped": engine_stopped,
    "network cut": network_cut,
    "script hung": script_hung,
}


def tried(trials: Trials, kind: str, times: int) -> Iterator[tuple[float, str]]:
    """Try one kind some times, with a progress bar."""
    with typer.progressbar(range(times), label=f"{kind:<16}") as numbers:
        for _ in numbers:
            trials.shown()
            yield KINDS[kind](trials)


def line(kind: str, found: list[tuple[float, str]]) -> str:
    """Return a row of the table."""
    values_ms = [value_ms for value_ms, _ in found]
    shown = ", ".join(sorted({became for _, became in found}))
    figures = (*np.percentile(values_ms, (50, 95)), max(values_ms), limit_ms(kind))
    return f"| {kind} | {len(found)} | {' | '.join(f'{figure:.0f}' for figure in figures)} | {shown} |"


def limit_ms(kind: str) -> float:
    """Longest time for the 95th percentile."""
    return HUNG_LIMIT_MS if kind == "script hung" else LIMIT_MS


def main(
    times: Annotated[int, typer.Option(help="Trials of each kind", min=1, max=1_000)] = 20,
    kinds: Annotated[str, typer.Option(help="Kinds, separated by commas; all if left out")] = "",
) -> None:
    """Print how long the page shows a state after its newest frame; end with 1 where a p95 is above its limit."""
    wanted = [one.strip() for one in kinds.split(",") if one.strip()] or list(KINDS)
    unknown = [one for one in wanted if one not in KINDS]
    if unknown:
        raise typer.BadParameter(f"{', '.join(unknown)}: must be of {', '.join(KINDS)}", param_hint="--kinds")
    load_before = os.getloadavg()[0]
    with tempfile.TemporaryDirectory(prefix="tidegate-page-") as name, sync_playwright() as playwright:
        root, port = Path(name), free_port()
        volunteer_folder(root / "recordings", RECORDING_S)
        browser = launch_chromium(playwright, is_shell=False)
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.add_init_script(NOTE)
        trials = Trials(root, page, Relay(port), port)
        try:
            trials.open()
            found = {kind: list(tried(trials, kind, times)) for kind in wanted}
        finally:
            trials.close()
        browser.close()
    typer.echo("| stopped | trials | median [ms] | p95 [ms] | longest [ms] | limit for p95 [ms] | the page then |")
    typer.echo("|---|---|---|---|---|---|---|")
    for kind, results in found.items():
        typer.echo(line(kind, results))
    typer.echo(f"{os.cpu_count()} processors, load {load_before:.1f} before and {os.getloadavg()[0]:.1f} after")
    if any(np.percentile([one for one, _ in results], 95) > limit_ms(kind) for kind, results in found.items()):
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(main)
