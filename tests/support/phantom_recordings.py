"""Recordings of virtual volunteers, made once on this machine and copied for each test process."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from lab.phantom.recording import make_volunteer
from tests.support.build_cache import digest_of, made_once
from tests.support.repository import ROOT

MAKERS = [
    ROOT / name
    for name in ("lab/phantom", "engine/capture/oni", "engine/core/geometry.py", "engine/calibration/laser_plane.py")
]
"""The sources that a recording depends on: one changed, it is made anew."""


def volunteer(factory: pytest.TempPathFactory, scenario: str, **options: object) -> Path:
    """Return a folder with a copy of a volunteer's recording, its truth and its calibration."""
    wish = (scenario, sorted(options.items()), np.__version__, cv2.__version__)
    with made_once(f"volunteer-{scenario}-{digest_of(wish, *MAKERS)}") as (kept, draft):
        if draft is not None:
            make_volunteer(scenario, out=draft / "volunteer", **options)
    return Path(shutil.copytree(kept / "volunteer", factory.mktemp(f"volunteer-{scenario}") / scenario))
