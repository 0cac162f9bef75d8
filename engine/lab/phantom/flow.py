"""The spirometer of the article's section 4.5.1: ``flow.csv``, with the faults of a real one.

It has a clock of its own, not synchronised with the camera, a drifting flow offset, and noise. Positive flow is inhale.
The truth holds its lag: an event ``t`` seconds after the first depth frame is at ``t + spirometer_lag_s`` in the file.
"""

from dataclasses import dataclass

import numpy as np

from engine.lab.phantom.scene import Scene
from engine.lab.phantom.truth import Grid

RATE_HZ = 100.0
NOISE_L_PER_S = 0.012
OFFSET_L_PER_S = 0.02
GREATEST_LAG_S = 1.8
_STEP_S = 0.005


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Flow:
    """A spirometer's recording: time on its own clock [s] and flow [l/s], shapes (n,)."""

    time_s: Grid
    flow_l_per_s: Grid
    lag_s: float

    def to_csv(self) -> str:
        """Return the content of ``flow.csv``."""
        rows = (f"{time:.3f},{flow:.5f}\n" for time, flow in zip(self.time_s, self.flow_l_per_s, strict=True))
        return "time_s,flow_l_per_s\n" + "".join(rows)


def breathe_through(scene: Scene, first_frame_us: int) -> Flow:
    """Simulate the spirometer's recording of a scene."""
    rng = scene.script.rng(13)
    lag_s = round(float(rng.uniform(0.3, GREATEST_LAG_S)) * (1.0 if rng.random() < 0.5 else -1.0), 3)
    time_s = np.arange(0.0, scene.script.seconds, 1.0 / RATE_HZ)
    scene_s = time_s - lag_s + first_frame_us * 1e-6
    later, earlier = (
        scene.skin.volume_l(scene.breathing.weights(scene_s + half)) for half in (0.5 * _STEP_S, -0.5 * _STEP_S)
    )
    offset = OFFSET_L_PER_S * (float(rng.uniform(-1.0, 1.0)) + 0.3 * time_s / scene.script.seconds)
    noise = rng.normal(0.0, NOISE_L_PER_S, len(time_s))
    return Flow(time_s=time_s, flow_l_per_s=(later - earlier) / _STEP_S + offset + noise, lag_s=lag_s)
