"""Run `tidegate measure` in this process, and share what it made of a recording."""

import csv
import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from service.cli import app
from tests.support.build_cache import made_once, run_folder


def invoke(folder: Path, out: Path, *extra: str) -> Result:
    """Measure a volunteer's recording."""
    arguments = ["measure", str(folder / "recording.oni"), "--calibration", str(folder / "calibration.json")]
    return CliRunner().invoke(app, [*arguments, "--out", str(out), *extra])


@dataclass(frozen=True, slots=True)
class Measured:
    """The files of a run and what it printed to standard error; the folder may be shared, so it is only read."""

    out: Path
    said: str

    @property
    def rows(self) -> list[dict[str, str]]:
        """motion.csv."""
        with (self.out / "motion.csv").open() as file:
            return list(csv.DictReader(file))

    @property
    def summary(self) -> dict[str, object]:
        """motion_summary.json."""
        return json.loads((self.out / "motion_summary.json").read_text())


def measured(folder: Path, out: Path, *options: str) -> Measured:
    """Measure a volunteer's recording into a folder of one's own."""
    result = invoke(folder, out, *options)
    assert result.exit_code == 0, result.output
    return Measured(out=out, said=result.stderr)


def measured_once(factory: pytest.TempPathFactory, folder: Path, *options: str, model: Path | None = None) -> Measured:
    """Measure a volunteer's recording with these options once per run of the tests, in whichever process asks first."""
    digest = hashlib.sha256(repr((options, model and model.read_bytes())).encode())
    digest.update((folder / "recording.oni").read_bytes())
    with made_once(f"measured-{digest.hexdigest()[:16]}", run_folder(factory)) as (kept, draft):
        if draft is not None:
            more = [] if model is None else ["--model", str(model)]
            said = measured(folder, draft / "out", *options, *more).said
            (draft / "said.txt").write_text(said, encoding="utf-8")
    return Measured(out=kept / "out", said=(kept / "said.txt").read_text(encoding="utf-8"))
