"""The receiver's own altitude in addition to the autopilot's, from messages to the prior."""

from __future__ import annotations

import math

import pytest
from pymavlink.dialects.v20 import common as dialect  # type: ignore[import-untyped]

from mavlink.telemetry.decode import decode
from mavlink.telemetry.history import VehicleHistory
from mavlink.telemetry.samples import AccuracySample, PositionSample
from service.cameras.rig import Rig
from service.config import CameraConfig, FusionConfig, ScanConfig

S = 1_000_000_000


def climbing() -> VehicleHistory:
    """Two metres a second up from 500 m by the autopilot; fixes 1.5 m above that."""
    history = VehicleHistory()
    for tenth in range(31):
        at = tenth / 10.0
        position = PositionSample(None, 47.0, 8.0, 500.0 + 2.0 * at, None, (0.0, 0.0, -2.0))
        history.add(position, round(at * S))
    for fix in range(4):
        at = 0.05 + fix
        history.add(AccuracySample(None, True, 1.0, 1.5, 501.5 + 2.0 * at), round(at * S))
    return history


def test_fixes_are_compared_at_their_own_time() -> None:
    state = climbing().state_at(round(1.4 * S))
    assert state is not None and state.receiver is not None
    assert state.receiver.time_ns == round(1.05 * S)
    assert state.receiver.gnss_minus_baro_m == pytest.approx(1.5, abs=1e-6)
    prior = Rig(CameraConfig(), ScanConfig(), FusionConfig()).prior(state, None)
    assert prior.gnss_minus_baro_m == pytest.approx(1.5, abs=1e-6)
    assert (prior.gnss_minus_baro_fixes, prior.gnss_minus_baro_ns) == (1, round(1.05 * S))


def test_an_accuracy_without_altitude_says_nothing() -> None:
    history = climbing()
    history.add(AccuracySample(None, True, 1.0, 1.5), round(1.4 * S))
    state = history.state_at(round(1.4 * S))
    assert state is not None and state.receiver is None


@pytest.mark.parametrize("h_acc_mm", [0, 900])
def test_the_prior_says_whether_the_receiver_claims_its_accuracy(h_acc_mm: int) -> None:
    history = climbing()
    message = dialect.MAVLink_gps_raw_int_message(
        0, 3, 470000000, 80000000, 501500, 80, 120, 0, 0, 14, 0, h_acc_mm, 1400, 0, 0
    )
    sample = decode(message)
    assert isinstance(sample, AccuracySample)
    history.add(sample, round(1.4 * S))
    prior = Rig(CameraConfig(), ScanConfig(), FusionConfig()).prior(
        history.state_at(round(1.4 * S)), None
    )
    assert prior.sigma_position_m is not None
    assert prior.sigma_position_m[0] == pytest.approx(0.9 if h_acc_mm else 1.2, rel=0.01)
    assert prior.is_sigma_claimed is bool(h_acc_mm)


def test_a_receiver_alone_places_the_camera_until_an_estimator_speaks() -> None:
    history = VehicleHistory()
    for k in range(4):  # 10 m/s to the north-east, climbing, no height above home
        step_m = 10.0 * 0.2 * k / math.sqrt(2.0)
        lat = round(470000000 + step_m / 111_319.49 * 1e7)
        message = dialect.MAVLink_gps_raw_int_message(
            0, 3, lat, 80000000, 500000 + 100 * k, 80, 120, 1000, 4500, 14, 0, 900, 1400, 0, 0
        )
        sample = decode(message)
        assert sample is not None
        history.add(sample, round(0.2 * k * S))
    state = history.state_at(round(0.3 * S))
    assert state is not None and state.lat_deg is not None and state.alt_amsl_m is not None
    assert (state.lat_deg - 47.0) * 111_319.49 == pytest.approx(3.0 / math.sqrt(2.0), abs=0.02)
    assert state.alt_amsl_m == pytest.approx(500.15)
    assert state.sigma_h_m == pytest.approx(0.9, abs=0.01) and state.is_claimed
    assert state.receiver is None and state.v_ned_m_s is None and state.alt_agl_m is None
    assert (history.first_ns, history.last_ns, len(history)) == (0, round(0.6 * S), 4)
    for t in (0.2, 0.4):
        history.add(PositionSample(None, 46.0, 8.0, 400.0, 30.0, None), round(t * S))
    state = history.state_at(round(0.3 * S))
    assert state is not None and state.lat_deg == 46.0 and state.alt_agl_m == 30.0
    history.clear()
    assert history.state_at(round(0.3 * S)) is None


def test_only_a_fix_has_an_altitude() -> None:
    for kind, altitude in ((3, 612.345), (1, None)):
        message = dialect.MAVLink_gps_raw_int_message(
            0, kind, 470000000, 80000000, 612345, 80, 120, 0, 0, 14, 0, 900, 1400, 0, 0
        )
        sample = decode(message)
        assert isinstance(sample, AccuracySample)
        assert sample.alt_amsl_m == altitude
