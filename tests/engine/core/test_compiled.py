"""The compiled path is chosen openly, never stale, and refuses every array that is not what it computes with."""

import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from engine.core import compiled
from engine.core.errors import InvalidValueError
from engine.core.geometry import least_squares


def test_it_is_built_where_there_is_a_compiler():
    assert compiled.frame_path().startswith("compiled ") or shutil.which("cc") is None


def path_with(**environment):
    program = "from engine.core.compiled import frame_path; print(frame_path())"
    return subprocess.run(
        [sys.executable, "-c", program], env=os.environ | environment, capture_output=True, text=True, check=False
    )


def test_the_environment_forces_the_numpy_forms():
    assert path_with(TIDEGATE_FRAME_PATH="numpy").stdout.strip() == compiled.CHOSEN


def test_another_choice_is_refused_by_name_value_and_bound():
    refused = path_with(TIDEGATE_FRAME_PATH="fast")
    assert refused.returncode != 0
    assert "TIDEGATE_FRAME_PATH is 'fast': must be auto, compiled, numpy" in refused.stderr


def test_a_build_of_other_sources_does_not_run(monkeypatch):
    if compiled.FramePath.kernels is None:
        pytest.skip("not built")
    monkeypatch.setattr(compiled, "_source_digest", lambda: "of other sources")
    assert compiled._load("auto") == (None, compiled.STALE)
    with pytest.raises(InvalidValueError, match="only where it is built"):
        compiled._load("compiled")


def test_the_numpy_forms_run_inside_their_block_only():
    before = compiled.frame_path()
    with compiled.numpy_forms():
        assert compiled.FramePath.kernels is None
        assert compiled.frame_path() == compiled.CHOSEN
    assert compiled.frame_path() == before


F32, F64 = np.float32, np.float64
CALLS = {
    "decode_16zt": [b"\x00" * 8, np.zeros((4, 5), np.uint16)],
    "scene_blocks": [np.zeros((32, 48), np.uint16), 16, np.zeros((2, 3))],
    "least_squares": [np.eye(3, 5), np.ones(5), np.zeros(3)],
    "corner_medians": [np.ones((9, 8), F32), np.ones((9, 8), bool), 3, 2, np.zeros(4)],
    "cell_means": [
        *(np.ones((6, 4), F32), np.ones((6, 4), bool), np.repeat(np.arange(3), 2), np.repeat(np.arange(2), 2)),
        *(np.ones((3, 2)), np.zeros((3, 2))),
    ],
    "align_nodes": [
        np.ones((7, 3)),
        np.ones(7),
        np.eye(3),
        np.zeros(3),
        np.ones(9),
        np.zeros((7, 2)),
        np.zeros((7, 2)),
    ],
    "cut_out": [
        *(np.ones((40, 40), np.uint16), np.full((135, 2), 20.0), np.ones(65536, F32), 25, 0.5, 0.8),
        *(np.zeros((14, 8), F32), np.zeros((14, 8), bool)),
    ],
    "surface_change": [np.eye(6, 30), np.ones(30), 4, 5, np.zeros(4), np.zeros(30), np.zeros(3)],
    "camera_rays": [np.ones((7, 2)), np.ones(9), 5, np.zeros((7, 3))],
    "map_points": [np.eye(3), np.ones((5, 2)), np.zeros((5, 2))],
    "node_surface": [np.ones((12, 2)), np.ones(12), 4, 0.9, np.zeros((12, 3))],
    "mesh_volume": [np.ones((6, 3)), np.array([[0, 1, 2], [3, 4, 5]]), 900.0],
    "seen_shares": [
        *(np.ones((4, 3), bool), np.ones((2, 4), F32), np.ones((3, 2), F32), np.ones((5, 12), F32), 1e4),
        np.zeros(9, F32),
    ],
    "changed_cells": [np.zeros((12, 2), F32), np.ones((12, 2), F32), np.zeros((12, 2), F32), 4, 2, 0.03, 3, 2, 0.015],
    "scene_movement": [
        *(np.ones(6), np.arange(5), np.ones(5), np.ones((5, 3)), np.ones(5), np.arange(3), np.ones(3)),
        *(15.0, 0.5, 3, np.ones((4, 3)), np.zeros(5)),
    ],
    "look_at_depth": [
        *(np.ones((9, 12), np.uint16), 4, 2, np.arange(9) % 4, np.arange(9), np.ones((5, 9), np.uint16)),
        *(np.zeros((5, 4), np.int64), np.ones(4), 4, 3, 0.88, 0.9),
        *(np.zeros(9, np.uint16), np.zeros(4, np.int64), np.zeros((5, 6), np.uint16)),
    ],
    "look_at_color": [np.ones((9, 12, 3), np.uint8), 4, np.ones((5, 27), np.uint8), 4, np.zeros(27, np.uint8)],
    "median_square": [np.ones(7), np.ones(7), np.ones(7)],
    "mean_cells": [[np.ones(6), np.ones(6)], np.zeros(6)],
    "largest_mean": [[np.ones(4), np.ones(4)]],
    "marker_places": [np.ones(7), 90.0, np.ones((4, 3)), np.eye(3), np.zeros(3), np.zeros((4, 3)), np.zeros((4, 3))],
    "mean_depth": [np.ones((9, 8), F32), np.ones((9, 8), bool)],
    "depths": [
        *(np.ones(3), np.ones(7), np.ones((3, 7)), np.ones(5), np.ones((5, 3)), np.ones(5, bool)),
        *(np.zeros(7), np.zeros(5)),
    ],
    "largest_difference": [np.ones((4, 2)), np.zeros((4, 2))],
    "shift_correlations": [np.arange(5.0), np.arange(5.0), 1e-12, np.zeros(9)],
    "sample_chroma": [
        np.zeros((40, 60, 3), np.uint8),
        np.eye(3),
        4,
        np.zeros((5, 6, 3), np.uint8),
        45.0,
        np.zeros((8, 2), F32),
    ],
    "refine_markers": [
        *(np.zeros((40, 60, 3), np.uint8), np.full((2, 2), 20.0), 3, np.arange(9), np.arange(4), np.ones((49, 6), F32)),
        *(30.0, 0.7, 1.0, 4, 0.6, 9.0, 1.5, 0.5, 0.7, 1.3, np.zeros((2, 8)), np.zeros(2, bool)),
    ],
    "project": [
        *(np.ones((1, 12), F32), np.ones((4, 1), F32), np.ones((3, 2), F32), np.ones((12, 3), F32), np.ones(12, F32)),
        *(np.ones(12, bool), np.ones((2, 3)), np.ones(2), 1.0, np.ones(3), np.eye(3) * 12),
        *(np.ones((4, 3), F32), np.ones((4, 3), bool), np.zeros(3), np.array([0, 0, 1, 1]), np.array([0, 0, 1])),
        *(np.ones((2, 2)), np.ones(9), 12, np.zeros(3), np.zeros((4, 3), bool), np.zeros(4)),
    ],
}
"""Arguments that every function takes."""
ARRAYS = [(name, at) for name, args in CALLS.items() for at, one in enumerate(args) if isinstance(one, np.ndarray)]


def args_of(name):
    """Return arguments that nothing has written to."""
    return [
        [part.copy() for part in one] if isinstance(one, list) else one.copy() if isinstance(one, np.ndarray) else one
        for one in CALLS[name]
    ]


def called(name, args):
    functions = compiled.FramePath.kernels
    if functions is None:
        pytest.skip("not built")
    return getattr(functions, name)(*args)


@pytest.mark.parametrize("name", CALLS)
def test_a_function_takes_its_arguments_and_no_other_number_of_them(name):
    called(name, args_of(name))
    for args in ([], args_of(name)[:-1], [*args_of(name), 1]):
        with pytest.raises(TypeError, match="arguments"):
            called(name, args)


def misplaced(array):
    """Return the array with another item type, number of dimensions, order, alignment, and as no array."""
    wide = np.repeat(array, 2, axis=-1)
    unaligned = np.frombuffer(b"\x00" + array.tobytes(), array.dtype, offset=1).reshape(array.shape)
    changed = [
        array.astype(np.int16),
        array.astype(f">{array.dtype.str[1:]}") if array.itemsize > 1 else array.astype(np.uint32),
        array[None],
        wide[..., ::2],
        array.astype(object),
        None,
        3,
    ]
    return changed if array.itemsize == 1 else [*changed, unaligned]


@pytest.mark.parametrize(("name", "at"), ARRAYS)
def test_an_array_of_another_kind_is_refused(name, at):
    args = args_of(name)
    for other in misplaced(args[at]):
        if other is None and (name, at) == ("project", 13):
            continue  # a projection without a start
        with pytest.raises((ValueError, TypeError, BufferError)):
            called(name, [*args[:at], other, *args[at + 1 :]])


@pytest.mark.parametrize("name", ["mean_cells", "largest_mean"])
def test_a_list_of_other_arrays_is_refused(name):
    rest = args_of(name)[1:]
    others = [[], [np.ones(6)] * 65, [np.ones(6), np.ones(5)], [np.ones(6), None], (np.ones(6),), np.ones((2, 6)), None]
    others += [[np.ones(6), one] for one in misplaced(np.ones(6)) if one is not None]
    for other in others:
        with pytest.raises((ValueError, TypeError, BufferError)):
            called(name, [other, *rest])


@pytest.mark.parametrize(("name", "at"), ARRAYS)
def test_an_array_of_another_size_is_refused_or_of_no_consequence(name, at):
    """Every dimension longer, shorter, and empty: an error or a result, and no byte beyond (run under a sanitizer)."""
    args = args_of(name)
    array = args[at]
    for axis in range(array.ndim):
        for size in (0, array.shape[axis] - 1, array.shape[axis] + 1):
            other = np.ascontiguousarray(np.resize(array, (*array.shape[:axis], size, *array.shape[axis + 1 :])))
            try:
                called(name, [*args[:at], other, *args[at + 1 :]])
            except ValueError as error:
                assert str(error)  # noqa: PT017 - some sizes are free


@pytest.mark.parametrize(
    ("name", "at", "values"),
    [
        ("cell_means", 2, [0, 0, 1, 1, 2, 3]),
        ("cell_means", 3, [0, 0, -1, 1]),
        ("refine_markers", 3, [0, 49]),
        ("refine_markers", 4, [-1]),
        ("project", 14, [0, 0, 1, 2]),
        ("project", 15, [0, -1, 1]),
        ("mesh_volume", 1, [[0, 1, 6], [3, 4, 5]]),
        ("mesh_volume", 1, [[0, 1, 2], [3, -1, 5]]),
    ],
)
def test_an_index_off_its_array_is_refused(name, at, values):
    with pytest.raises(ValueError, match=r"patch|cell|vertex"):
        called(name, [*args_of(name)[:at], np.array(values), *args_of(name)[at + 1 :]])


@pytest.mark.parametrize(("name", "at"), [("decode_16zt", 1), ("seen_shares", 5), ("cut_out", 6), ("project", 19)])
def test_a_read_only_result_is_refused(name, at):
    frozen = args_of(name)[at].copy()
    frozen.setflags(write=False)
    with pytest.raises((ValueError, BufferError)):
        called(name, [*args_of(name)[:at], frozen, *args_of(name)[at + 1 :]])


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 2**32 - 1), st.integers(0, 14), st.integers(0, 60), st.sampled_from(["full", "zero", "same", "tiny"])
)
def test_least_squares_are_numpys(seed, terms, values, kind):
    rng = np.random.default_rng(seed)
    matrix, wanted = rng.normal(size=(terms, values)) * rng.choice([1e-3, 1.0, 1e3]), rng.normal(size=values)
    if terms > 1 and kind != "full":
        matrix[-1] = {"zero": 0.0, "same": matrix[0], "tiny": matrix[0] * (1.0 + 1e-12)}[kind]
    found = least_squares(matrix, wanted)
    with compiled.numpy_forms():
        expected = least_squares(matrix, wanted)
    assert found @ matrix == pytest.approx(expected @ matrix, abs=1e-9)
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-9 / max(np.abs(matrix).max(initial=0.0), 1e-9))
