"""The camera's latency, from light to received frame, measured with a light or a plate of known times."""

from typing import TYPE_CHECKING

from engine.core.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from engine.qa.latency.light_driver import (
        BeamLineLight as BeamLineLight,
        intervals_ns as intervals_ns,
    )
    from engine.qa.latency.light_timing import (
        OUTPUT_BOUNDS_MS as OUTPUT_BOUNDS_MS,
    )
    from engine.qa.latency.measure import (
        LEAD_S as LEAD_S,
        SECONDS_BOUNDS as SECONDS_BOUNDS,
        LightInput as LightInput,
    )

__getattr__, __all__ = lazy_exports(__name__)
