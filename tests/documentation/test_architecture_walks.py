"""The walks of docs/1-start/architecture.md: they name what exists, and all that an armed frame runs through."""

import ast
import re
import threading
from dataclasses import replace
from pathlib import Path

import pytest

from engine.beam.simulated import SimulatedBeamLine
from engine.calibration.camera_calibration import load_calibration
from engine.capture.oni.reader import OniReader
from engine.control.loop import EngineLoop
from engine.core.clock import ManualClock
from engine.core.commands import Arm, SetReference
from engine.core.errors import SourceEndedError
from engine.core.gate_state import GateState
from engine.gating.windows import amplitude_window
from engine.motion.learning.trainer import InlineTrainer, TrainingSettings
from engine.motion.pipeline import Pipeline
from engine.motion.settings import PipelineSettings
from lab.performance.session import EndlessSource, Recording
from tests.documentation.walks import PAGE, STEP, pictures, steps_of, walks
from tests.support.control.loop_bench import drained
from tests.support.repository import ROOT

HELPERS = re.compile(r"<!-- helpers: a frame -->\n(.*?)<!-- end -->", re.DOTALL)
FRAMES = 5
WALKS = walks()


@pytest.mark.parametrize("path", pictures(), ids=lambda path: path.stem)
def test_each_picture_is_the_page_s_walk(path):
    assert path.read_text(encoding="utf-8") == pictures()[path]


def functions_of(path: Path) -> set[str]:
    """The names of all functions and methods that a file defines."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)}


def test_there_are_four_walks():
    assert list(WALKS) == ["a frame", "an arm call", "a transition", "a live sample"]


@pytest.mark.parametrize("name", WALKS)
def test_every_step_names_a_file_and_a_function_that_exist(name):
    steps = [STEP.fullmatch(line) for line in WALKS[name].splitlines()]
    assert all(steps)
    found = [step.groups() for step in steps if step is not None]
    assert [int(number) for number, _, _ in found] == list(range(1, len(found) + 1))
    missing = [
        f"{path} {function}"
        for _, path, function in found
        if not (ROOT / path).is_file() or function not in functions_of(ROOT / path)
    ]
    assert missing == []


def named_files() -> set[str]:
    """All files that the walk of a frame names, steps and helpers."""
    steps = {path for path, _ in steps_of(WALKS["a frame"])}
    helpers = HELPERS.search(PAGE.read_text(encoding="utf-8"))[1]
    for folder, names in re.findall(r"^- `([\w/]+/)`: (.+)$", helpers, re.MULTILINE):
        steps |= {folder + name for name in re.findall(r"`(\w+\.py)`", names)}
    return steps


@pytest.mark.long
def test_the_walk_of_a_frame_names_every_file_that_an_armed_frame_runs_through(lit_volunteer):
    """Trace frames with the beam on: no file outside of `core` that the page does not name, and none too many."""
    hurried = TrainingSettings(min_frames=40, min_cycles=0, min_seconds=3.0, max_seconds=6.0, max_frames=200)
    with OniReader(lit_volunteer / "recording.oni") as reader:
        recording = Recording(folder=lit_volunteer, fps=float(reader.depth.fps), training=hurried)
    clock = ManualClock(1_000_000_000)
    settings = PipelineSettings(training=recording.training)
    pipeline = Pipeline(load_calibration(recording.calibration), settings, clock, InlineTrainer())
    passed: set[str] = set()
    frames_on = 0

    def note(frame, event, _argument):
        if event == "call" and frames_on:
            passed.add(frame.f_code.co_filename)

    class Source(EndlessSource):
        def read(self, timeout_s):
            nonlocal frames_on
            if frames_on == FRAMES:
                raise SourceEndedError("all frames were traced")
            is_on = loop.status.view is not None and loop.status.view.record.gate_state is GateState.BEAM_ON
            frames_on += is_on
            if not is_on and loop.status.learning.model is not None:
                has_reference = loop.status.learning.has_reference
                loop.submit(Arm(operator="test", reason="test") if has_reference else SetReference(operator="test"))
            drained(loop.samples)  # as the service's writer does
            drained(loop.transitions)
            clock.advance_ns(round(1e9 / recording.fps))
            return super().read(timeout_s)

    loop = EngineLoop(
        source=Source(recording, most_frames=2000, clock=clock),
        measurer=pipeline,
        learner=pipeline.learner,
        beam=SimulatedBeamLine(clock),
        limits=replace(recording.limits, window=amplitude_window(lower_mm=-1.5, upper_mm=60.0)),
        clock=clock,
    )
    threading.setprofile(note)
    try:
        loop.start()
    finally:
        threading.setprofile(None)
    assert loop.join(timeout_s=60.0)
    assert frames_on == FRAMES
    own = {str(Path(path).relative_to(ROOT)) for path in passed if Path(path).is_relative_to(ROOT / "engine")}
    own = {path for path in own if not path.startswith(("engine/core/", "lab/"))}
    assert own - named_files() == set(), "these are on the way and not on the page"
    assert named_files() - own == set(), "these are on the page and not on the way"
