"""The formats of stored files, by the name of their version: who changes one, names another version."""

import dataclasses
import json
import sys

import numpy as np
import pytest

from engine.motion.learning import model_file
from engine.offline.replay import encoding, tape_file
from service.storage.samples import layout
from tests.support.repository import ROOT

KEPT = ROOT / "tests/service/storage/formats.json"


def fields_of(known: type) -> dict[str, bool]:
    """Return a class's fields, and whether each has to be given."""
    missing = dataclasses.MISSING
    return {
        one.name: one.default is missing and one.default_factory is missing
        for one in dataclasses.fields(known)
        if one.init
    }


def samples() -> dict[str, list[str]]:
    return {one.name: [str(one.kind), one.unit, "optional" if one.is_optional else "always"] for one in layout.COLUMNS}


def model() -> dict[str, object]:
    arrays = {**model_file.ARRAYS, **model_file.OPTIONAL_ARRAYS}
    return {
        "arrays": {name: np.dtype(kind).name for name, kind in arrays.items()},
        "optional": sorted(model_file.OPTIONAL_ARRAYS),
        "header": sorted(model_file._REQUIRED),
    }


def tape() -> dict[str, dict[str, bool]]:
    return {
        name: fields_of(known) for name, known in sorted(encoding._CLASSES.items()) if dataclasses.is_dataclass(known)
    }


FORMATS = {layout.SCHEMA_NAME: samples, model_file.SCHEMA: model, tape_file.SCHEMA: tape}


@pytest.mark.parametrize("name", [layout.SCHEMA_NAME, model_file.SCHEMA])
def test_a_changed_file_has_another_version(name):
    """A department reads files of rooms that run another release."""
    assert json.loads(KEPT.read_text(encoding="utf-8"))[name] == FORMATS[name]()


def test_a_tape_of_this_version_can_still_be_read():
    """Older tapes lack a new field, so it needs a default; a field may neither be removed nor lose its default."""
    kept, now = json.loads(KEPT.read_text(encoding="utf-8"))[tape_file.SCHEMA], tape()
    assert kept.keys() <= now.keys()
    for name, fields in kept.items():
        assert fields.keys() <= now[name].keys(), name
        assert {field for field, is_needed in now[name].items() if is_needed and not fields.get(field)} == set(), name


if __name__ == "__main__":
    if sys.argv[1:] != ["--write"]:
        sys.exit("--write: keep the formats of today under the names of their versions")
    known = json.loads(KEPT.read_text(encoding="utf-8")) if KEPT.exists() else {}
    KEPT.write_text(json.dumps(known | {name: of() for name, of in FORMATS.items()}, indent=1) + "\n", encoding="utf-8")
