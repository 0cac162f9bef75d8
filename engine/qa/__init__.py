"""Quality assurance: what is measured of camera, motion, gate and beam line, and whether that is good enough."""

from typing import TYPE_CHECKING

from engine.core.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from engine.qa.bounds import (
        BASELINE_BOUNDS as BASELINE_BOUNDS,
        QaBaseline as QaBaseline,
        QaBounds as QaBounds,
    )
    from engine.qa.checks import (
        CHECKS as CHECKS,
        check_of as check_of,
        checks_of as checks_of,
    )
    from engine.qa.device_check import (
        DeviceCheck as DeviceCheck,
        DeviceFinding as DeviceFinding,
    )
    from engine.qa.inputs import (
        PART_BOUNDS as PART_BOUNDS,
        REPEATS_BOUNDS as REPEATS_BOUNDS,
        SECONDS_BOUNDS as SECONDS_BOUNDS,
        BeamInput as BeamInput,
        PhantomInput as PhantomInput,
        PlateInput as PlateInput,
        QaInputs as QaInputs,
    )
    from engine.qa.playing import (
        opened as opened,
    )
    from engine.qa.recorded_traces import (
        read_trace as read_trace,
    )
    from engine.qa.results import (
        QaBound as QaBound,
        QaCheck as QaCheck,
        QaFigure as QaFigure,
        QaKind as QaKind,
        QaNeed as QaNeed,
        QaReport as QaReport,
        QaResult as QaResult,
        judge as judge,
    )
    from engine.qa.run import (
        Progress as Progress,
        run_qa as run_qa,
    )
    from engine.qa.trace import (
        read_commanded as read_commanded,
    )

__getattr__, __all__ = lazy_exports(__name__)
