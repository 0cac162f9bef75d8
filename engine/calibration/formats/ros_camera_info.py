"""A pair of ROS ``camera_info`` files, one a camera: as calibration tools store them, or as the message is echoed.

The depth camera's is found by ``camera_name`` (or the header's ``frame_id``): depth or ir, rgb or color as a word
of its own; else ``first_camera`` has to be said. The pose between the cameras is in neither, unless both were rectified
together: then the fourth column of a projection matrix, Tx = -fx' B in metres, and the two rectifications give it.
Otherwise it has to be given.
"""

import re
from dataclasses import dataclass

import numpy as np

from engine.calibration.camera_calibration import MAX_BASELINE_MM, MIN_BASELINE_MM
from engine.calibration.formats import documents
from engine.calibration.formats.builder import (
    MM_PER_M,
    ROLES,
    Draft,
    ImportOptions,
    Role,
)
from engine.calibration.formats.documents import Tree
from engine.core.errors import CalibrationError
from engine.core.frames import FloatArray

FORMAT = "ros-camera-info"
_WORDS: dict[str, Role] = {
    "depth": "depth",
    "ir": "depth",
    "infrared": "depth",
    "rgb": "color",
    "color": "color",
    "colour": "color",
}
_STORED = {
    *("image_width", "image_height", "camera_name", "camera_matrix", "distortion_model", "distortion_coefficients"),
    *("rectification_matrix", "projection_matrix"),
}
_ECHOED = {"header", "width", "height", "distortion_model", "D", "K", "R", "P", "binning_x", "binning_y", "roi"}
_MODELS = ("plumb_bob", "rational_polynomial")
_SHAPES = {"K": (3, 3), "R": (3, 3), "P": (3, 4)}
_IDENTITY_TOLERANCE = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Info:
    """One camera's file; ``label`` identifies it in refusals."""

    label: str
    name: str
    fields: dict[str, Tree]
    keys: dict[str, str]

    def their(self, key: str) -> str:
        """Name a field as the file does."""
        return f"{self.label}.{self.keys[key]}"

    def get(self, key: str) -> Tree:
        """Find a field by its name in the message."""
        if self.keys[key] not in self.fields:
            raise CalibrationError(self.their(key), "missing", "given")
        return self.fields[self.keys[key]]

    def matrix(self, key: str) -> FloatArray:
        """Take K, R or P."""
        value = self.get(key)
        if isinstance(value, list):
            entries = documents.numbers(self.their(key), value)
            rows, columns = _SHAPES[key]
            if len(entries) != rows * columns:
                raise CalibrationError(self.their(key), f"{len(entries)} numbers", f"{rows * columns} numbers")
            return np.array(entries).reshape(rows, columns)
        return documents.shaped(self.their(key), documents.matrix(self.their(key), value), _SHAPES[key])

    def has(self, key: str) -> bool:
        """Whether the file has a field."""
        return self.keys[key] in self.fields


def is_camera_info(tree: dict[str, Tree]) -> bool:
    """Whether a document has the keys of a ``camera_info``."""
    is_stored = {"camera_matrix", "image_width"} <= tree.keys() and bool(
        tree.keys() & {"distortion_model", "projection_matrix", "rectification_matrix"}
    )
    return is_stored or {"K", "P", "width"} <= tree.keys() or {"k", "p", "width"} <= tree.keys()


def draft_of(trees: list[dict[str, Tree]], options: ImportOptions) -> Draft:
    """Draft our document from two files; raise CalibrationError."""
    if len(trees) != 2:
        raise CalibrationError("files", f"{len(trees)} camera_info", "two: the depth and the colour camera's")
    if options.translation_unit is not None:
        raise CalibrationError("translation_unit", options.translation_unit, "left out: camera_info is in metres")
    if options.image_size_px is not None:
        raise CalibrationError("size", options.image_size_px, "left out: camera_info has it")
    draft = Draft()
    infos = _assigned([_info(i, tree) for i, tree in enumerate(trees)], options, draft)
    name = options.camera or infos["color"].name or infos["depth"].name
    if not name:
        raise CalibrationError("camera", "missing", "given beside the files")
    draft.put("camera", name, "camera" if options.camera else infos["color"].their("name"))
    for role, info in infos.items():
        _put_camera(draft, role, info)
    _put_pose(draft, infos["depth"], infos["color"], options)
    return draft


def _info(index: int, tree: dict[str, Tree]) -> _Info:
    label = f"files[{index}]"
    if "camera_matrix" in tree:
        documents.refuse_unknown(tree.keys(), _STORED, prefix=f"{label}.")
        keys = {"width": "image_width", "height": "image_height", "name": "camera_name", "K": "camera_matrix"}
        keys |= {"D": "distortion_coefficients", "R": "rectification_matrix", "P": "projection_matrix"}
        name = documents.text(f"{label}.camera_name", tree.get("camera_name", ""))
    else:
        is_lower = "k" in tree
        known = {key.lower() if is_lower else key for key in _ECHOED}
        documents.refuse_unknown(tree.keys(), known, prefix=f"{label}.")
        keys = {key: key.lower() if is_lower else key for key in ("D", "K", "R", "P", "width", "height")}
        keys["name"] = "header.frame_id"
        header = tree.get("header")
        name = (
            documents.text(f"{label}.header.frame_id", header.get("frame_id", "")) if isinstance(header, dict) else ""
        )
        _refuse_part(label, tree)
    return _Info(label=label, name=name[:80], fields=tree, keys=keys)


def _refuse_part(label: str, tree: dict[str, Tree]) -> None:
    """Refuse a camera that sends only a part of its picture, or a coarser one."""
    for key in ("binning_x", "binning_y"):
        if documents.whole(f"{label}.{key}", tree.get(key, 0)) > 1:
            raise CalibrationError(f"{label}.{key}", tree[key], "0 or 1: the whole picture")
    roi = tree.get("roi")
    for key, value in roi.items() if isinstance(roi, dict) else ():
        if key != "do_rectify" and documents.whole(f"{label}.roi.{key}", value) != 0:
            raise CalibrationError(f"{label}.roi.{key}", value, "0: the whole picture")


def _assigned(infos: list[_Info], options: ImportOptions, draft: Draft) -> dict[Role, _Info]:
    """Assign the files to the depth and the colour camera."""
    roles = [_role_of(info) for info in infos]
    first = options.first_camera
    if first is None:
        if set(roles) != set(ROLES):
            bound = "depth or color: the names of the two files do not identify the cameras"
            names = " and ".join(info.name or "no name" for info in infos)
            raise CalibrationError("first_camera", f"missing, and the names are {names}", bound)
        return {role: info for role, info in zip(roles, infos, strict=True) if role is not None}
    for role in ROLES:
        if first == role and roles[0] in {role, None} and roles[1] != role:
            draft.notes.append(f"{infos[0].label} is the {role} camera's, as said")
            return {role: infos[0], ROLES[1 - ROLES.index(role)]: infos[1]}
    raise CalibrationError("first_camera", first, f"as in {infos[0].their('name')} ({infos[0].name})")


def _role_of(info: _Info) -> Role | None:
    found = {_WORDS[word] for word in re.split(r"[^a-z]+", info.name.lower()) if word in _WORDS}
    return found.pop() if len(found) == 1 else None


def _put_camera(draft: Draft, role: Role, info: _Info) -> None:
    for key in ("width", "height"):
        draft.put(f"{role}.{key}", documents.whole(info.their(key), info.get(key)), info.their(key))
    draft.put_camera(role, documents.camera_matrix(info.their("K"), info.matrix("K")), info.their("K"))
    model = info.fields.get("distortion_model")
    if model is None:
        draft.notes.append(f"{info.label} names no distortion model: taken as plumb_bob, as ROS does")
    elif model not in _MODELS:
        raise CalibrationError(f"{info.label}.distortion_model", model, " or ".join(_MODELS))
    value, name = info.get("D"), info.their("D")
    entries = (
        documents.matrix(name, value).ravel().tolist() if isinstance(value, dict) else documents.numbers(name, value)
    )
    draft.put(f"{role}.distortion", documents.distortion(name, entries), name)


def _put_pose(draft: Draft, depth: _Info, color: _Info, options: ImportOptions) -> None:
    offsets_m = {info.label: _offset_m(info) for info in (depth, color)}
    is_given = options.baseline_mm is not None or options.depth_to_color is not None
    is_in_files = any(offset.any() for offset in offsets_m.values())
    if is_given and is_in_files:
        field = "baseline_mm" if options.baseline_mm is not None else "depth_to_color"
        raise CalibrationError(field, "given", f"left out: {color.their('P')} or {depth.their('P')} has it")
    turns = {info.label: _rectification(info) for info in (depth, color)}
    if is_given:
        if options.baseline_mm is not None:
            _refuse_turned(turns, color)
        draft.put_given_pose(options)
        return
    name = color.their("P")
    if not is_in_files:
        bound = "a pose: Tx beside 0 in one of the two, or baseline_mm, or depth_to_color, given beside the files"
        raise CalibrationError(name, "without Tx", bound)
    # Both cameras turned into one common frame, there only shifted.
    shift_mm = (offsets_m[color.label] - offsets_m[depth.label]) * MM_PER_M
    length_mm = float(np.linalg.norm(shift_mm))
    if not MIN_BASELINE_MM <= length_mm <= MAX_BASELINE_MM:
        bound = f"a baseline of {MIN_BASELINE_MM:g} to {MAX_BASELINE_MM:g} mm (P is in metres)"
        raise CalibrationError(name, f"{length_mm:g} mm", bound)
    back = turns[color.label].T
    draft.put_pose(back @ turns[depth.label], back @ shift_mm, names=(color.their("R"), name))
    draft.notes.append(f"the pose comes from {name}, which is in metres, and the two rectifications")


def _offset_m(info: _Info) -> FloatArray:
    """Where the common rectified frame's origin lies in this camera's rectified frame [m], shape (3,)."""
    if not info.has("P"):
        return np.zeros(3)
    projection = info.matrix("P")
    name = info.their("P")
    if not projection[:, 3].any():
        return np.zeros(3)
    if projection[2, 3] != 0.0 or min(projection[0, 0], projection[1, 1]) <= 0.0:
        raise CalibrationError(name, projection.tolist(), "fx' 0 cx' Tx, 0 fy' cy' Ty, 0 0 1 0 with fx', fy' above 0")
    return np.array([projection[0, 3] / projection[0, 0], projection[1, 3] / projection[1, 1], 0.0])


def _rectification(info: _Info) -> FloatArray:
    return info.matrix("R") if info.has("R") else np.eye(3)


def _refuse_turned(turns: dict[str, FloatArray], color: _Info) -> None:
    """Refuse a baseline alone where the cameras were rectified: its axis is unknown."""
    for turn in turns.values():
        if np.abs(turn - np.eye(3)).max() > _IDENTITY_TOLERANCE:
            bound = "left out beside rectified cameras: give depth_to_color, the whole pose"
            raise CalibrationError("baseline_mm", f"given beside {color.their('R')}", bound)
