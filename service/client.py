"""Tidegate over HTTP, for planning and record-and-verify systems: this one file, the standard library, Python 3.11+.

Copy it next to your program, or import it from the distribution; it needs nothing of the server::

    with TidegateClient("https://gating.example", key=KEY, ca_file="site-ca.pem", operator="A. Therapist") as tidegate:
        for session in tidegate.sessions():
            print(session["id"], session["status"])

What it promises: TLS is verified, answers are bounded, and a call is repeated only where that is safe. Reading is; so
is creating (every such call carries an ``Idempotency-Key``), and whatever takes the beam away. Nothing that could lead
to a beam (start, reference, arm, release, acknowledge, correct) is ever sent twice: where its answer was lost, read
the session. No call here turns a beam on; arming lets the gate decide. Starting QA, which permits the beam, is for
people at the machine, and is not part of this client.

One file on purpose: copy it next to your program. The part between the marks is generated from the contract by
``python -m tests.support.documents.client_models --write``.
"""

import contextlib
import hashlib
import http.client
import ipaddress
import json
import os
import re
import ssl
import tempfile
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from typing import Any, Final, Literal, NotRequired, Self, TypedDict, TypeVar, cast
from urllib.parse import quote, urlencode, urlsplit

VERSION: Final = "1"
MIB: Final = 1024 * 1024
MAX_ANSWER_BYTES: Final = 16 * MIB
MAX_EXPORT_BYTES: Final = 16 * 1024 * MIB
MAX_EVENT_BYTES: Final = MIB
CHUNK_BYTES: Final = 64 * 1024
LONGEST_WAIT_S: Final = 30.0
"""Longest ``Retry-After`` that is waited for; a longer one is raised to the caller."""

HOLD_TIMEOUT_S: Final = 2.0
"""A hold without an answer is repeated sooner than other calls."""

FIRST_WAIT_S: Final = 0.2
KEPT_FOR_S: Final = 2.0
"""How long an unused connection is kept: less than servers and proxies keep theirs."""

PASSING: Final = frozenset({429, 502, 503, 504})
JSON_TYPE: Final = "application/json"
_VISIBLE: Final = re.compile(r"[\x21-\x7e]+")

# <made: answers>


class AcknowledgeRequest(TypedDict):
    """The person who acknowledges, and which alarms."""

    alarms: NotRequired[list[int] | None]
    operator: NotRequired[str]


class SentenceParts(TypedDict):
    """What a sentence was made from."""

    template: str
    text: str
    values: dict[str, str]


class LiveAlarm(TypedDict):
    """An active alarm of a session; priorities are those of IEC 60601-1-8."""

    acknowledged_at: str | None
    acknowledged_by: str | None
    code: str
    detail: str
    latches: bool
    number: int
    priority: Literal["high", "medium", "low"]
    sentences: NotRequired[list[SentenceParts]]
    session_id: str
    since: str
    text: str


class LiveAlarmEvent(TypedDict):
    """A change of one alarm."""

    alarm: LiveAlarm
    at: str
    kind: Literal["begin", "acknowledged", "end"]
    number: int


class Alarms(TypedDict):
    """The active alarms after an event; also sent after `hello` if there are any, without an event."""

    active: list[LiveAlarm]
    event: LiveAlarmEvent | None
    sent_at: str
    type: NotRequired[Literal["alarms"]]


class ArmRequest(TypedDict):
    """The operator who arms, and the head direction that the operator confirms."""

    head_direction: NotRequired[Literal["top", "bottom", "left", "right"] | None]
    operator: NotRequired[str]
    reason: NotRequired[str]
    state: NotRequired[str | None]


class LiveCondition(TypedDict):
    """One condition of the window as the gate applies it; fields that its kind does not have are null."""

    column: int | None
    from_percent: NotRequired[float | None]
    hold: NotRequired[Literal["inspiration", "expiration"] | None]
    hysteresis: NotRequired[float | None]
    is_inside: bool
    kind: Literal["amplitude", "breath_hold", "phase"]
    label: str
    lower: NotRequired[float | None]
    max_drift: NotRequired[float | None]
    min_confidence: NotRequired[float | None]
    name: str | None
    row: int | None
    seen_share: NotRequired[float | None]
    settle_ms: NotRequired[float | None]
    signal: Literal["whole", "thorax", "abdomen", "region", "named", "point", "volume"]
    stage: NotRequired[Literal["awaited", "settling", "held", "drifted", "over"] | None]
    still: NotRequired[float | None]
    timeout_s: NotRequired[float | None]
    to_percent: NotRequired[float | None]
    unit: NotRequired[Literal["mm", "l", "percent"] | None]
    upper: NotRequired[float | None]


class LiveWindow(TypedDict):
    """The gating window; the edges outside the list are those of the first condition, null if it has none in mm."""

    column: int | None
    conditions: NotRequired[list[LiveCondition]]
    hysteresis_mm: float | None
    join: NotRequired[Literal["and", "or"]]
    lower_mm: float | None
    row: int | None
    signal: Literal["whole", "thorax", "abdomen", "region", "named", "point", "volume"]
    upper_mm: float | None


class ArmingItem(TypedDict):
    """One thing that has to be right before the gate is armed."""

    code: Literal[
        "patient",
        "plan",
        "camera",
        "head_direction",
        "view",
        "model",
        "reference",
        "window",
        "position",
        "checks",
        "countersignature",
        "site",
        "gate",
    ]
    state: Literal["ok", "attention", "missing"]
    text: str


class Condition(TypedDict):
    """A condition that the breathing must meet."""

    column: NotRequired[int | None]
    from_percent: NotRequired[float | None]
    hold: NotRequired[Literal["inspiration", "expiration"] | None]
    hysteresis_l: NotRequired[float | None]
    hysteresis_mm: NotRequired[float | None]
    hysteresis_percent: NotRequired[float | None]
    kind: NotRequired[Literal["amplitude", "breath_hold", "phase"]]
    lower_l: NotRequired[float | None]
    lower_mm: NotRequired[float | None]
    lower_percent: NotRequired[float | None]
    max_drift_l: NotRequired[float | None]
    max_drift_mm: NotRequired[float | None]
    min_confidence: NotRequired[float | None]
    name: NotRequired[str | None]
    row: NotRequired[int | None]
    settle_ms: NotRequired[float | None]
    signal: NotRequired[Literal["whole", "thorax", "abdomen", "region", "named", "point", "volume"]]
    still_l: NotRequired[float | None]
    still_mm: NotRequired[float | None]
    timeout_s: NotRequired[float | None]
    to_percent: NotRequired[float | None]
    upper_l: NotRequired[float | None]
    upper_mm: NotRequired[float | None]
    upper_percent: NotRequired[float | None]


class Window(TypedDict):
    """The gating window; the beam may be on only while the patient stays inside it."""

    column: NotRequired[int | None]
    dwell_ms: NotRequired[float]
    from_percent: NotRequired[float | None]
    further: NotRequired[list[Condition]]
    hold: NotRequired[Literal["inspiration", "expiration"] | None]
    hysteresis_l: NotRequired[float | None]
    hysteresis_mm: NotRequired[float | None]
    hysteresis_percent: NotRequired[float | None]
    join: NotRequired[Literal["and", "or"]]
    kind: NotRequired[Literal["amplitude", "breath_hold", "phase"]]
    lower_l: NotRequired[float | None]
    lower_mm: NotRequired[float | None]
    lower_percent: NotRequired[float | None]
    max_cycles_per_min: NotRequired[int | None]
    max_drift_l: NotRequired[float | None]
    max_drift_mm: NotRequired[float | None]
    min_confidence: NotRequired[float | None]
    min_off_ms: NotRequired[float | None]
    min_on_ms: NotRequired[float | None]
    name: NotRequired[str | None]
    row: NotRequired[int | None]
    settle_ms: NotRequired[float | None]
    signal: NotRequired[Literal["whole", "thorax", "abdomen", "region", "named", "point", "volume"]]
    still_l: NotRequired[float | None]
    still_mm: NotRequired[float | None]
    timeout_s: NotRequired[float | None]
    to_percent: NotRequired[float | None]
    upper_l: NotRequired[float | None]
    upper_mm: NotRequired[float | None]
    upper_percent: NotRequired[float | None]


class ArmingSummary(TypedDict):
    """What the gate would be armed with. Send its `state` with `POST .../arm`: the engine refuses any other."""

    gate_window: LiveWindow | None
    is_ready: bool
    items: list[ArmingItem]
    needs_reason: bool
    predicted_duty_percent: float | None
    sentences: NotRequired[list[SentenceParts]]
    session_id: str
    state: str
    window: Window


class AuditEntry(TypedDict):
    """One row of the append-only log."""

    action: str
    actor: str
    at: str
    detail: dict[str, object]
    hash: str
    outcome: Literal["done", "requested", "refused", "failed"]
    previous_hash: str
    sequence: int
    session_id: str | None


class AuditPage(TypedDict):
    """Newest first."""

    items: list[AuditEntry]
    next_cursor: str | None


Breakage = Literal["changed", "missing", "inserted", "reordered", "resealed", "cut_off", "replaced", "anchors"]


class AuditVerification(TypedDict):
    """Whether the chain of hashes holds; names the first broken row, and what was done to it, when it does not."""

    breakage: Breakage | None
    checked_to: int
    detail: str
    first_broken_sequence: int | None
    head_hash: str
    is_complete: bool
    is_intact: bool
    notes: list[str]
    rows: int


class BaselineCorrectionRequest(TypedDict):
    """A shift of the window by a baseline drift that a person confirms: in mm, or in l for signal volume."""

    by_l: NotRequired[float | None]
    by_mm: NotRequired[float | None]
    drift_l: NotRequired[float | None]
    drift_mm: NotRequired[float | None]
    operator: NotRequired[str]
    reason: NotRequired[str]


class CalibrationDetail(TypedDict):
    """A calibration with its document in the canonical format."""

    camera: str
    created_at: str
    document: dict[str, object]
    id: str
    sha256: str
    uploaded_by: str


class Calibration(TypedDict):
    """A stored camera calibration; the same content has the same id."""

    camera: str
    created_at: str
    id: str
    sha256: str
    uploaded_by: str


class CalibrationPage(TypedDict):
    """Calibrations, newest first; `next_cursor` is null on the last page."""

    items: list[Calibration]
    next_cursor: str | None


class CameraMode(TypedDict):
    """A camera in one mode, as its driver describes it; sizes are width and height [px]."""

    color_size: list[object]
    depth_size: list[object]
    fps: float
    name: str
    serial: str


class CameraLatency(TypedDict):
    """The newest measured latency of a camera in one mode; all times from light to the receipt of the depth frame."""

    at: str
    camera: CameraMode
    counted_ms: float
    median_ms: float
    operator: str
    p95_ms: float
    refusal: str | None
    run_id: str
    uncertainty_ms: float
    verdict: Literal["pass", "warn", "fail"]
    worst_ms: float


class CameraLatencyList(TypedDict):
    """The newest measured latency of each camera and mode."""

    configured_ms: float
    items: list[CameraLatency]
    max_age_days: float


class CountersignRequest(TypedDict):
    """What a second person countersigns; with name and password if another person is logged in at this page."""

    name: NotRequired[str | None]
    operator: NotRequired[str]
    password: NotRequired[str | None]
    state: str


class Device(TypedDict):
    """A connected camera."""

    name: str
    uri: str


class DeviceKind(TypedDict):
    """A kind of cameras, by its SDK."""

    install_hint: str
    is_installed: bool
    label: str
    plug_in: NotRequired[str]


class DeviceList(TypedDict):
    """Cameras; `detail` says why the list is empty."""

    detail: str
    is_runtime_available: bool
    items: list[Device]
    kinds: NotRequired[list[DeviceKind]]


class Dropped(TypedDict):
    """The client was too slow: samples before the next one were dropped."""

    gate_changes: NotRequired[int]
    sent_at: str
    skipped: int
    type: NotRequired[Literal["dropped"]]


class Gap(TypedDict):
    """After a reconnection: frames of the session that are not resent."""

    from_frame: int
    reason: Literal["too_long_ago", "recorder_behind", "not_recorded", "busy"]
    sent_at: str
    session_id: str
    to_frame: int | None
    type: NotRequired[Literal["gap"]]


class Hello(TypedDict):
    """First message of every connection; fields that do not apply are left out."""

    calibration: NotRequired[Literal["uploaded", "device registration", "device calibration"] | None]
    calibration_warning: NotRequired[str | None]
    camera_fps: NotRequired[float | None]
    form: Literal["full", "thin"]
    ping_s: float
    rate_hz: NotRequired[float | None]
    resumes_after: NotRequired[int | None]
    room: NotRequired[str | None]
    schema: NotRequired[Literal["tidegate.live/1"]]
    sent_at: str
    session_id: NotRequired[str | None]
    type: NotRequired[Literal["hello"]]
    version: str


class Idle(TypedDict):
    """Sent twice a second while no session runs."""

    sent_at: str
    type: NotRequired[Literal["idle"]]


class InterlockSetting(TypedDict):
    """A site setting that sets the limit of an interlock."""

    high: float | None
    low: float | None
    name: str
    value: float | bool | list[str] | None
    variable: str


class Interlock(TypedDict):
    """A check that holds the beam when it trips."""

    code: str
    latches: bool
    settings: list[InterlockSetting]
    source: str
    text: str
    trips: str


class InterlockList(TypedDict):
    """All interlocks."""

    items: list[Interlock]


class LoginRequest(TypedDict):
    """A name and a password."""

    name: str
    password: str
    reason: NotRequired[str | None]


Permission = Literal[
    "sessions.read",
    "sessions.run",
    "gate.reference",
    "gate.arm",
    "gate.hold",
    "gate.acknowledge",
    "models.write",
    "plans.write",
    "calibrations.read",
    "calibrations.write",
    "qa.read",
    "qa.run",
    "qa.baseline",
    "audit.read",
    "users.manage",
    "metrics.read",
    "coach.watch",
    "coach.manage",
]

Role = Literal["viewer", "therapist", "physicist", "admin"]


class Me(TypedDict):
    """Who is logged in, and what they may do."""

    expires_at: NotRequired[str | None]
    idle_minutes: NotRequired[float | None]
    is_break_glass: NotRequired[bool]
    kind: Literal["user", "key", "oidc", "machine"]
    must_change_password: bool
    name: str
    permissions: list[Permission]
    roles: list[Role]
    way: NotRequired[Literal["password", "oidc"] | None]


class ModelQuality(TypedDict):
    """Quality of a model's training frames."""

    amplitude_mm: float
    explained_share: float
    noise_mm: float
    outlier_share: float
    residual_mm: float
    shift_mm: float
    tilt_deg: float


class Model(TypedDict):
    """A motion model of a session."""

    calibration_id: str
    components: int
    created_at: str
    cycles: NotRequired[int | None]
    id: str
    is_active: bool
    number: int
    patient_reference: str
    quality: NotRequired[ModelQuality | None]
    session_id: str
    settings: NotRequired[dict[str, float]]
    sha256: str
    software: NotRequired[str | None]
    source: NotRequired[str | None]
    training_frames: NotRequired[int | None]


class ModelPage(TypedDict):
    """Models, newest first; `next_cursor` is null on the last page."""

    items: list[Model]
    next_cursor: str | None


class OperatorRequest(TypedDict):
    """The body of a call that names only the operator."""

    operator: NotRequired[str]


class PasswordRequest(TypedDict):
    """The old password and the new."""

    new_password: str
    old_password: str


class Ping(TypedDict):
    """Sent when no other message was sent for a second: the connection works, and there is no newer frame."""

    sent_at: str
    type: NotRequired[Literal["ping"]]


class PlanBeam(TypedDict):
    """A beam of the plan."""

    delivery: str | None
    energies: list[float]
    energy_unit: Literal["MV", "MeV", "MeV/u"] | None
    machine: str | None
    name: str | None
    number: int
    radiation: str | None
    scan_mode: str | None
    setup_number: int | None
    type: str | None


class PlanContradiction(TypedDict):
    """A later file with the same UID and different content; the plan keeps the content of the first file."""

    approval: str | None
    created_at: str
    differing: list[str]
    imported_by: str


class PlanFractionBeam(TypedDict):
    """Meterset of a beam in one fraction."""

    beam_number: int
    meterset: float | None


class PlanFractionGroup(TypedDict):
    """A group of identical fractions."""

    beams: list[PlanFractionBeam]
    fractions_planned: int | None
    number: int


class PlanMotion(TypedDict):
    """A motion compensation technique of a patient setup, in DICOM terms."""

    description: str | None
    signal_source: str | None
    technique: str


class PlanSetup(TypedDict):
    """A patient setup: its position on the couch and its respiratory techniques."""

    label: str | None
    motion: list[PlanMotion]
    number: int
    position: NotRequired[str | None]


class Plan(TypedDict):
    """A stored plan; plans are never changed or removed."""

    approval: str | None
    beams: list[PlanBeam]
    character_set: NotRequired[list[str]]
    contradicted: PlanContradiction | None
    created_at: str
    date: str | None
    fraction_groups: list[PlanFractionGroup]
    gating: Literal["not_stated", "none", "breath_hold", "gating", "unknown", "mixed", "other"]
    id: str
    imported_by: str
    intent: str | None
    kind: Literal["RT Plan", "RT Ion Plan"]
    label: str
    name: str | None
    notes: list[str]
    patient_reference: str
    setups: list[PlanSetup]
    sha256: str
    sop_instance_uid: str


class PlanLastSession(TypedDict):
    """The newest session of a plan's patient and label that was started."""

    fraction_number: int | None
    id: str
    started_at: str
    status: Literal["created", "running", "ended", "stopped", "failed", "interrupted"]


class PlanSummary(TypedDict):
    """A plan in a list, with what was done of it."""

    created_at: str
    fractions_planned: int | None
    gating: Literal["not_stated", "none", "breath_hold", "gating", "unknown", "mixed", "other"]
    id: str
    imported_by: str
    kind: Literal["RT Plan", "RT Ion Plan"]
    label: str
    last_session: PlanLastSession | None
    next_fraction: int
    patient_reference: str
    sop_instance_uid: str


class PlanPage(TypedDict):
    """Newest first; `next_cursor` is null on the last page."""

    items: list[PlanSummary]
    next_cursor: str | None


class Region(TypedDict):
    """A simple polygon on the region's grid of 350 rows by 200 columns, reported under its name."""

    name: str
    vertices: list[list[float]]


class SplitLine(TypedDict):
    """The line between thorax and abdomen: the rows where it crosses the patient's right and left edge of the grid."""

    left_row: float
    right_row: float


class Regions(TypedDict):
    """The regions for which motion is reported, in addition to the whole and the cells of the grid."""

    extra_markers: NotRequired[bool]
    named: NotRequired[list[Region]]
    split: NotRequired[SplitLine | None]


class RecordingSource(TypedDict):
    """A recording in one of the site's allowed folders."""

    kind: Literal["recording"]
    path: str
    player: NotRequired[Literal["openni", "reader", "repeated", "auto"]]


class DeviceSource(TypedDict):
    """A live camera."""

    kind: Literal["device"]
    uri: NotRequired[str | None]


class PlanSessionRequest(TypedDict):
    """The part of a session that the plan does not define: camera, calibration, edges of the window, fraction."""

    calibration_id: NotRequired[str | None]
    continues: NotRequired[str | None]
    fraction_group: NotRequired[int | None]
    fraction_number: int
    head_direction: NotRequired[Literal["top", "bottom", "left", "right"] | None]
    model_id: NotRequired[str | None]
    operator: NotRequired[str]
    overrides_contradiction: NotRequired[str | None]
    overrides_plan_gating: NotRequired[str | None]
    regions: NotRequired[Regions]
    repeats_fraction: NotRequired[str | None]
    source: RecordingSource | DeviceSource
    window: Window


class PositionCheckRequest(TypedDict):
    """The person who signs the patient's position, and which comparison that person was shown."""

    operator: NotRequired[str]
    reason: NotRequired[str]
    reference_number: int


class PreparedSession(TypedDict):
    """A session created from a plan, with notes for the operator."""

    calibration: NotRequired[Literal["uploaded", "device registration", "device calibration"]]
    calibration_id: str
    calibration_warning: NotRequired[str | None]
    continues: NotRequired[str | None]
    created_at: str
    ended_at: str | None
    fraction_id: str
    fraction_number: int | None
    head_direction: NotRequired[Literal["top", "bottom", "left", "right"] | None]
    id: str
    is_simulated_beam: bool
    model_id: NotRequired[str | None]
    operator: str
    patient_reference: str
    plan_id: str
    regions: NotRequired[Regions]
    rt_plan_id: NotRequired[str | None]
    signed_by: NotRequired[list[str]]
    source: RecordingSource | DeviceSource
    source_warning: NotRequired[str | None]
    started_at: str | None
    status: Literal["created", "running", "ended", "stopped", "failed", "interrupted"]
    status_detail: str
    warnings: list[str]
    window: Window


class QaCheck(TypedDict):
    """A check with this site's bounds."""

    code: str
    expected: float | None
    fail: float
    fail_setting: str
    has_baseline: bool
    kinds: list[Literal["daily", "monthly", "annual", "latency"]]
    method: str
    most: float
    needs: Literal["plate", "phantom", "beam", "camera"]
    sidedness: Literal["absolute", "at_most"]
    source: str
    title: str
    unit: str
    warn: float
    warn_setting: str


class QaCheckList(TypedDict):
    """All checks."""

    items: list[QaCheck]


class QaProgress(TypedDict):
    """Progress of a run: completed and total steps of a stage; `total` is null if unknown."""

    done: int
    stage: str
    total: int | None


class QaResult(TypedDict):
    """The result of one check; `value` is null if it could not be measured, which is a fail."""

    code: str
    detail: str
    deviation: float | None
    expected: float | None
    fail: float
    sidedness: Literal["absolute", "at_most"]
    title: str
    uncertainty: float | None
    unit: str
    value: float | None
    verdict: Literal["pass", "warn", "fail"]
    warn: float


class QaCurve(TypedDict):
    """Points of a plot."""

    name: str
    x: list[float]
    y: list[float]


class QaSeries(TypedDict):
    """Data of a report's plot."""

    code: str
    curves: list[QaCurve]
    title: str
    x_label: str
    y_label: str


class QaRunDetail(TypedDict):
    """A QA run with its checks and plot data."""

    baseline_number: int | None
    calibration_sha256: str | None
    created_at: str
    ended_at: str | None
    id: str
    is_simulated: bool
    is_simulated_beam: bool
    kind: Literal["daily", "monthly", "annual", "latency"]
    machine: str
    note: str
    operator: str
    progress: NotRequired[QaProgress | None]
    results: list[QaResult]
    series: list[QaSeries]
    sha256: str | None
    site: str
    software: str
    status: Literal["running", "finished", "cancelled", "failed", "interrupted"]
    status_detail: str
    verdict: Literal["pass", "warn", "fail"] | None


class QaRun(TypedDict):
    """A QA run with its current status."""

    created_at: str
    ended_at: str | None
    id: str
    is_simulated: bool
    is_simulated_beam: bool
    kind: Literal["daily", "monthly", "annual", "latency"]
    machine: str
    operator: str
    progress: NotRequired[QaProgress | None]
    site: str
    software: str
    status: Literal["running", "finished", "cancelled", "failed", "interrupted"]
    status_detail: str
    verdict: Literal["pass", "warn", "fail"] | None


class QaRunPage(TypedDict):
    """A page of runs, newest first."""

    items: list[QaRun]
    next_cursor: str | None


class QaStatus(TypedDict):
    """The newest run of each kind, simulated runs excluded, and whether the QA requirement permits arming."""

    is_arming_allowed: bool
    newest: dict[str, QaRun | None]
    refusal: str | None
    required_daily_h: float


class QaTrendPoint(TypedDict):
    """One check of one finished run."""

    at: str
    deviation: float | None
    expected: float | None
    fail: float
    kind: Literal["daily", "monthly", "annual", "latency"]
    run_id: str
    value: float | None
    verdict: Literal["pass", "warn", "fail"]
    warn: float


class QaTrend(TypedDict):
    """Values of a check in the newest runs, oldest first, without simulated runs."""

    check: str
    items: list[QaTrendPoint]
    sidedness: Literal["absolute", "at_most"]
    title: str
    unit: str


ReadinessCode = Literal[
    "anchors_inside",
    "audit_trouble",
    "camera_latency",
    "camera_runtime_missing",
    "certificate_ended",
    "certificate_ends_soon",
    "certificate_unreadable",
    "clock_behind",
    "clock_doubted",
    "database_log_large",
    "database_unwritable",
    "disk_low",
    "engine_missing",
    "not_known",
    "qa_overdue",
    "recordings_missing",
    "service_stopping",
    "thread_ended",
]


class ReadinessReason(TypedDict):
    """One problem or warning."""

    code: ReadinessCode
    detail: str


class Readiness(TypedDict):
    """Whether a session can run, and what prevents it."""

    checked_at: str
    is_ready: bool
    not_ready: list[str]
    reasons: list[ReadinessReason]
    warnings: list[ReadinessReason]


class RecordedSample(TypedDict):
    """A recorded frame, resent after a reconnection."""

    abdomen_mm: float | None
    captured_at: str | None
    form: NotRequired[Literal["recorded"]]
    frame_index: int
    gate: Literal["disarmed", "hold", "dwell", "beam_on", "fault"]
    hold_reason: str | None
    hold_text: str | None
    latency_ms: float | None
    line_on: bool
    received_at: str | None
    sent_at: str
    session_id: str
    signal_mm: float | None
    state: Literal["training", "measuring", "lost"]
    thorax_mm: float | None
    timestamp_us: int
    type: NotRequired[Literal["sample"]]
    volume_l: float | None
    whole_mm: float | None


class Recording(TypedDict):
    """A recording in one of the site's folders, described by its first records; no frame is read."""

    bytes: int | None
    fps: int | None
    has_color: bool | None
    height_px: int | None
    mirrored: str | None
    modified_at: str | None
    path: str
    problem: str | None
    seconds: float | None
    width_px: int | None


class RecordingPage(TypedDict):
    """Recordings by path; `next_cursor` is null on the last page."""

    items: list[Recording]
    next_cursor: str | None


class ReferenceRequest(TypedDict):
    """The person who sets the reference, the moment of the breath, and what that person was shown."""

    at: NotRequired[Literal["end_exhale", "end_inhale", "now"]]
    level_seen: NotRequired[float | None]
    move_seen_mm: NotRequired[float | None]
    operator: NotRequired[str]
    reason: NotRequired[str]
    setup_confirmed: NotRequired[bool]


class Resumed(TypedDict):
    """After a reconnection: all following samples are live."""

    frames: int
    last_frame: int
    sent_at: str
    session_id: str
    type: NotRequired[Literal["resumed"]]


class RetrainRequest(TypedDict):
    """The operator who requests a new model, and whether the reference is transferred to it."""

    keeps_reference: NotRequired[bool]
    operator: NotRequired[str]


class LiveBreathEvent(TypedDict):
    """An ongoing breathing event that is not quiet breathing."""

    confidence: float
    detail: str
    kind: Literal["cough", "sigh", "apnoea", "talking", "irregular", "no_cycle", "drift"]
    since_s: float


class LiveBreath(TypedDict):
    """Breathing of the first gated signal; unknown values are null."""

    amplitude: float | None
    baseline: float | None
    drift: float | None
    drift_per_s: float | None
    events: list[LiveBreathEvent]
    note: str
    phase_confidence: float
    phase_percent: float | None
    rate_confidence: float
    rate_per_min: float | None
    regularity: float | None
    signal: str
    unit: Literal["mm", "l"]


class LiveBreathHold(TypedDict):
    """Progress of the window's breath hold."""

    count: int
    hold: Literal["inspiration", "expiration"]
    seconds: float | None
    settle_s: float
    stage: Literal["awaited", "settling", "held", "drifted", "over"]
    timeout_s: float


class LiveCameraView(TypedDict):
    """How the camera looks at the patient: the middle of the picture, about once a second."""

    advice: list[Literal["too_near", "too_far", "tilted", "gaps", "too_dark", "too_bright", "warming_up"]]
    brightness: float
    coverage: float
    distance_mm: float | None
    running_s: float
    saturated: float
    tilt_deg: float | None
    warm_in_s: float


class LiveCheck(TypedDict):
    """A check of the measurement against the reference: one that cannot work finds nothing."""

    name: Literal["surface", "color", "camera", "markers", "clock"]
    seconds: float | None
    state: Literal["on", "off", "never"]
    text: str


class LiveLag(TypedDict):
    """Delay of the first region's motion behind the second's; if it is unknown, `note` says why."""

    confidence: float | None
    first: str
    lag_deg: float | None
    lag_s: float | None
    note: str
    period_s: float | None
    second: str


class LiveLatency(TypedDict):
    """Latency from frame capture to the command at the beam line [ms]."""

    last: float | None
    max: NotRequired[float | None]
    p50: float | None
    p99: float | None
    warned: NotRequired[bool]


class LiveLost(TypedDict):
    """Reason why this frame could not be measured; while `state` is `measuring`, why the gate does not rest on it."""

    detail: str
    moved: NotRequired[Literal["couch", "camera", "camera_or_couch"] | None]
    moved_mm: NotRequired[float | None]
    reason: str


class LivePosition(TypedDict):
    """How far the patient has moved since the present reference, breathing aside; null where that is not known."""

    height_mm: float | None
    roll_deg: float | None
    shift_mm: float | None
    tilt_deg: float | None
    travel_mm: NotRequired[float | None]
    turn_deg: float | None


class LiveDegree(TypedDict):
    """One degree of freedom of the patient's position against the plan's."""

    is_within: bool
    name: Literal["lateral", "longitudinal", "vertical", "pitch", "roll", "yaw"]
    tolerance: float
    uncertainty: float | None
    unit: Literal["mm", "deg"]
    value: float | None


class LivePositionCheck(TypedDict):
    """The patient's position against that of the plan, and who signed it."""

    degrees: list[LiveDegree]
    is_within: bool
    lapse: str
    plan_session_id: str | None
    reason: str
    reference_number: int | None
    shape_mm: float | None
    shortcomings: list[str]
    signed_by: str | None
    status: Literal["first_fraction", "no_reference", "unsigned", "lapsed", "signed"]
    text: str


class LiveReference(TypedDict):
    """How far the reference, and the window with its corrections, lie from the first reference of the fraction."""

    budget_mm: float
    correction: float
    distance_mm: float | None
    height_mm: float | None
    is_beyond: bool
    level: float | None
    moved_mm: float | None
    shape_mm: float | None
    shift_mm: float | None
    text: str
    tilt_deg: float | None
    turn_deg: float | None
    uncertainty_mm: float | None
    unit: Literal["mm", "l"]
    unknown: NotRequired[str]


class LiveTraining(TypedDict):
    """Progress of the training; `share` runs from 0 to 1."""

    amplitude_mm: NotRequired[float | None]
    cycles: int
    frames: int
    note: str
    seconds: float
    share: float
    shift_mm: NotRequired[float | None]


class Sample(TypedDict):
    """The newest frame with its measurement and gate decision."""

    abdomen_mm: float | None
    accelerator_beam: NotRequired[Literal["on", "off", "unknown"] | None]
    age_ms: float
    armed_by: NotRequired[str | None]
    body_warning: NotRequired[str | None]
    breath: NotRequired[LiveBreath | None]
    breath_hold: NotRequired[LiveBreathHold | None]
    calibration: NotRequired[Literal["uploaded", "device registration", "device calibration"]]
    camera_view: NotRequired[LiveCameraView | None]
    captured_at: NotRequired[str | None]
    checks: NotRequired[list[LiveCheck]]
    form: NotRequired[Literal["full"]]
    fps: float | None
    frame_index: int
    frames: int
    gate: Literal["disarmed", "hold", "dwell", "beam_on", "fault"]
    hold_detail: NotRequired[str]
    hold_reason: str | None
    hold_text: str | None
    is_armed: bool
    is_simulated_beam: bool
    lags: list[LiveLag] | None
    latency_ms: LiveLatency
    line_on: bool
    lost: LiveLost | None
    missed_frames: int
    named_mm: dict[str, float | None] | None
    operator_hold: NotRequired[str | None]
    operator_holds: NotRequired[list[str]]
    position: NotRequired[LivePosition | None]
    position_check: NotRequired[LivePositionCheck | None]
    received_at: NotRequired[str | None]
    reference: NotRequired[LiveReference | None]
    regions_mm: list[list[float | None]] | None
    residual_mm: float | None
    roi_px: list[list[float]] | None
    sent_at: str
    sentences: NotRequired[list[SentenceParts]]
    sequence: int
    session_id: str
    session_status: Literal["running", "ended", "stopped", "failed"]
    signal_mm: float | None
    split_rows: list[float] | None
    state: Literal["training", "measuring", "lost"]
    thorax_mm: float | None
    timestamp_us: int
    training: LiveTraining | None
    type: NotRequired[Literal["sample"]]
    unseen_cells: NotRequired[list[list[int]] | None]
    valid_share: float | None
    volume_l: float | None
    whole_mm: float | None
    window: LiveWindow


class Session(TypedDict):
    """A session."""

    calibration: NotRequired[Literal["uploaded", "device registration", "device calibration"]]
    calibration_id: str
    calibration_warning: NotRequired[str | None]
    continues: NotRequired[str | None]
    created_at: str
    ended_at: str | None
    fraction_id: str
    fraction_number: int | None
    head_direction: NotRequired[Literal["top", "bottom", "left", "right"] | None]
    id: str
    is_simulated_beam: bool
    model_id: NotRequired[str | None]
    operator: str
    patient_reference: str
    plan_id: str
    regions: NotRequired[Regions]
    rt_plan_id: NotRequired[str | None]
    signed_by: NotRequired[list[str]]
    source: RecordingSource | DeviceSource
    source_warning: NotRequired[str | None]
    started_at: str | None
    status: Literal["created", "running", "ended", "stopped", "failed", "interrupted"]
    status_detail: str
    window: Window


class BodyView(TypedDict):
    """Comparison of the surface that this session learned with that of the patient's newest earlier session."""

    is_position_compared: bool
    model_id: str
    session_id: str
    shape_mm: float
    shift_mm: list[float]
    tilt_deg: float
    warning: str | None


class CameraView(TypedDict):
    """The camera that a session opened, compared with the calibration's serial number."""

    code: Literal["camera_mismatch", "serial_unknown"] | None
    name: str
    serial: str | None
    warning: str | None


class GateView(TypedDict):
    """State of the gate of a running session."""

    armed_at: NotRequired[str | None]
    armed_by: NotRequired[str | None]
    hold_detail: NotRequired[str]
    hold_reason: str | None
    hold_text: str | None
    is_armed: bool
    line_on: bool
    operator_hold: NotRequired[str | None]
    operator_holds: NotRequired[list[str]]
    state: Literal["disarmed", "hold", "dwell", "beam_on", "fault"]
    state_since: NotRequired[str | None]


class LikenessView(TypedDict):
    """Result of comparing today's patient with the stored model that the session started with."""

    explained_share: float
    frames: int
    is_accepted: bool
    refusal: str | None
    residual_mm: float | None
    shape_mm: float
    shift_mm: list[float]
    tilt_deg: float


class ReferenceProposalView(TypedDict):
    """A position of the last breaths that a person may make the reference."""

    at: Literal["end_exhale", "end_inhale"]
    breaths: int
    distance: NotRequired[str | None]
    distance_mm: NotRequired[float | None]
    is_beyond: NotRequired[bool]
    level: float
    percent: float | None
    position: NotRequired[list[LiveDegree]]
    scatter: float
    signal: str
    unit: Literal["mm", "l"]


class BeamOffSummary(TypedDict):
    """Times from a hold to the accelerator's beam off [ms], of each permit that ended with the beam on."""

    holds: int
    median_ms: float
    p95_ms: float
    slowest_ms: float


class HoldCount(TypedDict):
    """How often the gate began to hold for one reason."""

    count: int
    reason: str
    text: str


class LatencyView(TypedDict):
    """Latency from frame capture to the command at the beam line [ms]."""

    max_ms: NotRequired[float | None]
    p50_ms: float | None
    p99_ms: float | None


class Summary(TypedDict):
    """Statistics of a session so far, from the database."""

    beam_off: NotRequired[BeamOffSummary | None]
    beam_on_s: NotRequired[float | None]
    duty_cycle: float | None
    elapsed_s: NotRequired[float | None]
    frames: int
    holds: NotRequired[list[HoldCount]]
    latency: LatencyView
    lost: int
    missed_frames: int
    transitions: int


class TrainingView(TypedDict):
    """Progress of the training; `share` runs from 0 to 1."""

    amplitude_mm: NotRequired[float | None]
    cycles: int
    frames: int
    note: str
    seconds: float
    share: float
    shift_mm: NotRequired[float | None]


class SessionDetail(TypedDict):
    """A session with gate, training and statistics."""

    active_model_id: str | None
    alarms: NotRequired[list[LiveAlarm]]
    body: NotRequired[BodyView | None]
    breath: NotRequired[LiveBreath | None]
    breath_hold: NotRequired[LiveBreathHold | None]
    calibration: NotRequired[Literal["uploaded", "device registration", "device calibration"]]
    calibration_id: str
    calibration_warning: NotRequired[str | None]
    camera: NotRequired[CameraView | None]
    checks: NotRequired[list[LiveCheck]]
    continues: NotRequired[str | None]
    created_at: str
    delivered_before_s: NotRequired[float | None]
    ended_at: str | None
    fraction_id: str
    fraction_number: int | None
    gate: GateView | None
    gate_window: NotRequired[LiveWindow | None]
    has_reference: NotRequired[bool | None]
    head_direction: NotRequired[Literal["top", "bottom", "left", "right"] | None]
    id: str
    is_simulated_beam: bool
    likeness: NotRequired[LikenessView | None]
    measurement_state: Literal["training", "measuring", "lost"] | None
    model_id: NotRequired[str | None]
    operator: str
    patient_reference: str
    plan_id: str
    position_check: NotRequired[LivePositionCheck | None]
    predicted_duty_percent: NotRequired[float | None]
    reference: NotRequired[LiveReference | None]
    reference_proposals: NotRequired[list[ReferenceProposalView]]
    regions: NotRequired[Regions]
    rt_plan_id: NotRequired[str | None]
    signed_by: NotRequired[list[str]]
    source: RecordingSource | DeviceSource
    source_warning: NotRequired[str | None]
    started_at: str | None
    status: Literal["created", "running", "ended", "stopped", "failed", "interrupted"]
    status_detail: str
    summary: Summary
    training: TrainingView | None
    window: Window


class SessionPage(TypedDict):
    """Newest first; `next_cursor` is null on the last page."""

    items: list[Session]
    next_cursor: str | None


class ReportEvent(TypedDict):
    """What a person or the service did in the session, from the audit."""

    action: str
    actor: str
    at: str
    text: str


class Range(TypedDict):
    """Median of a figure, and the range of its middle 90 %."""

    high: float
    low: float
    median: float


class HeldTime(TypedDict):
    """A reason for which the armed gate held, with the time that it took."""

    count: int
    reason: str
    seconds: float
    text: str


class GatedMotion(TypedDict):
    """Motion while the beam was on, of one signal, around its own mean."""

    deviation_mm: float
    frames: int
    mean_mm: float
    signal: str
    within_95_mm: float


class Pulse(TypedDict):
    """One stretch of consecutive samples with the beam on; times since the first sample."""

    from_s: float
    seconds: float
    spread: float | None
    to_s: float


class ReportFigures(TypedDict):
    """What is counted from the session's samples alone; times are from each sample to the next, at most a second."""

    amplitude: Range | None
    armed_s: float
    baseline_first: float | None
    baseline_last: float | None
    beam_on_s: float
    cells: list[list[float | None]]
    duty_percent: float | None
    frames: int
    holds: list[HeldTime]
    latency: LatencyView
    latency_bins: list[int]
    lost: int
    missed_frames: int
    motion: list[GatedMotion]
    period_s: Range | None
    pulse_list: NotRequired[list[Pulse]]
    pulse_s: Range | None
    pulses: int
    recorded_s: float


class ReportHead(TypedDict):
    """Place, equipment and persons of the session; the content hash covers the first three."""

    armed_by: list[str]
    calibrated_at: str | None
    camera: str
    first_sample_at: str | None
    machine: str
    plan_label: str
    plan_uid: str
    qa: str
    room: str


class SignedDegree(TypedDict):
    """One of the six degrees of the position against the plan's, as it was signed."""

    name: str
    tolerance: float
    unit: str
    value: float | None


class ReportSignature(TypedDict):
    """A note to a session that is over, or a signature under its report."""

    at: str
    content_sha256: str
    is_of_this: bool
    is_signed: bool
    meaning: NotRequired[Literal["checked", "approved"] | None]
    name: str
    note: str


class ReportWindow(TypedDict):
    """A window of the session: as it was prescribed, and each one that was set or moved later."""

    actor: str
    at: str
    lower: NotRequired[float | None]
    reason: str
    text: str
    upper: NotRequired[float | None]


class SessionReport(TypedDict):
    """A session as its report states it."""

    calibration_sha256: str
    content_sha256: str
    deviations: list[str]
    differs: list[str]
    events: list[ReportEvent]
    figures: ReportFigures
    head: ReportHead
    model: str
    position: list[SignedDegree]
    samples_sha256: str
    session: Session
    session_id: str
    settings_sha256: str
    signatures: list[ReportSignature]
    signatures_needed: int
    software: str
    windows: list[ReportWindow]


class SessionRequest(TypedDict):
    """A new session: patient, plan, camera or recording, and gating window."""

    calibration_id: NotRequired[str | None]
    continues: NotRequired[str | None]
    fraction_id: str
    fraction_number: NotRequired[int | None]
    head_direction: NotRequired[Literal["top", "bottom", "left", "right"] | None]
    model_id: NotRequired[str | None]
    operator: NotRequired[str]
    patient_reference: str
    plan_id: str
    regions: NotRequired[Regions]
    source: RecordingSource | DeviceSource
    window: Window


class ThinSample(TypedDict):
    """The newest frame, reduced to what monitors of the gate need; the fields are those of the full form."""

    abdomen_mm: float | None
    age_ms: float
    captured_at: str | None
    form: NotRequired[Literal["thin"]]
    fps: float | None
    frame_index: int
    gate: Literal["disarmed", "hold", "dwell", "beam_on", "fault"]
    hold_reason: str | None
    hold_text: str | None
    is_armed: bool
    is_simulated_beam: bool
    latency_ms: float | None
    line_on: bool
    received_at: str | None
    sent_at: str
    sequence: int
    session_id: str
    session_status: Literal["running", "ended", "stopped", "failed"]
    signal_mm: float | None
    state: Literal["training", "measuring", "lost"]
    thorax_mm: float | None
    timestamp_us: int
    type: NotRequired[Literal["sample"]]
    volume_l: float | None
    whole_mm: float | None


class Transition(TypedDict):
    """One change of the gate, from the audit log; fields ending in `_ns` are host monotonic time."""

    armed_by: NotRequired[str | None]
    asserted_ns: int | None
    at: str
    audit_sequence: int
    captured_ns: NotRequired[int | None]
    captured_us: int | None
    decided_ns: int | None
    detail: str
    frame_index: int | None
    from_state: str
    latency_ms: NotRequired[float | None]
    number: NotRequired[int | None]
    operator: str | None
    reason: str | None
    received_ns: int | None
    recovered: NotRequired[bool]
    to_state: str


class TransitionPage(TypedDict):
    """Transitions, oldest first; `next_cursor` is null on the last page."""

    items: list[Transition]
    next_cursor: str | None


class UploadedCalibration(TypedDict):
    """An uploaded calibration with its source format and the assumptions of the conversion."""

    camera: str
    created_at: str
    format: NotRequired[Literal["tidegate.calibration/1", "opencv-filestorage", "ros-camera-info"]]
    id: str
    notes: NotRequired[list[str]]
    sha256: str
    uploaded_by: str


class WindowRequest(TypedDict):
    """Another window for a session that runs, with the conditions of the present one and other numbers."""

    operator: NotRequired[str]
    reason: NotRequired[str]
    window: Window


LiveMessage = Hello | Idle | Ping | Dropped | Gap | Resumed | Alarms | Sample | ThinSample | RecordedSample


# </made: answers>


class ClientError(Exception):
    """Base of what this client raises; `code` is stable."""

    code = "client_error"


class UsageError(ClientError, ValueError):
    """The client was given what it cannot work with."""

    code = "usage"


class UnreachableError(ClientError):
    """No answer came: the network, the service, or a proxy.

    The call may have been done or not. After one that is never repeated (arm!) read the session to know.
    """

    code = "unreachable"


class AnswerError(ClientError):
    """An answer came that the contract does not know: too large, cut off, no JSON, or without what it must have."""

    code = "answer_unexpected"


class ProblemError(ClientError):
    """The service refused, with a problem (RFC 9457).

    Attributes
    ----------
    code
        Stable; what a program decides by. The catalogue is docs/4-integrate/problems.md.
    status
        Of HTTP.
    field, value, bound
        What was wrong, where one field was; else None.
    retry_after_s
        When to come back, if the service said so.
    request_id
        To be named when asking the site's IT: it stands in the service's log.
    """

    def __init__(self, status: int, problem: Mapping[str, object], headers: Mapping[str, str]) -> None:
        self.code = _text_of(problem.get("code")) or f"http_{status}"
        self.status = status
        self.title = _text_of(problem.get("title")) or ""
        self.detail = _text_of(problem.get("detail")) or ""
        self.field, self.value, self.bound = (_text_of(problem.get(name)) for name in ("field", "value", "bound"))
        self.retry_after_s = _seconds_of(headers.get("retry-after"))
        self.request_id = headers.get("x-request-id")
        super().__init__(f"{status} {self.code}: {self.detail or self.title}")

    def __reduce__(self) -> tuple[type["ProblemError"], tuple[object, ...]]:
        """Support pickling, for another process."""
        problem = {name: getattr(self, name) for name in ("code", "title", "detail", "field", "value", "bound")}
        headers = {"x-request-id": self.request_id} if self.request_id else {}
        if self.retry_after_s is not None:
            headers["retry-after"] = str(self.retry_after_s)
        return (ProblemError, (self.status, problem, headers))


@dataclass(frozen=True, slots=True, kw_only=True)
class Exported:
    """A completely written file."""

    path: Path
    size: int
    sha256: str


@dataclass(frozen=True, slots=True, kw_only=True)
class TaggedSession:
    """A session and its version, to be given as ``if_match`` of a call that must not act on a newer one."""

    session: "SessionDetail"
    etag: str | None


AnswerT = TypeVar("AnswerT")
Query = Mapping[str, str | int | float | bool | None]


@dataclass(frozen=True, slots=True, kw_only=True)
class SentCall:
    """One request; with ``is_repeatable`` it may be sent again when its outcome is unknown."""

    method: str
    path: str
    query: Query = field(default_factory=dict)
    body: bytes | None = None
    headers: Mapping[str, str] = field(default_factory=dict)
    is_repeatable: bool
    accepted: frozenset[int] = frozenset()
    timeout_s: float | None = None

    @property
    def target(self) -> str:
        """Path and query."""
        arguments = {name: _query_text(value) for name, value in self.query.items() if value is not None}
        return f"{self.path}?{urlencode(arguments)}" if arguments else self.path


@dataclass(frozen=True, slots=True, kw_only=True)
class AnsweredCall:
    """A complete answer."""

    status: int
    headers: Mapping[str, str]
    body: bytes


class TidegateClient:
    """The calls a planning system needs; may be used by several threads at once.

    Parameters
    ----------
    base_url
        ``https://host[:port][/prefix]``; plain ``http`` only to this machine, unless ``is_plain_http_allowed``.
    key
        An API key, ``tg_...``; or None, and a person logs in with :meth:`log_in`.
    operator
        For whom this program acts, in the audit; a call may name another.
    ca_file
        The certificate authority of the site, PEM; the system's when left out. Certificates are always verified.
    timeout_s
        Longest silence of the service within one call.
    retries
        How often a call that may be repeated is.
    """

    def __init__(
        self,
        base_url: str,
        *,
        key: str | None = None,
        operator: str | None = None,
        ca_file: str | Path | None = None,
        timeout_s: float = 10.0,
        retries: int = 3,
        is_plain_http_allowed: bool = False,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        if not 0.05 <= timeout_s <= 600.0:
            raise UsageError(f"timeout_s {timeout_s!r} must be from 0.05 to 600")
        if not 0 <= retries <= 20:
            raise UsageError(f"retries {retries!r} must be from 0 to 20")
        self._place = _Place.of(base_url, ca_file, is_plain_http_allowed=is_plain_http_allowed)
        self._timeout_s = timeout_s
        self._retries = retries
        self._operator = operator
        self._sleep = sleep
        self._lock = threading.Lock()
        self._kept: list[tuple[http.client.HTTPConnection, float]] = []
        self._secrets: dict[str, str] = {} if key is None else {"Authorization": f"Bearer {_checked_key(key)}"}

    def __repr__(self) -> str:
        """Show the address, never the key."""
        return f"TidegateClient({self._place.origin!r})"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Close idle connections; the client may be used again."""
        with self._lock:
            kept, self._kept = self._kept, []
        for connection, _ in kept:
            connection.close()

    # -- who, and whether

    def log_in(self, name: str, password: str) -> "Me":
        """Log in as a person: for calls that no key may make, such as acknowledging a fault."""
        return self._send("POST", "/api/v1/login", Me, body={"name": name, "password": password})

    def log_out(self) -> None:
        """Log out."""
        self._exchange(SentCall(method="POST", path="/api/v1/logout", body=b"{}", is_repeatable=False))
        self._secrets.pop("Cookie", None)

    def change_password(self, old_password: str, new_password: str) -> None:
        """Change the password of the logged-in person."""
        body = {"old_password": old_password, "new_password": new_password}
        self._act("/api/v1/me/password", body)

    def me(self) -> "Me":
        """Return the authenticated identity and its permissions."""
        return self._read("/api/v1/me", Me)

    def readiness(self) -> "Readiness":
        """Return whether a session could run, and the reasons why not."""
        return self._read("/readyz", Readiness, accepted=frozenset({503}))

    def devices(self) -> "DeviceList":
        """List the cameras."""
        return self._read("/api/v1/devices", DeviceList)

    def recordings(self) -> Iterator["Recording"]:
        """List the recordings in the site's folders, by path."""
        return self._pages("/api/v1/recordings", RecordingPage)

    def interlocks(self) -> "InterlockList":
        """List every reason to hold, what trips it, and whether it latches."""
        return self._read("/api/v1/interlocks", InterlockList)

    # -- calibrations

    def upload_calibration(
        self, document: bytes, *, media_type: str = JSON_TYPE, operator: str | None = None
    ) -> "UploadedCalibration":
        """Upload a camera calibration; the same content again returns the same calibration."""
        query = {"operator": operator or self._operator}
        return self._make("/api/v1/calibrations", UploadedCalibration, document, media_type=media_type, query=query)

    def calibrations(self, *, camera: str | None = None) -> Iterator["Calibration"]:
        """List the calibrations, newest first."""
        return self._pages("/api/v1/calibrations", CalibrationPage, {"camera": camera})

    def read_calibration(self, calibration_id: str) -> "CalibrationDetail":
        """Return a calibration with its document."""
        return self._read(f"/api/v1/calibrations/{_part(calibration_id)}", CalibrationDetail)

    # -- plans

    def import_plan(self, dicom: bytes, *, operator: str | None = None, idempotency_key: str | None = None) -> "Plan":
        """Import an RT Plan or RT Ion Plan; the same plan again returns the same plan."""
        query = {"operator": operator or self._operator}
        media_type = "application/dicom"
        return self._make(
            "/api/v1/plans", Plan, dicom, media_type=media_type, query=query, idempotency_key=idempotency_key
        )

    def plans(
        self, *, patient_reference: str | None = None, label: str | None = None, search: str | None = None
    ) -> Iterator["PlanSummary"]:
        """List the plans, newest first, with what was done of each."""
        query = {"patient_reference": patient_reference, "label": label, "search": search}
        return self._pages("/api/v1/plans", PlanPage, query)

    def read_plan(self, plan_id: str) -> "Plan":
        """Return a plan: fractions, beams, prescribed breathing technique."""
        return self._read(f"/api/v1/plans/{_part(plan_id)}", Plan)

    def prepare_session(
        self, plan_id: str, request: "PlanSessionRequest", *, idempotency_key: str | None = None
    ) -> "PreparedSession":
        """Prepare a session of a fraction of this plan; `warnings` are for the person who starts it."""
        path = f"/api/v1/plans/{_part(plan_id)}/sessions"
        return self._make(path, PreparedSession, self._for_somebody(request), idempotency_key=idempotency_key)

    # -- sessions

    def create_session(self, request: "SessionRequest", *, idempotency_key: str | None = None) -> "Session":
        """Prepare a session. Pass an idempotency key if your program may have to repeat the call after a restart."""
        return self._make("/api/v1/sessions", Session, self._for_somebody(request), idempotency_key=idempotency_key)

    def sessions(
        self,
        *,
        status: str | None = None,
        patient_reference: str | None = None,
        plan_id: str | None = None,
        search: str | None = None,
        since: str | None = None,
        until: str | None = None,
    ) -> Iterator["Session"]:
        """List the sessions, newest first; times are RFC 3339."""
        query = {"status": status, "patient_reference": patient_reference, "plan_id": plan_id, "search": search}
        return self._pages("/api/v1/sessions", SessionPage, {**query, "since": since, "until": until})

    def read_session(self, session_id: str) -> "SessionDetail":
        """Return a session with gate, training and figures."""
        return self._read(_session(session_id), SessionDetail)

    def read_arming(self, session_id: str) -> "ArmingSummary":
        """Return the parameters that an arming would take, and what is missing."""
        return self._read(f"{_session(session_id)}/arming", ArmingSummary)

    def read_session_tagged(self, session_id: str) -> TaggedSession:
        """Return a session and its ETag."""
        answer = self._exchange(SentCall(method="GET", path=_session(session_id), is_repeatable=True))
        return TaggedSession(session=_parsed(answer, SessionDetail), etag=answer.headers.get("etag"))

    def start(self, session_id: str, *, operator: str | None = None, if_match: str | None = None) -> "Session":
        """Open the camera and start the training, disarmed. Never repeated."""
        return self._do(session_id, "start", Session, operator, if_match)

    def set_reference(
        self,
        session_id: str,
        *,
        at: Literal["end_exhale", "end_inhale", "now"] = "end_exhale",
        level_seen: float | None = None,
        move_seen_mm: float | None = None,
        reason: str = "",
        setup_confirmed: bool = False,
        operator: str | None = None,
        if_match: str | None = None,
    ) -> "SessionDetail":
        """Set the reference to the mean of the last ends of exhale; disarms. Never repeated.

        For a person who logged in; no key may. ``level_seen`` is the proposed level that the person was shown,
        ``move_seen_mm`` the movement of couch or camera that the reference accepts (``lost.moved_mm`` of a sample), and
        ``reason`` is required for an amplitude window where the level is neither near the end of exhale nor of inhale,
        and far from the fraction's first reference. ``setup_confirmed`` says that the person has seen the stickers on
        the skin and the chest uncovered, which a session in clinical mode needs once.
        """
        arguments: dict[str, object] = {"at": at, "reason": reason}
        if setup_confirmed:
            arguments["setup_confirmed"] = True
        if level_seen is not None:
            arguments["level_seen"] = level_seen
        if move_seen_mm is not None:
            arguments["move_seen_mm"] = move_seen_mm
        return self._do(session_id, "reference", SessionDetail, operator, if_match, arguments)

    def sign_position(
        self,
        session_id: str,
        *,
        reference_number: int,
        reason: str = "",
        operator: str | None = None,
        if_match: str | None = None,
    ) -> "SessionDetail":
        """Sign the patient's position against the plan's, which a later fraction needs before arming. Never repeated.

        For a person who logged in; no key may. ``reference_number`` is that of the session's ``position_check`` that
        the person was shown; ``reason`` is required where it is beyond the tolerance or not determined.
        """
        arguments: dict[str, object] = {"reference_number": reference_number, "reason": reason}
        return self._do(session_id, "position-check", SessionDetail, operator, if_match, arguments)

    def countersign(
        self, session_id: str, state: str, *, operator: str | None = None, if_match: str | None = None
    ) -> "SessionDetail":
        """Countersign the ``state`` of `arming` as a second person; refused to keys. Never repeated."""
        return self._do(session_id, "countersign", SessionDetail, operator, if_match, {"state": state})

    def arm(
        self,
        session_id: str,
        *,
        head_direction: Literal["top", "bottom", "left", "right"] | None = None,
        state: str | None = None,
        reason: str | None = None,
        operator: str | None = None,
        if_match: str | None = None,
    ) -> "SessionDetail":
        """Arm the gate. Never repeated: without an answer, read the session.

        ``head_direction`` is the side of the picture at which the operator sees the patient's head; required unless
        the window is on the whole region or its volume only. ``state`` is that of the arming summary that the operator
        looked at: another one is refused. ``reason`` is required of a person where the window joins conditions by or.
        """
        given = {"head_direction": head_direction, "state": state, "reason": reason}
        arguments = {name: value for name, value in given.items() if value is not None}
        return self._do(session_id, "arm", SessionDetail, operator, if_match, arguments)

    def release(self, session_id: str, *, operator: str | None = None, if_match: str | None = None) -> "SessionDetail":
        """Release a hold by hand; the gate decides again after a full dwell. Never repeated."""
        return self._do(session_id, "release", SessionDetail, operator, if_match)

    def acknowledge(
        self,
        session_id: str,
        *,
        alarms: Sequence[int] | None = None,
        operator: str | None = None,
        if_match: str | None = None,
    ) -> "SessionDetail":
        """Acknowledge the fault and the alarms as the logged-in person; refused to keys. Never repeated.

        ``alarms`` are the numbers of those that the person has seen; all that are active, if left out.
        """
        arguments: dict[str, object] = {} if alarms is None else {"alarms": list(alarms)}
        return self._do(session_id, "acknowledge", SessionDetail, operator, if_match, arguments)

    def correct_baseline(
        self,
        session_id: str,
        *,
        by_mm: float,
        drift_mm: float,
        reason: str = "",
        operator: str | None = None,
        if_match: str | None = None,
    ) -> "SessionDetail":
        """Move the window by a drift that a person confirms; disarms. Never repeated.

        Far from the fraction's first reference a ``reason`` is required, of a person who logged in.
        """
        arguments: dict[str, object] = {"by_mm": by_mm, "drift_mm": drift_mm}
        if reason:
            arguments["reason"] = reason
        return self._do(session_id, "baseline-correction", SessionDetail, operator, if_match, arguments)

    def set_window(
        self,
        session_id: str,
        window: "Window",
        *,
        operator: str | None = None,
        if_match: str | None = None,
        reason: str = "",
    ) -> "SessionDetail":
        """Set the window of a running session, on the same signals, while the gate is disarmed. Never repeated.

        Far beyond the fraction's first armed window a ``reason`` is required, of a person who logged in.
        """
        arguments: dict[str, object] = {"window": window} | ({"reason": reason} if reason else {})
        return self._do(session_id, "window", SessionDetail, operator, if_match, arguments)

    def note_presence(self, session_id: str, *, operator: str | None = None) -> None:
        """Report that the person who is logged in sees this session: every second while they do. Refused to a key."""
        self._act(f"{_session(session_id)}/presence", self._for_whom(operator))

    def hold(self, session_id: str, *, operator: str | None = None) -> "SessionDetail":
        """Hold the beam until a release. Repeated until an answer comes."""
        return self._take_away(session_id, "hold", SessionDetail, operator)

    def disarm(self, session_id: str, *, operator: str | None = None) -> "SessionDetail":
        """Disarm: hold the beam until the gate is armed again. Repeated until an answer comes."""
        return self._take_away(session_id, "disarm", SessionDetail, operator)

    def stop(self, session_id: str, *, operator: str | None = None) -> "Session":
        """Hold the beam and close the session. Repeated until an answer comes; a closed session stays closed."""
        try:
            return self._take_away(session_id, "stop", Session, operator)
        except ProblemError as problem:
            if problem.code != "session_state":
                raise
            return self.read_session(session_id)

    def transitions(
        self, session_id: str, *, to_state: str | None = None, reason: str | None = None
    ) -> Iterator["Transition"]:
        """List the gate's transitions, oldest first."""
        query = {"to_state": to_state, "reason": reason}
        return self._pages(f"{_session(session_id)}/transitions", TransitionPage, query)

    # -- motion models

    def session_models(self, session_id: str) -> Iterator["Model"]:
        """List the models of a session, newest first."""
        return self._pages(f"{_session(session_id)}/models", ModelPage)

    def read_model(self, model_id: str) -> "Model":
        """Return a model's training data and quality figures."""
        return self._read(f"/api/v1/models/{_part(model_id)}", Model)

    def retrain(self, session_id: str, *, keeps_reference: bool = True, operator: str | None = None) -> "SessionDetail":
        """Train a new model in the background. Never repeated."""
        arguments = {"keeps_reference": keeps_reference}
        return self._do(session_id, "models/retrain", SessionDetail, operator, None, arguments)

    def apply_model(self, session_id: str, *, operator: str | None = None) -> "SessionDetail":
        """Switch to the waiting model; disarms. Never repeated."""
        return self._do(session_id, "models/apply", SessionDetail, operator, None)

    # -- taking along

    def export_samples(
        self, session_id: str, to: str | Path, *, form: Literal["csv", "arrow", "parquet"] = "csv"
    ) -> Exported:
        """Write the sample of every frame to a file, complete or not at all."""
        return self._download(f"{_session(session_id)}/samples", {"format": form}, Path(to))

    def read_report(self, session_id: str) -> "SessionReport":
        """Return the report of a session that is over: its figures, its events, its hashes."""
        return self._read(f"{_session(session_id)}/report", SessionReport)

    def export_report(self, session_id: str, to: str | Path) -> Exported:
        """Write the PDF report of a session that is over to a file."""
        return self._download(f"{_session(session_id)}/report.pdf", {}, Path(to))

    def export_waveform(self, session_id: str, to: str | Path, *, deidentify_as: str | None = None) -> Exported:
        """Write thorax and abdomen as a DICOM waveform to a file; de-identified under another Patient ID."""
        query = {} if deidentify_as is None else {"deidentify_as": deidentify_as}
        return self._download(f"{_session(session_id)}/waveform.dcm", query, Path(to))

    def export_report_dicom(self, session_id: str, to: str | Path) -> Exported:
        """Write the report as a DICOM Encapsulated PDF to a file."""
        return self._download(f"{_session(session_id)}/report.dcm", {}, Path(to))

    def audit(
        self,
        *,
        session_id: str | None = None,
        action: str | None = None,
        actor: str | None = None,
        outcome: str | None = None,
        since: str | None = None,
        until: str | None = None,
    ) -> Iterator["AuditEntry"]:
        """List the audit, newest first; times are RFC 3339."""
        query = {"session_id": session_id, "action": action, "actor": actor, "outcome": outcome}
        return self._pages("/api/v1/audit", AuditPage, {**query, "since": since, "until": until})

    def verify_audit(self, *, after: int = 0, limit: int = 100_000) -> "AuditVerification":
        """Verify the audit hash chain."""
        return self._read("/api/v1/audit/verify", AuditVerification, {"after": after, "limit": limit})

    def export_audit(
        self,
        to: str | Path,
        *,
        session_id: str | None = None,
        since: str | None = None,
        until: str | None = None,
    ) -> Exported:
        """Write the audit to a file of JSON lines, complete or not at all. Times are RFC 3339."""
        query = {"session_id": session_id, "since": since, "until": until}
        return self._download("/api/v1/audit/export", query, Path(to))

    # -- QA

    def qa_status(self) -> "QaStatus":
        """Return whether the site's QA permits arming."""
        return self._read("/api/v1/qa/status", QaStatus)

    def qa_latency(self) -> "CameraLatencyList":
        """List the newest measured latency of each camera and mode."""
        return self._read("/api/v1/qa/latency", CameraLatencyList)

    def qa_checks(self) -> "QaCheckList":
        """List the QA checks with their bounds."""
        return self._read("/api/v1/qa/checks", QaCheckList)

    def qa_runs(self, *, kind: str | None = None, verdict: str | None = None) -> Iterator["QaRun"]:
        """List the QA runs, newest first."""
        return self._pages("/api/v1/qa/runs", QaRunPage, {"kind": kind, "verdict": verdict})

    def read_qa_run(self, run_id: str) -> "QaRunDetail":
        """Return a QA run with every check."""
        return self._read(f"/api/v1/qa/runs/{_part(run_id)}", QaRunDetail)

    def qa_trend(self, check: str, *, limit: int = 30) -> "QaTrend":
        """Return the trend of a check over the newest runs."""
        return self._read("/api/v1/qa/trend", QaTrend, {"check": check, "limit": limit})

    def export_qa_report(self, run_id: str, to: str | Path) -> Exported:
        """Write the PDF report of a run to a file."""
        return self._download(f"/api/v1/qa/runs/{_part(run_id)}/report.pdf", {}, Path(to))

    # -- live

    def live(
        self,
        *,
        session_id: str | None = None,
        after_frame: int | None = None,
        rate_hz: float | None = None,
        form: Literal["full", "thin"] = "thin",
        silence_s: float = 5.0,
        reconnects: int = 8,
    ) -> Iterator["LiveMessage"]:
        """Follow the live stream without end; a broken stream is resumed.

        The two ask for what was recorded of a session behind a frame (-1: all of it), which comes first. Ends with
        UnreachableError where ``reconnects`` attempts one after another brought nothing. ``silence_s`` is how long
        the stream may be silent (the service sends something every one or two seconds). Close the iterator, or leave
        its loop, to end it.
        """
        query = {"session_id": session_id, "after_frame": after_frame, "rate_hz": rate_hz, "form": form}
        call = SentCall(method="GET", path="/api/v1/live/events", query=query, is_repeatable=True)
        return self._live(call, silence_s=silence_s, reconnects=reconnects)

    # -- how it is done

    def _live(self, call: SentCall, *, silence_s: float, reconnects: int) -> Iterator["LiveMessage"]:
        last_id: str | None = None
        failures = 0
        while True:
            headers = {"Accept": "text/event-stream", **({} if last_id is None else {"Last-Event-ID": last_id})}
            wait_s = min(FIRST_WAIT_S * 2**failures, 2.0)
            try:
                with self._opened(_with(call, headers), timeout_s=silence_s) as response:
                    for event in _events(response):
                        last_id = event.id if event.id is not None else last_id
                        failures = 0
                        yield cast("LiveMessage", _document(event.data, "a live message"))
                broken: Exception = AnswerError("the stream ended")
            except ProblemError as problem:
                if problem.status not in PASSING:
                    raise
                broken, wait_s = problem, max(wait_s, problem.retry_after_s or 0.0)
            except (OSError, http.client.HTTPException) as error:
                broken = error
            failures += 1
            if failures > reconnects or wait_s > LONGEST_WAIT_S:
                raise UnreachableError(f"the live stream is broken: {broken}") from broken
            self._sleep(wait_s)

    def _read(
        self,
        path: str,
        kind: type[AnswerT],
        query: Query | None = None,
        *,
        accepted: frozenset[int] = frozenset(),
    ) -> AnswerT:
        call = SentCall(method="GET", path=path, query=query or {}, is_repeatable=True, accepted=accepted)
        return _parsed(self._exchange(call), kind)

    def _pages(self, path: str, kind: type[Any], query: Query | None = None) -> Iterator[Any]:
        """Iterate over a list; each page is requested when it is reached."""
        seen: set[str] = set()
        cursor: str | None = None
        while True:
            page = self._read(path, kind, {**(query or {}), "cursor": cursor})
            yield from page["items"]
            cursor = page["next_cursor"]
            if cursor is None:
                return
            if cursor in seen:
                raise AnswerError(f"{path}: the server returned the same cursor twice")
            seen.add(cursor)

    def _make(
        self,
        path: str,
        kind: type[AnswerT],
        body: bytes | Mapping[str, object],
        *,
        media_type: str = JSON_TYPE,
        query: Query | None = None,
        idempotency_key: str | None = None,
    ) -> AnswerT:
        """Create a resource: once, however often the call is repeated with this key."""
        headers = {"Idempotency-Key": idempotency_key or uuid.uuid4().hex, "Content-Type": media_type}
        sent = body if isinstance(body, bytes) else json.dumps(body, allow_nan=False).encode()
        call = SentCall(method="POST", path=path, query=query or {}, body=sent, headers=headers, is_repeatable=True)
        return _parsed(self._exchange(call), kind)

    def _do(
        self,
        session_id: str,
        action: str,
        kind: type[AnswerT],
        operator: str | None,
        if_match: str | None,
        arguments: Mapping[str, object] | None = None,
    ) -> AnswerT:
        """Send a call that could lead to a permit, once."""
        body = {**self._for_whom(operator), **(arguments or {})}
        headers = {} if if_match is None else {"If-Match": if_match}
        return self._send("POST", f"{_session(session_id)}/{action}", kind, body=body, headers=headers)

    def _take_away(self, session_id: str, action: str, kind: type[AnswerT], operator: str | None) -> AnswerT:
        """Send a call that takes the permit away, until it is answered."""
        path, body = f"{_session(session_id)}/{action}", json.dumps(self._for_whom(operator)).encode()
        timeout_s = None if kind is Session else min(self._timeout_s, HOLD_TIMEOUT_S)
        call = SentCall(method="POST", path=path, body=body, is_repeatable=True, timeout_s=timeout_s)
        return _parsed(self._exchange(call), kind)

    def _send(
        self,
        method: str,
        path: str,
        kind: type[AnswerT],
        *,
        body: Mapping[str, object],
        headers: Mapping[str, str] | None = None,
    ) -> AnswerT:
        sent = json.dumps(body, allow_nan=False).encode()
        call = SentCall(method=method, path=path, body=sent, headers=headers or {}, is_repeatable=False)
        return _parsed(self._exchange(call), kind)

    def _act(self, path: str, body: Mapping[str, object]) -> None:
        """Send a call whose answer has no body."""
        self._exchange(SentCall(method="POST", path=path, body=json.dumps(body).encode(), is_repeatable=False))

    def _for_whom(self, operator: str | None) -> dict[str, object]:
        named = operator or self._operator
        return {} if named is None else {"operator": named}

    def _for_somebody(self, request: Mapping[str, object]) -> dict[str, object]:
        return {**self._for_whom(None), **request}

    def _exchange(self, call: SentCall) -> AnsweredCall:
        """Send a call; repeat it where that is safe and could help."""
        attempts = 0
        while True:
            attempts += 1
            wait_s = FIRST_WAIT_S * 2 ** (attempts - 1)
            is_last = not call.is_repeatable or attempts > self._retries
            try:
                answer = self._once(call)
            except (OSError, http.client.HTTPException) as error:
                if is_last or isinstance(error, ssl.SSLCertVerificationError):
                    message = f"{call.method} {call.path}: no answer ({type(error).__name__}: {error})"
                    raise UnreachableError(message) from error
            else:
                if answer.status < 300 or answer.status in call.accepted:
                    return answer
                problem = _problem(answer)
                wait_s = wait_s if problem.retry_after_s is None else problem.retry_after_s
                if is_last or answer.status not in PASSING or wait_s > LONGEST_WAIT_S:
                    raise problem
            self._sleep(wait_s)

    def _once(self, call: SentCall) -> AnsweredCall:
        """Send a call once; one that must not be repeated never uses a connection that may be closed already."""
        if call.timeout_s is not None or not call.is_repeatable:
            connection = self._place.connection(call.timeout_s or self._timeout_s)
        else:
            connection = self._connection()
        try:
            with self._asked(connection, call) as response:  # whose end frees its connection for the next call
                body = _bounded(response, MAX_ANSWER_BYTES, time.monotonic() + 4 * self._timeout_s)
        except BaseException:
            connection.close()
            raise
        if response.will_close or call.timeout_s is not None:
            connection.close()
        else:
            self._keep(connection)
        headers = _headers_of(response)
        self._take_cookie(headers)
        return AnsweredCall(status=response.status, headers=headers, body=body)

    @contextlib.contextmanager
    def _opened(self, call: SentCall, *, timeout_s: float | None = None) -> Iterator[http.client.HTTPResponse]:
        """Open a streamed answer on a dedicated connection."""
        connection = self._place.connection(timeout_s or self._timeout_s)
        try:
            with self._asked(connection, call) as response:
                if response.status >= 300:
                    body = _bounded(response, MAX_ANSWER_BYTES, time.monotonic() + self._timeout_s)
                    raise _problem(AnsweredCall(status=response.status, headers=_headers_of(response), body=body))
                yield response
        finally:
            connection.close()

    def _asked(self, connection: http.client.HTTPConnection, call: SentCall) -> http.client.HTTPResponse:
        headers = {"Accept": "application/json, application/problem+json, */*;q=0.1", **self._secrets}
        headers["User-Agent"] = f"tidegate-client/{VERSION}"
        if call.body is not None:
            headers["Content-Type"] = JSON_TYPE
        if "Cookie" in self._secrets:
            headers["Origin"] = self._place.origin
        target = self._place.prefix + call.target
        connection.request(call.method, target, body=call.body, headers={**headers, **call.headers})
        return connection.getresponse()

    def _download(self, path: str, query: Query, to: Path) -> Exported:
        """Write an answer to a temporary file beside ``to``; rename it when it is complete."""
        call = SentCall(method="GET", path=path, query=query, is_repeatable=True)
        attempts = 0
        while True:
            attempts += 1
            wait_s = FIRST_WAIT_S * 2 ** (attempts - 1)
            try:
                with self._opened(call) as response:
                    return _written(response, to)
            except ProblemError as problem:
                wait_s = wait_s if problem.retry_after_s is None else problem.retry_after_s
                if attempts > self._retries or problem.status not in PASSING or wait_s > LONGEST_WAIT_S:
                    raise
            except (ConnectionError, TimeoutError, http.client.HTTPException) as error:
                if attempts > self._retries:
                    raise UnreachableError(f"GET {path}: the export was cut off ({error})") from error
            self._sleep(wait_s)

    def _connection(self) -> http.client.HTTPConnection:
        with self._lock:
            while self._kept:
                connection, since_s = self._kept.pop()
                if time.monotonic() - since_s < KEPT_FOR_S:
                    return connection
                connection.close()
        return self._place.connection(self._timeout_s)

    def _keep(self, connection: http.client.HTTPConnection) -> None:
        with self._lock:
            self._kept.append((connection, time.monotonic()))
            spare = self._kept[:-4]
            del self._kept[:-4]
        for old, _ in spare:
            old.close()

    def _take_cookie(self, headers: Mapping[str, str]) -> None:
        """Keep the cookie of a log-in."""
        cookie = headers.get("set-cookie")
        if cookie is None or "Authorization" in self._secrets:
            return
        with contextlib.suppress(CookieError):
            for name, morsel in SimpleCookie(cookie).items():
                self._secrets["Cookie"] = f"{name}={morsel.value}"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Place:
    """Address of the service."""

    host: str
    port: int
    prefix: str
    origin: str
    tls: ssl.SSLContext | None

    @classmethod
    def of(cls, base_url: str, ca_file: str | Path | None, *, is_plain_http_allowed: bool) -> "_Place":
        parts = urlsplit(base_url)
        if parts.scheme not in {"http", "https"} or not parts.hostname:
            raise UsageError("base_url must be https://host[:port][/prefix]")
        if parts.username or parts.password or parts.query or parts.fragment:
            raise UsageError("base_url must have no user, password, query or fragment")
        is_plain = parts.scheme == "http"
        if is_plain and not is_plain_http_allowed and not _is_this_machine(parts.hostname):
            raise UsageError("base_url must be https: a key over plain http to another machine can be read by others")
        tls = None if is_plain else ssl.create_default_context(cafile=None if ca_file is None else str(ca_file))
        if tls is not None:
            tls.minimum_version = ssl.TLSVersion.TLSv1_2
        port = parts.port or (80 if is_plain else 443)
        origin = f"{parts.scheme}://{parts.netloc}"
        return cls(host=parts.hostname, port=port, prefix=parts.path.rstrip("/"), origin=origin, tls=tls)

    def connection(self, timeout_s: float) -> http.client.HTTPConnection:
        if self.tls is None:
            return http.client.HTTPConnection(self.host, self.port, timeout=timeout_s)
        return http.client.HTTPSConnection(self.host, self.port, timeout=timeout_s, context=self.tls)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Event:
    """A server-sent event."""

    id: str | None
    data: str


def _events(response: http.client.HTTPResponse) -> Iterator[_Event]:
    """Read server-sent events; what is no field of one, such as a comment, is passed over."""
    content_type = response.headers.get_content_type()
    if content_type != "text/event-stream":
        raise AnswerError(f"the live stream came as {content_type}")
    data: list[str] = []
    event_id: str | None = None
    size = 0
    while line := response.readline(MAX_EVENT_BYTES + 1):
        size += len(line)
        if size > MAX_EVENT_BYTES:
            raise AnswerError(f"a live message is larger than {MAX_EVENT_BYTES} bytes")
        text = line.decode("utf-8", errors="replace").rstrip("\r\n")
        if not text:
            if data:
                yield _Event(id=event_id, data="\n".join(data))
            data, event_id, size = [], None, 0
            continue
        name, _, value = text.partition(":")
        value = value.removeprefix(" ")
        if name == "data":
            data.append(value)
        elif name == "id" and "\0" not in value:
            event_id = value


def _written(response: http.client.HTTPResponse, to: Path) -> Exported:
    """Write a whole answer under another name, sync it, and give it its name."""
    if response.length is None and not response.chunked:
        raise AnswerError("cannot tell whether the download is complete: no Content-Length, not chunked")
    digest, size = hashlib.sha256(), 0
    number, draft = tempfile.mkstemp(dir=to.parent, prefix=f".{to.name}.")
    try:
        with os.fdopen(number, "wb") as file:
            while piece := response.read(CHUNK_BYTES):
                size = _within(size + len(piece), MAX_EXPORT_BYTES)
                digest.update(piece)
                file.write(piece)
            _check_whole(response)
            file.flush()
            os.fsync(file.fileno())
        Path(draft).replace(to)
    except BaseException:
        Path(draft).unlink(missing_ok=True)
        raise
    return Exported(path=to, size=size, sha256=digest.hexdigest())


def _bounded(response: http.client.HTTPResponse, most: int, until_s: float) -> bytes:
    """Read an answer as far as its bound, and no longer than until a time."""
    pieces, size = [], 0
    while piece := response.read1(CHUNK_BYTES):
        pieces.append(piece)
        size = _within(size + len(piece), most)
        if time.monotonic() > until_s:
            raise TimeoutError("the answer does not end")
    _check_whole(response)
    return b"".join(pieces)


def _within(size: int, most: int) -> int:
    if size > most:
        raise AnswerError(f"the answer is larger than {most} bytes")
    return size


def _check_whole(response: http.client.HTTPResponse) -> None:
    """Refuse a body shorter than its Content-Length; of chunked bodies the library checks the end."""
    if response.length:
        raise http.client.IncompleteRead(b"", response.length)


def _parsed(answer: AnsweredCall, kind: type[AnswerT]) -> AnswerT:
    """Parse JSON and check that it has the contract's required fields; unknown fields are ignored."""
    found = _document(answer.body, "the answer")
    missing = sorted(getattr(kind, "__required_keys__", frozenset()) - found.keys())
    if missing:
        raise AnswerError(f"the answer is no {kind.__name__}: {', '.join(missing)} is missing")
    return cast("AnswerT", found)


def _document(text: bytes | str, what: str) -> dict[str, Any]:
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise AnswerError(f"{what} is no JSON") from error
    if not isinstance(found, dict):
        raise AnswerError(f"{what} is no JSON object")
    return found


def _problem(answer: AnsweredCall) -> ProblemError:
    """Parse a problem; an error page of a proxy becomes one too."""
    try:
        problem = _document(answer.body, "the problem")
    except AnswerError:
        problem = {"detail": f"HTTP {answer.status}, without a problem document of Tidegate"}
    return ProblemError(answer.status, problem, answer.headers)


def _headers_of(response: http.client.HTTPResponse) -> dict[str, str]:
    return {name.lower(): value for name, value in response.getheaders()}


def _session(session_id: str) -> str:
    return f"/api/v1/sessions/{_part(session_id)}"


def _part(identifier: str) -> str:
    """Make an id one part of a path, whatever somebody put into it."""
    if not identifier or identifier in {".", ".."}:
        raise UsageError(f"{identifier!r} is no id")
    return quote(identifier, safe="")


def _with(call: SentCall, headers: Mapping[str, str]) -> SentCall:
    return SentCall(method=call.method, path=call.path, query=call.query, headers=headers, is_repeatable=True)


def _query_text(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def _text_of(value: object) -> str | None:
    return value if isinstance(value, str) else None


def _seconds_of(header: str | None) -> float | None:
    """Read ``Retry-After`` in seconds; a date, which this service never sends, is ignored."""
    try:
        return max(0.0, float(header)) if header is not None else None
    except ValueError:
        return None


def _checked_key(key: str) -> str:
    """Refuse a key that could not stand in a header, without repeating it."""
    if not _VISIBLE.fullmatch(key):
        raise UsageError("key must be visible ASCII characters, without spaces or line ends")
    return key


def _is_this_machine(host: str) -> bool:
    if host == "localhost":
        return True
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return False
