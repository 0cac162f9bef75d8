"""Recordings of virtual volunteers, made once on this machine and copied for each test process."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

import engine
from engine.lab.phantom.recording import make_volunteer
from tests.support.build_cache import digest_of, made_once

MAKERS = [
    Path(engine.__path__[0]) / name
    for name in ("lab/phantom", "capture/oni", "core/geometry.py", "calibration/laser_plane.py")
]
"""The sources that a recording depends on: one changed, it is made anew."""


def volunteer(factory: pytest.TempPathFactory, scenario: str, **options: object) -> Path:
    """Return a folder with a copy of a volunteer's recording, its truth and its calibration."""
    wish = (scenario, sorted(options.items()), np.__version__, cv2.__version__)
    with made_once(f"volunteer-{scenario}-{digest_of(wish, *MAKERS)}") as (kept, draft):
        if draft is not None:
            make_volunteer(scenario, out=draft / "volunteer", **options)
    return Path(shutil.copytree(kept / "volunteer", factory.mktemp(f"volunteer-{scenario}") / scenario))
