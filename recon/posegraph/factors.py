"""Factors of the adjustment that GTSAM does not bring, and conversions to its conventions.

GTSAM perturbs poses on the right; this package on the left. Both put the rotation first.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from recon import se3
from recon.types import F64

MAX_LOG = 20.0
"""Of a scale that a step of the solver may ask about."""


def right_covariance(T: F64, covariance: F64) -> F64:
    """(6, 6) covariance of the right perturbation of ``T`` from that of the left."""
    A = se3.adjoint(se3.inverse(T))
    return np.asarray(A @ covariance @ A.T)


def pose3(T: F64) -> Any:
    """The gtsam.Pose3 of ``T`` (4, 4), its rotation made exact."""
    import gtsam

    T = se3.project_to_so3(T)
    return gtsam.Pose3(gtsam.Rot3(T[:3, :3]), T[:3, 3])


def matrix(pose: Any) -> F64:
    """(4, 4) of a gtsam.Pose3."""
    return np.asarray(pose.matrix(), np.float64)


def whitened(factor: Any, noise: Any, values: Any) -> F64:
    """(n,) error of a factor over the sigmas of ``noise``, its noise model without a robust loss.

    Some builds of GTSAM give the error of no GPSFactor and the whitening of no robust model.
    """
    import gtsam

    if isinstance(factor, gtsam.GPSFactor):
        error = values.atPose3(factor.keys()[0]).translation() - factor.measurementIn()
    else:
        error = factor.unwhitenedError(values)
    return np.asarray(noise.whiten(error), np.float64)


def scaled_motion_error(T_a_b: F64) -> Any:
    """Error function of (pose a, pose b, log scale): their motion against the scaled ``T_a_b``."""
    R, t = T_a_b[:3, :3].copy(), T_a_b[:3, 3].copy()

    def error(factor: Any, values: Any, jacobians: Any) -> F64:
        import gtsam

        a_key, b_key, scale_key = factor.keys()
        stretched = t * float(np.exp(np.clip(values.atVector(scale_key)[0], -MAX_LOG, MAX_LOG)))
        motion = values.atPose3(a_key).between(values.atPose3(b_key))
        expected = gtsam.Pose3(gtsam.Rot3(R), stretched)
        if jacobians is not None:
            # To first order in the error, which is small where the graph is any good.
            jacobians[0] = -motion.inverse().AdjointMap()
            jacobians[1] = np.eye(6)
            jacobians[2] = -np.concatenate([np.zeros(3), R.T @ stretched])[:, None]
        return np.asarray(gtsam.Pose3.Logmap(expected.between(motion)), np.float64)

    return error
