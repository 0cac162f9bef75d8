"""No compiled function reads or writes beyond its arrays, with the arrays of whole sessions."""

import subprocess
import sys

import pytest

from engine.core import compiled
from tests.support.repository import ROOT

pytestmark = [
    pytest.mark.skipif(compiled.FramePath.kernels is None, reason="the numpy forms run"),
    pytest.mark.verification,
]
SESSIONS = "tests/support/guarded_sessions.py"
READS_BEYOND = """
import ctypes
import numpy as np
from tests.support.guard_pages import Guarded
class Functions:
    @staticmethod
    def beyond(array):
        return ctypes.string_at(array.ctypes.data + array.nbytes, 1)
Guarded(Functions).beyond(np.zeros(3))
"""


@pytest.mark.timeout(900)
def test_sessions_run_with_every_array_at_the_end_of_a_page():
    early = "ignore:Module already imported:pytest.PytestAssertRewriteWarning"
    plugins = ("-W", early, "-p", "tests.support.guard_pages", "-p", "no:cacheprovider")
    command = [sys.executable, "-m", "pytest", "-q", *plugins, SESSIONS]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2_000:] + done.stderr[-4_000:]
    assert "1 passed" in done.stdout


def test_the_last_pixel_of_a_picture_is_read_alone():
    """Others are read together with the byte behind them."""
    code = (
        "import numpy as np\nfrom engine.core import compiled\nimport tests.support.guard_pages\n"
        "chroma = np.zeros((8, 2), np.float32)\n"
        "color = np.full((8, 16, 3), 90, np.uint8)\n"
        "compiled.FramePath.kernels.sample_chroma(color, np.eye(3), 4, color, 45.0, chroma)\n"
        "assert np.isfinite(chroma).all(), chroma\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_function_that_reads_one_item_beyond_ends_its_process():
    done = subprocess.run([sys.executable, "-c", READS_BEYOND], cwd=ROOT, capture_output=True, check=False)
    assert done.returncode < 0, "killed by the fault"


def test_results_come_back_from_the_copies():
    code = (
        "import numpy as np\nfrom engine.core import compiled\nimport tests.support.guard_pages\n"
        "found = np.zeros((1, 2))\n"
        "compiled.FramePath.kernels.map_points(np.eye(3), np.array([[2.0, 3.0]]), found)\n"
        "assert found.tolist() == [[2.0, 3.0]], found\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
