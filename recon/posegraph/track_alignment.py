"""The similarity between two tracks, in closed form."""

from __future__ import annotations

import numpy as np

from recon import se3
from recon.types import F64


def umeyama(source: F64, target: F64, weight: F64) -> tuple[float, F64, F64]:
    """Scale, (3, 3) rotation about z and (3,) shift that best take ``source`` (N, 3) to ``target``.

    Umeyama 1991, doi:10.1109/34.88573. ``weight`` (N,) is relative.
    """
    w = weight / weight.sum()
    ms, mt = w @ source, w @ target
    a, b = source - ms, target - mt
    cross = (b * w[:, None]).T @ a
    yaw = np.arctan2(cross[1, 0] - cross[0, 1], cross[0, 0] + cross[1, 1])
    R = se3.so3_exp(np.array([0.0, 0.0, yaw]))
    power = float(w @ np.sum(a**2, axis=1))
    scale = float(np.sum(R * cross)) / max(power, 1e-12)
    return scale, R, np.asarray(mt - scale * R @ ms)
