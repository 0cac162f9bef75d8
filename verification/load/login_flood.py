"""What a flood of log-ins costs the gate.

Run: ``python -m verification.load.login_flood [--rounds 8] [--volunteer FOLDER]``.

A real service plays a recorded volunteer in real time; the time from receipt of a frame to the command is read from
the live stream, two seconds in peace, two seconds while eight clients try made-up names and passwords from made-up
addresses, in turn, so that what the session does meanwhile is the same for both. No lock-out spares the service work.
"""

import argparse
import http.client
import json
import os
import secrets
import ssl
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path

import httpx2
import numpy as np
from websockets.sync.client import connect

from lab.phantom.recording import make_volunteer
from service.core.settings.settings import Settings
from tests.support.repository import ROOT
from tests.support.service.accounts import SOMEBODY, Provisioned, provision
from tests.support.service.processes import free_port

FLOODERS = 8
SETTLE_S = 3.0
ROUND_S = 2.0
WINDOW = {"signal": "whole", "lower_mm": -1.0, "upper_mm": 3.0, "hysteresis_mm": 0.2, "dwell_ms": 200.0}


def start_session(client: httpx2.Client, folder: Path) -> str:
    """Start a session on the volunteer; returns its id."""
    document = (folder / "calibration.json").read_bytes()
    json_type = {"Content-Type": "application/json"}
    kept = client.post("/api/v1/calibrations", content=document, headers=json_type).raise_for_status().json()
    body = {
        "patient_reference": "P-0001",
        "plan_id": "PLAN-1",
        "fraction_id": "FX-1",
        "source": {"kind": "recording", "path": str(folder / "recording.oni"), "player": "reader"},
        "calibration_id": kept["id"],
        "window": WINDOW,
    }
    session_id = client.post("/api/v1/sessions", json=body).raise_for_status().json()["id"]
    client.post(f"/api/v1/sessions/{session_id}/start", json={}).raise_for_status()
    return session_id


def watch(port: int, headers: dict[str, str], seconds: float) -> np.ndarray:
    """Read each frame's latency [ms] for so long."""
    found = []
    with connect(f"ws://127.0.0.1:{port}/api/v1/live", additional_headers=headers) as socket:
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            message = json.loads(socket.recv(timeout=10.0))
            if message["type"] == "sample" and message["latency_ms"]["last"] is not None:
                found.append(message["latency_ms"]["last"])
    return np.array(found)


class Flood:
    """Clients that try to log in as fast as they are answered."""

    def __init__(self, port: int, trusted: ssl.SSLContext | None = None) -> None:
        self._port, self._trusted = port, trusted
        self._is_over = threading.Event()
        self.answers: Counter[int] = Counter()
        self._threads = [threading.Thread(target=self._try, daemon=True) for _ in range(FLOODERS)]

    def __enter__(self) -> "Flood":
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_over.set()
        for thread in self._threads:
            thread.join()

    def _try(self) -> None:
        if self._trusted is None:
            client = http.client.HTTPConnection("127.0.0.1", self._port, timeout=30.0)
        else:
            client = http.client.HTTPSConnection("127.0.0.1", self._port, timeout=30.0, context=self._trusted)
        while not self._is_over.is_set():
            address = ".".join(str(1 + secrets.randbelow(200)) for _ in range(4))
            body = json.dumps({"name": secrets.token_hex(8), "password": secrets.token_hex(12)})
            headers = {"X-Forwarded-For": address, "Content-Type": "application/json"}
            client.request("POST", "/api/v1/login", body, headers)
            answer = client.getresponse()
            answer.read()
            self.answers[answer.status] += 1
        client.close()


def reported(name: str, latencies_ms: np.ndarray) -> str:
    """Write a line of the table."""
    p50, p99 = np.percentile(latencies_ms, [50, 99])
    return f"| {name} | {len(latencies_ms)} | {p50:.1f} | {p99:.1f} | {latencies_ms.max():.1f} |"


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=8, help="of two seconds in peace and two under attack")
    parser.add_argument("--volunteer", type=Path, help="a folder of `tidegate phantom`; made when left out")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        folder, data, port = options.volunteer or Path(place) / "volunteer", Path(place) / "data", free_port()
        if options.volunteer is None:
            make_volunteer("regular", volunteer=1, seconds=4.0 * options.rounds + 15.0, seed=1, out=folder)
        settings = Settings(data_dir=data, behind_proxy=True)
        known = provision(data, origin=f"https://127.0.0.1:{port}", settings=settings)
        _measure(known, folder, data, port, options.rounds)


def _measure(known: Provisioned, folder: Path, data: Path, port: int, rounds: int) -> None:
    arguments = ("serve", "--port", str(port), "--data", str(data), "--recordings", str(folder))
    process = subprocess.Popen(
        [sys.executable, "-m", "service.cli", *arguments],
        cwd=ROOT,
        env={**os.environ, "TIDEGATE_BEHIND_PROXY": "true", "TIDEGATE_ALLOWED_HOSTS": "127.0.0.1"},
    )
    headers = known.people[SOMEBODY]
    peace, storm, answers = [], [], Counter()
    try:
        with httpx2.Client(base_url=f"http://127.0.0.1:{port}", headers=headers, timeout=30.0) as client:
            _wait(client)
            start_session(client, folder.resolve())
            watch(port, headers, SETTLE_S)
            for _ in range(rounds):
                peace.append(watch(port, headers, ROUND_S))
                with Flood(port) as flood:
                    storm.append(watch(port, headers, ROUND_S))
                answers += flood.answers
    finally:
        process.terminate()
        process.wait(30.0)
    lines = ["| | frames | p50 [ms] | p99 [ms] | longest [ms] |", "|---|---|---|---|---|"]
    lines += [
        reported("in peace", np.concatenate(peace)),
        reported(f"{FLOODERS} clients log in", np.concatenate(storm)),
    ]
    lines += ["", f"passwords checked: {answers[401]}, refused unread: {answers[503] + answers[429]}"]
    lines += [f"load of the machine, 1 min: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"]
    sys.stdout.write("\n".join(lines) + "\n")


def _wait(client: httpx2.Client) -> None:
    for _ in range(600):
        try:
            client.get("/healthz").raise_for_status()
        except httpx2.TransportError:
            time.sleep(0.1)
        else:
            return


if __name__ == "__main__":
    main()
