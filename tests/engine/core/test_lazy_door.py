"""Doors whose modules are loaded late: every name is found, nothing is loaded before, and no other name is there."""

import importlib
import subprocess
import sys

import pytest

DOORS = [
    "engine.motion",
    "engine.calibration",
    "engine.calibration.formats",
    "engine.calibration.procedures",
    "engine.offline",
    "engine.offline.replay",
    "engine.qa",
    "engine.qa.latency",
]


@pytest.mark.parametrize("name", DOORS)
def test_every_exported_name_is_found_in_its_module(name):
    door = importlib.import_module(name)
    assert door.__all__
    for exported in door.__all__:
        found = getattr(door, exported)
        home = getattr(found, "__module__", "")
        assert not home.startswith("engine.") or home.startswith((name, "engine.core"))


@pytest.mark.parametrize("name", DOORS)
def test_another_name_is_no_attribute(name):
    door = importlib.import_module(name)
    with pytest.raises(AttributeError, match=f"module '{name}' has no attribute 'nothing'"):
        _ = door.nothing


def test_a_door_loads_a_module_when_its_name_is_taken_and_not_before():
    text = (
        "import sys; import engine.motion; before = 'engine.motion.pipeline' in sys.modules; "
        "from engine.motion import Pipeline; print(before, 'engine.motion.pipeline' in sys.modules)"
    )
    run = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True)
    assert run.stdout.split() == ["False", "True"]
