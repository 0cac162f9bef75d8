"""The examples, each run as its user runs it, in a folder of its own."""

import ast
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.verification

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
TRACE = next((ROOT / "tests" / "data" / "rpm").glob("*.vxp"))
PNG = b"\x89PNG"


def run(name: str, folder: Path, *arguments: object) -> str:
    command = [sys.executable, EXAMPLES / name, *map(str, arguments)]
    ended = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (0, ""), ended.stderr
    return ended.stdout


def numbers(text: str) -> list[float]:
    return [float(one) for one in re.findall(r"[-+]?\d+\.?\d*", text)]


def test_thorax_and_abdomen_are_plotted(regular_volunteer, tmp_path):
    said = run("plot_motion.py", tmp_path, regular_volunteer / "recording.oni", "motion.png")
    measured, frames = numbers(said)
    assert measured == frames > 600
    assert (tmp_path / "motion.png").read_bytes()[:4] == PNG


def test_a_phantom_is_compared_with_its_truth(tmp_path):
    said = run("phantom_and_truth.py", tmp_path, "volunteer")
    cells_mm, abdomen_mm, frames = numbers(said)
    assert abdomen_mm < cells_mm + 0.05 < 0.3
    assert frames > 800


def test_another_instrument_s_signal_is_gated(tmp_path):
    duty_percent, residual_mm = numbers(run("gate_a_signal.py", tmp_path, TRACE, "gating.png"))
    assert 0.0 < duty_percent < 100.0
    assert residual_mm > 0.0
    assert (tmp_path / "gating.png").read_bytes()[:4] == PNG


def test_settings_are_swept_side_by_side(regular_volunteer, tmp_path):
    said = run("sweep.py", tmp_path, regular_volunteer / "recording.oni")
    ranges_mm = numbers(said)[1::2]
    assert len(said.splitlines()) == 3
    assert ranges_mm == sorted(ranges_mm), "the further down the line, the more of the abdomen is thorax"


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.name)
def test_an_example_is_a_dozen_lines_and_imports_tidegate_alone(path):
    text = path.read_text()
    code = [line for line in text.split('"""')[2].splitlines() if line.strip() and not line.startswith("import sys")]
    assert len(code) <= 13
    assert not re.search(r"\b(engine|service|lab)\b[. ]", text)


def test_the_readme_s_first_lines_are_such_an_example(tmp_path):
    (code,) = re.findall(r"^```python\n(.*?)^```", (ROOT / "README.md").read_text(), re.MULTILINE | re.DOTALL)
    ended = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "regions_mm=nan" in ended.stdout, "cells of 25 px"
    assert (tmp_path / "gating.png").read_bytes()[:4] == PNG


def test_the_notebook_runs_and_shows_pictures(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cells = json.loads((EXAMPLES / "first_recording.ipynb").read_text())["cells"]
    names: dict[str, object] = {}
    shown = []
    for cell in (one for one in cells if one["cell_type"] == "code"):
        *before, last = ast.parse("".join(cell["source"])).body
        exec(compile(ast.Module(before, []), "cell", "exec"), names)
        if isinstance(last, ast.Expr):
            shown.append(eval(compile(ast.Expression(last.value), "cell", "eval"), names))
        else:
            exec(compile(ast.Module([last], []), "cell", "exec"), names)
    pictures = [one._repr_png_() for one in shown if hasattr(one, "_repr_png_")]
    assert [picture[:4] for picture in pictures] == [PNG, PNG]
    assert (tmp_path / "error.png").read_bytes()[:4] == PNG
    (median_mm,) = [one for one in shown if isinstance(one, float)]
    assert 0.01 < median_mm < 0.2
