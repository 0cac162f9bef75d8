"""What the window of a session is where a request leaves it out; offline runs decide by the same."""

from collections.abc import Mapping

from engine.gating.windows.amplitude import Unit

HYSTERESIS: Mapping[Unit, float] = {Unit.MM: 0.2, Unit.L: 0.01, Unit.PERCENT: 2.0}
"""Distance inside the edges that a signal must reach to enter, by unit."""

DWELL_MS = 200.0
"""Time that the signal must stay inside before beam on [ms]."""
