"""Projective ICP in torch against the compiled one, on ``--device``.

Tolerances: surface elements 1e-5 of themselves; motions a fifth of their own sigma; standard
deviations a fifth of themselves; the same verdicts and the same weak directions.
"""

from __future__ import annotations

import numpy as np
import pytest

from recon import se3
from recon.mapping import registration
from recon.mapping.registration import DepthSurface, IcpConfig
from recon.mapping.registration import register_projective as compiled
from recon.types import F64, DepthMap, Registration

torch = pytest.importorskip("torch")

K = np.array([[110.0, 0, 79.5], [0, 110.0, 44.5], [0, 0, 1]])
DOWN = np.diag([1.0, -1.0, -1.0])
UNKNOWN = 0.05  # variances above those of any direction that the surface shows


def ground(x: F64, y: F64, kind: str) -> F64:
    """Height in m."""
    if kind == "flat":
        return np.zeros_like(x)
    if kind == "trench":  # looks the same from everywhere along y
        return np.asarray(2.5 * np.sin(x / 4))
    return np.asarray(3 * np.sin(x / 5) * np.cos(y / 6) + 0.02 * x**2)


def seen(T_world_camera: F64, kind: str, seed: int, gaps: float = 0.0) -> DepthMap:
    """(90, 160) depth with 3 cm of noise and some holes, cast ray by ray from 40 m."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[0:90, 0:160]
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(u.shape)], axis=-1)
    direction = rays @ T_world_camera[:3, :3].T
    z = np.full(u.shape, 40.0)
    for _ in range(60):
        p = T_world_camera[:3, 3] + direction * z[..., None]
        z += 0.7 * (p[..., 2] - ground(p[..., 0], p[..., 1], kind))
    z = z + rng.normal(0, 0.03, z.shape)
    z[rng.random(z.shape) < gaps] = np.nan
    z[:20, :30] = np.nan if gaps else z[:20, :30]
    sigma = np.full(z.shape, 0.03, np.float32)
    return DepthMap(z.astype(np.float32), sigma, np.ones(z.shape, np.uint8), K, T_world_camera)


def moved(kind: str, gaps: float = 0.0) -> tuple[DepthMap, DepthMap, F64, F64]:
    """Source, target, the true motion between them and a start near it."""
    T_a = se3.compose(DOWN, np.array([0.0, 0.0, 40.0]))
    T_b = se3.compose(
        DOWN @ se3.so3_exp(np.array([0.01, -0.015, 0.02])), np.array([1.1, -0.7, 40.4])
    )
    truth = se3.inverse(T_a) @ T_b
    start = se3.compose(se3.so3_exp(np.array([0.004, 0.002, 0])), np.array([0.2, 0.1, -0.25]))
    return seen(T_b, kind, 1, gaps), seen(T_a, kind, 2, gaps), truth, start @ truth


def on_device(
    device: str, source: DepthMap, target: DepthMap, T: F64, config: IcpConfig
) -> Registration:
    from recon.backends.torch_icp import DeviceIcp

    icp = DeviceIcp(device)
    first = icp.register(source, target, T, config)
    if device == "cuda":
        again = icp.register(source, target, T, config)
        np.testing.assert_array_equal(first.T_target_source, again.T_target_source)
    return first


@pytest.mark.parametrize("gaps", [0.0, 0.15])
def test_surface_elements_are_the_compiled_ones(device: str, gaps: float) -> None:
    """Whole windows, windows with holes, borders, edges of depth; centre and lever too."""
    from recon.backends.torch_icp import build

    depth = seen(se3.compose(DOWN, np.array([0.0, 0.0, 40.0])), "hills", 3, gaps)
    depth.depth_m[40:60, 70:100] -= 6
    want = DepthSurface.build(depth)
    z, sigma, intrinsics = (
        torch.from_numpy(np.ascontiguousarray(x)).to(device)
        for x in (depth.depth_m, depth.sigma_m, want.intrinsics)
    )
    got = build(z, sigma, intrinsics)
    elements = got.elements.cpu().numpy()
    there = want.elements[..., 4] > 0
    assert 0.3 < there.mean() < 0.99
    assert ((elements[..., 4] > 0) == there).mean() > 0.9999
    both = there & (elements[..., 4] > 0)
    np.testing.assert_allclose(elements[both][:, :5], want.elements[both][:, :5], atol=1e-4)
    np.testing.assert_allclose(elements[both][:, 5], want.elements[both][:, 5], atol=1e-5)
    np.testing.assert_allclose(got.centre.cpu().numpy(), want.centre, atol=1e-4)
    assert float(got.lever_m) == pytest.approx(want.lever_m, rel=1e-5)


@pytest.mark.parametrize(("kind", "gaps"), [("hills", 0.0), ("hills", 0.15), ("trench", 0.0),
                                            ("flat", 0.0), ("flat", 0.15)])  # fmt: skip
def test_the_motion_is_that_of_the_compiled_one(device: str, kind: str, gaps: float) -> None:
    """All directions determined, one open, three open: strong ones agree, weak ones stay put."""
    if device == "cpu" and (kind, gaps) not in (("hills", 0.15), ("flat", 0.0)):
        pytest.skip("the interpreter takes half a minute for each; two are enough")
    source, target, truth, start = moved(kind, gaps)
    want = compiled(source, target, start)
    got = on_device(device, source, target, start, IcpConfig())
    assert got.verdict == want.verdict == ("converged" if kind == "hills" else "degenerate")
    mine, theirs = (np.linalg.eigvalsh(r.covariance) for r in (got, want))
    strong = int(np.count_nonzero(theirs < UNKNOWN))
    assert np.count_nonzero(mine < UNKNOWN) == strong == {"hills": 6, "trench": 5, "flat": 3}[kind]
    mine, theirs = mine[:strong], theirs[:strong]
    np.testing.assert_allclose(np.sqrt(mine), np.sqrt(theirs), rtol=0.2)
    between = got.T_target_source @ se3.inverse(want.T_target_source)
    twist = np.r_[se3.so3_log(between[:3, :3]), between[:3, 3]]
    assert np.sqrt(twist @ np.linalg.solve(want.covariance, twist)) < 0.2
    assert got.rms_m == pytest.approx(want.rms_m, rel=0.02)
    assert got.inlier_share == pytest.approx(want.inlier_share, abs=0.02)
    left = got.T_target_source @ se3.inverse(truth)
    assert abs(left[2, 3]) < 0.06  # along the normals every kind of ground determines it
    if kind != "hills":
        kept = got.T_target_source @ se3.inverse(start)
        middle = np.array([0.0, 0, 40])
        assert abs((kept[:3, :3] @ middle + kept[:3, 3] - middle)[1]) < 0.05


def test_what_does_not_fit_is_rejected(device: str) -> None:
    """No overlap, no surface, another scene, a start that is not a number, shapes that differ."""
    source, target, truth, _ = moved("hills")
    config = IcpConfig()
    far = se3.compose(np.eye(3), np.array([500.0, 0, 0]))
    nothing = DepthMap(np.full((90, 160), np.nan, np.float32), source.sigma_m, source.views, K,
                       np.eye(4))  # fmt: skip
    other = seen(se3.compose(DOWN, np.array([9.0, 30.0, 40.0])), "hills", 5)
    misfits = [(nothing, target, truth), (source, nothing, truth), (source, target, far),
               (other, target, truth)]  # fmt: skip
    for a, b, T in misfits if device == "cuda" else misfits[:1]:
        found = on_device(device, a, b, T, config)
        assert found.verdict == compiled(a, b, T).verdict == "rejected"
        assert np.isfinite(found.T_target_source).all()
    coarse = DepthMap(target.depth_m[::2, ::2].copy(), target.sigma_m[::2, ::2].copy(),
                      target.views[::2, ::2].copy(),
                      K * np.array([[0.5], [0.5], [1.0]]), target.T_world_camera)  # fmt: skip
    if device == "cuda":
        assert on_device(device, source, coarse, truth, config).verdict == "converged"
    with pytest.raises(ValueError, match="finite"):
        on_device(device, source, target, np.full((4, 4), np.nan), config)
    with pytest.raises(ValueError, match="do not fit"):
        bad = DepthMap(source.depth_m, source.sigma_m[:-1], source.views, K, np.eye(4))
        on_device(device, bad, target, truth, config)


def test_residuals_that_err_together_are_counted_alike(device: str) -> None:
    """White, smooth and holey fields against the compiled sum of autocorrelations."""
    import cv2

    from recon.backends.torch_icp import area_of, correlation_sums

    rng = np.random.default_rng(0)
    none = np.zeros((20, 30))
    assert registration.correlated_area(none.astype(np.float32), 1.0, 12) == 1.0
    still = torch.from_numpy(none).to(device)
    assert area_of(correlation_sums(still, still == 0, 12).cpu().numpy()) == 1.0
    for blur in (0.0, 1.5, 3.0):
        field = rng.normal(0, 1, (60, 100))
        if blur:
            field = np.asarray(cv2.GaussianBlur(field, (0, 0), blur))
        field[rng.random(field.shape) < 0.2] = float(registration.UNMATCHED)
        limit = 2.0 * float(np.std(field[field < 10]))
        want = registration.correlated_area(field.astype(np.float32), limit, 12)
        near = np.abs(field) < limit
        size, members = (torch.from_numpy(x).to(device) for x in (np.where(near, field, 0.0), near))
        lags = correlation_sums(size, members, 12).cpu().numpy()
        assert area_of(lags) == pytest.approx(want, rel=1e-4)
