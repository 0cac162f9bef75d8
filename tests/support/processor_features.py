"""The numeric tests under other processor features.

Run: ``python -m tests.support.processor_features`` (``make processors``).

The order in which numbers are added depends on the width of a processor's vectors, and so do the last bits of every
measurement. A test that wants equal bits passes on one processor and fails on another; here each setting plays such a
processor of x86-64. Features that the machine lacks change nothing.
"""

import os
import subprocess
import sys

import cv2


def _of_this_machine(*features: str) -> str:
    """Return those of OpenCV's features that this processor has: it complains about the others."""
    lacking = {one.strip("*?") for one in cv2.getCPUFeaturesLine().split() if one.endswith("?")}
    return ",".join(one for one in features if one not in lacking)


WITHOUT_AVX512 = {
    "OPENCV_CPU_DISABLE": _of_this_machine("AVX512-SKX"),
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",
    "OPENBLAS_CORETYPE": "Haswell",
}
WITHOUT_AVX = {
    "OPENCV_CPU_DISABLE": _of_this_machine("AVX512-SKX", "AVX2", "FP16", "AVX"),
    "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL AVX512_SPR",
    "OPENBLAS_CORETYPE": "Nehalem",
}
NUMPY_FORMS = {"TIDEGATE_FRAME_PATH": "numpy"}
SETTINGS = {"without AVX-512": WITHOUT_AVX512, "without AVX": WITHOUT_AVX, "without the compiled path": NUMPY_FORMS}

NUMERIC = (
    *(f"tests/engine/{name}" for name in ("core", "calibration", "motion", "gating", "offline", "qa")),
    "tests/lab",
    "tests/engine/capture/oni",
    "tests/lab/evaluation",
    "tests/lab/phantom",
    *(
        f"tests/service/cli/test_{name}.py"
        for name in ("measure", "measure_motion", "measure_window", "calibrate", "qa")
    ),
)
"""What computes."""

QUICK = (
    "tests/engine/motion/stages/test_roi.py",
    "tests/engine/motion/stages/test_projection.py",
    "tests/engine/offline/replay/test_comparison.py",
)
"""A few of them, for every run of the tests."""


def run(setting: dict[str, str], tests: tuple[str, ...], *options: str) -> int:
    """Run tests in a process with these features, and return its exit code."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *options, *tests]
    return subprocess.run(command, env=os.environ | setting, check=False).returncode


def main() -> int:
    """Run all of them under every setting; options go on to pytest."""
    outcomes = {name: run(setting, NUMERIC, *sys.argv[1:]) for name, setting in SETTINGS.items()}
    for name, code in outcomes.items():
        sys.stdout.write(f"{name}: {'passed' if code == 0 else 'FAILED'}\n")
    return max(outcomes.values())


if __name__ == "__main__":
    sys.exit(main())
