"""Parameters of the odometry."""

from __future__ import annotations

from dataclasses import dataclass, field

from recon.tracking import matching, pnp


@dataclass(frozen=True, slots=True)
class OdometryConfig:
    """Parameters of the odometry; angles are in rad, shares are of the image width."""

    base_to_height: float = 0.1  # motion between keyframes over the distance to the ground
    least_base_to_height: float = 0.03  # under it two frames are not triangulated
    window: int = 8  # keyframes adjusted together
    search_share: float = 0.03  # ZSSD search radius around a good prediction
    wide_search_share: float = 0.09  # and around a poor one
    min_tracks: int = 40  # fewer inliers: lost
    min_track_share: float = 0.25  # of the corners that should be visible
    tracked_landmarks: int = 300  # enough for a pose; keyframes match all their corners
    max_tilt_error_rad: float = 0.35  # vision against attitude: more is a false solution
    loose_px: float = 6.0  # gate of a second try: a rolling shutter bends pictures that much
    lost_after: int = 8  # frames in a row without a pose before a new segment starts
    still_gap_s: float = 0.7  # frames further apart are stills: no motion model holds
    matching: matching.MatchingConfig = field(default_factory=matching.MatchingConfig)
    pnp: pnp.PnpConfig = field(default_factory=pnp.PnpConfig)

    def __post_init__(self) -> None:
        if not 0.0 < self.least_base_to_height <= self.base_to_height < 1.0:
            raise ValueError("0 < least_base_to_height <= base_to_height < 1 must hold")
        if self.window < 3:
            raise ValueError(f"window must hold 3 keyframes or more, got {self.window}")
