"""Where the references lie in the breath that are confirmed in sessions started at twenty moments of one recording.

`python -m tests.campaigns.measurements.references --volunteer 1` makes a virtual volunteer's recording, runs the twenty
sessions and prints, against the recording's truth, how far the confirmed references are from the end of exhale.
"""

import tempfile
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from engine.verification.phantom.recording import make_volunteer
from tests.support.evaluation.confirmed_references import LONGEST_S, STARTS, STEP_S, Confirmed, confirmed_references

VOLUNTEERS = (1, 3)


def references_of(number: int, scenario: str, seed: int) -> list[Confirmed]:
    """Make a recording just long enough, and run the sessions."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "volunteer"
        make_volunteer(scenario, volunteer=number, seconds=STARTS * STEP_S + LONGEST_S, seed=seed, out=out)
        return confirmed_references(out)


def main(
    volunteer: Annotated[list[int] | None, typer.Option(min=1, max=10)] = None,
    scenario: str = "regular",
    seed: int = 1,
) -> None:
    """Print a line for each recording."""
    for number in volunteer or VOLUNTEERS:
        found = references_of(number, scenario, seed)
        errors = np.array([one.error_percent for one in found])
        typer.echo(
            f"volunteer {number}, {scenario}: {len(found)} references, {errors.min():+.1f} to {errors.max():+.1f} % "
            f"of a breath from the end of exhale, of {min(one.breaths for one in found)} to "
            f"{max(one.breaths for one in found)} breaths; model after {max(one.model_s for one in found):.1f} s, "
            f"reference at most {max(one.confirmed_s - one.model_s for one in found):.1f} s later"
        )


if __name__ == "__main__":
    typer.run(main)
