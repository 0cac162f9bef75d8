"""Measured motion: frame by frame, or a whole recording as arrays."""

import csv
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from engine.calibration.camera_calibration import Calibration
from engine.capture.recording_source import OniFileSource
from engine.core.clock import ManualClock
from engine.core.errors import InvalidValueError, ModelError, RecordingError
from engine.core.frames import BoolArray, Measurement, MeasurementState
from engine.core.motion_model import MotionModel
from engine.gating.limits import GateLimits
from engine.motion.learning.trainer import BackgroundTrainer, InlineTrainer, Trainer
from engine.motion.pipeline import Pipeline
from engine.motion.settings import PipelineSettings
from engine.offline.measure import measure_recording as measure_to_files
from engine.offline.result_files import OfflineSummary
from tidegate._signals import Signal
from tidegate._sources import Source, open_recording, required_calibration

if TYPE_CHECKING:
    import pyarrow as pa

    from engine.motion.learning.tasks import Outcome

Values = npt.NDArray[np.float64]
WIDE = ("whole_mm", "thorax_mm", "abdomen_mm", "volume_l")
BEAM_ON = "beam_on"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionSeries:
    """Motion of every frame, from the reference: shape (n, ...), NaN where a frame was not measured.

    Attributes
    ----------
    timestamp_us
        Device time of each frame [us].
    state
        ``training``, ``measuring`` or ``lost``.
    whole_mm, thorax_mm, abdomen_mm
        Of the wide regions [mm], shape (n,).
    volume_l
        Volume against the reference [l], shape (n,).
    regions_mm
        Of the cells, shape (n, rows, columns): row 0 is superior, column 0 the patient's right.
    is_on
        Whether the gate permits the beam, shape (n,); nowhere without limits.
    reasons
        Code of the gate's reason where it does not, empty without one.
    summary
        Figures of the whole recording; None of frames measured singly.
    """

    timestamp_us: npt.NDArray[np.int64]
    state: tuple[str, ...]
    whole_mm: Values
    thorax_mm: Values
    abdomen_mm: Values
    volume_l: Values
    regions_mm: Values
    is_on: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    reasons: tuple[str, ...] = ()
    summary: OfflineSummary | None = None

    @classmethod
    def of(cls, measurements: Iterable[Measurement]) -> "MotionSeries":
        """Collect measurements, for example of `measure`."""
        found = list(measurements)
        grid = next((one.motion.regions_mm.shape for one in found if one.motion is not None), (0, 0))
        unseen = np.full(grid, np.nan)
        motions = [one.motion for one in found]

        def wide(name: str) -> Values:
            return np.array([np.nan if one is None else getattr(one, name) for one in motions], dtype=np.float64)

        return cls(
            timestamp_us=np.array([one.timestamp_us for one in found], dtype=np.int64),
            state=tuple(one.state.value for one in found),
            whole_mm=wide("whole_mm"),
            thorax_mm=wide("thorax_mm"),
            abdomen_mm=wide("abdomen_mm"),
            volume_l=wide("volume_l"),
            regions_mm=np.array([unseen if one is None else one.regions_mm for one in motions]).reshape(
                len(found), *grid
            ),
        )

    @classmethod
    def read(cls, folder: str | Path, summary: OfflineSummary | None = None) -> "MotionSeries":
        """Read ``motion.csv`` and ``regions.npz`` of `measure_recording` or of ``tidegate measure``.

        Raises
        ------
        RecordingError
            The folder has no such files.
        """
        folder = Path(folder)
        try:
            with (folder / "motion.csv").open(newline="") as file:
                rows = list(csv.DictReader(file))
            with np.load(folder / "regions.npz", allow_pickle=False) as regions:
                cells = np.asarray(regions["motion_mm"], dtype=np.float64)
            wide = {name: np.array([float(row[name] or "nan") for row in rows], dtype=np.float64) for name in WIDE}
            return cls(
                timestamp_us=np.array([int(row["timestamp_us"]) for row in rows], dtype=np.int64),
                state=tuple(row["state"] for row in rows),
                regions_mm=cells,
                is_on=np.array([row["gate"] == BEAM_ON for row in rows], dtype=np.bool_),
                reasons=tuple(row["hold_reason"] for row in rows),
                summary=summary,
                whole_mm=wide["whole_mm"],
                thorax_mm=wide["thorax_mm"],
                abdomen_mm=wide["abdomen_mm"],
                volume_l=wide["volume_l"],
            )
        except (OSError, KeyError, ValueError) as error:
            raise RecordingError(f"{folder}: has no measured motion ({error})") from error

    @property
    def time_s(self) -> Values:
        """Time since the first frame [s]."""
        return np.asarray((self.timestamp_us - self.timestamp_us[:1]) * 1e-6)

    @property
    def is_measured(self) -> BoolArray:
        """Whether each frame was measured."""
        return np.array([state == MeasurementState.MEASURING.value for state in self.state], dtype=np.bool_)

    def signal(self, region: str = "whole") -> Signal:
        """Return the motion of ``whole``, ``thorax`` or ``abdomen`` over the measured frames."""
        if f"{region}_mm" not in WIDE:
            raise InvalidValueError("region", region, "whole, thorax or abdomen")
        kept = self.is_measured
        return Signal(name=region, time_s=self.time_s[kept], value_mm=getattr(self, f"{region}_mm")[kept])

    def to_arrow(self) -> "pa.Table":
        """Return one row per frame as an Arrow table, for pandas or polars; cells are lists, row by row."""
        import pyarrow as pa

        cells = self.regions_mm.reshape(len(self.timestamp_us), -1)
        columns: dict[str, object] = {"timestamp_us": self.timestamp_us, "time_s": self.time_s, "state": self.state}
        columns |= {name: getattr(self, name) for name in WIDE}
        columns["regions_mm"] = pa.FixedSizeListArray.from_arrays(pa.array(cells.ravel()), max(1, cells.shape[1]))
        if self.reasons:
            columns |= {"is_on": self.is_on, "reason": self.reasons}
        return pa.table(columns)


def measure(
    source: Source,
    calibration: Calibration | str | Path | None = None,
    *,
    settings: PipelineSettings | None = None,
    model: MotionModel | None = None,
) -> Iterator[Measurement]:
    """Measure frame by frame, as a session does: learn the motion model first, then yield motion.

    A recording gives the same numbers on every run on one processor; a camera's model is learned in the background.

    Parameters
    ----------
    calibration
        In place of the source's own.
    model
        A stored model, in place of learning one.

    Raises
    ------
    CalibrationError
        There is no calibration.
    SourceLostError, RecordingError
        The camera is disconnected, or the recording is damaged.
    """
    pipeline = _pipeline(source, calibration, settings, model)
    for frame in source:
        yield pipeline.measure(frame)


def train(
    source: Source, calibration: Calibration | str | Path | None = None, *, settings: PipelineSettings | None = None
) -> MotionModel:
    """Learn a motion model from the first breaths; read no further.

    Raises
    ------
    ModelError
        The recording ended before that.
    """
    pipeline = _pipeline(source, calibration, settings, None)
    with source:
        for frame in source:
            pipeline.measure(frame)
            model = pipeline.learner.status.model
            if model is not None:
                return model
    msg = "the recording was too short to learn a motion model"
    raise ModelError(msg)


def _pipeline(
    source: Source,
    calibration: Calibration | str | Path | None,
    settings: PipelineSettings | None,
    model: MotionModel | None,
) -> Pipeline:
    trainer: Trainer[Outcome] = BackgroundTrainer() if source.is_live else InlineTrainer()
    found = Pipeline(required_calibration(source, calibration), settings or PipelineSettings(), source.clock, trainer)
    if model is not None:
        found.learner.models.resume(model)
    return found


def measure_recording(
    recording: str | Path,
    calibration: Calibration | str | Path | None = None,
    *,
    out: str | Path | None = None,
    settings: PipelineSettings | None = None,
    limits: GateLimits | None = None,
    model: MotionModel | None = None,
    is_single_pass: bool = False,
    on_frame: Callable[[Measurement], None] | None = None,
) -> MotionSeries:
    """Measure a whole recording as ``tidegate measure`` does: every frame, with a model of the whole recording.

    Parameters
    ----------
    calibration
        A calibration or its file; the ``calibration.json`` beside the recording by default.
    out
        Folder for ``motion.csv``, ``breathing.csv``, ``regions.npz``, ``motion_summary.json`` and ``model.npz``.
    limits
        Decides as a session's gate that is armed as soon as it may be.
    is_single_pass
        What a live session measures: nothing before it has a model.

    Raises
    ------
    CalibrationError
        There is no calibration.
    RecordingError, ModelError
        No frame could be read, or too few to learn from.
    """
    used = required_calibration(open_recording(recording, calibration), None)
    with TemporaryDirectory() as scratch:
        folder = Path(scratch if out is None else out)
        summary = measure_to_files(
            OniFileSource(Path(recording), clock=ManualClock()),
            used,
            folder,
            settings=settings or PipelineSettings(),
            limits=limits,
            model=model,
            is_single_pass=is_single_pass,
            on_frame=on_frame,
        )
        return MotionSeries.read(folder, summary)
