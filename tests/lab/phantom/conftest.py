"""Studios that several tests look into; made once a process."""

from functools import lru_cache

import pytest

from lab.phantom.scene import Script
from lab.phantom.studio import Studio


@lru_cache(maxsize=4)
def open_studio(scenario: str, volunteer: int, seconds: float = 60.0, seed: int = 1) -> Studio:
    return Studio(Script(scenario=scenario, volunteer=volunteer, seconds=seconds, fps=30.0, seed=seed))


@pytest.fixture(scope="session")
def studio():
    return open_studio
