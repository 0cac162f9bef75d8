"""Sessions for replays: a real service on a real engine, a recording played as fast as it can be, and a busy person.

Everything that may come between two frames comes here by chance, from a seed: commands, silences, lost frames, a line
that fails, an engine that hangs. What a machine makes of the same seed differs from run to run; a replay must not.
"""

import contextlib
import random
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from engine.beam.simulated import SimulatedBeamLine
from engine.capture.recording_source import OniFileSource
from engine.core.errors import BeamLineError, FrameTimeoutError
from engine.core.frames import RgbdFrame
from engine.motion.learning.trainer import TrainingSettings
from engine.motion.settings import PipelineSettings
from service.core.settings.settings import Settings
from service.engine_host import local_engine
from service.engine_host.local_engine import LocalEngine
from service.web.app import create_app
from tests.support.service.accounts import PASSWORD, PeopleClient, QuickHashing
from tests.support.service.api_calls import act, make_session_body, upload

PATIENT_LIMITS = {
    "max_frame_age_ms": 200.0,
    "lease_ms": 200.0,
    "watchdog_ms": 500.0,
    "max_gap_ms": 200.0,
    "min_fps": 5.0,
    "max_latency_ms": 1000.0,
    "operator_timeout_s": 0.0,
    "max_duty_percent": 100.0,
}
FEW_FRAMES = TrainingSettings(min_frames=40, max_frames=120, min_cycles=1, min_seconds=4.0)
PERSON = "A. Therapist"
LONGEST_S = 120.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Troubles:
    """How likely a thing is, a frame or a call."""

    silence: float = 0.0
    loss: float = 0.0
    hang: float = 0.0
    line: float = 0.0


class TroubledSource(OniFileSource):
    """A recording with silences, losses and hangs that it does not have."""

    def __init__(self, path: Path, troubles: Troubles, chance: random.Random, **how) -> None:
        super().__init__(path, **how)
        self._troubles, self._chance = troubles, chance

    def read(self, timeout_s: float) -> RgbdFrame:
        if self._chance.random() < self._troubles.silence:
            time.sleep(timeout_s)
            raise FrameTimeoutError("nothing came")
        if self._chance.random() < self._troubles.hang:
            time.sleep(0.6)
        if self._chance.random() < self._troubles.loss:
            super().read(timeout_s)
        return super().read(timeout_s)


class TroubledLine(SimulatedBeamLine):
    """A line that does not answer now and then."""

    def trouble_by(self, troubles: Troubles, chance: random.Random) -> "TroubledLine":
        self._troubles, self._chance = troubles, chance
        return self

    def is_on(self) -> bool:
        if self._chance.random() < self._troubles.line:
            raise BeamLineError("it does not answer")
        return super().is_on()


class TroubledEngine(LocalEngine):
    """Plays as fast as frames can be measured, learns from few of them, and has its troubles from a seed."""

    troubles = Troubles()
    seed = 0
    training = FEW_FRAMES

    def __init__(self, settings: Settings) -> None:
        super().__init__(settings, measuring=PipelineSettings(training=self.training))

    def _player(self, path: Path, _player: str) -> OniFileSource:
        return TroubledSource(path, self.troubles, random.Random(self.seed), clock=self._clock, is_paced=False)


@contextlib.contextmanager
def troubled_line(troubles: Troubles, seed: int):
    """Let engines have such lines meanwhile."""
    before = local_engine.make_beam_line
    local_engine.make_beam_line = lambda _settings, clock: TroubledLine(clock).trouble_by(troubles, random.Random(seed))
    try:
        yield
    finally:
        local_engine.make_beam_line = before


@dataclass(frozen=True, slots=True, kw_only=True)
class Played:
    """A session that has run."""

    data_dir: Path
    session_id: str
    status: str
    frames: int


def play(
    data_dir: Path,
    volunteer: Path,
    seed: int,
    *,
    troubles: Troubles = Troubles(),
    window: dict | None = None,
    training: TrainingSettings = FEW_FRAMES,
    regions: dict | None = None,
    earlier: str | None = None,
    person: "Person | None" = None,
    fraction: int | None = None,
    simulation: str | None = None,
) -> Played:
    """Run one session with a person whose mind is made up by a seed, until its recording is over.

    ``earlier`` is a session of the same folder whose model this one begins with; ``person`` is somebody else;
    ``simulation`` is the simulation day of another plan, for which this one is.
    """
    kind = type("Engine", (TroubledEngine,), {"troubles": troubles, "seed": seed, "training": training})
    settings = Settings(
        data_dir=data_dir, recordings_dirs=(volunteer,), allowed_hosts=("testserver",), **PATIENT_LIMITS
    )
    with troubled_line(troubles, seed), PeopleClient(create_app(settings, kind)) as client:
        calibration_id = upload(client, (volunteer / "calibration.json").read_bytes()).json()["id"]
        source = {"kind": "recording", "path": "recording.oni", "player": "reader"}
        body = make_session_body(calibration_id) | {"window": window or WIDE, "source": source}
        if fraction is not None:
            body |= {"fraction_id": f"FX-{fraction}", "fraction_number": fraction}
        if regions is not None:
            body["regions"] = regions
        if earlier is not None:
            body["model_id"] = client.get(f"/api/v1/sessions/{earlier}/models").json()["items"][0]["id"]
        if simulation is not None:
            body |= {"plan_id": "PLAN-2"}
        answer = client.post("/api/v1/sessions", json=body)
        assert answer.status_code == 201, answer.text
        session_id = answer.json()["id"]
        if simulation is not None:
            _sign_simulation(client, session_id, simulation)
        assert act(client, session_id, "start").status_code == 200
        detail = _live_through(Hands(client, session_id), person or BusyPerson(random.Random(seed)))
    return Played(data_dir=data_dir, session_id=session_id, status=detail["status"], frames=detail["summary"]["frames"])


def _sign_simulation(client: PeopleClient, session_id: str, simulation: str) -> None:
    client.desk.logins._hashing = QuickHashing()
    body = {"operator": "A. Therapist", "session_id": simulation, "password": PASSWORD}
    answer = client.post(f"/api/v1/sessions/{session_id}/simulation", json=body)
    assert answer.status_code == 200, answer.text


WIDE = {"signal": "whole", "lower_mm": -40.0, "upper_mm": 40.0, "hysteresis_mm": 0.2, "dwell_ms": 100.0}
SOON = WIDE | {"dwell_ms": 10.0}
"""For a recording that is played as fast as the machine can: with losses in every second of it no long dwell ends."""
WINDOWS = (
    WIDE,
    {"signal": "whole", "lower_mm": -2.0, "upper_mm": 2.0, "hysteresis_mm": 0.2, "dwell_ms": 0.0},
    {
        "signal": "thorax",
        "lower_mm": -1.0,
        "upper_mm": 6.0,
        "hysteresis_mm": 0.5,
        "dwell_ms": 200.0,
        "min_on_ms": 300.0,
    },
    {"kind": "phase", "signal": "whole", "from_percent": 20.0, "to_percent": 80.0, "min_confidence": 0.6},
)


@dataclass(frozen=True, slots=True)
class Hands:
    """What a person can do in one session."""

    client: PeopleClient
    session_id: str

    def look(self) -> dict:
        return self.client.get(f"/api/v1/sessions/{self.session_id}").json()

    def act(self, action: str) -> None:
        act(self.client, self.session_id, action)

    def post(self, path: str, **body: object) -> None:
        self.client.post(f"/api/v1/{path}", json={"operator": PERSON, **body})


Person = Callable[[Hands, dict], None]


def _live_through(hands: Hands, person: Person) -> dict:
    """Let a person act until the session is over."""
    end_s = time.monotonic() + LONGEST_S
    while (detail := hands.look())["status"] == "running":
        if time.monotonic() > end_s:
            hands.act("stop")
        person(hands, detail)
    return detail


def make_ready(hands: Hands, detail: dict) -> bool:
    """Do what brings the beam nearer; return whether nothing was to do."""
    gate = detail["gate"] or {"state": "disarmed", "is_armed": False}
    if gate["state"] == "fault":
        hands.act("acknowledge")
    elif not gate["is_armed"] and detail["measurement_state"] == "measuring":
        _ = detail["has_reference"] or hands.act("reference")
        _sign(hands, detail["position_check"])
        hands.act("arm")
    else:
        return gate["is_armed"]
    return False


def _sign(hands: Hands, check: dict | None) -> None:
    """Sign the position where a later fraction needs it."""
    if check is not None and check["status"] == "unsigned":
        number = check["reference_number"]
        hands.post(f"sessions/{hands.session_id}/position-check", reference_number=number, reason="by the lasers")


@dataclass(frozen=True, slots=True)
class BusyPerson:
    """Somebody of little patience, whose mind is made up by a seed; who stops after so many frames, if given."""

    chance: random.Random
    frames: int | None = None

    def __call__(self, hands: Hands, detail: dict) -> None:
        session, chance = f"sessions/{hands.session_id}", self.chance
        if self.frames is not None and detail["summary"]["frames"] >= self.frames:
            hands.act("stop")
            return
        if make_ready(hands, detail) and chance.random() < 0.25:
            wish = chance.choice(("by hand", "by hand", "by hand", "retrain", "apply", "activate", "correct"))
            match wish:
                case "by hand":
                    hands.act(chance.choice(["hold", "disarm", "reference", "acknowledge", "arm"]))
                    hands.act("release")
                case "retrain":
                    hands.post(f"{session}/models/retrain", keeps_reference=chance.random() < 0.5)
                case "apply":
                    hands.post(f"{session}/models/apply")
                case "activate":
                    hands.post(f"models/{detail['active_model_id']}/activate")
                case "correct":
                    drift_mm = (detail["breath"] or {}).get("drift") or 0.0
                    hands.post(f"{session}/baseline-correction", drift_mm=drift_mm, by_mm=drift_mm)
        time.sleep(chance.uniform(0.01, 0.1))


class DeliberatePerson:
    """Somebody who waits for the beam, holds it, releases it, sets the zero, and stops when it is on again."""

    STEPS = ("hold", "release", "reference", "", "stop")

    def __init__(self) -> None:
        self.done = 0

    def __call__(self, hands: Hands, detail: dict) -> None:
        step = self.STEPS[min(self.done, len(self.STEPS) - 1)]
        is_on = make_ready(hands, detail) and detail["gate"]["state"] == "beam_on"
        if is_on or step == "release":
            hands.act(step) if step else None
            self.done += 1
        time.sleep(0.02)
