"""`tidegate smoke` against real services, over plain HTTP and TLS, and against what must fail."""

import json
import os
import subprocess
import sys
from datetime import UTC, datetime, timedelta

import pytest

from engine import __version__
from service.cli.smoke import check_stream
from service.client import UnreachableError
from tests.support.access.tls_certificate import make_certificate
from tests.support.planning.treatment_services import quick_room
from tests.support.repository import ROOT
from tests.support.service.processes import free_port, service_process
from tests.support.service.tls_stub import tls_stub
from tests.support.waiting import eventually

KEY = "tg_" + "A" * 43
DEAD_ENGINE = """
import sys
from service.engine_host.process import messages
messages.MODULE = "service.no_such_module"
from service.cli import app
app(sys.argv[1:])
"""


def smoke(url, *words, key=None, **environment):
    """Run the command; returns its exit code and its checks by name."""
    done = subprocess.run(
        [sys.executable, "-m", "service.cli", "smoke", url, "--json", *map(str, words)],
        cwd=ROOT,
        env={**os.environ, "TPS_KEY": key or "", **environment},
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert done.returncode in {0, 1}, done.stderr
    found = json.loads(done.stdout)
    assert found["passed"] == (done.returncode == 0)
    return done.returncode, {one["check"]: one for one in found["checks"]}


def key_of(client):
    return client.key_headers["Authorization"].removeprefix("Bearer ")


def outcomes(checks):
    return {name: one["outcome"] for name, one in checks.items()}


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plain")
    port = free_port()
    arguments = ("service.cli", "serve", "--port", str(port), "--data", str(folder / "data"))
    outside = {"TIDEGATE_AUDIT_ANCHOR_FILE": str(folder / "anchors.jsonl")}
    where = {"port": port, "log": folder / "log", "data": folder / "data", "environment": outside}
    with service_process(*arguments, **where) as (_, client):
        eventually(lambda: client.get("/readyz").status_code == 200, within_s=120.0)
        yield f"http://127.0.0.1:{port}", key_of(client)


@pytest.fixture(scope="module")
def over_tls(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tls")
    tls = make_certificate(folder, ends_in=timedelta(days=20.5))
    port = free_port()
    arguments = ("service.cli", "serve", "--port", str(port), "--data", str(folder / "data"))
    with service_process(*arguments, port=port, log=folder / "log", data=folder / "data", tls=tls) as (_, client):
        eventually(lambda: client.get("/readyz").status_code == 200, within_s=120.0)
        yield f"https://127.0.0.1:{port}", key_of(client), tls[0]


def test_an_idle_service_over_plain_http_on_this_machine_passes(plain):
    code, checks = smoke(plain[0], "--expect-version", __version__, key=plain[1])
    assert code == 0, checks
    assert outcomes(checks) == {
        "certificate": "skipped",
        "liveness": "ok",
        "readiness": "ok",
        "version": "ok",
        "clock": "ok",
        "live stream": "ok",
    }
    assert checks["live stream"]["figures"]["messages"] >= 2


def test_frames_are_required_where_they_are_asked_for(plain):
    code, checks = smoke(plain[0], "--require-frames", key=plain[1])
    assert (code, checks["live stream"]["detail"]) == (1, "no frame was received: no session runs")


def test_another_version_than_expected_fails(plain):
    code, checks = smoke(plain[0], "--expect-version", "0.0.1", key=plain[1])
    assert (code, checks["version"]["outcome"]) == (1, "failed")
    assert checks["version"]["detail"] == f"{__version__}, and 0.0.1 is required"


def test_a_key_that_is_not_known_fails(plain):
    code, checks = smoke(plain[0], key=KEY)
    assert (code, checks["readiness"]["outcome"], checks["live stream"]["outcome"]) == (1, "failed", "failed")


def test_over_its_own_tls_the_certificate_is_described(over_tls):
    url, key, authority = over_tls
    code, checks = smoke(url, "--ca-file", authority, key=key)
    certificate = checks["certificate"]
    assert (code, certificate["outcome"]) == (0, "ok"), checks
    assert certificate["figures"]["names"] == ["localhost", "gating.example", "127.0.0.1"]
    assert 20.0 < certificate["figures"]["days_left"] < 20.6
    assert certificate["figures"]["tls"] in {"TLSv1.2", "TLSv1.3"}
    assert checks["live stream"]["outcome"] == "ok"


def test_a_certificate_that_ends_soon_is_a_warning_of_the_service_and_fails_where_it_must_not(over_tls):
    """The service warns 30 days before."""
    url, key, authority = over_tls
    code, checks = smoke(url, "--ca-file", authority, key=key)
    assert (code, checks["readiness"]["outcome"]) == (0, "warning"), checks
    assert smoke(url, "--ca-file", authority, "--strict", key=key)[0] == 1
    code, checks = smoke(url, "--ca-file", authority, "--min-days", "21", key=key)
    assert (code, checks["certificate"]["outcome"]) == (1, "failed")
    assert "at least 21 are required" in checks["certificate"]["detail"]


def test_an_authority_that_is_not_trusted_fails_and_no_key_is_sent(over_tls):
    code, checks = smoke(over_tls[0], key=over_tls[1])
    assert code == 1
    assert checks["certificate"]["detail"].startswith("not trusted: self-signed certificate")
    assert outcomes(checks)["liveness"] == "failed"
    assert {outcomes(checks)[name] for name in ("readiness", "version", "live stream")} == {"skipped"}


@pytest.mark.parametrize(
    ("made", "words"),
    [
        ({"ends_in": timedelta(days=-1)}, "not trusted: certificate has expired"),
        (
            {"began_before": timedelta(days=-1), "ends_in": timedelta(days=9)},
            "not trusted: certificate is not yet valid",
        ),
        ({"addresses": ("192.0.2.1",)}, "not trusted: IP address mismatch"),
    ],
    ids=["expired", "not yet valid", "another name"],
)
def test_a_wrong_certificate_is_named_and_described(tmp_path, made, words):
    certificate, key = make_certificate(tmp_path, **made)
    with tls_stub(certificate, key) as port:
        code, checks = smoke(f"https://127.0.0.1:{port}", "--ca-file", certificate, key=KEY)
    assert (code, checks["certificate"]["outcome"]) == (1, "failed")
    assert checks["certificate"]["detail"].startswith(words)
    assert checks["certificate"]["figures"]["names"][:2] == ["localhost", "gating.example"]


def test_where_nothing_listens_it_fails():
    code, checks = smoke(f"https://127.0.0.1:{free_port()}", key=KEY)
    assert (code, checks["certificate"]["outcome"], checks["liveness"]["outcome"]) == (1, "failed", "failed")


def test_a_service_whose_engine_does_not_start_fails(tmp_path):
    port = free_port()
    program = tmp_path / "dead_engine.py"
    program.write_text(DEAD_ENGINE)
    with service_process(
        "dead_engine",
        *("serve", "--port", str(port), "--data", str(tmp_path / "data")),
        port=port,
        log=tmp_path / "log",
        data=tmp_path / "data",
        environment={"PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}"},
    ) as (_, client):
        code, checks = smoke(f"http://127.0.0.1:{port}", key=key_of(client))
    assert (code, checks["readiness"]["outcome"]) == (1, "failed")
    assert "engine" in checks["readiness"]["detail"]


def test_a_running_session_has_frames_and_a_frame_that_is_too_old_fails(tmp_path):
    with quick_room(tmp_path) as room, room.client() as client:
        calibration = client.upload_calibration((tmp_path / "calibration.json").read_bytes())["id"]
        source = {"kind": "recording", "path": "chest.oni", "player": "reader"}
        window = {"signal": "whole", "lower_mm": -1.0, "upper_mm": 2.0}
        wanted = {"calibration_id": calibration, "source": source, "window": window, "patient_reference": "P-1"}
        session = client.create_session({**wanted, "fraction_id": "F-1", "plan_id": "plan"})
        client.start(session["id"])
        code, checks = smoke(room.url, "--require-frames", key=room.key)
        assert (code, checks["live stream"]["outcome"]) == (0, "ok"), checks
        assert checks["live stream"]["figures"]["frames"] > 5
        client.stop(session["id"])
        assert smoke(room.url, "--require-frames", key=room.key)[0] == 1


class Streaming:
    """A client whose live stream says what it is given."""

    def __init__(self, *messages, error=None):
        self._messages, self._error = messages, error

    def live(self, **_):
        yield from self._messages
        if self._error is not None:
            raise self._error


def hello(seconds_ago=0.0):
    sent = (datetime.now(UTC) - timedelta(seconds=seconds_ago)).isoformat()
    return {"type": "hello", "version": "1.2.3", "sent_at": sent}


def sample(age_ms, status="running"):
    return {"type": "sample", "age_ms": age_ms, "session_status": status}


@pytest.mark.parametrize(
    ("messages", "error", "said"),
    [
        ((hello(), sample(20.0), sample(499.0)), None, None),
        ((hello(), sample(501.0), sample(20.0)), None, "a frame was 501 ms old; at most 500 ms are allowed"),
        ((hello(), sample(20.0, "failed")), None, "no frame was received: no session runs"),
        ((hello(), {"type": "idle"}), None, "no frame was received: no session runs"),
        ((hello(),), None, "nothing came after the greeting"),
        ((), None, "no message was received"),
        ((hello(), sample(20.0)), UnreachableError("the live stream is broken"), "the live stream is broken"),
    ],
    ids=["fresh", "old", "failed session", "idle", "only a greeting", "nothing", "broken"],
)
def test_what_comes_on_the_stream_is_judged(messages, error, said):
    stream = check_stream(Streaming(*messages, error=error), None, needs_frames=True)[2]
    assert (stream.outcome, stream.detail if said else None) == ("failed" if said else "ok", said)


@pytest.mark.parametrize(("seconds_ago", "outcome"), [(0.0, "ok"), (5.0, "warning"), (-5.0, "warning")])
def test_clocks_that_differ_are_a_warning(seconds_ago, outcome):
    assert check_stream(Streaming(hello(seconds_ago), sample(20.0)), None, needs_frames=False)[1].outcome == outcome


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("http://192.0.2.1",), "base_url must be https"),
        (("gating.example",), "base_url must be https://host"),
        (("https://gating.example", "--min-days", "-1"), "--min-days"),
        (("https://gating.example", "--ca-file", "/no/such/file"), "No such file"),
        (("https://gating.example", "--key-file", "/no/such/file"), "No such file"),
    ],
)
def test_options_that_cannot_be_are_refused(words, said):
    done = subprocess.run(
        [sys.executable, "-m", "service.cli", "smoke", *words],
        cwd=ROOT,
        env={**os.environ, "TPS_KEY": KEY},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, said in done.stderr) == (2, True), done.stderr


def test_without_any_key_it_is_refused():
    environment = {name: value for name, value in os.environ.items() if name != "TPS_KEY"}
    words = [sys.executable, "-m", "service.cli", "smoke", "https://gating.example"]
    done = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, "TPS_KEY" in done.stderr) == (2, True), done.stderr
