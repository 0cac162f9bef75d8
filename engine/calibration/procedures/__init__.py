"""Making a calibration: from pictures of a checkerboard, and from recordings of a flat plate; how good it is, in mm."""

from typing import TYPE_CHECKING

from engine.core.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from engine.calibration.procedures.boards import (
        Board as Board,
        list_pictures as list_pictures,
        match_pictures as match_pictures,
    )
    from engine.calibration.procedures.checkerboard import (
        CheckerboardResult as CheckerboardResult,
        FoundBoards as FoundBoards,
        calibrate as calibrate,
        find_boards as find_boards,
    )
    from engine.calibration.procedures.depth_scale import (
        DepthScale as DepthScale,
        check_distances as check_distances,
        corrected as corrected,
        disparity_of as disparity_of,
        fit_depth_scale as fit_depth_scale,
    )
    from engine.calibration.procedures.flat_plate import (
        PlateReading as PlateReading,
        find_plate_steps as find_plate_steps,
        read_plate as read_plate,
    )

__getattr__, __all__ = lazy_exports(__name__)
