"""Two more stickers on a virtual volunteer: seen where they are, and nothing else changed by them."""

import json

import numpy as np
import pytest

from engine.motion.stages.markers import MarkerSearch, find_stickers
from engine.motion.stages.roi import color_from_roi
from engine.motion.tracking.costal_line import find_split
from lab.phantom.laser import CostalStickers
from lab.phantom.recording import _labels
from lab.phantom.scene import Scene, Script
from lab.phantom.studio import Studio

pytestmark = pytest.mark.slow


def script(volunteer, **options):
    return Script(scenario="regular", volunteer=volunteer, seconds=4.0, fps=30.0, seed=2, **options)


@pytest.mark.parametrize("volunteer", [1, 9])
def test_they_are_found_where_the_truth_states(volunteer):
    studio = Studio(script(volunteer, has_extra_markers=True))
    scene = studio.scene
    true = CostalStickers(scene.anatomy).split_rows(scene.rig, scene.skin, scene.timeline.pose(0.0))
    search = MarkerSearch(diameter_px=13.0)
    found = find_split(find_stickers(studio.color_frame(3, 0.2), search), color_from_roi(scene.markers_px(0.2)))
    assert found == pytest.approx(true, abs=2.5)  # a breath moves them a little along the grid
    assert 35.0 < min(true) < max(true) < 315.0


def test_pictures_differ_in_two_places_only():
    plain, marked = (Studio(script(4, has_extra_markers=has)) for has in (False, True))
    difference = np.abs(plain.color_frame(3, 0.2).astype(int) - marked.color_frame(3, 0.2)).max(axis=2) > 30
    assert 150 < difference.sum() < 500
    assert np.array_equal(plain.depth_frame(3, 0.2), marked.depth_frame(3, 0.2))


def test_the_labels_tell_the_split_only_where_it_is_marked():
    plain, marked = (json.loads(_labels(Scene(script(2, has_extra_markers=has)))) for has in (False, True))
    assert "split_rows" not in plain
    right, left = marked.pop("split_rows")
    assert 100.0 < right < left < 250.0
    assert marked == plain
