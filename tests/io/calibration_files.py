"""Calibrations and extrinsics as KITTI, OpenCV, ROS, Kalibr and plain files write them."""

from __future__ import annotations

import cv2
import numpy as np

KITTI = """P0: 700 0 600 0 0 700 170 0 0 0 1 0
P2: 700 0 600 42 0 700 170 -0.35 0 0 1 0.005
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27
Tr_imu_to_velo: 1 0 0 -0.8 0 1 0 0.3 0 0 1 -0.8
"""


PLAIN = """# a comment
K: [[500.5, 0, 320], [0, 501, 240],
    [0, 0, 1]]
R: [0, -1, 0, 0, 0, -1, 1, 0, 0]
t: [0.1, -0.2, -0.3]   # metres
distortion: [-0.02, 0.01, -0.003, 0.001]
size: [640, 480]
lens: fisheye
"""


K = [[500.5, 0, 320], [0, 501, 240], [0, 0, 1]]


ROS = """image_width: 640
image_height: 480
camera_matrix: {{rows: 3, cols: 3, data: [500.5, 0, 320, 0, 501, 240, 0, 0, 1]}}
distortion_model: {model}
distortion_coefficients: {{rows: 1, cols: 5, data: {data}}}
rectification_matrix: {{rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}}
"""


TOPIC = """height: 480
width: 640
distortion_model: plumb_bob
d: [-0.1, 0.02, 0.001, -0.002, 0.01]
k: [500.5, 0.0, 320.0, 0.0, 501.0, 240.0, 0.0, 0.0, 1.0]
---
height: 480
"""


KALIBR = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.02, 0.01, -0.003, 0.001]
  distortion_model: equidistant
  intrinsics: [500.5, 501, 320, 240]
  resolution: [640, 480]
cam1:
  T_cam_lidar: [[0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3], [0, 0, 0, 1]]
  camera_model: pinhole
  distortion_coeffs: [-0.1, 0.02, 0.001, -0.002]
  distortion_model: radtan
  intrinsics: [500.5, 501, 320, 240]
  resolution: [640, 480]
"""


POSES = {
    "matrix of 16": "0 -1 0 0.1\n0 0 -1 -0.2\n1 0 0 -0.3\n0 0 0 1\n",
    "matrix of 12": "[[0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3]]  # by rows",
    "quaternion": "0.1 -0.2 -0.3 0.5 -0.5 0.5 0.5",
    "tf": "transforms:\n- transform:\n    translation: {x: 0.1, y: -0.2, z: -0.3}\n"
    "    rotation: {x: 0.5, y: -0.5, z: 0.5, w: 0.5}\n",
}


def opencv_file(coefficients: list[float], **others: int) -> str:
    file = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for name, value in {"image_width": 640, "image_height": 480, **others}.items():
        file.write(name, value)
    file.write("camera_matrix", np.array(K))
    file.write("distortion_coefficients", np.array(coefficients)[:, None])
    return file.releaseAndGetString()


FIVE = [-0.1, 0.02, 0.001, -0.002, 0.01]


FOUR = [-0.02, 0.01, -0.003, 0.001]
