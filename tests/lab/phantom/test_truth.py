import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from engine.core.errors import RecordingError
from lab.phantom.truth import POINTS_RC, load_truth, roi_nodes
from lab.phantom.view import Frustum

pytestmark = pytest.mark.slow

CASES = [("regular", 1, 1.3), ("regular", 7, 2.9), ("dibh", 2, 30.0), ("shift", 8, 33.5), ("shift", 8, 50.0)]


def grid_in_depth_view(made, time_s):
    """Grid place (row, column) of every depth pixel, by the way a measurement goes: out, over, and into the picture."""
    rig = made.scene.rig
    depth = made.true_depth(time_s)
    rows, columns = np.mgrid[0:480, 0:640]
    rays = rig.depth.rays(np.column_stack([columns.ravel(), rows.ravel()]).astype(float))
    pixels = rig.color.project(rig.color_from_depth.apply(rays * depth.ravel()[:, None]))
    corners = np.array([[0, 0], [199, 0], [199, 349], [0, 349]], np.float32)
    back = cv2.getPerspectiveTransform(made.scene.markers_px(time_s).astype(np.float32), corners)
    grid = cv2.perspectiveTransform(pixels[None], back)[0]
    inside = (grid > 1.0).all(axis=1) & (grid[:, 0] < 198.0) & (grid[:, 1] < 348.0)
    return depth.ravel()[inside], grid[inside][:, ::-1]


@pytest.mark.parametrize(("scenario", "volunteer", "time_s"), CASES)
def test_true_depth_is_what_the_picture_shows_without_noise(studio, scenario, volunteer, time_s):
    made = studio(scenario, volunteer)
    full = made.scene.roi_truth(time_s).depth(roi_nodes(), made.scene.breathing.weights(time_s)).reshape(350, 200)
    shown, place = grid_in_depth_view(made, time_s)
    assert len(shown) > 25_000
    error = shown - map_coordinates(full, place.T, order=3)
    assert abs(error.mean()) < 0.004
    assert error.std() < 0.01
    assert np.abs(error).max() < 0.15


@pytest.mark.parametrize(("scenario", "volunteer", "time_s"), CASES)
def test_cell_means_are_those_of_the_whole_grid(studio, scenario, volunteer, time_s):
    scene = studio(scenario, volunteer).scene
    weights = scene.breathing.weights(time_s)
    full = scene.roi_truth(time_s).depth(roi_nodes(), weights).reshape(350, 200)
    cells, halves, points = scene.roi_truth(time_s).cells(weights)
    assert np.abs(full.reshape(35, 10, 20, 10).mean(axis=(1, 3)) - cells).max() < 0.002
    assert halves == pytest.approx([full[:175].mean(), full[175:].mean()], abs=1e-4)
    assert halves.mean() == pytest.approx(cells.mean(), abs=1e-6)
    assert points == pytest.approx(full[POINTS_RC[:, 0], POINTS_RC[:, 1]], abs=1e-4)


@pytest.mark.parametrize(("scenario", "volunteer", "time_s"), CASES)
def test_grid_corners_lie_on_the_stickers(studio, scenario, volunteer, time_s):
    scene = studio(scenario, volunteer).scene
    weights = scene.breathing.weights(time_s)
    corners = np.array([(0.0, 0.0), (0.0, 199.0), (349.0, 199.0), (349.0, 0.0)])
    depth = scene.roi_truth(time_s).depth(corners, weights)
    camera = Frustum(scene.rig.depth_from_couch, scene.timeline.pose(time_s)).camera_from_body
    assert depth == pytest.approx(camera.apply(scene.skin.anchors(weights))[:, 2], abs=0.005)


def noise_free(made, time_s):
    made._color_camera.expose, kept = lambda scene, _frame, _time_s: scene, made._color_camera.expose
    try:
        return made.color_frame(0, time_s).astype(float)
    finally:
        made._color_camera.expose = kept


def rendered_centers(made, time_s):
    """Centres of mass of the stickers in a picture without noise, over the shirt around them."""
    gray = noise_free(made, time_s).mean(axis=2)
    centers = []
    for x, y in np.rint(made.scene.markers_px(time_s)).astype(int):
        patch = gray[y - 11 : y + 12, x - 11 : x + 12]
        rows, columns = np.mgrid[-11:12, -11:12]
        light = np.clip(patch - 90.0, 0.0, None) * (rows**2 + columns**2 < 100)
        centers.append((x + (light * columns).sum() / light.sum(), y + (light * rows).sum() / light.sum()))
    return np.array(centers)


@pytest.mark.parametrize("volunteer", [1, 4, 7])
def test_true_centres_are_those_of_the_drawn_stickers(studio, volunteer):
    made = studio("regular", volunteer)
    errors = []
    for time_s in np.arange(1.0, 4.0, 0.37):
        drawn = rendered_centers(made, time_s)
        errors.append(drawn - made.scene.markers_px(time_s))
    # A tilted disc's image has its middle a little nearer to the camera's side of it: perspective, not a fault.
    errors = np.array(errors)
    assert np.abs(errors).max() < 0.08
    assert np.abs(errors - errors.mean(axis=0)).max() < 0.02


def covariance(points, weights):
    away = points - (points * weights[:, None]).sum(axis=0) / weights.sum()
    return (away[:, :, None] * away[:, None, :] * weights[:, None, None]).sum(axis=0) / weights.sum()


@pytest.mark.parametrize("volunteer", [1, 7])
def test_stickers_lie_flat_on_the_slope_of_the_skin(studio, volunteer):
    made = studio("regular", volunteer)
    scene, time_s = made.scene, 1.0
    picture = noise_free(made, time_s).mean(axis=2)
    camera = Frustum(scene.rig.color_from_couch, scene.timeline.pose(time_s)).camera_from_body
    anchors = scene.skin.anchors(scene.breathing.weights(time_s))
    for center_mm, center_px in zip(anchors, scene.markers_px(time_s), strict=True):
        x, y = np.rint(center_px).astype(int)
        rows, columns = np.mgrid[-9:10, -9:10]
        light = np.clip(picture[y - 9 : y + 10, x - 9 : x + 10] - 90.0, 0.0, None).ravel()
        drawn = covariance(np.column_stack([columns.ravel(), rows.ravel()]).astype(float), light)
        # A disc of points on the plane through three points of the skin around the sticker.
        ring = center_mm[:2] + np.array([[5.0, 0.0], [-5.0, 0.0], [0.0, 5.0], [0.0, -5.0]])
        east, west, south, north = scene.anatomy.trunk_height(ring[:, 0], ring[:, 1])
        across = np.array([1.0, 0.0, -(east - west) / 10.0])
        down = np.array([0.0, 1.0, -(south - north) / 10.0])
        across /= np.linalg.norm(across)
        down -= across * (down @ across)
        down /= np.linalg.norm(down)
        u, v = (part.ravel() for part in np.meshgrid(np.linspace(-10, 10, 81), np.linspace(-10, 10, 81)))
        disc = center_mm + u[:, None] * across + v[:, None] * down
        pixels = scene.rig.color.project(camera.apply(disc[u**2 + v**2 <= 100.0]))
        true = covariance(pixels, np.ones(len(pixels)))
        assert abs(true[0, 1]) > 0.2
        assert drawn[0, 1] == pytest.approx(true[0, 1], abs=0.3)
        assert np.sign(drawn[0, 1]) == np.sign(true[0, 1])
        assert np.linalg.eigvalsh(drawn) == pytest.approx(np.linalg.eigvalsh(true), rel=0.15)


def test_stickers_move_with_the_breath_in_the_picture(studio):
    scene = studio("regular", 7).scene
    centers = np.stack([scene.markers_px(t) for t in np.arange(0.0, 8.0, 0.1)])
    assert np.ptp(centers, axis=0).max() > 0.3


@pytest.mark.parametrize("volunteer", [1, 5, 9])
def test_the_motion_needs_more_than_three_components(studio, volunteer):
    scene = studio("regular", volunteer).scene if volunteer in (1, 5) else studio("irregular", volunteer).scene
    times = np.arange(0.0, 20.0, 0.25)
    cells = np.stack([scene.roi_truth(t).cells(scene.breathing.weights(t))[0].ravel() for t in times])
    spread = np.linalg.svd(cells - cells.mean(axis=0), compute_uv=False) / np.sqrt(cells.size)
    assert spread[3] > 0.012
    assert spread[4] > 0.004
    assert spread[:3].sum() > 20 * spread[3]


def test_a_file_that_is_no_truth_is_refused(tmp_path):
    path = tmp_path / "truth.npz"
    for content in (b"", b"PK\x03\x04 but no more", b"\x93NUMPY"):
        path.write_bytes(content)
        with pytest.raises(RecordingError, match=r"truth\.npz: is no truth of a virtual volunteer"):
            load_truth(path)
    np.savez(path, labels="{}")
    with pytest.raises(RecordingError, match="is no truth"):
        load_truth(path)
    with pytest.raises(RecordingError, match="is no truth"):
        load_truth(tmp_path / "missing.npz")
