"""Every form of the compiled frame path that this processor can run measures the same bits.

The loader picks one of them (`WIDE_VECTORS` in ``engine/core/compiled/arguments.h``); here each is built by itself.
"""

import hashlib
import importlib.util
import shutil
import subprocess
import sysconfig
from importlib.machinery import ExtensionFileLoader
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from engine.core.compiled import FramePath
from engine.motion.learning.trainer import InlineTrainer, TrainingSettings
from lab.performance.session import BenchSession, Recording
from tests.support.repository import ROOT

pytestmark = [pytest.mark.long, pytest.mark.verification]

SOURCES = ROOT / "engine/core/compiled"
FORMS = {"baseline": ((), "sse2"), "AVX2": (("-mavx2",), "avx2"), "AVX-512": (("-march=x86-64-v4",), "avx512vl")}
"""Options of the compiler, and the processor flag, of each form."""
HURRIED = TrainingSettings(min_frames=40, min_cycles=0, min_seconds=3.0, max_seconds=6.0, max_frames=200)
FRAMES = 60


def built(folder: Path, options: tuple[str, ...]) -> ModuleType:
    """Compile the frame path in one form, and load it."""
    setup = (ROOT / "setup.py").read_text()
    flags = [
        line.strip().strip('",') for line in setup.split("FLAGS = [")[1].split("]")[0].splitlines() if line.strip()
    ]
    path = folder / f"_kernels{sysconfig.get_config_var('EXT_SUFFIX')}"
    command = ["gcc", "-shared", "-fPIC", *flags, *options, "-DTIDEGATE_PLAIN", '-DSOURCE_DIGEST="form"']
    include = ["-I", sysconfig.get_path("include"), *map(str, sorted(SOURCES.glob("*.c"))), "-o", str(path), "-lm"]
    subprocess.run([*command, *include], check=True, capture_output=True, text=True)
    spec = importlib.util.spec_from_file_location("_kernels", path, loader=ExtensionFileLoader("_kernels", str(path)))
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def measured(folder: Path) -> list[str]:
    """Return a digest of each measured frame: motion, volume, surface, and what was seen."""
    session = BenchSession(Recording(folder=folder, fps=10.0, training=HURRIED), InlineTrainer())
    session.learn()
    digests = []
    for _ in range(FRAMES):
        motion = session.pipeline.measure(session.read()).motion
        assert motion is not None
        parts = (
            motion.regions_mm,
            motion.surface_mm,
            motion.volume_l,
            motion.projection.coefficients,
            motion.seen.cells,
        )
        digests.append(hashlib.sha256(b"".join(np.asarray(part).tobytes() for part in parts)).hexdigest())
    session.close()
    return digests


@pytest.mark.skipif(shutil.which("gcc") is None, reason="there is no compiler")
@pytest.mark.skipif("sse2" not in Path("/proc/cpuinfo").read_text(), reason="another kind of processor")
def test_all_forms_that_this_processor_has_measure_the_same_bits(lit_volunteer, tmp_path, monkeypatch):
    has = set(Path("/proc/cpuinfo").read_text().split())
    found = {}
    for name, (options, flag) in FORMS.items():
        if flag in has:
            folder = tmp_path / name
            folder.mkdir()
            monkeypatch.setattr(FramePath, "kernels", built(folder, options))
            found[name] = measured(lit_volunteer)
    assert len(set(map(tuple, found.values()))) == 1, f"of {', '.join(found)} not all are alike"
    assert len(set(found["baseline"])) == FRAMES
