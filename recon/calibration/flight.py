"""The camera's focal length, centre and distortion from a flight itself, by bundle adjustment.

Poses, landmarks and one shared camera are adjusted at once (Levenberg-Marquardt of GTSAM, pixels
with a robust loss). What the flight's geometry tells of the camera is in the covariance: seen
straight down from one height, a longer focal length looks like a greater height.

Tangential terms (Brown, Decentering Distortion of Lenses, 1966) are found with the others: a lens
off its axis tilts the surface of each view its own way, and views of the same ground that are
turned to each other disagree. They and the centre nearly trade places, so neither is sure alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from recon.posegraph.factors import matrix, pose3
from recon.types import F64, Bool, Camera

I64 = npt.NDArray[np.int64]

FAR_OFF_M = 20.0
"""What a landmark may be off by beforehand."""

MIDDLE_SHARE = 0.8
"""Root mean square of the better nine tenths of pixels' errors over their sigma, a robust loss
allowed for."""


@dataclass(frozen=True, slots=True)
class SelfCalibrationConfig:
    """How far the camera may be off, and what is asked of the flight."""

    sigma_focal: float = 0.05  # of the focal length beforehand, as a share
    sigma_aspect: float = 5e-4  # of height over width of a pixel: one focal length holds for both
    sigma_centre: float = 0.015  # of the centre, as a share of the width
    sigma_k: float = 0.1  # of k1 and of k2
    sigma_p: float = 0.005  # of p1 and of p2
    most_sigma_focal: float = 0.003  # a focal length less sure than this is not told
    most_sigmas: float = 3.0  # from the model given; a camera further off is not believed
    pixel_sigma: float = 0.5
    huber_sigmas: float = 1.5
    gate_sigmas: float = 6.0  # sightings further off after the first round are left out
    least_sightings: int = 200
    iterations: int = 40

    def __post_init__(self) -> None:
        """Raise ValueError when a parameter makes no sense."""
        positive = ("sigma_focal", "sigma_centre", "sigma_k", "sigma_p", "most_sigma_focal")
        for name in (*positive, "pixel_sigma"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """Landmarks seen in distorted pictures of full size; one row of each array per sighting."""

    view: I64  # (M,) which pose
    landmark: I64  # (M,) which landmark
    uv_px: F64  # (M, 2)


@dataclass(frozen=True, slots=True, eq=False)
class SelfCalibrated:
    """What the flight tells of its camera."""

    camera: Camera
    sigma_focal: float  # as a share
    sigma_k: tuple[float, float]
    sigma_p: tuple[float, float]
    rms_before_px: float  # of the sightings' robust middle, with the camera given
    rms_after_px: float
    errors_px: F64  # (M,) of the sightings that took part, robust loss applied
    poses: F64  # (N, 4, 4) T_world_camera
    why_not: str  # empty when the camera may be believed


def self_calibrate(
    camera: Camera, poses: F64, landmarks: F64, seen: Sightings, fixes: F64, sigma_fixes: F64,
    config: SelfCalibrationConfig | None = None,
) -> SelfCalibrated:  # fmt: skip
    """The camera that explains the sightings best, with its sigmas.

    Args:
        camera: the model given, a start and a bound.
        poses: (N, 4, 4) T_world_camera to begin with; ``landmarks`` (P, 3) likewise, world.
        fixes: (N, 3) measured places of the cameras, NaN where there is none, with their
            sigmas ``sigma_fixes`` (N, 3) as of independent readings.

    Raises ValueError for too few sightings or shapes that do not fit.
    """
    config = config or SelfCalibrationConfig()
    if len(poses) < 3 or poses.shape[1:] != (4, 4) or fixes.shape != (len(poses), 3):
        raise ValueError(f"expected three poses (N, 4, 4) or more with fixes, got {poses.shape}")
    if len(seen.view) < config.least_sightings:
        raise ValueError(f"{len(seen.view)} sightings are too few; {config.least_sightings} needed")
    seen = _shared(seen, np.ones(len(seen.view), bool))
    first = _Bundle(camera, poses, landmarks, seen, fixes, sigma_fixes, config).solved()
    # Once more without wild sightings and with the pixels' own scatter, on which sigmas rest.
    sigma = float(np.clip(first.rms_after_px / MIDDLE_SHARE, 0.1, 2.0))
    config = replace(config, pixel_sigma=sigma)
    seen = _shared(seen, first.errors_px < config.gate_sigmas * sigma)
    return _Bundle(camera, poses, landmarks, seen, fixes, sigma_fixes, config).solved()


def _shared(seen: Sightings, kept: Bool) -> Sightings:
    """The sightings that are ``kept`` (M,), of landmarks that two or more of them show."""
    often = np.bincount(seen.landmark[kept], minlength=int(seen.landmark.max()) + 1)
    kept = kept & (often[seen.landmark] >= 2)
    return Sightings(seen.view[kept], seen.landmark[kept], seen.uv_px[kept])


class _Bundle:
    """The factors of one adjustment."""

    def __init__(
        self, camera: Camera, poses: F64, landmarks: F64, seen: Sightings, fixes: F64,
        sigma_fixes: F64, config: SelfCalibrationConfig,
    ) -> None:  # fmt: skip
        import gtsam

        self._gtsam, self._given, self._config = gtsam, camera, config
        self._count = len(poses)
        self._graph, self._start = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._key = int(gtsam.symbol("k", 0))
        for key, T in enumerate(poses):
            self._start.insert(key, pose3(T))
        loose = gtsam.noiseModel.Isotropic.Sigma(3, FAR_OFF_M)  # for those that rays leave open
        for k in np.unique(seen.landmark):
            place = np.asarray(landmarks[k], np.float64)
            self._start.insert(self._point(int(k)), place)
            self._graph.add(gtsam.PriorFactorPoint3(self._point(int(k)), place, loose))
        self._add_camera()
        self._add_fixes(poses, fixes, sigma_fixes)
        self._add_sightings(seen)

    def solved(self) -> SelfCalibrated:
        """The camera after the adjustment."""
        gtsam = self._gtsam
        settings = gtsam.LevenbergMarquardtParams()
        settings.setMaxIterations(self._config.iterations)
        settings.setRelativeErrorTol(1e-6)
        found = gtsam.LevenbergMarquardtOptimizer(self._graph, self._start, settings).optimize()
        spread = np.asarray(gtsam.Marginals(self._graph, found).marginalCovariance(self._key))
        model = np.asarray(found.atCal3DS2(self._key).vector(), np.float64)
        sigma = np.sqrt(np.diag(spread))
        camera = self._camera(model)
        focal = float(max(sigma[0], sigma[1]) / model[0])
        return SelfCalibrated(
            camera, focal, (float(sigma[5]), float(sigma[6])),
            (float(sigma[7]), float(sigma[8])),
            _middle(self._errors_px(self._start)), _middle(self._errors_px(found)),
            self._errors_px(found),
            np.array([matrix(found.atPose3(key)) for key in range(self._count)]),
            self._doubt(camera, focal),
        )  # fmt: skip

    def _doubt(self, camera: Camera, sigma_focal: float) -> str:
        """Why the camera is not to be believed; empty when it is."""
        c = self._config
        if sigma_focal > c.most_sigma_focal:
            return (
                f"the flight cannot tell the focal length (to {100 * sigma_focal:.1f} %, asked "
                f"{100 * c.most_sigma_focal:.1f} %): seen straight down from one height it looks "
                "like another height; fly two heights or an oblique turn"
            )
        off = abs(camera.K[0, 0] / self._given.K[0, 0] - 1.0) / c.sigma_focal
        shift = np.abs(camera.K[:2, 2] - self._given.K[:2, 2]).max()
        off = max(off, float(shift) / (c.sigma_centre * self._given.size_px[0]))
        bent = np.abs(camera.distortion[:4] - self._given.distortion[:4])
        off = max(off, float((bent / [c.sigma_k, c.sigma_k, c.sigma_p, c.sigma_p]).max()))
        if off > c.most_sigmas:
            return "the camera found is too far from the model given; calibrate with a chessboard"
        return ""

    def _camera(self, model: F64) -> Camera:
        """The camera of (fx, fy, skew, u0, v0, k1, k2, p1, p2)."""
        K = np.array([[model[0], 0.0, model[3]], [0.0, model[1], model[4]], [0.0, 0.0, 1.0]])
        distortion = self._given.distortion.copy()
        distortion[:4] = model[5:9]
        return replace(self._given, K=K, distortion=distortion)

    def _errors_px(self, values: Any) -> F64:
        """(M,) what each sighting is off by, of one coordinate; under a robust loss."""
        cost = [self._graph.at(i).error(values) for i in self._pixels]
        return np.asarray(np.sqrt(np.array(cost)) * self._config.pixel_sigma)

    def _point(self, k: int) -> int:
        return int(self._gtsam.symbol("l", k))

    def _add_camera(self) -> None:
        gtsam, c, given = self._gtsam, self._config, self._given
        K, d = given.K, given.distortion
        model = gtsam.Cal3DS2(K[0, 0], K[1, 1], 0.0, K[0, 2], K[1, 2], d[0], d[1], d[2], d[3])
        self._start.insert(self._key, model)
        f, centre = c.sigma_focal * K[0, 0], c.sigma_centre * given.size_px[0]
        held = 1e-6  # skew stays
        sigma = np.array([f, f, held, centre, centre, c.sigma_k, c.sigma_k, c.sigma_p, c.sigma_p])
        spread = np.diag(sigma**2)
        spread[0, 1] = spread[1, 0] = f * f - 0.5 * (c.sigma_aspect * K[0, 0]) ** 2
        noise = gtsam.noiseModel.Gaussian.Covariance(spread)
        self._graph.add(gtsam.PriorFactorCal3DS2(self._key, model, noise))

    def _add_fixes(self, poses: F64, fixes: F64, sigma_fixes: F64) -> None:
        gtsam = self._gtsam
        loose = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.2] * 3 + [20.0] * 3))
        self._graph.add(gtsam.PriorFactorPose3(0, pose3(poses[0]), loose))
        if not np.isfinite(fixes).all(axis=1).any():  # the scale has to be held by something
            span = float(np.linalg.norm(np.ptp(poses[:, :3, 3], axis=0)))
            fixes, sigma_fixes = poses[:, :3, 3], np.full((len(poses), 3), 0.05 * span)
        for key in np.flatnonzero(np.isfinite(fixes).all(axis=1)):
            noise = gtsam.noiseModel.Diagonal.Sigmas(np.maximum(sigma_fixes[key], 0.005))
            self._graph.add(gtsam.GPSFactor(int(key), fixes[key], noise))

    def _add_sightings(self, seen: Sightings) -> None:
        gtsam, c = self._gtsam, self._config
        noise = gtsam.noiseModel.Robust.Create(
            gtsam.noiseModel.mEstimator.Huber.Create(c.huber_sigmas),
            gtsam.noiseModel.Isotropic.Sigma(2, c.pixel_sigma),
        )
        first = self._graph.size()
        uv = without_k3(self._given, seen.uv_px)
        for view, landmark, at in zip(seen.view, seen.landmark, uv, strict=True):
            keys = int(view), self._point(int(landmark)), self._key
            self._graph.add(gtsam.GeneralSFMFactor2Cal3DS2(at, noise, *keys))
        self._pixels = range(first, self._graph.size())


def _middle(errors: F64) -> float:
    """Root mean square of the better nine tenths."""
    kept = np.sort(errors)[: max(1, int(0.9 * len(errors)))]
    return float(np.sqrt(np.mean(kept**2)))


def without_k3(camera: Camera, uv_px: F64) -> F64:
    """(M, 2) pixels as the camera would show them without its third radial term."""
    d = camera.distortion
    if d[4] == 0.0:
        return uv_px
    flat = cv2.undistortPoints(uv_px[:, None], camera.K, d).reshape(-1, 2)
    rays = np.column_stack([flat, np.ones(len(flat))])
    fewer = np.array([d[0], d[1], d[2], d[3], 0.0])
    out, _ = cv2.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), camera.K, fewer)
    return np.asarray(out.reshape(-1, 2), np.float64)
