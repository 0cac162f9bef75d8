"""OpenCV FileStorage: the names of OpenCV's own ``stereo_calib`` sample, or names that identify the cameras.

======================================  ===============================================================
``M1 D1 M2 D2 R T``                     as ``stereo_calib`` writes them (intrinsics.yml and extrinsics.yml, given
                                        together); X_2 = R X_1 + T. Which camera is the first is nowhere in them:
                                        ``first_camera`` (``depth`` or ``color``) has to be said, in a file or beside it
``depth_camera_matrix`` ``depth_distortion``  and the same with ``color_``; ``rotation`` and ``translation`` (or R, T)
                                        with X_color = R X_depth + T
``image_width`` ``image_height``        of both cameras, or ``image_size: [w, h]``, or ``depth_image_width`` and so on
``translation_unit``                    ``mm`` or ``m``; optional where the length determines it
``camera``                              the camera's name
======================================  ===============================================================
"""

from engine.calibration.formats import documents
from engine.calibration.formats.builder import LENGTH_UNITS, ROLES, Draft, ImportOptions, LengthUnit, Role, length_in_mm
from engine.calibration.formats.documents import Tree
from engine.core.errors import CalibrationError
from engine.core.frames import FloatArray
from engine.core.geometry import RigidTransform

FORMAT = "opencv-filestorage"
_MATRICES = {role: f"{role}_camera_matrix" for role in ROLES}
_DISTORTIONS = {role: (f"{role}_distortion", f"{role}_distortion_coefficients") for role in ROLES}
_NUMBERED = {"M1", "D1", "M2", "D2"}
_SIZES = {"image_width", "image_height", "image_size"}
_OWN_SIZES = {f"{role}_image_{side}" for role in ROLES for side in ("width", "height")}
_POSE = {"R", "T", "rotation", "translation"}
_SAID = {"translation_unit", "first_camera", "camera"}
_NAMED = {*_MATRICES.values(), *(name for names in _DISTORTIONS.values() for name in names)}
# Fields that OpenCV's samples write besides, not needed here.
_BESIDE = {
    *("E", "F", "R1", "R2", "P1", "P2", "Q", "calibration_time", "nframes", "nr_of_frames", "board_width"),
    *("board_height", "square_size", "aspectRatio", "flags", "avg_reprojection_error", "per_view_reprojection_errors"),
}
KNOWN = _NUMBERED | _NAMED | _SIZES | _OWN_SIZES | _POSE | _SAID | _BESIDE


def is_storage(tree: dict[str, Tree]) -> bool:
    """Whether a document has a camera matrix or a pose by one of the names."""
    return bool(tree.keys() & (_NUMBERED | _NAMED | _POSE))


def draft_of(trees: list[dict[str, Tree]], options: ImportOptions) -> Draft:
    """Draft our document from one or more files together; raise CalibrationError."""
    tree = _merged(trees)
    documents.refuse_unknown(tree.keys(), KNOWN)
    draft = Draft()
    draft.put("camera", _given(tree, "camera", options.camera), "camera")
    is_numbered = bool(tree.keys() & _NUMBERED)
    if is_numbered and tree.keys() & _NAMED:
        name = next(iter(tree.keys() & _NAMED))
        raise CalibrationError(name, "given beside M1, D1, M2, D2", "given instead of them")
    first = _first_camera(tree, options) if is_numbered else "depth"
    for role in ROLES:
        matrix_name = f"M{_number(role, first)}" if is_numbered else _MATRICES[role]
        names = (f"D{_number(role, first)}",) if is_numbered else _DISTORTIONS[role]
        _put_camera(draft, role, tree, matrix_name, names)
        _put_size(draft, role, tree, options)
    _put_pose(draft, tree, options, is_depth_first=first == "depth")
    return draft


def _merged(trees: list[dict[str, Tree]]) -> dict[str, Tree]:
    merged: dict[str, Tree] = {}
    for tree in trees:
        for key, value in tree.items():
            if key in merged:
                raise CalibrationError(key[:80], "given in two files", "given in one")
            merged[key] = value
    return merged


def _number(role: Role, first: Role) -> int:
    return 1 if role == first else 2


def _given(tree: dict[str, Tree], key: str, option: str | None) -> str:
    """Return the value from the file or the user; raise CalibrationError for both or neither."""
    if key in tree and option is not None:
        raise CalibrationError(key, option, "left out: the file contains it")
    if key in tree:
        return documents.text(key, tree[key])
    if option is None:
        raise CalibrationError(key, "missing", "given, in the file or beside it")
    return option


def _first_camera(tree: dict[str, Tree], options: ImportOptions) -> Role:
    said = tree.get("first_camera", options.first_camera)
    for role in ROLES:
        if said == role:
            return role
    bound = "depth or color: whether M1 is the depth or the colour camera is nowhere in these names"
    raise CalibrationError("first_camera", "missing" if said is None else said, bound)


def _put_camera(
    draft: Draft, role: Role, tree: dict[str, Tree], matrix_name: str, distortion_names: tuple[str, ...]
) -> None:
    draft.put_camera(role, documents.camera_matrix(matrix_name, _matrix(tree, matrix_name)), matrix_name)
    given = [name for name in distortion_names if name in tree]
    if len(given) > 1:
        raise CalibrationError(given[1], f"given beside {given[0]}", "given once")
    name = given[0] if given else distortion_names[0]
    value = _matrix(tree, name)
    if 1 not in value.shape:
        raise CalibrationError(name, f"{value.shape[0]} x {value.shape[1]}", "one row or one column")
    draft.put(f"{role}.distortion", documents.distortion(name, value.ravel().tolist()), name)


def _put_size(draft: Draft, role: Role, tree: dict[str, Tree], options: ImportOptions) -> None:
    for index, side in enumerate(("width", "height")):
        own, shared = f"{role}_image_{side}", f"image_{side}"
        given: dict[str, Tree] = {name: tree[name] for name in (own, shared) if name in tree}
        if "image_size" in tree:
            given["image_size"] = _pair("image_size", tree["image_size"])[index]
        if options.image_size_px is not None:
            given["size"] = options.image_size_px[index]
        if not given:
            raise CalibrationError(own, "missing", f"given, or {shared}, or the size beside the file")
        if len(given) > 1:
            raise CalibrationError(list(given)[1], f"given beside {next(iter(given))}", "given once")
        name, value = next(iter(given.items()))
        draft.put(f"{role}.{side}", documents.whole(name, value), name)


def _pair(field: str, value: Tree) -> list[float]:
    pair = documents.numbers(field, value)
    if len(pair) != 2:
        raise CalibrationError(field, value, "width and height")
    return pair


def _put_pose(draft: Draft, tree: dict[str, Tree], options: ImportOptions, *, is_depth_first: bool) -> None:
    has_pose = bool(tree.keys() & _POSE)
    if options.baseline_mm is not None or options.depth_to_color is not None:
        if has_pose:
            name = next(iter(tree.keys() & _POSE))
            raise CalibrationError(name, "given beside another pose", "the only pose")
        draft.put_given_pose(options)
        return
    rotation_name, translation_name = (_one_of(tree, *names) for names in (("R", "rotation"), ("T", "translation")))
    rotation = documents.shaped(rotation_name, _matrix(tree, rotation_name), (3, 3))
    raw = documents.shaped(translation_name, _matrix(tree, translation_name), (3, 1), (1, 3)).ravel()
    translation_mm = length_in_mm(translation_name, raw, _unit(tree, options), draft.notes)
    pose = RigidTransform(rotation=rotation, translation_mm=translation_mm)
    if not is_depth_first:
        pose = pose.inverse
        draft.notes.append(f"{rotation_name} and {translation_name} lead from colour to depth: turned round")
    draft.put_pose(pose.rotation, pose.translation_mm, names=(rotation_name, translation_name))


def _one_of(tree: dict[str, Tree], short: str, long: str) -> str:
    if short in tree and long in tree:
        raise CalibrationError(long, f"given beside {short}", "given once")
    return long if long in tree else short


def _unit(tree: dict[str, Tree], options: ImportOptions) -> LengthUnit | None:
    said = tree.get("translation_unit", options.translation_unit)
    if said is None:
        return None
    if said == "mm":
        return "mm"
    if said == "m":
        return "m"
    raise CalibrationError("translation_unit", said, " or ".join(LENGTH_UNITS))


def _matrix(tree: dict[str, Tree], name: str) -> FloatArray:
    if name not in tree:
        raise CalibrationError(name, "missing", "given")
    return documents.matrix(name, tree[name])
