"""How exactly a patient who lies elsewhere by a known move is compared with the plan's position.

`python -m tests.campaigns.measurements.position_check --volunteer 1` prints the errors of each degree of freedom: of
the exact surface of the resting body, and between the references of two sessions, each with the sensor's errors, a
breathing and a model of its own. Markers are where they were, or put back elsewhere on the skin.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, NamedTuple

import numpy as np
import typer

from engine.core.frames import FloatArray
from engine.motion.learning.position_fit import position_between
from engine.verification.phantom.falsifications import Move
from tests.support.evaluation.fractions import Fraction

SHIFTS, TURNS = ("x_mm", "y_mm", "up_mm"), ("tilt_deg", "roll_deg", "turn_deg")
NAMES = ("lateral mm", "longitudinal mm", "vertical mm", "pitch deg", "roll deg", "yaw deg")
TOLERANCE = np.array([2.0] * 3 + [1.0] * 3)
EXACT = (
    *(Move(**{axis: size}) for axis in SHIFTS for size in (1.0, 5.0)),
    *(Move(**{axis: size}) for axis in TURNS for size in (0.5, 3.0)),
)
BETWEEN_SESSIONS = (
    Move(),
    *(Move(**{axis: 3.0}) for axis in SHIFTS),
    *(Move(**{axis: 1.5}) for axis in TURNS),
)
KINDS: tuple[tuple[str, tuple[Move, ...], Callable[[Fraction], FloatArray]], ...] = (
    ("at rest, exact", EXACT, Fraction.resting_surface),
    ("two sessions", BETWEEN_SESSIONS, Fraction.reference_surface),
)


SurfaceOf = Callable[[Fraction], FloatArray]


class Markers(NamedTuple):
    """Standard deviation of each marker's place on the skin, and what the site's setting says of it [mm]."""

    off_mm: float
    placement_mm: float


MARKERS = (Markers(0.0, 5.0), Markers(1.0, 1.0), Markers(3.0, 5.0))


class Found(NamedTuple):
    """Errors and stated uncertainties [mm; deg], shapes (moves, 6)."""

    error: FloatArray
    stated: FloatArray

    def lines(self) -> Iterator[str]:
        """Yield one line for each degree of freedom."""
        within, determined = np.abs(self.error) <= 2.0 * self.stated, 2.0 * self.stated <= TOLERANCE
        for index, name in enumerate(NAMES):
            error, stated = self.error[:, index], self.stated[:, index].mean()
            yield (
                f"  {name:15} {np.sqrt((error**2).mean()):5.2f} {np.abs(error).max():7.2f} {stated:7.2f}"
                f" {within[:, index].mean():9.0%} {determined[:, index].mean():10.0%}"
            )


def found(
    volunteer: int, moves: Sequence[Move], markers: Markers, surface_of: Callable[[Fraction], FloatArray]
) -> Found:
    """Compare each move with the first fraction."""
    rng = np.random.default_rng(volunteer)
    first_mm = surface_of(Fraction(volunteer=volunteer))
    errors, stated = [], []
    for number, move in enumerate(moves):
        offsets_mm = rng.normal(0.0, 1.0, (4, 2)) * markers.off_mm
        fraction = Fraction(volunteer=volunteer, move=move, offsets_mm=offsets_mm, seed=2 + number)
        fit = position_between(first_mm, surface_of(fraction), marker_placement_mm=markers.placement_mm)
        assert fit is not None, "the surfaces were not compared"
        errors.append(np.concatenate([fit.shift_mm, fit.turn_deg]) - fraction.moved(first_mm))
        stated.append(np.concatenate([fit.shift_uncertainty_mm, fit.turn_uncertainty_deg]))
    return Found(np.array(errors), np.array(stated))


def main(volunteer: Annotated[list[int] | None, typer.Option(min=1, max=10)] = None) -> None:
    """Print a table for each volunteer, kind of surface, and place of the markers."""
    for number in volunteer or (1, 3):
        for name, moves, surface_of in KINDS:
            for markers in MARKERS:
                typer.echo(
                    f"volunteer {number}, {name}, {len(moves)} moves; markers off by {markers.off_mm:g} mm, "
                    f"setting {markers.placement_mm:g} mm\n  {'':15}   rms largest  stated in 2 dev. determined"
                )
                for line in found(number, moves, markers, surface_of).lines():
                    typer.echo(line)


if __name__ == "__main__":
    typer.run(main)
