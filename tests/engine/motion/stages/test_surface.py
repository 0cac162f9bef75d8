"""The surface as a mesh: normals out of the patient, files that others read, litres that repeat."""

import struct

import numpy as np
import pytest

from engine.motion.stages.surface import end_at_markers, grid_triangles, surface_mesh, vertices_mm, volume_l
from engine.offline.mesh_files import obj_text, ply_bytes, save_mesh

ROWS, COLUMNS = 36, 21


def dome(height_mm=40.0, z_mm=850.0):
    """A dome towards the camera over a flat rim, as vertices (756, 3)."""
    x, y = np.meshgrid(np.linspace(-100.0, 100.0, COLUMNS), np.linspace(-175.0, 175.0, ROWS))
    bulge = np.cos(np.pi * x / 200.0) * np.cos(np.pi * y / 350.0)
    return np.column_stack([x.ravel(), y.ravel(), (z_mm - height_mm * bulge).ravel()])


def normals(mesh):
    a, b, c = (mesh.vertices_mm[mesh.triangles[:, i]] for i in range(3))
    return np.cross(b - a, c - a)


def test_every_normal_points_to_the_camera_and_out_of_the_patient():
    assert (normals(surface_mesh(dome(), ROWS, COLUMNS))[:, 2] < 0.0).all()


def test_the_mesh_is_one_sheet_without_a_hole():
    triangles = surface_mesh(dome(), ROWS, COLUMNS).triangles
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    directed = {tuple(edge) for edge in edges.tolist()}
    assert len(directed) == len(edges)  # consistent winding: no edge is run through twice the same way
    rim = [edge for edge in directed if edge[::-1] not in directed]
    assert len(rim) == 2 * (ROWS - 1) + 2 * (COLUMNS - 1)
    assert set(np.unique(triangles)) == set(range(ROWS * COLUMNS))
    assert len(triangles) == 2 * (ROWS - 1) * (COLUMNS - 1)


def test_a_mesh_cannot_be_written_to():
    mesh = surface_mesh(dome(), ROWS, COLUMNS)
    with pytest.raises(ValueError, match="read-only"):
        mesh.vertices_mm[0] = 0.0


def read_ply(content):
    """Read a PLY as its format says: a text header that tells what the bytes behind it are."""
    header, body = content.split(b"end_header\n", 1)
    lines = header.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    counts = {line.split()[1]: int(line.split()[2]) for line in lines if line.startswith("element")}
    assert [line for line in lines if line.startswith("property")] == [
        *(f"property float {axis}" for axis in "xyz"),
        "property list uchar int vertex_indices",
    ]
    points = [struct.unpack_from("<3f", body, 12 * i) for i in range(counts["vertex"])]
    start = 12 * counts["vertex"]
    faces = [struct.unpack_from("<B3i", body, start + 13 * i) for i in range(counts["face"])]
    assert len(body) == start + 13 * counts["face"]
    assert {face[0] for face in faces} == {3}
    return np.array(points), np.array(faces)[:, 1:]


def test_a_ply_states_what_the_mesh_states():
    mesh = surface_mesh(dome(), ROWS, COLUMNS)
    points, faces = read_ply(ply_bytes(mesh))
    assert np.abs(points - mesh.vertices_mm).max() < 1e-4
    assert np.array_equal(faces, mesh.triangles)


def test_an_obj_states_what_the_mesh_states_and_counts_from_one():
    mesh = surface_mesh(dome(), ROWS, COLUMNS)
    rows = [line.split() for line in obj_text(mesh).splitlines() if not line.startswith("#")]
    points = np.array([[float(value) for value in row[1:]] for row in rows if row[0] == "v"])
    faces = np.array([[int(value) for value in row[1:]] for row in rows if row[0] == "f"])
    assert np.abs(points - mesh.vertices_mm).max() < 1e-3
    assert np.array_equal(faces - 1, mesh.triangles)


@pytest.mark.parametrize("name", ["frame.ply", "frame.obj"])
def test_a_mesh_file_is_whole_or_not_there(tmp_path, name):
    save_mesh(surface_mesh(dome(), ROWS, COLUMNS), tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(OSError, match=r"folder\.ply"):
        save_mesh(surface_mesh(dome(), ROWS, COLUMNS), tmp_path / "folder.ply")
    assert not list(tmp_path.glob("*.partial"))


def test_the_grid_ends_where_the_markers_are():
    x, y = np.meshgrid(np.arange(COLUMNS) * 10.0, np.arange(ROWS) * 10.0)
    ended = end_at_markers(np.column_stack([x.ravel(), y.ravel()]), ROWS, COLUMNS, 0.9)
    assert ended[-1].tolist() == pytest.approx([199.0, 349.0])
    assert ended[0].tolist() == [0.0, 0.0]
    assert ended[COLUMNS - 1].tolist() == pytest.approx([199.0, 0.0])
    assert ended[1].tolist() == [10.0, 0.0]


def test_the_volume_of_a_dome_is_its_integral():
    volume = volume_l(dome(), grid_triangles(ROWS, COLUMNS), 850.0)
    assert volume == pytest.approx(40.0 * 200.0 * 350.0 * (2.0 / np.pi) ** 2 / 1e6, rel=0.004)


def test_breath_volumes_repeat_to_a_millilitre_under_the_sensors_noise():
    # What a projection leaves: 27 smooth modes, known to about 0.05 mm each, move all nodes together.
    rng = np.random.default_rng(4)
    x, y = np.meshgrid(np.linspace(0.0, 1.0, COLUMNS), np.linspace(0.0, 1.0, ROWS))
    modes = np.stack([(np.cos(np.pi * i * y) * np.cos(np.pi * j * x)).ravel() for i in range(6) for j in range(4)])
    rest, triangles = dome(), grid_triangles(ROWS, COLUMNS)
    rays = rest[:, :2] / rest[:, 2:]
    empty_l = volume_l(rest, triangles, 850.0)
    volumes = []
    for _ in range(200):
        noise_mm = (0.05 * rng.normal(size=len(modes))) @ modes / np.sqrt(len(modes))
        volumes.append(volume_l(vertices_mm(rays, rest[:, 2] + noise_mm), triangles, 850.0) - empty_l)
    assert np.std(volumes) < 0.001
    assert abs(np.mean(volumes)) < 0.0005


def test_moving_the_whole_patient_sideways_moves_no_volume():
    triangles = grid_triangles(ROWS, COLUMNS)
    shifted = dome() + np.array([12.0, -7.0, 0.0])
    assert volume_l(shifted, triangles, 850.0) == pytest.approx(volume_l(dome(), triangles, 850.0), abs=1e-9)
