"""A model survives its file with all that made it, and nothing else is taken for a model."""

import io
import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest

from engine.core.errors import InvalidValueError, ModelError
from engine.core.motion_model import ModelOrigin, MotionModel, Provenance, TrainingQuality
from engine.motion.learning.model_file import header_text, load_model, save_model

pytestmark = pytest.mark.slow

QUALITY = TrainingQuality(
    amplitude_mm=7.5,
    noise_mm=0.12,
    explained_share=0.985,
    shift_mm=0.4,
    tilt_deg=0.1,
    outlier_share=0.02,
    residual_mm=0.6,
)
ORIGIN = ModelOrigin(
    patient="P-0001", source="chest.oni", created_at="2026-11-21T10:00:00.000000Z", software="tidegate 0.1.0"
)


@pytest.fixture(scope="module")
def model():
    random = np.random.default_rng(4)
    flat, _ = np.linalg.qr(random.standard_normal((70_000, 2)))
    return MotionModel(
        mean_mm=random.uniform(800.0, 900.0, (350, 200)).astype(np.float32),
        components=flat.T.reshape(2, 350, 200).astype(np.float32),
        eigenvalues_mm2=np.array([900.0, 20.0, 0.5]),
        known=random.random((350, 200)) < 0.9,
        training_frames=120,
        cycles=4,
        seconds=16.5,
        calibration_sha256="ab" * 32,
        surface_mm=random.uniform(-200.0, 900.0, (756, 3)),
        shape_errors=(2e-4, 5e-3),
        provenance=Provenance(quality=QUALITY, settings={"components": 2, "min_seconds": 10.0}, origin=ORIGIN),
    )


@pytest.fixture
def saved(model, tmp_path):
    path = tmp_path / "model.npz"
    save_model(model, path)
    return path


def rewritten(path, *, header=None, arrays=None, drop=(), dumps=json.dumps):
    """Write the model file again, with keys of its header or arrays changed."""
    with np.load(path) as archive:
        found = {name: archive[name] for name in archive.files}
    document = json.loads(found.pop("header").tobytes())
    for key, value in (header or {}).items():
        *parents, last = key.split(".")
        place = document
        for parent in parents:
            place = place[parent]
        place[last] = value
    found["header"] = np.frombuffer(dumps(document).encode(), dtype=np.uint8)
    found |= arrays or {}
    np.savez(path, **{name: array for name, array in found.items() if name not in drop})
    return path


def test_everything_comes_back_and_nothing_else_is_left_in_the_folder(model, saved):
    loaded = load_model(saved)
    for name in ("mean_mm", "components", "eigenvalues_mm2", "known", "surface_mm"):
        assert np.array_equal(getattr(loaded, name), getattr(model, name)), name
    assert loaded.provenance == model.provenance
    assert header_text(loaded) == header_text(model)
    assert np.allclose(loaded.spectrum, model.spectrum)
    assert [file.name for file in saved.parent.iterdir()] == ["model.npz"]


def test_the_same_model_gives_the_same_bytes(model, saved, tmp_path):
    save_model(model, tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == saved.read_bytes()


def test_a_model_without_surface_quality_and_origin_comes_back_too(model, tmp_path):
    bare = replace(model, surface_mm=None, provenance=Provenance())
    save_model(bare, tmp_path / "bare.npz")
    loaded = load_model(tmp_path / "bare.npz")
    assert (loaded.surface_mm, loaded.provenance) == (None, Provenance())


def test_a_failed_write_leaves_neither_a_model_nor_half_of_one(model, tmp_path, monkeypatch):
    def full(*_args, **_kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(OSError, match="No space"):
        save_model(model, tmp_path / "model.npz")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("schema", "tidegate.model/3"),
        ("schema", "tidegate.model/1"),
        ("schema", 2),
        ("cycles", -1),
        ("cycles", 1.5),
        ("cycles", True),
        ("seconds", "16"),
        ("seconds", float("nan")),
        ("training_frames", 10**9),
        ("calibration_sha256", "AB" * 32),
        ("shape_errors", [0.1]),
        ("shape_errors", [0.1, -0.1]),
        ("calibration_sha256", "../../etc/passwd"),
        ("quality.explained_share", 1.01),
        ("quality.amplitude_mm", -1.0),
        ("quality.extra", 1),
        ("settings", []),
        ("settings", {str(i): 1.0 for i in range(65)}),
        ("settings.components", "2"),
        ("origin.patient", "a\nb"),
        ("origin.patient", "x" * 201),
        ("origin.source", None),
        ("origin.colour", "blue"),
        ("colour", "blue"),
    ],
    ids=lambda value: str(value)[:30],
)
def test_each_impossible_entry_of_the_header_is_refused_by_name(saved, key, value):
    with pytest.raises(ModelError, match=r"^model\.npz is no motion model: ") as refusal:
        load_model(rewritten(saved, header={key: value}))
    if value == value:  # noqa: PLR0124 - NaN is refused by the JSON reader, which names the document
        assert key.rpartition(".")[2] in str(refusal.value)


@pytest.mark.parametrize(
    ("name", "array"),
    [
        ("mean_mm", np.full((350, 200), 850.0)),
        ("mean_mm", np.full((350, 200), np.nan, dtype=np.float32)),
        ("mean_mm", np.full((350, 200), 50.0, dtype=np.float32)),
        ("mean_mm", np.float32(850.0)),
        ("mean_mm", np.full((20, 20), 850.0, dtype=np.float32)),
        ("components", np.zeros((0, 350, 200), dtype=np.float32)),
        ("components", np.full((2, 350, 200), np.inf, dtype=np.float32)),
        ("eigenvalues_mm2", np.array([-1.0])),
        ("eigenvalues_mm2", np.array([np.nan])),
        ("eigenvalues_mm2", np.zeros((2, 2))),
        ("known", np.ones((350, 200), dtype=np.uint8)),
        ("surface_mm", np.zeros((756, 2))),
        ("surface_mm", np.full((756, 3), np.inf)),
        ("extra", np.zeros(3)),
        ("known", np.array([{"a": 1}], dtype=object)),
    ],
    ids=lambda value: value if isinstance(value, str) else f"{value.dtype}{value.shape}",
)
def test_each_array_of_another_type_shape_or_range_is_refused(saved, name, array):
    with pytest.raises(ModelError, match=r"^model\.npz is no motion model: "):
        load_model(rewritten(saved, arrays={name: array}))


@pytest.mark.parametrize("name", ["header", "mean_mm", "components", "eigenvalues_mm2", "known"])
def test_a_missing_array_is_named(saved, name):
    with pytest.raises(ModelError, match=f"{name} is 'missing'"):
        load_model(rewritten(saved, drop=(name,)))


def test_an_archive_that_unpacks_to_too_much_is_refused_before_it_is_unpacked(tmp_path):
    path = tmp_path / "bomb.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("mean_mm.npy", bytes(65 * 1024 * 1024))
    with pytest.raises(ModelError, match="unpacks to more than"):
        load_model(path)


def test_an_array_that_claims_to_be_larger_than_memory_is_refused(saved):
    with zipfile.ZipFile(saved) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    claim = io.BytesIO()
    np.lib.format.write_array_header_1_0(claim, {"descr": "<f4", "fortran_order": False, "shape": (1 << 40, 350, 200)})
    parts["components.npy"] = claim.getvalue()
    with zipfile.ZipFile(saved, "w") as archive:
        for name, content in parts.items():
            archive.writestr(name, content)
    with pytest.raises(ModelError, match="no motion model"):
        load_model(saved)


@pytest.mark.parametrize("content", [b"", b"not a zip", b"PK\x03\x04" + bytes(100)], ids=str)
def test_what_is_no_archive_is_refused(tmp_path, content):
    path = tmp_path / "model.npz"
    path.write_bytes(content)
    with pytest.raises(ModelError, match=r"^model\.npz is no motion model"):
        load_model(path)


def test_every_bit_that_flips_in_the_file_is_either_harmless_or_refused(model, saved):
    whole = saved.read_bytes()
    for at in np.random.default_rng(1).integers(0, len(whole), 12):
        spoiled = bytearray(whole)
        spoiled[at] ^= 0x40
        saved.write_bytes(bytes(spoiled))
        try:
            loaded = load_model(saved)
        except ModelError:
            continue
        assert np.array_equal(loaded.mean_mm, model.mean_mm)
        assert np.array_equal(loaded.components, model.components)


def test_an_origin_of_unprintable_or_endless_texts_cannot_be_made():
    for text in ("a\nb", "x" * 201, 3):
        with pytest.raises(InvalidValueError, match="patient"):
            ModelOrigin(patient=text)


def test_a_reference_is_as_uncertain_as_it_lies_far_from_the_middle_of_the_training(model):
    at_rest_mm, away_mm, other_mm = (model.zero_error_mm(np.array(at)) for at in ([0, 0], [900, 0, 5], [900, 60, 0]))
    assert 0.0 < at_rest_mm < 0.03
    assert away_mm == pytest.approx(np.hypot(0.18, at_rest_mm))
    assert other_mm == pytest.approx(np.hypot(0.3, away_mm))
    assert np.isnan(replace(model, shape_errors=None).zero_error_mm(np.zeros(2)))
