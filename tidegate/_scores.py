"""Measured motion against the truth of a phantom."""

from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import numpy.typing as npt

from engine.core.errors import InvalidValueError, RecordingError
from engine.core.frames import MeasurementState
from tidegate._motion import MotionSeries


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """Mean absolute error over the frames that were measured, against the truth from the first of them.

    Attributes
    ----------
    frames
        Frames that were compared.
    whole_mm, thorax_mm, abdomen_mm, volume_l
        Of the wide regions [mm] and of the volume [l].
    regions_mm
        Mean over all cells [mm]; NaN where the two grids differ. Truths have cells of 10 px.
    worst_mm
        Largest error of the whole region [mm].
    """

    frames: int
    whole_mm: float
    thorax_mm: float
    abdomen_mm: float
    volume_l: float
    regions_mm: float
    worst_mm: float


def read_truth(path: str | Path) -> MotionSeries:
    """Read a phantom's ``truth.npz``: motion from its first frame, in cells of 10 px.

    Raises
    ------
    RecordingError
        The file is no truth of a phantom.
    """
    try:
        with np.load(Path(path), allow_pickle=False) as file:
            depths = {name: file[f"{name}_depth_mm"] for name in ("whole", "thorax", "abdomen", "cell")}
            motion = {name: np.asarray(depth[0] - depth, dtype=np.float64) for name, depth in depths.items()}
            timestamp_us, volume_l = file["timestamp_us"], np.asarray(file["volume_l"], dtype=np.float64)
    except (OSError, ValueError, KeyError, EOFError, IndexError, BadZipFile) as error:
        raise RecordingError(f"{Path(path).name}: is no truth of a phantom ({error})") from error
    return MotionSeries(
        timestamp_us=timestamp_us,
        state=(MeasurementState.MEASURING.value,) * len(timestamp_us),
        whole_mm=motion["whole"],
        thorax_mm=motion["thorax"],
        abdomen_mm=motion["abdomen"],
        volume_l=volume_l,
        regions_mm=motion["cell"],
    )


def score(measured: MotionSeries, truth: MotionSeries) -> Score:
    """Compare frames of the same time; raise InvalidValueError where there are none."""
    found = measured.is_measured
    _, ours, theirs = np.intersect1d(measured.timestamp_us[found], truth.timestamp_us, return_indices=True)
    if len(ours) == 0:
        raise InvalidValueError("truth", "no frame of a measured time", "of the same recording")
    ours = np.flatnonzero(found)[ours]

    def error(name: str) -> npt.NDArray[np.float64]:
        true = getattr(truth, name)[theirs]
        return np.asarray(np.abs(getattr(measured, name)[ours] - (true - true[0])))

    is_same_grid = measured.regions_mm.shape[1:] == truth.regions_mm.shape[1:]
    means = {name: float(np.mean(error(name))) for name in ("whole_mm", "thorax_mm", "abdomen_mm", "volume_l")}
    return Score(
        frames=len(ours),
        **means,
        regions_mm=float(np.nanmean(error("regions_mm"))) if is_same_grid else float("nan"),
        worst_mm=float(np.max(error("whole_mm"))),
    )
