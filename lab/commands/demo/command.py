"""``tidegate demo``: a complete gated session on a virtual volunteer, over the HTTP API.

Creates an account, starts ``tidegate serve`` as a process and makes a recording meanwhile, logs in, plays the recording
in real time through the OpenNI2 runtime, opens a session, trains, sets the reference at end-exhale, arms, gates, and
compares what the service stored with the truth.
"""

import contextlib
import os
import secrets
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType
from typing import Annotated, Literal

import typer
from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from engine.capture.drivers import is_player_available, missing_text
from engine.core.errors import TidegateError
from lab.commands.demo.result import DemoWindow, Result, result_of
from service.access.accounts.passwords import Argon2Hashing
from service.access.accounts.people import AccountService, Change
from service.access.accounts.records import name_key
from service.access.accounts.store import AccessStore
from service.cli.terminal import refused
from service.client import ClientError, ProblemError, Sample, TidegateClient, Window
from service.core.permissions import Role
from service.storage.database.engine import Database
from service.storage.database.startup import prepare
from service.storage.files.folder_lock import alone_in

OPERATOR = "Demo"
PASSWORD_BYTES = 12
EDGES = DemoWindow(lower_mm=-1.5, upper_mm=2.0, hysteresis_mm=0.2, dwell_s=0.2)
WINDOW: Window = {
    "signal": "whole",
    "lower_mm": EDGES.lower_mm,
    "upper_mm": EDGES.upper_mm,
    "hysteresis_mm": EDGES.hysteresis_mm,
    "dwell_ms": 1000.0 * EDGES.dwell_s,
}
HEAD: Literal["top"] = "top"
"""The virtual volunteers lie with the head at the top of the picture."""
START_TIMEOUT_S = 60.0
SILENCE_S = 15.0
ENDED = 128 + signal.SIGTERM
"""Exit code of a program that was ended, as a shell shows it."""
LOOK_US = 500_000
"""How often the session is read for the proposed reference."""
OPEN = frozenset({"created", "running"})
PRESENCE_S = 1.0
"""The person of the demonstration watches its output here, as another does the page."""
ROLES = frozenset({Role.PHYSICIST, Role.ADMIN})
"""All roles, so that the demonstration shows every page. At a site two people have them."""
_STYLES = {"beam_on": "bold black on green", "fault": "bold white on red", "hold": "black on yellow"}


class DemoError(TidegateError):
    """The demonstration cannot continue."""

    code = "demo_failed"


def put_person(data: Path, name: str, *, by: str) -> str:
    """Create the account or reset its password; return the one-time password."""
    data.mkdir(mode=0o700, parents=True, exist_ok=True)  # it will hold password hashes
    with alone_in(data):
        database = Database(data / "tidegate.db")
        try:
            prepare(database, data_dir=data, min_free_disk_mb=0.0)
            return _one_time_password(database, name, by=by)
        finally:
            database.close()


def _one_time_password(database: Database, name: str, *, by: str) -> str:
    store = AccessStore(database)
    store.load()
    people = AccountService(store, Argon2Hashing().hash)
    if name_key(name) in store.users:
        change = Change(roles=ROLES, is_disabled=False, reset_password=True)
        issued = people.change(name, change, by=by)
    else:
        issued = people.add(name, ROLES, by=by)
    return issued.one_time_password or ""


def demo(
    folder: Annotated[Path, typer.Option(help="Folder for recordings and the service's data.")] = Path("var/demo"),
    seconds: Annotated[float, typer.Option(help="Length of the recording [s].", min=30.0, max=3600.0)] = 40.0,
    volunteer: Annotated[int, typer.Option(help="Number of the volunteer, 1 to 10.")] = 10,
    port: Annotated[
        int, typer.Option(help="Port of the service; if it is taken, the next free one.", min=1, max=65_535)
    ] = 8000,
    keep: Annotated[bool, typer.Option("--keep", help="Keep the service running until Ctrl-C.")] = False,
) -> None:
    """Run a gated session on a virtual volunteer and compare it with the true motion.

    Starts a service and generates a recording meanwhile, plays the recording as a camera, trains, arms and gates; the
    web page shows it live.
    """
    console = Console(highlight=False)
    try:
        one_time_password = put_person(_data(folder), OPERATOR, by="tidegate demo")
        with _service(folder, _free_port(port)) as service:
            recording = _volunteer(folder, volunteer, seconds, console)
            service.wait_until_ready()
            address, api = service.address, service.api
            console.print(f"2 of 4  The service is running: open [bold]{address}/[/bold]")
            password = _log_in(api, one_time_password)
            _show(_gate(api, recording, seconds, console), console)
            if keep:
                console.print(
                    f"Still running: {address}/  Log in as {OPERATOR} with the password {password}  (Ctrl-C ends)",
                    markup=False,
                )
                _wait_for_ctrl_c()
    except (TidegateError, ClientError) as error:
        raise refused("demo", error) from error


def _leave(_signal: int, _frame: FrameType | None) -> None:
    """End as by Ctrl-C, so that the service is stopped, too."""
    raise typer.Exit(ENDED)


def _volunteer(folder: Path, volunteer: int, seconds: float, console: Console) -> Path:
    """Generate the recording, or use the one of an earlier run."""
    from lab.commands.phantom import phantom

    out = folder / f"regular-{volunteer}-{seconds:g}s"
    if (out / "truth.npz").exists():
        console.print(f"1 of 4  Volunteer {volunteer}, {seconds:g} s: recording of an earlier run, {out}", markup=False)
    else:
        console.print(f"1 of 4  Making volunteer {volunteer}, {seconds:g} s of regular breathing", markup=False)
        phantom("regular", out=out, volunteer=volunteer, seconds=seconds, fps=30.0, seed=1, trace=None, workers=None)
    return out


def _log_in(api: TidegateClient, one_time_password: str) -> str:
    """Log in with the one-time password and change it; return the new one."""
    password = secrets.token_urlsafe(PASSWORD_BYTES)
    api.log_in(OPERATOR, one_time_password)
    api.change_password(one_time_password, password)
    return password


def _data(folder: Path) -> Path:
    return (folder / "data").resolve()


def _free_port(wanted: int) -> int:
    for port in range(wanted, min(wanted + 50, 65_536)):
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port
    message = f"no free port from {wanted} to {wanted + 49}"
    raise DemoError(message)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Service:
    """A service of the demonstration's own, as a process."""

    address: str
    api: TidegateClient
    process: "subprocess.Popen[bytes]"
    log: Path

    def wait_until_ready(self) -> None:
        """Wait until it answers; raise DemoError where it does not, with the end of its log."""
        deadline = time.monotonic() + START_TIMEOUT_S
        while time.monotonic() < deadline:
            if self.process.poll() is not None:
                message = f"the service stopped during its start: {self.log.read_text(errors='replace')[-400:].strip()}"
                raise DemoError(message)
            url = f"{self.address}/healthz"
            with contextlib.suppress(OSError), urllib.request.urlopen(url, timeout=1.0):  # noqa: S310 - loopback # nosec B310
                return
            time.sleep(0.1)
        message = f"the service did not answer within {START_TIMEOUT_S:g} s"
        raise DemoError(message)


@contextlib.contextmanager
def _service(folder: Path, port: int) -> Iterator[_Service]:
    command = [sys.executable, "-m", "service.cli", "serve", "--port", str(port), "--data", str(_data(folder))]
    environment = {key: value for key, value in os.environ.items() if not key.startswith("TIDEGATE_")}
    log_path, address = folder / "service.log", f"http://127.0.0.1:{port}"
    early: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _frame: early.append(number))
    with log_path.open("wb") as log:
        process = subprocess.Popen(
            [*command, "--recordings", str(folder.resolve())], stdout=log, stderr=log, env=environment
        )
        try:
            signal.signal(signal.SIGTERM, _leave)  # from here on the service is ended with it
            if early:
                raise typer.Exit(ENDED)
            with TidegateClient(address, retries=0, timeout_s=30.0) as api:
                yield _Service(address=address, api=api, process=process, log=log_path)
        finally:
            signal.signal(signal.SIGTERM, signal.SIG_IGN)  # it ends already
            process.terminate()
            try:
                process.wait(timeout=10.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _gate(api: TidegateClient, recording: Path, seconds: float, console: Console) -> Result:
    """Run one session from its creation to the end of the recording; compare it with the truth."""
    player: Literal["openni", "reader"] = "openni" if is_player_available() else "reader"
    if player == "reader":
        console.print(
            f"  {missing_text()}. Playing through Tidegate's own reader.",
            style="yellow",
        )
    calibration = api.upload_calibration((recording / "calibration.json").read_bytes())
    session = api.create_session(
        {
            "patient_reference": "PHANTOM-1",
            "plan_id": f"DEMO-{datetime.now(UTC):%Y%m%d-%H%M%S}",  # of its own: another volunteer lies elsewhere
            "fraction_id": "FX-1",
            "source": {"kind": "recording", "path": str((recording / "recording.oni").resolve()), "player": player},
            "calibration_id": calibration["id"],
            "window": WINDOW,
            "head_direction": HEAD,
        }
    )
    api.start(session["id"])
    console.print(f"3 of 4  Session {session['id'][:8]}: {seconds:g} s through {player}; the motion model is learned")
    _follow(api, session["id"], seconds, console)
    _close(api, session["id"])
    samples = api.export_samples(session["id"], recording / "samples.csv").path
    return result_of(api.read_session(session["id"])["summary"], samples, recording, EDGES)


def _close(api: TidegateClient, session_id: str) -> None:
    """Stop the session unless the end of the recording has closed it; wait until its samples are stored."""
    with contextlib.suppress(ProblemError):
        api.stop(session_id)
    deadline = time.monotonic() + START_TIMEOUT_S
    while api.read_session(session_id)["status"] in OPEN and time.monotonic() < deadline:
        time.sleep(0.1)


def _follow(api: TidegateClient, session_id: str, seconds: float, console: Console) -> None:
    """Print a live status line; set the reference as proposed and arm, until the recording ends."""
    began = time.monotonic()
    is_armed, looked_us, reported_s = False, 0, 0.0
    with Live(console=console, refresh_per_second=8, transient=True) as live:
        for message in api.live(form="full", silence_s=SILENCE_S):
            if message["type"] == "idle":
                if api.read_session(session_id)["status"] in OPEN:
                    continue
                return
            if message["type"] != "sample" or message["form"] != "full":
                continue
            live.update(_line(message, seconds))
            if message["session_status"] != "running":
                return
            if time.monotonic() - reported_s >= PRESENCE_S:
                reported_s = time.monotonic()
                _be_present(api, session_id)
            at_us = message["timestamp_us"]
            if not is_armed and message["state"] == "measuring" and at_us - looked_us >= LOOK_US:
                looked_us = at_us
                is_armed = _begin_gating(api, session_id, console, began)


def _begin_gating(api: TidegateClient, session_id: str, console: Console, began: float) -> bool:
    """Set the reference as proposed and arm; return false until enough breaths are known."""
    proposals = api.read_session(session_id).get("reference_proposals", [])
    proposed = next((one for one in proposals if one["at"] == "end_exhale"), None)
    if proposed is None:
        return False
    api.set_reference(session_id, level_seen=proposed["level"])
    _arm(api, session_id)
    console.print(
        f"4 of 4  Reference set at end-exhale of {proposed['breaths']} breaths, scatter {proposed['scatter']:.2f} mm; "
        f"armed after {time.monotonic() - began:.0f} s of the session."
    )
    return True


def _be_present(api: TidegateClient, session_id: str) -> None:
    """Report presence; the recording may have ended meanwhile."""
    with contextlib.suppress(ProblemError):
        api.note_presence(session_id)


def _arm(api: TidegateClient, session_id: str) -> None:
    """Arm once the next frame has become the reference."""
    for attempt in range(10):
        try:
            api.arm(session_id, head_direction=HEAD)
        except ProblemError:
            if attempt == 9:
                raise
            time.sleep(0.1)
        else:
            return


def _line(message: Sample, seconds: float) -> Text:
    line = Text(f"{message['timestamp_us'] / 1e6:4.0f} of {seconds:.0f} s ")
    line.append(f" {message['gate'].replace('_', ' ').upper():9}", _STYLES.get(message["gate"], "reverse"))
    if message["training"] is not None:
        training = message["training"]
        line.append(f"  training {training['share']:4.0%}, {training['cycles']} cycles  {training['note']}")
    else:
        motion = message["whole_mm"]
        line.append(f"  {motion:+6.2f} mm" if motion is not None else f"  {message['state']}")
    latency = message["latency_ms"]["last"]
    line.append(f"  {message['fps'] or 0.0:4.1f} frames/s  {latency or 0.0:4.1f} ms  {message['hold_text'] or ''}")
    return line


def _show(result: Result, console: Console) -> None:
    table = Table("", "expected", "measured", title="Result", title_justify="left")
    for row in result.rows:
        style = None if row.is_expected else "bold red"
        table.add_row(row.what, row.expected, row.measured, style=style)
    console.print(table)
    console.print(result.verdict, style="green" if all(row.is_expected for row in result.rows) else "bold red")


def _wait_for_ctrl_c() -> None:
    with contextlib.suppress(KeyboardInterrupt):
        while True:
            time.sleep(1.0)
