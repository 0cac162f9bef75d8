"""How exactly a patient who lies elsewhere by a known move is compared with the plan's position.

`python -m tests.campaigns.measurements.position_check --volunteer 1` prints the error of each degree of freedom, first
on the exact surface of the resting body, then between the references of two sessions, each with the sensor's errors, a
breathing and a model of its own. Markers are where they were, or put back elsewhere on the skin.
"""

from collections.abc import Callable
from typing import Annotated

import numpy as np
import typer

from engine.core.frames import FloatArray
from engine.motion.learning.position_fit import PositionFit, position_between
from engine.verification.phantom.falsifications import Move
from tests.support.evaluation.fractions import Fraction

NAMES = ("lateral", "longit.", "vertical", "pitch", "roll", "yaw")
UNITS = ("mm",) * 3 + ("deg",) * 3
AXES = ("x_mm", "y_mm", "up_mm", "tilt_deg", "roll_deg", "turn_deg")
EXACT = tuple(Move(**{axis: size}) for axis in AXES for size in ((1.0, 5.0) if axis.endswith("mm") else (0.5, 3.0)))
BETWEEN_SESSIONS = (
    Move(),
    *(Move(**{axis: 3.0 if axis.endswith("mm") else 1.5}) for axis in AXES),
)
MARKERS = (0.0, 3.0)
"""Standard deviation of each marker's place on the skin from fraction to fraction [mm]."""
TOLERANCE = np.array([2.0] * 3 + [1.0] * 3)


def errors(
    volunteer: int, moves: tuple[Move, ...], markers_mm: float, placement_mm: float, surface_of: Callable[..., FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return errors and standard uncertainties of all moves, each of shape (moves, 6) [mm; deg]."""
    rng = np.random.default_rng(volunteer)
    first_mm = surface_of(Fraction(volunteer=volunteer))
    found, uncertainties = [], []
    for number, move in enumerate(moves):
        offsets_mm = rng.normal(0.0, markers_mm, (4, 2)) if markers_mm else np.zeros((4, 2))
        fraction = Fraction(volunteer=volunteer, move=move, offsets_mm=offsets_mm, seed=2 + number)
        fit = position_between(first_mm, surface_of(fraction), marker_placement_mm=placement_mm)
        assert isinstance(fit, PositionFit), "the surfaces were not compared"
        found.append(np.concatenate([fit.shift_mm, fit.turn_deg]) - fraction.moved(first_mm))
        uncertainties.append(np.concatenate([fit.shift_uncertainty_mm, fit.turn_uncertainty_deg]))
    return np.array(found), np.array(uncertainties)


def main(volunteer: Annotated[list[int] | None, typer.Option(min=1, max=10)] = None, sessions: bool = True) -> None:
    """Print a table for each volunteer: root mean square and largest error, and the stated uncertainty."""
    kinds = [("at rest, exact", EXACT, Fraction.resting_surface)]
    kinds += [("two sessions", BETWEEN_SESSIONS, Fraction.reference_surface)] if sessions else []
    for number in volunteer or (1, 3):
        for name, moves, surface_of in kinds:
            for markers_mm in MARKERS:
                for placement_mm in (1.0,) if not markers_mm else (5.0,):
                    found, stated = errors(number, moves, markers_mm, placement_mm, surface_of)
                    typer.echo(f"volunteer {number}, {name}, {len(moves)} moves, markers off by {markers_mm:g} mm, taken as {placement_mm:g} mm")
                    for index, (label, unit) in enumerate(zip(NAMES, UNITS, strict=True)):
                        error, deviation = found[:, index], stated[:, index]
                        typer.echo(
                            f"  {label:8} rms {np.sqrt((error**2).mean()):5.2f}  largest {np.abs(error).max():5.2f} {unit:3}"
                            f"  stated {deviation.mean():5.2f}  within twice {np.mean(np.abs(error) <= 2 * deviation):5.0%}"
                            f"  determined {np.mean(2 * deviation <= TOLERANCE[index]):5.0%}"
                        )


if __name__ == "__main__":
    typer.run(main)
