"""The replay campaign: sessions of many volunteers with many troubles, played and replayed; its trials are seeds."""

import argparse
import contextlib
import random
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from rich.console import Console

from lab.phantom.recording import make_volunteer
from service.core.settings.database_place import DATABASE_NAME
from service.sessions.recovery.replay import StoredSession, Verdict
from service.storage.database.engine import Database
from tests.support.build_cache import digest_of, made_once
from tests.support.phantom_recordings import MAKERS
from tests.support.replay.real_sessions import WINDOWS, BusyPerson, Played, Troubles, play
from verification.campaign.bench import Bench
from verification.campaign.command_line import bounded
from verification.campaign.outcomes import TrialOutcome
from verification.campaign.program import Campaign

VOLUNTEERS = (
    *(("regular", number, 22.0) for number in (1, 2, 3, 4)),
    *(("irregular", number, 22.0) for number in (1, 2, 5)),
    *(("drift", number, 22.0) for number in (1, 6)),
    ("occlusion", 1, 36.0),
)
TROUBLES = (
    Troubles(),
    Troubles(silence=0.005),
    Troubles(loss=0.02),
    Troubles(line=0.004),
    Troubles(hang=0.004),
    Troubles(silence=0.004, loss=0.01, hang=0.002, line=0.002),
)
MOST_SESSIONS = 100_000
FROM_A_MODEL = 5
"""Every so many sessions begin with the model of the one before."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome(TrialOutcome):
    """One session, played and replayed."""

    seed: int
    status: str
    frames: int
    transitions: int


class ReplayBench(Bench[int, Outcome]):
    """Plays a session of a seed, with its volunteer, window, disturbances and commands, and replays it."""

    def __init__(self, folder: Path, *, frames: int | None, volunteers: int) -> None:
        super().__init__(folder)
        self._frames, self._volunteers = frames, volunteers

    def do(self, trial: int) -> Outcome:
        """Play and replay."""
        with tempfile.TemporaryDirectory(prefix="tidegate-replay-") as folder:
            data_dir, volunteer = Path(folder) / "data", kept_volunteer(*VOLUNTEERS[trial % self._volunteers])
            how = {"troubles": TROUBLES[trial % len(TROUBLES)], "window": WINDOWS[trial % len(WINDOWS)]}
            earlier = None
            if trial % FROM_A_MODEL == 0:
                earlier = play(data_dir, volunteer, trial, window=WINDOWS[0]).session_id
            person = BusyPerson(random.Random(trial), self._frames)
            played = play(data_dir, volunteer, trial, earlier=earlier, person=person, **how)
            verdict = verdict_on(played)
        return Outcome(
            seed=trial,
            status=played.status,
            frames=verdict.replay.frames,
            transitions=len(verdict.replay.transitions) + len(verdict.replay.elsewhere),
            troubles=() if verdict.is_identical else (f"different: {verdict.differences[0]}",),
        )

    def broken(self, trial: int, *, is_last: bool) -> Outcome | None:
        """Say after the last attempt that there is no result."""
        return Outcome(seed=trial, status="", frames=0, transitions=0, troubles=("no result",)) if is_last else None


def kept_volunteer(scenario: str, number: int, seconds: float) -> Path:
    """Give a volunteer's folder, made now if none was kept."""
    wish = ("replay", scenario, number, seconds, np.__version__, cv2.__version__)
    with made_once(f"replayed-{scenario}-{number}-{digest_of(wish, *MAKERS)}") as (kept, draft):
        if draft is not None:
            make_volunteer(scenario, out=draft / "volunteer", volunteer=number, seconds=seconds, seed=number)
    return kept / "volunteer"


def verdict_on(played: Played) -> Verdict:
    """Replay a session and compare."""
    database = Database(played.data_dir / DATABASE_NAME)
    try:
        return StoredSession(database, played.data_dir, played.session_id).run_again(None, lambda _frames: None)
    finally:
        database.close()


class ReplayCampaign(Campaign[int, Outcome]):
    """So many sessions."""

    name = "replay"
    kind = Outcome

    def add_options(self, parser: argparse.ArgumentParser) -> None:
        """Add how many sessions, how long, of how many volunteers."""
        parser.add_argument("--sessions", type=bounded(1, MOST_SESSIONS), default=50)
        parser.add_argument("--first-seed", type=bounded(0, MOST_SESSIONS), default=0)
        parser.add_argument("--frames", type=bounded(1, MOST_SESSIONS), help="stop each session after so many")
        parser.add_argument("--volunteers", type=bounded(1, len(VOLUNTEERS)), default=len(VOLUNTEERS))

    def trials(self, asked: argparse.Namespace) -> range:
        """Return the seeds."""
        return range(asked.first_seed, asked.first_seed + asked.sessions)

    def key_of(self, outcome: Outcome) -> int:
        """Return the seed."""
        return outcome.seed

    @contextlib.contextmanager
    def benches(self, asked: argparse.Namespace, folder: Path) -> Iterator[Callable[[Path], ReplayBench]]:
        """Nothing is shared but the volunteers, which are kept."""
        yield partial(ReplayBench, frames=asked.frames, volunteers=asked.volunteers)

    def label(self, outcome: Outcome) -> str:
        """Name the seed, the end and the size."""
        return f"{outcome.seed} {outcome.status}, {outcome.frames} frames"

    def report(self, console: Console, outcomes: Sequence[Outcome], asked: argparse.Namespace) -> int:
        """Print the sums; 0 where every replay is identical."""
        frames, transitions = (sum(getattr(one, name) for one in outcomes) for name in ("frames", "transitions"))
        identical = sum(not one.is_red for one in outcomes)
        console.print(f"{identical} of {asked.sessions} sessions identical: {frames} frames, {transitions} transitions")
        return int(identical < asked.sessions)
