"""What a recording may change about its volunteer, and that nothing else changes with it."""

import json
from pathlib import Path

import numpy as np
import pytest

from engine.core.errors import InvalidValueError
from lab.phantom.builds import CLOTHING, NO_DEPARTURE, Departure, find_build
from lab.phantom.color import SHADOW_S
from lab.phantom.recording import load_truth, make_volunteer
from lab.phantom.scene import Script
from lab.phantom.sensor import WARM_UP_S
from lab.phantom.studio import Studio

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
    [
        ("camera_mm", 100.0),
        ("amplitude_mm", float("nan")),
        ("hole_share", 1.5),
        ("hole_share", True),
        ("drift_mm", 31.0),
        ("light", 0.0),
        ("shadow", 1.1),
    ],
)
def test_an_impossible_departure_is_refused_by_name_and_bound(field, value):
    with pytest.raises(InvalidValueError, match=rf"{field} is .*: must be a number from"):
        Departure(**{field: value})


@pytest.mark.parametrize(
    ("field", "value"), [("skin", 0), ("skin", 7), ("skin", 1.5), ("clothing", "coat"), ("sticker", "round")]
)
def test_an_unknown_skin_cloth_or_sticker_is_refused(field, value):
    with pytest.raises(InvalidValueError, match=f"{field} is"):
        Departure(**{field: value})


def test_a_cold_camera_reads_what_it_was_told_and_less_with_time():
    warm, cold = studio(NO_DEPARTURE), studio(Departure(drift_mm=-12.0))
    on_chest = (slice(200, 280), slice(280, 360))

    def drift_mm(time_s: float) -> float:
        read = [maker.depth_frame(7, time_s)[on_chest].astype(float) for maker in (cold, warm)]
        is_read = (read[0] > 0) & (read[1] > 0)
        return float((read[0] - read[1])[is_read].mean())

    assert drift_mm(0.0) == pytest.approx(-12.0, abs=0.3)
    assert drift_mm(3.9) == pytest.approx(-12.0 * np.exp(-3.9 / WARM_UP_S), abs=0.3)


def noise_of(maker: Studio) -> tuple[float, float]:
    """Mean and noise of the shirt's middle."""
    one, other = (maker.color_frame(frame, 0.0)[200:240, 300:340].astype(float) for frame in (0, 1))
    return float(one.mean()), float((one - other).std())


def test_a_dim_room_is_amplified_with_its_noise_and_a_dark_one_stays_dark():
    usual, dim, dark = (noise_of(studio(Departure(light=light))) for light in (1.0, 1 / 16, 1 / 256))
    assert dim[0] == pytest.approx(usual[0], rel=0.1)
    assert dim[1] > 3.0 * usual[1]
    assert dark[0] < 0.2 * usual[0]


def test_the_gantry_s_shadow_passes_over_the_patient_and_leaves_the_depth():
    shaded, usual = studio(Departure(shadow=0.8)), studio(NO_DEPARTURE)
    before, over = (shaded.color_frame(0, time_s)[300:340, 280:360].mean() for time_s in (0.0, 0.5 * SHADOW_S))
    assert over == pytest.approx(0.2 * before, rel=0.15)
    assert np.array_equal(shaded.depth_frame(0, 2.0), usual.depth_frame(0, 2.0))


@pytest.mark.parametrize("clothing", CLOTHING)
def test_the_trunk_has_the_colour_of_what_it_wears(clothing):
    skin = 6
    maker = studio(Departure(clothing=clothing, skin=skin))
    patch = maker.color_frame(0, 0.0)[190:250, 300:340].astype(float).mean(axis=2)
    bounds = {"white": (150, 230), "black": (0, 30), "striped": (60, 150), "bare": (25, 70)}[clothing]
    assert bounds[0] < patch.mean() < bounds[1]
    assert (float(patch.std()) > 40.0) == (clothing == "striped")


def test_a_ringed_sticker_is_white_in_a_black_disc_wherever_it_lies():
    maker = studio(Departure(clothing="white", sticker="ringed"))
    picture = maker.color_frame(0, 0.0).astype(float).mean(axis=2)
    for x, y in maker.scene.markers_px(0.0):
        column, row = round(x), round(y)
        assert picture[row, column] > 150.0
        ring = [picture[row, column + step] for step in (-10, 10)]
        assert max(ring) < 0.7 * picture[row, column]


def test_the_truth_names_what_was_changed(tmp_path: Path):
    make_volunteer(
        "regular",
        volunteer=1,
        seconds=2.0,
        fps=5.0,
        seed=1,
        out=tmp_path / "v",
        departure=Departure(camera_mm=700.0, clothing="bare"),
    )
    labels = json.loads(load_truth(tmp_path / "v" / "truth.npz").labels)
    assert (labels["camera_mm"], labels["clothing"]) == (700.0, "bare")
    assert "amplitude_mm" not in labels
