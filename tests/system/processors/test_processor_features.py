"""A few numeric tests as processors with narrower vectors run them; ``make processors`` runs all."""

import os
import platform
import subprocess
import sys

import pytest

from tests.support.processor_features import QUICK, SETTINGS, run

pytestmark = [
    pytest.mark.skipif(platform.machine() != "x86_64", reason="the settings name features of x86-64"),
    pytest.mark.parametrize("name", SETTINGS),
]


def test_regions_projections_and_replays_hold_under_other_processor_features(name, capfd):
    code = run(SETTINGS[name], QUICK, "-n", "0")
    assert code == 0, capfd.readouterr().out


def test_libraries_take_a_setting_without_a_warning(name):
    wish = [
        sys.executable,
        "-W",
        "error",
        "-c",
        "from engine.offline.replay.comparison import this_machine; this_machine()",
    ]
    said = subprocess.run(wish, env=os.environ | SETTINGS[name], capture_output=True, text=True, check=True)
    assert said.stderr == ""
