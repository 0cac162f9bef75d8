"""Convert a calibration of any supported format to our own; the content decides the format, not the name.

The command line and the API read with the same functions. Several files, or what belongs beside them, come over the API
in one JSON document, ``tidegate.calibration-import/1``: ``files`` (their texts), and where needed ``camera``,
``first_camera``, ``translation_unit``, ``image_size_px``, ``baseline_mm``, ``depth_to_color``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TypeVar

from engine.calibration.camera_calibration import SCHEMA, STRICT, Calibration, parse_calibration
from engine.calibration.formats import opencv_storage, ros_camera_info
from engine.calibration.formats.builder import LENGTH_UNITS, ROLES, Draft, ImportOptions
from engine.calibration.formats.documents import Tree, read_documents
from engine.core.errors import CalibrationError
from engine.core.strict_json import ROOT

IMPORT_SCHEMA = "tidegate.calibration-import/1"
FORMATS = (SCHEMA, opencv_storage.FORMAT, ros_camera_info.FORMAT)
MAX_FILES = 4
ChoiceT = TypeVar("ChoiceT", bound=str)
_NOT_OURS = (
    f"a {SCHEMA} document, an OpenCV FileStorage with M1 D1 M2 D2 R T or depth_camera_matrix and so on, or two ROS "
    "camera_info files"
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Converted:
    """A calibration, its original format, and remarks on the conversion."""

    calibration: Calibration
    format: str
    notes: tuple[str, ...] = ()


def read_upload(body: bytes) -> Converted:
    """Read what was uploaded: a calibration in one file, or the JSON document that holds several.

    Raises
    ------
    CalibrationError
        Not understood, ambiguous, or not possible; names field, value and bound.
    """
    documents = read_documents(body)
    if len(documents) == 1 and isinstance(documents[0], dict) and documents[0].get("schema") == IMPORT_SCHEMA:
        beside = tuple(each.name for each in fields(ImportOptions))
        envelope = STRICT.fields(ROOT, documents[0], required=("schema", "files"), optional=beside)
        texts = STRICT.items("files", envelope["files"], 1, MAX_FILES)
        files = [_file_text(i, text) for i, text in enumerate(texts)]
        return convert(files, options_of(envelope))
    return convert([body], ImportOptions())


def convert(files: Sequence[bytes], options: ImportOptions) -> Converted:
    """Read a calibration from the contents of one or more files.

    Raises
    ------
    CalibrationError
        Not understood, ambiguous, or not possible; names field, value and bound.
    """
    if not 1 <= len(files) <= MAX_FILES:
        raise CalibrationError("files", f"{len(files)} files", f"1 to {MAX_FILES} files")
    trees = [tree for file in files for tree in read_documents(file) if tree != ""]
    objects = [tree for tree in trees if isinstance(tree, dict)]
    if not objects or len(objects) != len(trees):
        raise CalibrationError(ROOT, trees[0] if trees else "empty", _NOT_OURS)
    if _is_ours(objects):
        return _ours(files, objects, options)
    if any(ros_camera_info.is_camera_info(tree) for tree in objects):
        return _finished(ros_camera_info.draft_of(objects, options), ros_camera_info.FORMAT)
    if any(opencv_storage.is_storage(tree) for tree in objects):
        return _finished(opencv_storage.draft_of(objects, options), opencv_storage.FORMAT)
    raise CalibrationError(ROOT, sorted(objects[0])[:6], _NOT_OURS)


def _finished(draft: Draft, name: str) -> Converted:
    return Converted(calibration=draft.finish(), format=name, notes=tuple(draft.notes))


def _is_ours(objects: list[dict[str, Tree]]) -> bool:
    return any("schema" in tree or {"depth", "color"} <= tree.keys() for tree in objects)


def _ours(files: Sequence[bytes], objects: list[dict[str, Tree]], options: ImportOptions) -> Converted:
    if len(objects) != 1:
        raise CalibrationError("files", f"{len(objects)} documents", f"one, as {SCHEMA} is complete")
    if options != ImportOptions():
        given = next(each.name for each in fields(options) if getattr(options, each.name) is not None)
        raise CalibrationError(given, getattr(options, given), f"left out: {SCHEMA} contains it")
    return Converted(calibration=parse_calibration(files[0]), format=SCHEMA)


def _file_text(index: int, text: object) -> bytes:
    if not isinstance(text, str):
        raise CalibrationError(f"files[{index}]", text, "the text of a file")
    return text.encode(errors="replace")


def options_of(beside: Mapping[str, object]) -> ImportOptions:
    """Return the values given beside the files, None for absent ones; raise CalibrationError."""
    size = beside.get("image_size_px")
    pose = beside.get("depth_to_color")
    baseline = beside.get("baseline_mm")
    camera = beside.get("camera")
    return ImportOptions(
        camera=None if camera is None else STRICT.name("camera", camera),
        first_camera=_one_of("first_camera", beside.get("first_camera"), ROLES),
        translation_unit=_one_of("translation_unit", beside.get("translation_unit"), LENGTH_UNITS),
        image_size_px=None if size is None else _size("image_size_px", size),
        baseline_mm=None if baseline is None else STRICT.number("baseline_mm", baseline, -200.0, 200.0),
        depth_to_color=None if pose is None else _pose("depth_to_color", pose),
    )


def _one_of(field: str, value: object, allowed: tuple[ChoiceT, ...]) -> ChoiceT | None:
    if value is None:
        return None
    for choice in allowed:
        if value == choice:
            return choice
    raise CalibrationError(field, value, " or ".join(allowed))


def _size(field: str, value: object) -> tuple[int, int]:
    pair = STRICT.items(field, value, 2, 2)
    width, height = (STRICT.integer(f"{field}[{i}]", side, 1, 4096) for i, side in enumerate(pair))
    return width, height


def _pose(field: str, value: object) -> dict[str, object]:
    return dict(STRICT.fields(field, value, required=("rotation", "translation_mm")))
