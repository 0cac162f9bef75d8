"""The tape of a session, written beside it: what its engine heard, so that `tidegate replay` can run it again.

Never in the gate's way: a tape that cannot be written is a session that cannot be replayed, and the log and the audit
say so.
"""

import logging
from pathlib import Path

from engine.capture.raw_recorder import RawRecorder
from engine.limits import GateLimits
from engine.pipeline import PipelineSettings
from engine.replaying.head import RAW, RECORDING, Frames, TapeHead, this_machine, this_software
from engine.replaying.spelling import Spelling
from engine.replaying.tape_file import SUFFIX
from engine.replaying.tape_writer import TapeWriter, sha256_of
from engine.replaying.taping import Taping
from service.model_store import MODELS_FOLDER, ModelStore
from service.ports import SessionPlan
from service.settings import Settings

logger = logging.getLogger(__name__)

FOLDER, RAW_FOLDER = "replays", "raw"
JOIN_S = 5.0
UNFINISHED = "the tape was still being written when the session was closed: its hash is not known"
MIB = 1024 * 1024


def tape_path(data_dir: Path, session_id: str) -> Path:
    """Return where a session's tape lies."""
    return data_dir / FOLDER / f"{session_id}{SUFFIX}"


def raw_path(data_dir: Path, session_id: str) -> Path:
    """Return where a session's raw recording lies, if it has one."""
    return data_dir / RAW_FOLDER / f"{session_id}.oni"


def spelling_of(models: ModelStore) -> Spelling:
    """Spell models by the hash they are kept under."""
    return Spelling(name_of=models.save, model_of=models.load)


class SessionTape:
    """One session's tape, and the raw recording of its camera where the site keeps one; from start to end."""

    def __init__(self, plan: SessionPlan, settings: Settings) -> None:
        self._plan, self._settings = plan, settings
        self._path = tape_path(settings.data_dir, plan.session_id)
        self._raw: RawRecorder | None = None
        if plan.recording is None and settings.record_raw:
            path = raw_path(settings.data_dir, plan.session_id)
            self._raw = RawRecorder(path, min_free_bytes=settings.raw_min_free_mb * MIB)
        self.taping = Taping() if self._raw is None else Taping(keep_frame=self._raw.offer)
        self._writer: TapeWriter | None = None
        self._kept: dict[str, object] | None = None

    def start(self, limits: GateLimits, measuring: PipelineSettings) -> None:
        """Begin to write."""
        plan, settings = self._plan, self._settings
        spelling = spelling_of(ModelStore(settings.data_dir / MODELS_FOLDER))

        def head() -> dict[str, object]:
            return TapeHead(
                session_id=plan.session_id,
                limits=limits,
                measuring=measuring,
                calibration=plan.calibration,
                model=plan.model,
                frames=self._frames(),
                software=this_software(),
                machine=this_machine(),
            ).spelled(spelling)

        self._writer = TapeWriter(self.taping, self._path, head, spelling, recording=plan.recording)
        self._writer.start()
        if self._raw is not None:
            self._raw.start()

    def _frames(self) -> Frames:
        if self._plan.recording is not None:
            return Frames(kind=RECORDING, path=self._plan.recording)
        return Frames(kind=None if self._raw is None else RAW)

    def finish(self) -> dict[str, object]:
        """Wait a moment for the last line; return what the audit keeps of the tape, the same however often asked."""
        if self._kept is None:
            self._kept = {} if self._writer is None else self._finish(self._writer)
        return self._kept

    def _finish(self, writer: TapeWriter) -> dict[str, object]:
        raw_error = None if self._raw is None else self._raw.finish(JOIN_S)
        writer.join(JOIN_S)
        if writer.is_alive():
            self.taping.tear("the tape was not written in time")
            writer.join(JOIN_S)
        torn = self.taping.torn or raw_error
        if torn is not None:
            logger.warning("a session's tape ends early: %s", torn)
        if writer.is_alive():  # what it still writes would make any hash of now look like a change made later
            return {"tape_sha256": None, "tape_torn": torn, "tape_detail": UNFINISHED}
        try:
            return {"tape_sha256": sha256_of(self._path), "tape_torn": torn}
        except OSError:
            return {"tape_sha256": None, "tape_torn": torn or "there is no tape"}
