"""A lens with eight terms, as Femto cameras have, on the five of a calibration: a point is seen on the same pixel."""

from types import SimpleNamespace

import cv2
import numpy as np

from engine.capture.orbbec.camera import _intrinsics

# A Femto Bolt's depth camera at 640 x 576, as its makers publish one.
GIVEN = SimpleNamespace(width=640, height=576, fx=504.1, fy=504.2, cx=321.5, cy=330.2)
LENS = {"k1": 5.6, "k2": 3.5, "p1": 1e-5, "p2": -4e-5, "k3": 0.17, "k4": 5.9, "k5": 5.1, "k6": 0.9}


def test_the_middle_of_the_picture_is_seen_where_the_maker_sees_it():
    profile = SimpleNamespace(get_intrinsic=lambda: GIVEN, get_distortion=lambda: SimpleNamespace(**LENS))
    ours = _intrinsics(profile)
    matrix = np.array([[GIVEN.fx, 0, GIVEN.cx], [0, GIVEN.fy, GIVEN.cy], [0, 0, 1.0]])
    points = np.random.default_rng(2).uniform((-250.0, -250.0, 800.0), (250.0, 250.0, 1200.0), (300, 3))
    order = [LENS[name] for name in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")]
    wanted = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(order))[0].reshape(-1, 2)
    assert np.abs(ours.project(points) - wanted).max() < 0.15
