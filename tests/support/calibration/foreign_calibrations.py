"""Calibrations as OpenCV and ROS write them, made from a known pair of cameras."""

import json
from pathlib import Path

import cv2
import numpy as np
import yaml

from engine.calibration.camera_calibration import Calibration
from engine.core.geometry import Intrinsics, RigidTransform

TURN, _ = cv2.Rodrigues(np.array([0.004, -0.011, 0.006]))
CAMERAS = Calibration(
    camera="bench 7",
    depth=Intrinsics(
        width=640, height=480, fx=575.5, fy=576.25, cx=316.0, cy=243.5, distortion=(-0.03, 0.02, 1e-5, -2e-4, 0.0)
    ),
    color=Intrinsics(
        width=1280, height=1024, fx=1055.0, fy=1054.5, cx=640.5, cy=510.0, distortion=(0.08, -0.19, 5e-4, 1e-3, 0.125)
    ),
    color_from_depth=RigidTransform(rotation=TURN, translation_mm=np.array([25.0, -0.5, 1.25])),
)
SIZES = {
    "depth_image_width": 640,
    "depth_image_height": 480,
    "color_image_width": 1280,
    "color_image_height": 1024,
}


def storage_values(*, unit_mm: float = 1.0, first: str = "depth") -> dict[str, object]:
    """What ``stereo_calib`` would have found, with sizes, as names to arrays."""
    pose = CAMERAS.color_from_depth if first == "depth" else CAMERAS.color_from_depth.inverse
    cameras = (CAMERAS.depth, CAMERAS.color) if first == "depth" else (CAMERAS.color, CAMERAS.depth)
    values: dict[str, object] = {}
    for number, camera in enumerate(cameras, start=1):
        values |= {f"M{number}": camera.matrix, f"D{number}": np.array([camera.distortion])}
    return values | {"R": pose.rotation, "T": pose.translation_mm.reshape(3, 1) / unit_mm, **SIZES}


def write_storage(path: Path, values: dict[str, object]) -> bytes:
    """Let OpenCV write them; the suffix chooses YAML, XML or JSON."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in values.items():
        storage.write(name, value)
    storage.release()
    return path.read_bytes()


def camera_info(camera: Intrinsics, name: str, *, shift_m: float = 0.0, turn=None) -> dict[str, object]:
    """One camera as ROS stores it; rectified by ``turn``, and shifted there."""
    projection = np.column_stack([camera.matrix, [shift_m * camera.fx, 0.0, 0.0]])
    matrices = {
        "camera_matrix": camera.matrix,
        "distortion_coefficients": np.array([camera.distortion]),
        "rectification_matrix": np.eye(3) if turn is None else turn,
        "projection_matrix": projection,
    }
    return {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": name,
        "distortion_model": "plumb_bob",
        **{key: ros_matrix(value) for key, value in matrices.items()},
    }


def ros_matrix(value) -> dict[str, object]:
    rows, columns = value.shape
    return {"rows": rows, "cols": columns, "data": value.ravel().tolist()}


def as_yaml(document: dict[str, object]) -> bytes:
    return yaml.safe_dump(document).encode()


def echoed(document: dict[str, object]) -> dict[str, object]:
    """The same as the message is echoed."""
    return {
        "header": {"seq": 4, "frame_id": document["camera_name"]},
        "width": document["image_width"],
        "height": document["image_height"],
        "distortion_model": document["distortion_model"],
        "D": document["distortion_coefficients"]["data"],
        "K": document["camera_matrix"]["data"],
        "R": document["rectification_matrix"]["data"],
        "P": document["projection_matrix"]["data"],
        "binning_x": 0,
        "binning_y": 0,
        "roi": {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False},
    }


def ros_pair(**changes: object) -> list[bytes]:
    """Two files, rectified together, which leads to :data:`CAMERAS`' pose without its y and z."""
    depth = camera_info(CAMERAS.depth, "depth_PS1080")
    color = camera_info(CAMERAS.color, "rgb_PS1080", shift_m=0.025, turn=TURN.T)
    return [as_yaml(depth), as_yaml(color | changes)]


def import_document(files: list[bytes], **beside: object) -> bytes:
    texts = [file.decode() for file in files]
    return json.dumps({"schema": "tidegate.calibration-import/1", "files": texts, **beside}).encode()
