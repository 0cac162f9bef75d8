"""A controller that says what a test tells it to: the page and its contracts on a loopback port, nothing behind."""

import asyncio
import contextlib
import copy
import functools
import json
import math
import mimetypes
import re
import socket
import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import cv2
import numpy as np
import uvicorn
from starlette.applications import Starlette
from starlette.datastructures import MutableHeaders
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

import service
from engine.core.sentences import listed, say, word
from service.core.permissions import Role, permissions_of
from service.core.schemas.reports import SessionMoment
from service.core.schemas.sentences import sentence_parts
from service.sessions.report.trace import TraceSamples, trace_part
from service.web.app import LANGUAGE_LIST, language_names
from tests.support.waiting import eventually

DASHBOARD = Path(service.__file__).parent / "web" / "dashboard"
POLICY = "default-src 'self'; base-uri 'none'; frame-ancestors 'none'; form-action 'none'"
SESSION_ID = "5e" * 16
ROI_PX = [[238.0, 92.0], [409.0, 99.0], [421.0, 401.0], [226.0, 396.0]]
ROWS, COLUMNS = 14, 8

PROPOSAL = {"at": "end_exhale", "signal": "whole", "unit": "mm", "level": -1.25, "scatter": 0.21, "breaths": 4} | {
    "percent": 2.4
}
SESSION = {
    "signed_by": [],
    "reference_proposals": [PROPOSAL],
    "id": SESSION_ID,
    "status": "running",
    "status_detail": "",
    "patient_reference": "P-0117",
    "plan_id": "PLAN-LUNG-4",
    "fraction_id": "FX-03",
    "fraction_number": 3,
    "operator": "A. Therapist",
    "source": {"kind": "recording", "path": "demo/recording.oni", "player": "auto"},
    "calibration_id": "ca" * 16,
    "window": {"kind": "amplitude", "signal": "whole", "row": None, "column": None, "lower_mm": -1.0, "upper_mm": 3.0}
    | {"hysteresis_mm": 0.2, "dwell_ms": 200.0, "join": "and", "further": []},
    "is_simulated_beam": True,
    "created_at": "2026-11-21T03:00:00Z",
    "started_at": None,
    "ended_at": None,
}
CALIBRATION = {
    "id": "ca" * 16,
    "sha256": "0" * 64,
    "camera": "Xtion 03",
    "uploaded_by": "B. Physicist",
    "created_at": "2026-11-20T08:00:00Z",
}

RECORDING = {
    "path": "demo/recording.oni",
    "bytes": 41_000_000,
    "modified_at": "2026-11-20T08:00:00Z",
    "seconds": 40.0,
    "width_px": 640,
    "height_px": 480,
    "fps": 30,
    "has_color": True,
    "mirrored": None,
    "problem": None,
}
PLAN = {
    "id": "9a" * 16,
    "kind": "RT Plan",
    "sop_instance_uid": "1.2.3",
    "patient_reference": "P-0300",
    "label": "LUNG_GATED",
    "gating": "gating",
    "imported_by": "B. Physicist",
    "created_at": "2026-11-20T08:00:00Z",
    "fractions_planned": 15,
    "next_fraction": 3,
    "last_session": None,
}

REPORT = {
    "session": {"window": {"signal": "whole"}, "is_simulated_beam": True},  # the rest is that of the session asked for
    "head": {
        "room": "Room 2",
        "machine": "TrueBeam 4",
        "armed_by": ["A. Therapist"],
        "plan_label": "LUNG-4",
        "plan_uid": "1.2.3.4",
        "camera": "Astra 18042730123",
        "calibrated_at": "2026-11-02T08:00:00Z",
        "qa": "pass, 21 Nov 2026",
        "first_sample_at": "2026-11-21T09:12:00Z",
    },
    "figures": {
        "frames": 5400,
        "missed_frames": 3,
        "lost": 41,
        "recorded_s": 187.0,
        "armed_s": 120.1,
        "pulse_s": {"median": 1.6, "low": 1.1, "high": 1.9},
        "pulse_list": [{"from_s": 41.0, "to_s": 42.6, "seconds": 1.6, "spread": 0.8}],
        "holds": [{"reason": "outside_window", "text": "Outside the window", "count": 34, "seconds": 70.2}],
        "baseline_last": -0.4,
        "beam_on_s": 41.2,
        "duty_percent": 34.3,
        "pulses": 26,
        "latency": {"p99_ms": 31.0},
        "cells": [[round(0.1 * (row + column), 2) for column in range(8)] for row in range(14)],
        "latency_bins": [0, 3, 1100, 200, 40, 2, 1] + [0] * 34,
        "amplitude": {"median": 9.02, "low": 7.9, "high": 10.4},
        "period_s": {"median": 4.01, "low": 3.6, "high": 4.5},
        "motion": [
            {"signal": "whole", "mean_mm": 0.42, "deviation_mm": 0.81, "within_95_mm": 1.52, "frames": 1236},
            {"signal": "thorax", "mean_mm": 0.2, "deviation_mm": 0.4, "within_95_mm": 0.8, "frames": 1236},
        ],
    },
    "deviations": ["the beam line was simulated"],
    "content_sha256": "ab" * 32,
    "differs": [],
    "windows": [
        {
            "at": "2026-11-21T09:12:00Z",
            "actor": "A",
            "text": "as prescribed",
            "reason": "",
            "lower": -1.0,
            "upper": 3.0,
        },
        {"at": "2026-11-21T09:13:10Z", "actor": "A", "text": "set", "reason": "", "lower": -1.5, "upper": 2.0},
    ],
    "signatures": [],
    "signatures_needed": 1,
    "events": [
        {"at": "2026-11-21T09:12:40Z", "actor": "A. Therapist", "action": "session.arm", "text": "armed"},
        {"at": "2026-11-21T09:18:50Z", "actor": "A. Therapist", "action": "session.stop", "text": "stopped"},
    ],
}
"""What the page takes from the report of a session."""

WAITING = {
    "frames": 0,
    "cycles": 0,
    "seconds": 0.0,
    "share": 1.0,
    "note": "a new model is ready: it is used when the gate is disarmed",
}


BREATH = {
    "signal": "whole",
    "unit": "mm",
    "phase_percent": 37.4,
    "phase_confidence": 0.92,
    "note": "",
    "rate_per_min": 14.96,
    "rate_confidence": 0.95,
    "amplitude": 9.02,
    "baseline": -0.42,
    "drift": 0.21,
    "drift_per_s": 0.004,
    "regularity": 0.94,
    "events": [],
}


def condition(**changes: Any) -> dict[str, Any]:
    """Return an amplitude condition on the whole as the stream tells it; `changes` say what is different."""
    nothing = dict.fromkeys(
        (
            *("row", "column", "name", "hold", "settle_ms", "still", "max_drift", "timeout_s", "stage"),
            *("from_percent", "to_percent", "min_confidence"),
        )
    )
    edges = {"unit": "mm", "lower": -1.0, "upper": 3.0, "hysteresis": 0.2}
    return nothing | edges | {"kind": "amplitude", "signal": "whole", "label": "whole", "is_inside": False} | changes


def breath_hold(**changes: Any) -> dict[str, Any]:
    """Return a condition of a held inspiration."""
    numbers = {"settle_ms": 1000.0, "still": 1.0, "max_drift": 2.0, "timeout_s": 25.0, "lower": 6.0, "upper": 10.0}
    return condition(kind="breath_hold", hold="inspiration", stage="settling", **numbers) | changes


def phase(**changes: Any) -> dict[str, Any]:
    """Return a condition on the phase around the end of exhale."""
    nothing = dict.fromkeys(("unit", "lower", "upper", "hysteresis"))
    phases = {"from_percent": 30.0, "to_percent": 70.0, "min_confidence": 0.6}
    return condition(kind="phase") | nothing | phases | changes


def window(*conditions: dict[str, Any], join: str = "and") -> dict[str, Any]:
    """Return a window of these conditions."""
    first = conditions[0]
    edges = {f"{name}_mm": first[name] if first["unit"] == "mm" else None for name in ("lower", "upper", "hysteresis")}
    place = {name: first[name] for name in ("signal", "row", "column")}
    return place | edges | {"join": join, "conditions": list(conditions)}


def qa_run(kind: str, verdict: str | None, **changes: Any) -> dict[str, Any]:
    """Return a finished QA run."""
    run = {"id": "0a" * 16, "kind": kind, "status": "finished", "verdict": verdict}
    return run | {"created_at": "2026-11-21T06:30:12.123456Z"} | changes


def qa_status(refusal: str | None = None, hours: float = 0.0, **newest: dict[str, Any]) -> dict[str, Any]:
    """Return what the controller says of its QA."""
    return {
        "newest": dict.fromkeys(("daily", "monthly", "annual")) | newest,
        "required_daily_h": hours,
        "is_arming_allowed": refusal is None,
        "refusal": refusal,
    }


def motion_at(seconds: float) -> dict[str, Any]:
    """Return the measured part of a sample of someone breathing calmly."""
    depth_of_breath = (1.0 - math.cos(2.0 * math.pi * seconds / 4.0)) / 2.0
    rows, columns = np.mgrid[0:ROWS, 0:COLUMNS]
    shape = 0.35 + 0.65 * np.sin(np.pi * (columns + 0.5) / COLUMNS) * (0.4 + 0.6 * rows / ROWS)
    whole = 9.0 * depth_of_breath - 0.4
    return {
        "signal_mm": whole,
        "whole_mm": whole,
        "thorax_mm": 5.0 * depth_of_breath - 0.3,
        "abdomen_mm": 12.0 * depth_of_breath - 0.5,
        "volume_l": 0.55 * depth_of_breath,
        "residual_mm": 0.71,
        "valid_share": 0.978,
        "regions_mm": np.round(shape * (whole * 1.3), 3).tolist(),
    }


def summary(**changes: Any) -> dict[str, Any]:
    """Return a session's figures so far."""
    holds = [
        {"reason": "outside_window", "text": "Outside the window", "count": 34},
        {"reason": "marker_lost", "text": "A marker is not visible", "count": 2},
    ]
    latency = {"p50_ms": 5.1, "p99_ms": 9.4, "max_ms": 31.0}
    counts = {"frames": 5400, "missed_frames": 3, "lost": 41, "transitions": 96, "beam_off": None}
    times = {"duty_cycle": 0.381, "beam_on_s": 41.23, "elapsed_s": 187.6}
    return counts | times | {"holds": holds, "latency": latency} | changes


def over(status: str = "stopped", **changes: Any) -> dict[str, Any]:
    """Return a session that is over."""
    times = {"started_at": "2026-11-21T09:12:00Z", "ended_at": "2026-11-21T09:19:00Z"}
    kept = {"summary": summary(), "continues": None, "delivered_before_s": None, "rt_plan_id": None}
    return SESSION | {"status": status, "status_detail": "", "regions": {"named": []}} | times | kept | changes


def checks(**states: str) -> list[dict[str, Any]]:
    """Return what the gate rests on: each check on but for those named; one that is off has been so for 4 s."""
    names = ("surface", "color", "camera", "markers", "clock")
    times = {"on": 412.3, "off": 4.2, "never": 60.0}
    found = {name: states.get(name, "on") for name in names}
    return [
        {"name": name, "state": state, "seconds": times[state], "text": f"{name} is {state}"}
        for name, state in found.items()
    ]


def spoken(*texts: str) -> list[dict[str, Any]]:
    """Return what the sentences in these texts were made from, as answers have it."""
    return [one.model_dump() for one in sentence_parts(*texts)]


OUTSIDE = say(
    "{value} {unit} is not inside {edges}",
    value="4.10",
    unit="mm",
    edges=say("{lower} to {upper} {unit}", lower=-1, upper=3, unit="mm"),
)


def sample(**changes: Any) -> dict[str, Any]:
    """Return a sample of a running, armed session in hold; `changes` say what is different."""
    holder = changes.get("operator_hold")
    return {
        "type": "sample",
        "form": "full",
        "sequence": 0,
        "sent_at": "",
        "age_ms": 4.1,
        "session_id": SESSION_ID,
        "session_status": "running",
        "is_armed": True,
        "is_simulated_beam": True,
        "frame_index": 0,
        "timestamp_us": 0,
        "state": "measuring",
        "lost": None,
        "training": None,
        "gate": "hold",
        "hold_reason": "outside_window",
        "hold_text": "Outside the window",
        "hold_detail": OUTSIDE,
        "sentences": spoken(changes.get("hold_detail", OUTSIDE)),
        "operator_hold": None,
        "operator_holds": [] if holder is None else [holder],
        "line_on": False,
        "window": window(condition()),
        "breath": BREATH,
        "breath_hold": None,
        **motion_at(0.0),
        "named_mm": {},
        "split_rows": None,
        "lags": [],
        "roi_px": ROI_PX,
        "checks": checks(),
        "fps": 29.9,
        "frames": 513,
        "missed_frames": 0,
        "latency_ms": {"last": 5.2, "p50": 5.0, "p99": 9.1, "max": 31.4, "warned": False},
    } | changes


NOTHING_MEASURED = dict.fromkeys(
    (
        "signal_mm",
        "whole_mm",
        "thorax_mm",
        "abdomen_mm",
        "volume_l",
        "residual_mm",
        "valid_share",
        "regions_mm",
        "named_mm",
        "lags",
        "breath",
        "roi_px",
    )
)


@functools.cache
def alarm(number: int, code: str, priority: str, text: str, **changes: Any) -> dict[str, Any]:
    """An alarm as the stream carries it, since ``age_s`` ago."""
    since = datetime.fromtimestamp(time.time() - changes.pop("age_s", 0.0), UTC).isoformat()
    return {
        "number": number,
        "session_id": SESSION_ID,
        "code": code,
        "priority": priority,
        "text": text,
        "detail": "",
        "since": since,
        "latches": False,
        "acknowledged_by": None,
        "acknowledged_at": None,
    } | changes


def chest_jpeg() -> bytes:
    """Draw a dark shirt with four dots on a bright bed."""
    picture = np.full((480, 640, 3), 120, np.uint8)
    cv2.ellipse(picture, (322, 260), (190, 300), 0, 0, 360, (70, 52, 44), -1)
    for shade in range(30):
        cv2.ellipse(
            picture, (300, 240), (150 - 4 * shade, 240 - 6 * shade), 0, 0, 360, (70 + shade, 52 + shade, 44 + shade), -1
        )
    for x, y in ROI_PX:
        cv2.circle(picture, (round(x), round(y)), 9, (245, 245, 245), -1, cv2.LINE_AA)
    return bytes(cv2.imencode(".jpg", cv2.GaussianBlur(picture, (5, 5), 0))[1])


def person(name: str = "A. Therapist", *roles: Role, **changes: Any) -> dict[str, Any]:
    """Return who is logged in, as the controller says it; a physicist unless told otherwise."""
    held = roles or (Role.PHYSICIST,)
    told = {"name": name, "roles": sorted(held), "permissions": sorted(permissions_of(held))}
    return told | {"must_change_password": False, "is_break_glass": False, "way": "password"} | changes


def user(name: str, *roles: Role, **changes: Any) -> dict[str, Any]:
    """Return a person as the list of people has them."""
    row = {"name": name, "roles": sorted(roles), "is_disabled": False, "must_change_password": False}
    return row | {"is_break_glass": False, "created_at": "2026-11-20T08:00:00Z", "last_login_at": None} | changes


def api_key(name: str, *scopes: str, **changes: Any) -> dict[str, Any]:
    """Return an API key as the list of keys has them."""
    row = {"id": name[:4].lower(), "name": name, "scopes": sorted(scopes), "created_by": "Grace"}
    times = {"created_at": "2026-11-20T08:00:00Z", "expires_at": "2099-01-01T00:00:00Z"}
    return row | times | {"revoked_at": None, "last_used_at": None} | changes


def arming(**missing: str) -> dict[str, Any]:
    """Return what would be armed; ``missing`` are texts of the parts that keep it from being armed."""
    plan = say("{plan_id}, fraction {fraction_id}", plan_id="PLAN-LUNG-4", fraction_id="FX-03")
    level = say(
        "{moment} of {breaths} breaths, scatter {scatter:.2f} {unit}",
        moment=say("end of exhale"),
        breaths=4,
        scatter=0.21,
        unit="mm",
    )
    confirmed = listed(", ", (level, say("set by {by} at {at} UTC", by="A. Therapist", at="08:32")))
    model = (
        say("model {number} of {created_at} UTC", number=1, created_at="08:31"),
        say("learned from {frames} frames, {cycles} breaths", frames=312, cycles=4),
        say(
            "breathing {amplitude_mm:.1f} mm, {explained:.1f} % explained, residual {residual_mm:.2f} mm",
            amplitude_mm=9.0,
            explained=99.1,
            residual_mm=0.41,
        ),
    )
    texts = {
        "patient": "P-0117",
        "plan": listed(" ", (plan, say("(no. {number})", number=3))),
        "camera": say("{name}, calibrated as {camera}", name="Xtion", camera="Xtion 03"),
        "head_direction": say("at the {head_direction} of the picture: arming confirms it", head_direction=word("top")),
        "view": "the patient is measured",
        "model": listed("; ", model),
        "reference": listed(
            "; ", (confirmed, say("reference {distance_mm:.1f} mm from the fraction's first", distance_mm=0.0))
        ),
        "window": say("{duty:.0f} % of the learned breaths lie inside", duty=38.0),
        "position": "first fraction of the plan: the confirmed reference becomes the plan's position",
        "checks": listed(", ", map(word, ("surface", "color", "camera", "markers", "clock"))),
        "site": "QA and camera latency as this site requires",
        "gate": say("{line}, disarmed", line=say("SIMULATED beam line")),
    } | missing
    items = [
        {"code": code, "state": "missing" if code in missing else "ok", "text": text} for code, text in texts.items()
    ]
    return {
        "session_id": SESSION_ID,
        "is_ready": not missing,
        "items": items,
        "sentences": spoken(*texts.values()),
        "needs_reason": False,
        "state": "5e" * 16,
    }


ONE_TIME = "quiet-otter-plays-1729"
SECRET = "tg_plan_0123456789abcdef"


RELAXED_MS = {
    "js/stream/live_stream.js": {"STALE_MS": 60_000, "IDLE_STALE_MS": 60_000, "GIVE_UP_MS": 60_000},
    "js/panels/picture.js": {"OLD_MS": 60_000},
    "js/panels/click_guard.js": {"IGNORE_MS": 100},
    "js/api.js": {"TIMEOUT_MS": 60_000, "PRESENCE_TIMEOUT_MS": 60_000},
}
"""Times of the page for tests that are not about them: nothing is old because the machine is slow."""
LOOK_S = 0.05
"""How often a service between two turns notices that its page has gone."""
KEPT = {"Cache-Control": "max-age=3600"}


@functools.cache
def page_files(*, is_relaxed: bool) -> dict[str, Response]:
    """Return the page's files by their path; relaxed with the times above."""
    files = {}
    for file in DASHBOARD.rglob("*.*"):
        path = file.relative_to(DASHBOARD).as_posix()
        content = relaxed(path).encode() if is_relaxed and path in RELAXED_MS else file.read_bytes()
        files[path] = Response(content, media_type=mimetypes.guess_type(path)[0])
    languages = JSONResponse({"languages": language_names(DASHBOARD)})
    return files | {
        "": files["index.html"],
        "office/": files["office/index.html"],
        LANGUAGE_LIST.removeprefix("/"): languages,
    }


def relaxed(path: str) -> str:
    """Return a script of the page with these times instead of its own."""
    text = (DASHBOARD / path).read_text()
    for name, milliseconds in RELAXED_MS[path].items():
        text, count = re.subn(rf"\bconst {name} = \d+;", f"const {name} = {milliseconds};", text)
        assert count == 1, f"{name} is not in {path}"
    return text


UNKNOWN = JSONResponse({"code": "not_logged_in", "detail": "log in first"}, 401)
ABOUT_LOG_INS = {"/login", "/login/ways", "/logout", "/me", "/me/password"}


class FakeService:
    """What the page sees. Tests set the attributes; the server's thread reads them for every message."""

    def __init__(self) -> None:
        self.mode = "idle"  # idle, samples, silent
        self.alarms: tuple[dict[str, Any], ...] = ()
        self.sample: dict[str, Any] = sample()
        self.is_breathing = False
        self.keeps_gate = False  # while breathing: the gate stays as the sample has it
        self.is_up = True
        self.lag_s = 0.0
        self.clock: Callable[[], float] = time.time
        self.period_s = 1.0 / 20.0
        self.is_relaxed = True  # serves RELAXED_MS
        self.is_stepped = False  # sends one message per turn, not one per period
        self.turns = self.turns_done = 0
        self._loop: asyncio.AbstractEventLoop | None = None
        self._has_turned = asyncio.Event()
        self.sent = 0
        self.open_sockets = 0
        self.is_hung = threading.Event()  # while set, the page that asked for /hang waits
        self.schema = "tidegate.live/1"
        self.room = "Linac-2"
        self.sessions: list[dict[str, Any]] = [copy.deepcopy(SESSION)]
        self.report: dict[str, Any] = copy.deepcopy(REPORT)
        self.seconds = 120.0
        """Length of a session that is over."""
        self.models: list[dict[str, Any]] = []
        self.of_model: dict[str, dict[str, Any]] = {}  # answers below /models/, by path
        self.calibrations: list[dict[str, Any]] = [dict(CALIBRATION)]
        self.devices: list[dict[str, Any]] = []
        self.recordings: list[dict[str, Any]] = [dict(RECORDING)]
        self.plans: list[dict[str, Any]] = []
        self.office: dict[str, dict[str, Any]] = {}  # further answers, by path
        self.audit: list[dict[str, Any]] = []
        self.recorded: list[dict[str, Any]] = []
        self.qa: dict[str, Any] = qa_status()
        self.arming: dict[str, Any] = arming()
        self.arming_etag = '"as-looked-at"'
        self.if_match: list[str | None] = []
        self.problem: tuple[int, dict[str, Any]] | None = None
        self.calls: list[tuple[str, str, Any]] = []
        self.person: dict[str, Any] | None = person()
        self.passwords: dict[str, tuple[str, dict[str, Any]]] = {}
        self.locked_s = 0
        self.ways: dict[str, Any] = {"password": True, "oidc": None}
        self.people: list[dict[str, Any]] = [user("Grace", Role.ADMIN)]
        self.keys: list[dict[str, Any]] = []
        self.logins: list[dict[str, Any]] = []
        self.connections = 0
        self.pictures = 0
        self._jpeg = chest_jpeg()
        self.frame_index = 0

    def turn(self) -> None:
        """Let a stepped service send its next message; called by the test's thread."""
        self.turns += 1
        if self._loop is not None:
            self._loop.call_soon_threadsafe(self._has_turned.set)

    def _trace(self, request: Request) -> JSONResponse:
        asked = request.query_params
        part_s = (float(asked.get("from_s", 0.0)), float(asked.get("to_s", 1e5)))
        samples = trace_samples(self.seconds)
        found = trace_part(request.path_params["id"], samples, TRACE_AT, part_s, int(asked.get("points", 1000)))
        return JSONResponse(found.model_dump(mode="json"))

    def _report(self, request: Request) -> JSONResponse:
        return JSONResponse(self._report_of(request.path_params["id"]))

    def _report_of(self, session_id: str) -> dict[str, Any]:
        found = next(one for one in self.sessions if one["id"] == session_id)
        return self.report | {"session": found | self.report["session"]}

    def posts(self) -> list[tuple[str, Any]]:
        """Return the calls that change something, as (path under the API, body)."""
        return [(path.removeprefix("/api/v1"), body) for method, path, body in self.calls if method == "POST"]

    def app(self) -> Starlette:
        """Return the application."""
        routes = [
            WebSocketRoute("/api/v1/live", self._live),
            Route("/api/v1/sessions/{id}/picture", self._picture),
            Route("/api/v1/sessions/{id}/report", self._report),
            Route("/api/v1/sessions/{id}/trace", self._trace),
            Route("/api/v1/sessions/{id}/moment", _moment),
            Route("/api/v1/{rest:path}", self._api, methods=["GET", "POST", "PATCH"]),
            Route("/hang", self._hang),
            Route("/{path:path}", self._file),
        ]
        return Starlette(routes=routes, middleware=[Middleware(Policy)])

    async def _live(self, websocket: WebSocket) -> None:
        if not self.is_up or self.person is None:
            await websocket.close(1013 if self.person else 1008)
            return
        await websocket.accept()
        if "after_frame" in websocket.query_params:
            for one in self.recorded:
                await websocket.send_json(one)
            await websocket.send_json({"type": "resumed"})
            return
        self.connections += 1
        self.open_sockets += 1
        self._loop = asyncio.get_running_loop()
        gone = asyncio.create_task(websocket.receive())
        try:
            await websocket.send_json({"type": "hello", "schema": self.schema, "version": "0.1.0", "room": self.room})
            await self._send_messages(websocket, gone)
            if not gone.done():
                await websocket.close(1001 if self.person else 1008)
        except (WebSocketDisconnect, RuntimeError):
            return
        finally:
            gone.cancel()
            self.open_sockets -= 1

    async def _send_messages(self, websocket: WebSocket, gone: asyncio.Task[Any]) -> None:
        turn, alarms = -1, ()
        while self.is_up and self.person is not None and not gone.done():
            if self.is_stepped and turn == self.turns:
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self._has_turned.wait(), LOOK_S)
                self._has_turned.clear()
                continue
            turn = self.turns
            if self.alarms != alarms:
                alarms = self.alarms
                told = {"type": "alarms", "sent_at": self._now(), "event": None, "active": alarms}
                await websocket.send_json(told)
            message = self._next_message()
            if message is not None:
                await websocket.send_text(message)
                self.sent += 1
            self.turns_done = turn
            if not self.is_stepped:
                await asyncio.sleep(0.5 if self.mode == "idle" else self.period_s)

    def _next_message(self) -> str | None:
        """Return the next message; None in silence, in which the camera goes on all the same."""
        stamp = {"sent_at": self._now(), "sequence": self.sent + 1}
        if self.mode == "idle":
            return json.dumps({"type": "idle"} | stamp)
        self.frame_index += 1
        if self.mode == "silent":
            return None
        elapsed_s = self.frame_index / 30.0
        moving = motion_at(elapsed_s) if self.is_breathing else {}
        if self.is_breathing and self.sample["is_armed"] and not self.keeps_gate:
            moving |= _gate_for(moving["signal_mm"])
        stamp |= {"frame_index": self.frame_index, "timestamp_us": int(elapsed_s * 1e6)}
        return json.dumps(self.sample | moving | stamp)

    def _now(self) -> str:
        return datetime.fromtimestamp(self.clock() - self.lag_s, UTC).isoformat().replace("+00:00", "Z")

    def _hang(self, _request: Request) -> Response:
        eventually(lambda: not self.is_hung.is_set())
        return Response()

    async def _file(self, request: Request) -> Response:
        return page_files(is_relaxed=self.is_relaxed).get(request.path_params["path"], Response(status_code=404))

    async def _picture(self, _request: Request) -> Response:
        if self.person is None:
            return UNKNOWN
        self.pictures += 1
        return Response(self._jpeg, media_type="image/jpeg", headers={"X-Frame-Index": str(self.frame_index)})

    async def _api(self, request: Request) -> Response:
        text = (await request.body()).decode()
        body = json.loads(text) if text else None
        self.calls.append((request.method, request.url.path, body))
        path = request.url.path.removeprefix("/api/v1")
        if path in ABOUT_LOG_INS:
            return self._about_log_ins(path, body)
        if self.person is None and path != "/openapi.json":
            return UNKNOWN
        if request.method == "GET" and path.endswith("/arming"):
            return JSONResponse(self.arming, headers={"ETag": self.arming_etag})
        if path.endswith("/arm"):
            self.if_match.append(request.headers.get("If-Match"))
        if request.method != "GET" and self.problem is not None:
            status, problem = self.problem
            return JSONResponse(problem, status, media_type="application/problem+json")
        if path.startswith(("/users", "/keys")) or path.endswith(("/note", "/signature", "/send")):
            return self._about_others(path, request.method, body)
        answer = self._answer(request.url.path.removeprefix("/api/v1"), request.method, body)
        if path == "/audit":
            asked = request.query_params
            rows = [one for one in self.audit if asked.get("action", one["action"]) == one["action"]]
            answer = JSONResponse({"items": rows[: int(asked.get("limit", len(rows)))], "next_cursor": None})
        search = request.query_params.get("search")
        return answer if search is None else _searched(answer, search)

    def _sign(self, session_id: str, body: dict[str, Any]) -> Response:
        assert self.person is not None
        signed = {"at": self._now(), "name": self.person["name"], "note": body["note"], "is_of_this": True}
        self.report["signatures"].append(signed | {"is_signed": "meaning" in body, "meaning": body.get("meaning")})
        return JSONResponse(self._report_of(session_id))

    def _send(self, session_id: str) -> Response:
        assert self.person is not None
        waiting = {
            "session_id": session_id,
            "state": "waiting",
            "trouble": "",
            "tries": 0,
            "sent_at": None,
            "committed_at": None,
        }
        waiting |= {"asked_by": self.person["name"], "asked_at": self._now()}
        self.office["/pacs"] = {"is_configured": True, "items": [waiting]}
        return JSONResponse(waiting)

    def _about_log_ins(self, path: str, body: Any) -> Response:
        if path == "/login":
            return self._log_in(body)
        if path == "/login/ways":
            return JSONResponse(self.ways)
        if self.person is None:
            return UNKNOWN
        if path == "/logout":
            self.person = None
            return Response(status_code=204)
        if path == "/me/password":
            return self._change_password(body)
        return JSONResponse(self.person)

    def _log_in(self, body: dict[str, str]) -> Response:
        if self.locked_s:
            wait = {"Retry-After": str(self.locked_s)}
            return JSONResponse({"code": "locked_out", "detail": "Too many attempts."}, 429, headers=wait)
        password, someone = self.passwords.get(body["name"], ("", None))
        if someone is None or body["password"] != password:
            return JSONResponse({"code": "log_in_refused", "detail": "name or password is wrong"}, 401)
        self.person = someone
        return JSONResponse(someone)

    def _change_password(self, body: dict[str, str]) -> Response:
        assert self.person is not None
        name = self.person["name"]
        if name in self.passwords and self.passwords[name][0] != body["old_password"]:
            return JSONResponse({"code": "wrong_password", "detail": "the old password is wrong"}, 422)
        self.person = self.person | {"must_change_password": False}
        self.passwords[name] = (body["new_password"], self.person)
        return JSONResponse(self.person)

    def _about_others(self, path: str, method: str, body: Any) -> Response:
        if path.endswith(("/note", "/signature", "/send")):
            session_id = path.split("/")[2]
            return self._send(session_id) if path.endswith("/send") else self._sign(session_id, body)
        if "/logins" in path:
            return JSONResponse({"items": self.logins})
        kept = self.people if path.startswith("/users") else self.keys
        if method == "GET":
            return JSONResponse({"items": kept, "next_cursor": None})
        if path == "/users":
            kept.append(user(body["name"], *body["roles"], must_change_password=True))
            return JSONResponse(kept[-1] | {"one_time_password": ONE_TIME}, 201)
        if path == "/keys":
            kept.append(api_key(body["name"], *body["scopes"], expires_at=body["expires_at"]))
            return JSONResponse(kept[-1] | {"secret": SECRET}, 201)
        wanted = unquote(path.split("/")[2])
        (found,) = [one for one in kept if wanted in {one["name"], one.get("id")}]
        found |= {"revoked_at": "2026-11-21T03:00:00Z"} if path.startswith("/keys") else body
        return JSONResponse(found | ({"one_time_password": ONE_TIME} if found.pop("reset_password", None) else {}))

    def _answer(self, path: str, method: str, body: Any) -> Response:
        pages = {"/sessions": self.sessions, "/calibrations": self.calibrations, "/audit": self.audit}
        pages |= {"/devices": self.devices, "/recordings": self.recordings, "/plans": self.plans}
        nowhere = {"is_configured": False, "items": []}
        single = {"/qa/status": self.qa, "/pacs": nowhere, **self.of_model, **self.office}
        if method == "GET" and (path in single or path.endswith("/simulation")):
            none = {"code": "not_found", "detail": "none was signed"}
            return JSONResponse(single.get(path, none), 200 if path in single else 404)
        listed = self.models if path.endswith("/models") else pages.get(path)
        if method == "GET" and listed is not None:
            return JSONResponse({"items": listed, "next_cursor": None})
        plan = next((one for one in self.plans if path == f"/plans/{one['id']}/sessions"), None)
        if method == "POST" and plan is not None:
            own = {"patient_reference": plan["patient_reference"], "plan_id": plan["label"], "rt_plan_id": plan["id"]}
            own |= {"fraction_id": f"FX-{body['fraction_number']}", "warnings": []}
            self.sessions.insert(0, SESSION | body | own | {"id": "88" * 16, "status": "created"})
            return JSONResponse(self.sessions[0], 201)
        if method == "POST" and (path == "/sessions" or path.startswith("/plans/")):
            self.sessions.insert(0, SESSION | body | {"id": "77" * 16, "status": "created"})
            return JSONResponse(self.sessions[0], 201)
        if method == "POST" and path == "/calibrations":
            return JSONResponse(CALIBRATION, 201)
        found = [one for one in self.sessions if path.startswith(f"/sessions/{one['id']}")]
        return JSONResponse(found[0]) if found else JSONResponse({"detail": "no such session"}, 404)


def trace_samples(seconds: float = 120.0) -> TraceSamples:
    """Return a session of so many seconds: breaths of 4 s, the beam on below 3 mm, and a marker lost at 60 s."""
    times_s = np.arange(round(30.0 * seconds)) / 30.0
    is_lost = (times_s >= 60.0) & (times_s < 61.0)
    whole_mm = np.where(is_lost, np.nan, 5.0 - 5.0 * np.cos(np.pi * times_s / 2.0))
    gates = np.where(whole_mm < 3.0, "beam_on", "hold").astype(object)
    reasons = np.where(is_lost, "marker_lost", np.where(gates == "beam_on", "", "outside_window")).astype(object)
    motion_mm = {"whole": whole_mm, "thorax": whole_mm / 2.0, "abdomen": 1.4 * whole_mm}
    return TraceSamples(times_s=times_s, first_ns=0, gates=gates, reasons=reasons, motion_mm=motion_mm)


TRACE_AT = datetime(2026, 11, 21, 9, 12, tzinfo=UTC)


def _moment(request: Request) -> JSONResponse:
    """Answer a curved surface whose lower cells have moved most."""
    at_s = float(request.query_params["at_s"])
    mm = 5.0 - 5.0 * math.cos(math.pi * at_s / 2.0)
    cells = [[round(mm * row / 13.0, 3) for _ in range(8)] for row in range(14)]
    nodes = [
        [
            [25.0 * (column - 4), 25.0 * (row - 7), 850.0 + 2.0 * (column - 4) ** 2 - mm * row / 14.0]
            for column in range(9)
        ]
        for row in range(15)
    ]
    found = SessionMoment(
        session_id=request.path_params["id"],
        at_s=at_s,
        frame_index=round(30.0 * at_s),
        gate="beam_on" if mm < 3.0 else "hold",
        hold_reason=None if mm < 3.0 else "outside_window",
        lost_reason=None,
        whole_mm=round(mm, 3),
        thorax_mm=round(mm / 2.0, 3),
        abdomen_mm=round(1.4 * mm, 3),
        cells_mm=cells,
        surface_mm=nodes,
    )
    return JSONResponse(found.model_dump(mode="json"))


def _searched(page: Response, search: str) -> Response:
    found = [one for one in json.loads(bytes(page.body))["items"] if search in json.dumps(one)]
    return JSONResponse({"items": found, "next_cursor": None})


def _gate_for(signal_mm: float) -> dict[str, Any]:
    if -1.0 <= signal_mm <= 3.0:
        return {"gate": "beam_on", "hold_reason": None, "hold_text": None, "line_on": True}
    return {
        "gate": "hold",
        "hold_reason": "outside_window",
        "hold_text": "Outside the window",
        "line_on": False,
    }


class Policy:
    """Adds the headers of the real service."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers["Content-Security-Policy"] = POLICY
                headers["X-Content-Type-Options"] = "nosniff"
                if not scope["path"].startswith("/api/"):
                    headers.update(KEPT)  # the tabs of one context load the page once
            await send(message)

        await self._app(scope, receive, send_with_headers)


class ServerThread:
    """A uvicorn server on a free loopback port, in a thread of its own."""

    def __init__(self, app: ASGIApp) -> None:
        self._socket = socket.socket(proto=socket.IPPROTO_TCP)
        self._socket.bind(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._socket.getsockname()[1]}"
        config = uvicorn.Config(
            app, log_level="warning", lifespan="off", ws="websockets-sansio", timeout_graceful_shutdown=1
        )
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._server.run, kwargs={"sockets": [self._socket]}, daemon=True)

    def __enter__(self) -> "ServerThread":
        self._thread.start()
        eventually(lambda: self._server.started, within_s=10.0, detail=lambda: "the fake service did not start")
        return self

    def __exit__(self, *_: object) -> None:
        self._server.should_exit = True
        self._thread.join(10.0)
        self._socket.close()
