"""Batch measurement of recordings, and replay of recorded sessions."""

from typing import TYPE_CHECKING

from engine.core.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from engine.offline.batch import (
        FileOutcome as FileOutcome,
        Progress as Progress,
        measure_file as measure_file,
        measure_files as measure_files,
    )
    from engine.offline.conversion import (
        Conversion as Conversion,
        convert_recording as convert_recording,
    )
    from engine.offline.measure import (
        FileTask as FileTask,
        measure_recording as measure_recording,
    )
    from engine.offline.mesh_files import (
        MeshOptions as MeshOptions,
    )
    from engine.offline.result_files import (
        OfflineSummary as OfflineSummary,
        fingerprint as fingerprint,
    )
    from engine.offline.segments import (
        SegmentSummary as SegmentSummary,
    )

__getattr__, __all__ = lazy_exports(__name__)
