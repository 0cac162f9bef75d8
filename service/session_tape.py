"""The tape of a session, written beside it: what its engine heard, so that `tidegate replay` can run it again.

Never in the gate's way: a tape that cannot be written is a session that cannot be replayed, and the log and the audit
say so.
"""

import logging
from pathlib import Path

from engine.limits import GateLimits
from engine.pipeline import PipelineSettings
from engine.replaying.head import RECORDING, Frames, TapeHead, this_machine, this_software
from engine.replaying.spelling import Spelling
from engine.replaying.tape_file import SUFFIX
from engine.replaying.tape_writer import TapeWriter, sha256_of
from engine.replaying.taping import Taping
from service.model_store import ModelStore
from service.ports import SessionPlan

logger = logging.getLogger(__name__)

FOLDER = "replays"
JOIN_S = 5.0


def tape_path(data_dir: Path, session_id: str) -> Path:
    """Return where a session's tape lies."""
    return data_dir / FOLDER / f"{session_id}{SUFFIX}"


def spelling_of(models: ModelStore) -> Spelling:
    """Spell models by the hash they are kept under."""
    return Spelling(name_of=models.save, model_of=models.load)


class SessionTape:
    """One session's tape, from the engine's start to its end."""

    def __init__(self, taping: Taping, path: Path) -> None:
        self.taping, self._path = taping, path
        self._writer: TapeWriter | None = None

    def start(self, plan: SessionPlan, limits: GateLimits, measuring: PipelineSettings, models: ModelStore) -> None:
        """Begin to write."""
        spelling = spelling_of(models)

        def head() -> dict[str, object]:
            return TapeHead(
                session_id=plan.session_id,
                limits=limits,
                measuring=measuring,
                calibration=plan.calibration,
                model=plan.model,
                frames=Frames(kind=None if plan.recording is None else RECORDING, path=plan.recording),
                software=this_software(),
                machine=this_machine(),
            ).spelled(spelling)

        self._writer = TapeWriter(self.taping, self._path, head, spelling, recording=plan.recording)
        self._writer.start()

    def finish(self) -> dict[str, object]:
        """Wait a moment for the last line; return what the audit keeps of the tape."""
        if self._writer is None:
            return {}
        self._writer.join(JOIN_S)
        if self._writer.is_alive():
            self.taping.tear("the tape was not written in time")
            self._writer.join(JOIN_S)
        torn = self.taping.torn
        if torn is not None:
            logger.warning("a session's tape ends early: %s", torn)
        try:
            return {"tape_sha256": sha256_of(self._path), "tape_torn": torn}
        except OSError:
            return {"tape_sha256": None, "tape_torn": torn or "there is no tape"}
