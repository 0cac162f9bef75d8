"""A stored model is what its name says, every array of it."""

from dataclasses import replace

import numpy as np
import pytest

from engine.core.errors import ModelError
from engine.core.motion_model import MotionModel
from engine.motion.learning.model_file import ARRAYS, OPTIONAL_ARRAYS, save_model
from service.storage.files import motion_models
from service.storage.files.motion_models import ModelStore
from tests.support.service.fake_engine import make_model


@pytest.fixture
def model() -> MotionModel:
    """Make a model with every array that a file may have."""
    plain = make_model(1)
    random = np.random.default_rng(7)
    grid = random.uniform(-1.0, 1.0, (88, 50)).astype(np.float32)
    return replace(
        plain,
        surface_mm=random.uniform(800.0, 900.0, (756, 3)),
        scores_mm=random.uniform(-9.0, 9.0, (30, len(plain.components))).astype(np.float32),
        sample_raw_mm=grid,
        sample_reconstructed_mm=grid + 1.0,
        residual_map_mm=np.abs(grid),
    )


def other(model: MotionModel, name: str) -> MotionModel:
    array = getattr(model, name).copy()
    array.flat[2] = not array.flat[2] if array.dtype == np.bool_ else array.flat[2] + 1.0
    return replace(model, **{name: array})


@pytest.mark.parametrize("name", [*ARRAYS, *OPTIONAL_ARRAYS])
def test_a_file_with_one_value_changed_is_refused(model, tmp_path, name):
    store = ModelStore(tmp_path)
    sha256 = store.save(model)
    assert np.array_equal(getattr(store.load(sha256), name), getattr(model, name))
    save_model(other(model, name), tmp_path / f"{sha256}.npz")
    with pytest.raises(ModelError, match="changed after it was stored"):
        store.load(sha256)


def test_a_file_named_by_an_earlier_version_is_read_without_what_its_name_does_not_cover(model, tmp_path):
    header = motion_models.header_text(model).encode()
    covered = ("mean_mm", "components", "eigenvalues_mm2", "known", "surface_mm")
    content = b"".join([header, *(np.ascontiguousarray(getattr(model, name)).tobytes() for name in covered)])
    sha256 = motion_models.hashlib.sha256(content).hexdigest()
    save_model(model, tmp_path / f"{sha256}.npz")
    found = ModelStore(tmp_path).load(sha256)
    assert np.array_equal(found.surface_mm, model.surface_mm)
    assert {name for name in OPTIONAL_ARRAYS if getattr(found, name) is not None} == {"surface_mm"}
