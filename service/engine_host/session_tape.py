"""The tape of a session: every input of its engine, so that `tidegate replay` can run the session again.

Never in the gate's way: a tape that cannot be written is a session that cannot be replayed, and the log and the audit
say so.
"""

import logging
from collections.abc import Callable

from engine.capture import RawRecorder
from engine.gating import GateLimits
from engine.motion import PipelineSettings
from engine.offline.replay import (
    RAW,
    RECORDING,
    Frames,
    RecordingTap,
    TapeEncoding,
    TapeHeader,
    TapeWriter,
    sha256_of,
    this_machine,
    this_software,
)
from service.core.settings.settings import Settings
from service.engine_host.protocols import SessionPlan
from service.storage.files.motion_models import MODELS_FOLDER, ModelStore, raw_path, tape_path

logger = logging.getLogger(__name__)

JOIN_S = 5.0
UNFINISHED = "the tape was still being written when the session was closed: its hash is not known"
MIB = 1024 * 1024


def encoding_of(models: ModelStore) -> TapeEncoding:
    """Return the tape encoding that names models by the hash under which they are stored."""
    return TapeEncoding(name_of=models.save, model_of=models.load)


class SessionTape:
    """One session's tape and, where the site records it, the raw recording of its camera."""

    def __init__(self, plan: SessionPlan, settings: Settings) -> None:
        self._plan, self._settings = plan, settings
        self._path = tape_path(settings.data_dir, plan.session_id)
        self._raw: RawRecorder | None = None
        if plan.recording is None and settings.record_raw:
            path = raw_path(settings.data_dir, plan.session_id)
            self._raw = RawRecorder(path, min_free_bytes=settings.raw_min_free_mb * MIB)
        self.tap = RecordingTap() if self._raw is None else RecordingTap(keep_frame=self._raw.offer)
        self._writer: TapeWriter | None = None
        self._kept: dict[str, object] | None = None

    def start(self, limits: GateLimits, measuring: PipelineSettings, *, serial: Callable[[], str] = str) -> None:
        """Start writing tape and raw recording; ``serial`` is asked for the camera's serial number at the end."""
        plan, settings = self._plan, self._settings
        encoding = encoding_of(ModelStore(settings.data_dir / MODELS_FOLDER))

        def head() -> dict[str, object]:
            return TapeHeader(
                session_id=plan.session_id,
                limits=limits,
                measuring=measuring,
                calibration=plan.calibration,
                model=plan.model,
                first_reference=plan.first_reference,
                plan_position=plan.plan_position,
                fraction_arming=plan.fraction_arming,
                frames=self._frames(),
                software=this_software(),
                machine=this_machine(),
            ).encoded(encoding)

        self._writer = TapeWriter(self.tap, self._path, head, encoding, recording=plan.recording)
        self._writer.start()
        if self._raw is not None:
            self._raw.serial = serial
            self._raw.start()

    def _frames(self) -> Frames:
        if self._plan.recording is not None:
            return Frames(kind=RECORDING, path=self._plan.recording)
        return Frames(kind=None if self._raw is None else RAW)

    def finish(self) -> dict[str, object]:
        """Wait at most some seconds for the last line; return what the audit records of the tape, cached after that."""
        if self._kept is None:
            self._kept = {} if self._writer is None else self._finish(self._writer)
        return self._kept

    def _finish(self, writer: TapeWriter) -> dict[str, object]:
        raw_error = None if self._raw is None else self._raw.finish(JOIN_S)
        writer.join(JOIN_S)
        if writer.is_alive():
            self.tap.tear("the tape was not written in time")
            writer.join(JOIN_S)
        torn = self.tap.torn or raw_error
        if torn is not None:
            logger.warning("a session's tape ends early: %s", torn)
        if writer.is_alive():  # what it still writes would make any hash of now look like a change made later
            return {"tape_sha256": None, "tape_torn": torn, "tape_detail": UNFINISHED}
        try:
            return {"tape_sha256": sha256_of(self._path), "tape_torn": torn}
        except OSError:
            return {"tape_sha256": None, "tape_torn": torn or "there is no tape"}
