"""Plays sessions of many volunteers with many troubles, replays each, and prints what came of it.

`python -m verification.replay --sessions 50` is the campaign of docs/3-operate/replay.md.
Exit code 1 where a replay differed.
"""

import argparse
import random
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import typer

from lab.phantom.recording import make_volunteer
from service.core.settings.database_place import DATABASE_NAME
from service.sessions.recovery.replay import StoredSession, Verdict
from service.storage.database.engine import Database
from tests.support.build_cache import digest_of, made_once
from tests.support.phantom_recordings import MAKERS
from tests.support.replay.real_sessions import WINDOWS, BusyPerson, Played, Troubles, play

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
FROM_A_MODEL = 5
"""Every so many sessions begin with the model of the one before."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    seed: int
    played: Played
    verdict: Verdict

    @property
    def line(self) -> str:
        replayed, played = self.verdict.replay, self.played
        found = "identical" if self.verdict.is_identical else f"DIFFERENT: {self.verdict.differences[0]}"
        changes = len(replayed.transitions) + len(replayed.elsewhere)
        return f"{self.seed:4d} {played.status:8s} {replayed.frames:5d} frames {changes:4d} transitions {found}"


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


def outcomes(sessions: int, first_seed: int, frames: int | None, volunteers: int) -> Iterator[Outcome]:
    """Play and replay, one after the other."""
    for seed in range(first_seed, first_seed + sessions):
        with tempfile.TemporaryDirectory(prefix="tidegate-replay-") as folder:
            data_dir, volunteer = Path(folder) / "data", kept_volunteer(*VOLUNTEERS[seed % volunteers])
            how = {"troubles": TROUBLES[seed % len(TROUBLES)], "window": WINDOWS[seed % len(WINDOWS)]}
            earlier = None
            if seed % FROM_A_MODEL == 0:
                earlier = play(data_dir, volunteer, seed, window=WINDOWS[0]).session_id
            person = BusyPerson(random.Random(seed), frames)
            played = play(data_dir, volunteer, seed, earlier=earlier, person=person, **how)
            yield Outcome(seed=seed, played=played, verdict=verdict_on(played))


def main() -> int:
    """Run the campaign."""
    parser = argparse.ArgumentParser(prog="python -m verification.replay", description=__doc__)
    parser.add_argument("--sessions", type=int, default=50)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--frames", type=int, default=None, help="stop each session after so many")
    parser.add_argument("--volunteers", type=int, default=len(VOLUNTEERS), choices=range(1, len(VOLUNTEERS) + 1))
    wish = parser.parse_args()
    frames = transitions = identical = 0
    for outcome in outcomes(wish.sessions, wish.first_seed, wish.frames, wish.volunteers):
        typer.echo(outcome.line)
        replayed = outcome.verdict.replay
        frames += replayed.frames
        transitions += len(replayed.transitions) + len(replayed.elsewhere)
        identical += outcome.verdict.is_identical
    typer.echo(f"{identical} of {wish.sessions} sessions identical: {frames} frames, {transitions} transitions")
    return 0 if identical == wish.sessions else 1


if __name__ == "__main__":
    sys.exit(main())
