"""From frames to millimetres: model, projection, regions, surface, cycles."""

import numpy as np
import pytest

from engine.core.errors import InvalidValueError, ModelError
from engine.core.frames import ROI_COLUMNS, ROI_ROWS, RoiDepth
from engine.motion.breathing import count_cycles
from engine.motion.learning.fitting import fit
from engine.motion.learning.model_file import load_model, save_model
from engine.motion.stages.projection import modes_of, prepare_basis, project
from engine.motion.stages.regions import RegionLayout, check_points, grid_shape, prepare_regions, region_values
from engine.motion.stages.surface import grid_triangles, vertices_mm, volume_l

pytestmark = pytest.mark.slow

ROWS, COLUMNS = np.mgrid[0:ROI_ROWS, 0:ROI_COLUMNS].astype(np.float32)
MEAN = (850.0 + 0.001 * (COLUMNS - 100.0) ** 2).astype(np.float32)
THORAX = np.exp(-(((ROWS - 90.0) / 90.0) ** 2) - ((COLUMNS - 100.0) / 90.0) ** 2).astype(np.float32)
ABDOMEN = np.exp(-(((ROWS - 270.0) / 80.0) ** 2) - ((COLUMNS - 100.0) / 80.0) ** 2).astype(np.float32)


def surface(thorax_mm, abdomen_mm):
    return MEAN - thorax_mm * THORAX - abdomen_mm * ABDOMEN


def excursions(n, seed=0):
    t = np.linspace(0.0, 4.0, n) * 2.0 * np.pi
    return 3.0 * np.sin(t - 0.4), 8.0 * np.sin(t) ** 2


def frames(n=120, noise_mm=0.9, seed=0):
    rng = np.random.default_rng(seed)
    depth = np.stack([surface(a, b) for a, b in zip(*excursions(n), strict=True)])
    return (depth + rng.normal(0.0, noise_mm, depth.shape)).astype(np.float32)


def learn(depth, valid=None, components=3):
    valid = np.ones(depth.shape, dtype=bool) if valid is None else valid
    return fit(depth, valid, components=components, cycles=4, seconds=16.0, calibration_sha256="0" * 64)


@pytest.fixture(scope="module")
def model():
    return learn(frames())


def seen(depth, hole=None):
    valid = np.ones(depth.shape, dtype=bool)
    if hole is not None:
        valid[hole] = False
    return RoiDepth(depth_mm=np.where(valid, depth, 0.0).astype(np.float32), valid=valid)


def measured_surface(basis, model, projection):
    return model.mean_mm + np.tensordot(projection.coefficients, modes_of(model), axes=1)


def test_the_spectrum_is_descending_and_two_modes_carry_it(model):
    assert np.all(np.diff(model.eigenvalues_mm2) <= 0.0)
    assert model.spectrum.sum() == pytest.approx(1.0)
    assert model.spectrum[:2].sum() > 50 * model.spectrum[2]


def test_components_are_orthonormal_and_their_sign_is_inhale(model):
    flat = model.components.reshape(len(model.components), -1).astype(np.float64)
    assert np.allclose(flat @ flat.T, np.eye(len(flat)), atol=1e-5)
    assert (flat.sum(axis=1) <= 0.0).all()


def test_a_retrained_model_does_not_flip(model):
    again = learn(frames(seed=9)[::-1].copy())
    overlap = (model.components[0] * again.components[0]).sum()
    assert overlap > 0.99


def test_missing_pixels_do_not_bend_the_model():
    depth = frames()
    valid = np.random.default_rng(2).random(depth.shape) > 0.1
    valid[:, 100:110, 50:60] = False
    model = learn(np.where(valid, depth, 0.0).astype(np.float32), valid)
    assert not model.known[105, 55]
    assert np.abs(model.mean_mm - frames(noise_mm=0.0).mean(axis=0)).mean() < 0.15


def test_nothing_to_learn_is_refused():
    still = np.broadcast_to(MEAN, (40, ROI_ROWS, ROI_COLUMNS)).copy()
    with pytest.raises(ModelError, match="no motion"):
        learn(still)
    with pytest.raises(ModelError, match="training frames"):
        learn(still[:5])
    with pytest.raises(ModelError, match="had readings"):
        learn(frames(40), np.zeros((40, ROI_ROWS, ROI_COLUMNS), dtype=bool))


def test_a_saved_model_comes_back_and_anything_else_is_refused(model, tmp_path):
    path = tmp_path / "model.npz"
    save_model(model, path)
    assert [file.name for file in tmp_path.iterdir()] == ["model.npz"]
    loaded = load_model(path)
    assert np.array_equal(loaded.components, model.components)
    assert loaded.cycles == model.cycles
    whole = path.read_bytes()
    for bad in (b"", b"not a zip", whole[: len(whole) // 2]):
        path.write_bytes(bad)
        with pytest.raises(ModelError, match=r"model\.npz"):
            load_model(path)


def test_a_frame_with_holes_is_measured_as_if_it_had_none(model):
    basis = prepare_basis(model)
    depth = surface(2.0, 6.0)
    clean = project(basis, seen(depth), None)
    holed = project(basis, seen(depth, (slice(40, 120), slice(30, 110))), None)
    whole = measured_surface(basis, model, clean)
    assert np.abs(whole - depth).mean() < 0.1  # what 120 noisy training frames leave in the mean
    assert np.abs(measured_surface(basis, model, holed) - whole).max() < 0.05
    assert holed.valid_share == pytest.approx(1.0 - 80 * 80 / 70000, abs=0.01)


def test_a_hand_takes_no_part_and_shows_in_the_residual(model):
    basis = prepare_basis(model)
    before = project(basis, seen(surface(1.8, 5.8)), None)
    depth = surface(2.0, 6.0)
    hand = depth.copy()
    hand[150:250, 60:140] -= 60.0
    with_hand = project(basis, seen(hand), before.coefficients)
    away = np.ones(depth.shape, dtype=bool)
    away[140:260, 50:150] = False
    assert np.abs(measured_surface(basis, model, with_hand) - depth)[away].mean() < 0.1
    assert with_hand.residual_mm > 11.0
    assert with_hand.inlier_share < 0.9
    assert before.residual_mm < 0.5


def test_a_breath_hold_that_training_never_saw_is_not_shown_at_half_size(model):
    basis = prepare_basis(model)
    depth = surface(14.0, 9.0)
    held = project(basis, seen(depth), None)
    assert abs((measured_surface(basis, model, held) - depth).mean()) < 0.1
    assert np.abs(measured_surface(basis, model, held) - depth).mean() < 0.3


def test_an_empty_frame_is_no_projection(model):
    assert project(prepare_basis(model), seen(MEAN, (slice(None), slice(None))), None) is None


@pytest.mark.parametrize(("cell", "shape"), [(25, (14, 8)), (10, (35, 20)), (60, (6, 4))])
def test_region_means_are_the_means_of_the_rebuilt_surface(model, cell, shape):
    coefficients = np.random.default_rng(4).normal(0.0, 3.0, len(modes_of(model)))
    points = [(10, 20), (349, 199)]
    means = prepare_regions(
        model.mean_mm, modes_of(model), model.known, RegionLayout(cell_px=cell, points=tuple(points))
    )
    rebuilt = model.mean_mm.astype(np.float64) + np.tensordot(coefficients, modes_of(model).astype(np.float64), axes=1)
    values = means.depth_mm(coefficients)
    assert (means.rows, means.columns) == shape == grid_shape(cell)
    assert values[0] == pytest.approx(rebuilt[:cell, :cell].mean(), abs=1e-3)
    assert values[means.cells] == pytest.approx(rebuilt.mean(), abs=1e-3)
    assert values[means.cells + 1] == pytest.approx(rebuilt[:175].mean(), abs=1e-3)
    assert values[means.cells + 2] == pytest.approx(rebuilt[175:].mean(), abs=1e-3)
    assert values[-2:] == pytest.approx([rebuilt[10, 20], rebuilt[349, 199]], abs=1e-3)


def test_a_cell_that_was_never_seen_is_empty_not_zero(model):
    known = np.ones((ROI_ROWS, ROI_COLUMNS), dtype=bool)
    known[:25, :25] = False
    means = prepare_regions(model.mean_mm, modes_of(model), known, RegionLayout())
    values = means.depth_mm(np.zeros(len(modes_of(model))))
    assert np.isnan(values[0])
    assert np.isfinite(values[1:]).all()


def test_a_point_in_a_small_hole_is_interpolated_and_one_in_a_large_hole_is_empty(model):
    known = np.ones((ROI_ROWS, ROI_COLUMNS), dtype=bool)
    known[98:103, 58:63] = False
    known[200:260, 80:140] = False
    means = prepare_regions(model.mean_mm, modes_of(model), known, RegionLayout(points=((100, 60), (230, 110))))
    values = means.depth_mm(np.zeros(len(modes_of(model))))[means.ends[1] :]
    assert values[0] == pytest.approx(model.mean_mm[100, 60], abs=1e-3)
    assert np.isnan(values[1])


@pytest.mark.parametrize("point", [(-1, 0), (350, 0), (0, 200)])
def test_points_off_the_grid_are_refused(point):
    with pytest.raises(InvalidValueError, match="point"):
        check_points([point])


def test_cells_out_of_bounds_are_refused():
    for cell in (0, 4, 101):
        with pytest.raises(InvalidValueError, match="cell"):
            grid_shape(cell)


def test_the_last_smaller_cells_keep_their_own_mean():
    values = region_values(ROWS[None].astype(np.float64), RegionLayout(cell_px=60))
    assert values[0, 5 * 4] == pytest.approx(np.arange(300, 350).mean())


def tetrahedron(a, b, c, d):
    return np.linalg.det(np.vstack([np.column_stack([a, b, c, d]), np.ones(4)])) / 6.0


def test_the_volume_is_the_sum_of_the_articles_tetrahedra():
    rng = np.random.default_rng(8)
    rays = np.stack(np.meshgrid(np.linspace(-0.2, 0.2, 5), np.linspace(-0.3, 0.3, 7)), axis=-1).reshape(-1, 2)
    points = vertices_mm(rays, rng.uniform(800.0, 860.0, len(rays)))
    triangles = grid_triangles(7, 5)
    plane = 900.0
    total = 0.0
    for a, b, c in points[triangles]:
        a0, b0, c0 = ([*p[:2], plane] for p in (a, b, c))
        parts = tetrahedron(a, b, c, a0), tetrahedron(b, c, a0, b0), tetrahedron(c, a0, b0, c0)
        total += sum(abs(part) for part in parts)
    assert volume_l(points, triangles, plane) == pytest.approx(total / 1e6, rel=1e-9)


def test_a_surface_nearer_to_the_camera_is_more_volume():
    rays = np.stack(np.meshgrid(np.linspace(-0.1, 0.1, 3), np.linspace(-0.1, 0.1, 3)), axis=-1).reshape(-1, 2)
    triangles = grid_triangles(3, 3)
    low, high = (volume_l(vertices_mm(rays, np.full(9, z)), triangles, 900.0) for z in (880.0, 860.0))
    assert high > low > 0.0


@pytest.mark.parametrize(("cycles", "seconds"), [(3, 13.0), (5, 22.0)])
def test_complete_cycles_are_counted(cycles, seconds):
    t = np.arange(0.0, seconds, 1 / 30)
    signal = 5.0 * np.sin(2 * np.pi * (cycles + 0.9) / seconds * t) + np.random.default_rng(0).normal(0, 0.1, len(t))
    assert cycles - 1 <= count_cycles(signal, t) <= cycles


def test_noise_and_a_held_breath_are_no_cycles():
    t = np.arange(0.0, 20.0, 1 / 30)
    assert count_cycles(np.random.default_rng(0).normal(0, 0.3, len(t)), t) == 0
    assert count_cycles(np.minimum(t, 3.0) * 4.0, t) == 0
    assert count_cycles(np.zeros(2), np.zeros(2)) == 0
