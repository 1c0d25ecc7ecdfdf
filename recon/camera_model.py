"""The pinhole camera with Brown-Conrady distortion: pixels to rays and back.

Model and parameter order are OpenCV's and ROS's ``plumb_bob`` (k1 k2 p1 p2 k3). The paper
keeps the radial part only (section 2.1); ``skyrelief calibrate`` does so by default.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt

from recon.types import F64, U8, Camera


def check_camera(camera: Camera) -> None:
    """Raise ValueError, naming the fault, unless ``camera`` is a usable model."""
    W, H = camera.size_px
    if W < 16 or H < 16:
        raise ValueError(f"image size {W}x{H} is too small")
    K, distortion = camera.K, camera.distortion
    if not isinstance(K, np.ndarray) or not isinstance(distortion, np.ndarray):
        raise ValueError("K and distortion must be arrays of NumPy")
    if K.shape != (3, 3) or distortion.shape != (5,):
        raise ValueError(f"K must be (3, 3) and distortion (5,), got {K.shape}, {distortion.shape}")
    if not np.isfinite(camera.K).all() or not np.isfinite(camera.distortion).all():
        raise ValueError("K and distortion must be finite numbers")
    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    if fx <= 0 or fy <= 0:
        raise ValueError(f"focal lengths must be positive, got fx={fx:g}, fy={fy:g}")
    if not (0.2 < fx / fy < 5.0):
        raise ValueError(f"fx={fx:g} and fy={fy:g} differ beyond any real camera")
    if not (-W < cx < 2 * W and -H < cy < 2 * H):
        raise ValueError(f"principal point ({cx:g}, {cy:g}) lies far outside {W}x{H}")


def scaled(camera: Camera, size_px: tuple[int, int]) -> Camera:
    """The same camera for its image resized to ``size_px`` (W, H); pixel centres at integers."""
    sx, sy = size_px[0] / camera.size_px[0], size_px[1] / camera.size_px[1]
    return replace(camera, K=scaled_K(camera.K, sx, sy), size_px=size_px)


def scaled_K(K: F64, sx: float, sy: float) -> F64:
    """(3, 3) intrinsics after resizing by ``sx``, ``sy`` with pixel centres at integers."""
    S = np.array([[sx, 0.0, 0.5 * sx - 0.5], [0.0, sy, 0.5 * sy - 0.5], [0.0, 0.0, 1.0]])
    return np.asarray(S @ K)


def rays(K: F64, uv_px: F64) -> F64:
    """(N, 3) directions with z = 1 in the camera frame, of undistorted pixels (N, 2)."""
    x = (uv_px[:, 0] - K[0, 2]) / K[0, 0]
    y = (uv_px[:, 1] - K[1, 2]) / K[1, 1]
    return np.stack([x, y, np.ones_like(x)], axis=1)


def project(K: F64, xyz_m: F64) -> F64:
    """(N, 2) undistorted pixels of (N, 3) points in the camera frame; NaN behind the camera."""
    z = np.where(xyz_m[:, 2] > 1e-9, xyz_m[:, 2], np.nan)
    return np.stack(
        [K[0, 0] * xyz_m[:, 0] / z + K[0, 2], K[1, 1] * xyz_m[:, 1] / z + K[1, 2]], axis=1
    )


class Undistorter:
    """Takes images of a distorted camera to the same camera without distortion.

    The undistorted camera keeps K and the size of the original; pixels that the original
    does not see come out black and are zero in :attr:`valid`.
    """

    def __init__(self, camera: Camera) -> None:
        """Build the maps for ``camera``; raises ValueError when it is not a usable model."""
        check_camera(camera)
        self.camera = Camera(camera.K, np.zeros(5), camera.size_px)
        self._maps: tuple[npt.NDArray[np.int16], npt.NDArray[np.uint16]] | None = None
        self.valid: U8 = np.full((camera.size_px[1], camera.size_px[0]), 255, np.uint8)
        if np.any(camera.distortion):
            u_px, v_px = cv2.initUndistortRectifyMap(
                camera.K, camera.distortion, np.eye(3), camera.K, camera.size_px, cv2.CV_16SC2
            )  # fixed point in 1/32 px, as remap rounds to anyway
            self._maps = np.asarray(u_px, np.int16), np.asarray(v_px, np.uint16)
            seen = cv2.remap(self.valid, *self._maps, cv2.INTER_LINEAR)
            self.valid = np.where(seen == 255, 255, 0).astype(np.uint8)

    def image(self, image: U8) -> U8:
        """(H, W, 3) or (H, W) image without distortion."""
        if image.shape[:2] != (self.camera.size_px[1], self.camera.size_px[0]):
            raise ValueError(f"image {image.shape} is not of size (W, H) {self.camera.size_px}")
        if self._maps is None:
            return image
        return np.asarray(cv2.remap(image, *self._maps, cv2.INTER_LINEAR), dtype=np.uint8)
