"""A virtual volunteer with a laser's line and a spirometer."""

import pytest

from tests.conftest import volunteer


@pytest.fixture(scope="session")
def lit_volunteer(tmp_path_factory):
    """Return a folder with 22 s of volunteer 10 at 10 frames a second: quick breaths, so that it is soon learned."""
    return volunteer(tmp_path_factory, "regular", volunteer=10, seconds=22.0, fps=10.0, seed=4, has_laser=True)
