"""Tidegate for notebooks and programs: from depth frames of a breathing patient to motion in mm, and to a gate.

Lengths are mm, times s, volumes l unless a name says otherwise; motion is positive towards the camera. Arrays have one
row per frame. Nothing here needs the service or a settings file. What this package exports, and the REST API, follow
semantic versioning; modules beneath it do not.

>>> import tidegate
>>> motion = tidegate.measure_recording("recording.oni")
>>> figure = tidegate.plot(motion)
"""

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING


def _refuse_other(name: str) -> None:
    """Raise ImportError where ``name`` is another distribution's package: Tidegate's lies beside this one."""
    found, home = find_spec(name), Path(__file__).parents[1]
    origin = None if found is None or found.origin is None else Path(found.origin)
    if origin != home / name / "__init__.py":
        msg = f"the package {name!r} is not Tidegate's: it is at {origin}, must be at {home / name}"
        raise ImportError(msg)


_refuse_other("engine")

from engine import __version__  # noqa: E402 - after the check that it is Tidegate's
from engine.core.lazy_exports import lazy_exports  # noqa: E402

if TYPE_CHECKING:
    from engine.calibration.camera_calibration import Calibration as Calibration, load_calibration as load_calibration
    from engine.core.breath import SignalChoice as SignalChoice
    from engine.core.errors import TidegateError as TidegateError
    from engine.core.frames import Measurement as Measurement, RgbdFrame as RgbdFrame
    from engine.core.motion_model import MotionModel as MotionModel
    from engine.gating.limits import GateLimits as GateLimits
    from engine.gating.windows import (
        AmplitudeWindow as AmplitudeWindow,
        BreathHoldWindow as BreathHoldWindow,
        JoinedWindow as JoinedWindow,
        PhaseWindow as PhaseWindow,
    )
    from engine.motion.learning.model_file import load_model as load_model, save_model as save_model
    from engine.motion.learning.trainer import TrainingSettings as TrainingSettings
    from engine.motion.named_regions import NamedRegion as NamedRegion
    from engine.motion.settings import PipelineSettings as PipelineSettings
    from tidegate._gating import Gating as Gating, gate as gate
    from tidegate._motion import (
        MotionSeries as MotionSeries,
        measure as measure,
        measure_recording as measure_recording,
        train as train,
    )
    from tidegate._plots import plot as plot
    from tidegate._scores import Score as Score, read_truth as read_truth, score as score
    from tidegate._signals import Signal as Signal, read_signal as read_signal
    from tidegate._sources import (
        Source as Source,
        calibrate as calibrate,
        convert as convert,
        list_cameras as list_cameras,
        make_phantom as make_phantom,
        open_camera as open_camera,
        open_recording as open_recording,
    )

__getattr__, __all__ = lazy_exports(__name__)
__all__ += ["__version__"]
