"""A model with its figures and maps, for pages of the fake service."""

import math
from typing import Any

from tests.support.browser.fake_service import FakeService

MODEL_ID = "3d" * 16
ROWS = 88
COLUMNS = 50


def quality_maps(**changes: Any) -> dict[str, Any]:
    """Return maps of a breath of 9 mm with a hole, and of a difference of 0.4 mm but for one corner."""
    breath = [[9.0 * math.sin(math.pi * row / ROWS) for _ in range(COLUMNS)] for row in range(ROWS)]
    measured: list[list[float | None]] = [
        [value + (-1.0) ** (r + c) for c, value in enumerate(line)] for r, line in enumerate(breath)
    ]
    residual: list[list[float | None]] = [
        [2.5 if r >= 80 and c >= 43 else 0.4 for c in range(COLUMNS)] for r in range(ROWS)
    ]
    for row in range(7):
        for column in range(7):
            measured[row][column] = residual[row][column] = None
    return {
        "model_id": MODEL_ID,
        "measured_mm": measured,
        "reconstructed_mm": breath,
        "residual_mm": residual,
    } | changes


def give_model(fake: FakeService, **maps: Any) -> None:
    """Have the fake service's running session measure with a model."""
    fake.sessions[0]["active_model_id"] = MODEL_ID
    quality = {"amplitude_mm": 7.5, "noise_mm": 0.31, "explained_share": 0.985, "shift_mm": 0.4, "tilt_deg": 0.1}
    quality |= {"outlier_share": 0.02, "residual_mm": 0.62}
    fake.of_model = {
        f"/models/{MODEL_ID}": {"id": MODEL_ID, "number": 2, "training_frames": 412, "cycles": 4, "quality": quality},
        f"/models/{MODEL_ID}/spectrum": {"model_id": MODEL_ID, "share": [0.951, 0.021, 0.008, 0.005, 0.004]},
        f"/models/{MODEL_ID}/quality-maps": quality_maps(**maps),
    }
