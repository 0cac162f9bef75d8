"""What a recording may change about its volunteer, and that nothing else changes with it."""

import json
from pathlib import Path

import numpy as np
import pytest

from engine.core.errors import InvalidValueError
from engine.lab.phantom.builds import NO_DEPARTURE, Departure, find_build
from engine.lab.phantom.recording import load_truth, make_volunteer
from engine.lab.phantom.scene import Script
from engine.lab.phantom.studio import Studio

pytestmark = pytest.mark.slow


def studio(departure: Departure) -> Studio:
    return Studio(Script(scenario="regular", volunteer=1, seconds=4.0, fps=30.0, seed=1, departure=departure))


def share_unread(maker: Studio) -> float:
    seen = maker.depth_frame(0, 0.1)
    on_chest = (slice(180, 320), slice(260, 400))
    return float((seen[on_chest] == 0).mean())


def test_no_departure_is_the_volunteer_as_he_was():
    assert NO_DEPARTURE.of(find_build(4)) == find_build(4)
    assert NO_DEPARTURE.labels == {}


def test_the_camera_hangs_where_it_was_asked_to():
    near, far = (studio(Departure(camera_mm=height)).true_depth(0.0) for height in (600.0, 1200.0))
    middle = (slice(230, 250), slice(310, 330))
    assert abs(float(near[middle].mean()) - 600.0) < 40.0
    assert abs(float(far[middle].mean()) - float(near[middle].mean()) - 600.0) < 10.0


def test_a_larger_amplitude_scales_the_breath_and_leaves_its_times():
    small, large = (studio(Departure(amplitude_mm=mm)).scene.timeline.signals for mm in (2.0, 40.0))
    assert large.abdomen_mm.max() > 15.0 * small.abdomen_mm.max()
    assert np.argmax(large.abdomen_mm) == np.argmax(small.abdomen_mm)


@pytest.mark.parametrize("share", [0.2, 0.4, 0.6])
def test_the_asked_for_share_of_the_body_is_not_read(share):
    usual = share_unread(studio(NO_DEPARTURE))
    assert abs(share_unread(studio(Departure(hole_share=share))) - share - usual) < 0.1


@pytest.mark.parametrize(
    ("field", "value"),
    [("camera_mm", 100.0), ("amplitude_mm", float("nan")), ("hole_share", 1.5), ("hole_share", True)],
)
def test_an_impossible_departure_is_refused_by_name_and_bound(field, value):
    with pytest.raises(InvalidValueError, match=rf"{field} is .*: must be a number from"):
        Departure(**{field: value})


def test_the_truth_names_what_was_changed(tmp_path: Path):
    make_volunteer(
        "regular", volunteer=1, seconds=2.0, fps=5.0, seed=1, out=tmp_path / "v", departure=Departure(camera_mm=700.0)
    )
    labels = json.loads(load_truth(tmp_path / "v" / "truth.npz").labels)
    assert labels["camera_mm"] == 700.0
    assert "amplitude_mm" not in labels
