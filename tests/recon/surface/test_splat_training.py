"""Gaussians trained on their images, by a slow renderer of PyTorch in place of gsplat's."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from recon.surface.splat_training import difference, trained
from recon.surface.splats import Splats, rendered
from recon.surface.texture_views import TextureView
from recon.types import U8

torch = pytest.importorskip("torch", exc_type=ImportError)
pytestmark = pytest.mark.slow

STEPS = 24
SIZE_PX = W, H = 40, 30
K = np.array([[40.0, 0.0, 19.5], [0.0, 40.0, 14.5], [0.0, 0.0, 1.0]])


def rasterization(
    means: Any, quats: Any, scales: Any, opacities: Any, colors: Any, viewmats: Any, Ks: Any,
    width: int, height: int,
) -> tuple[Any, Any, dict[str, Any]]:  # fmt: skip
    """As gsplat's, of few Gaussians in front of the camera: each over all pixels (Zwicker et al.
    2001, doi:10.1109/VISUAL.2001.964490). A pixel's middle is at .5."""
    R, t = viewmats[0, :3, :3], viewmats[0, :3, 3]
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).T
    axes = torch.stack([
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ], 1).reshape(-1, 3, 3)  # fmt: skip
    local, M = means @ R.T + t, R @ axes * scales[:, None]
    u, v, far = local.T
    k, zero = Ks[0], torch.zeros_like(far)
    J = torch.stack([
        k[0, 0] / far, zero, -k[0, 0] * u / far**2, zero, k[1, 1] / far, -k[1, 1] * v / far**2,
    ], 1).reshape(-1, 2, 3)  # fmt: skip
    flat = J @ M @ M.transpose(1, 2) @ J.transpose(1, 2) + 0.3 * torch.eye(2)
    middle = torch.stack([k[0, 0] * u / far + k[0, 2], k[1, 1] * v / far + k[1, 2]], 1)
    rows, cols = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    off = torch.stack([cols + 0.5, rows + 0.5], 2)[..., None, :] - middle  # (h, w, N, 2)
    squared = torch.einsum("hwni,nij,hwnj->hwn", off, torch.linalg.inv(flat), off)
    alpha = (opacities * torch.exp(-0.5 * squared)).clamp(max=0.99)[..., far.argsort()]
    left = torch.cumprod(1.0 - alpha, dim=2)
    share = alpha * torch.cat([torch.ones_like(left[..., :1]), left[..., :-1]], dim=2)
    return (share @ colors[far.argsort()])[None], share.sum(dim=2)[None], {}


def wall() -> Splats:
    """Gaussians of all colours and directions, five metres ahead."""
    rng = np.random.default_rng(2)
    count = 40
    xyz = rng.uniform([-2.2, -1.6, 4.5], [2.2, 1.6, 5.5], (count, 3))
    q = rng.normal(size=(count, 4))
    return Splats(
        xyz.astype(np.float32),
        (q / np.linalg.norm(q, axis=1, keepdims=True)).astype(np.float32),
        rng.uniform(0.15, 0.4, (count, 3)).astype(np.float32),
        rng.uniform(0.3, 0.9, count).astype(np.float32),
        rng.uniform(0.0, 255.0, (count, 3)).astype(np.float32),
    )


def images(splats: Splats, places: int = 3) -> list[TextureView]:
    views = []
    for n in range(places):
        T = np.eye(4)
        T[:3, 3] = [0.3 * n - 0.3, 0.1 * n, 0.0]
        rgb = np.clip(np.rint(rendered(splats, K, SIZE_PX, T)[0]), 0, 255).astype(np.uint8)
        full: U8 = np.full((H, W, 1), 255, np.uint8)
        views.append(TextureView(np.dstack([rgb[..., ::-1], full]), K, T))
    return views


def test_the_renderer_is_asked_for_what_ours_draws() -> None:
    splats, drawn = wall(), []

    def draw(*args: Any) -> tuple[Any, Any, Any]:
        image, opacity, more = rasterization(*args)
        drawn.append(image[0].detach().numpy())
        return image, opacity, more

    (view,) = images(splats, 1)
    trained(splats, [view], 1, draw=draw, device="cpu")
    off = np.abs(255.0 * drawn[0] - view.bgra[..., 2::-1])
    assert off.max() < 6.0 and off.mean() < 1.0  # faint ends are left out of ours


@pytest.mark.parametrize("what", ["rgb", "opacity", "sigma_m", "xyz_m"])
def test_training_takes_gaussians_back_to_what_the_images_show(what: str) -> None:
    true = wall()
    rng = np.random.default_rng(3)
    noise = rng.normal(size=getattr(true, what).shape)
    value = getattr(true, what)
    spoilt = {
        "rgb": np.clip(value + 40.0 * noise, 0.0, 255.0),
        "opacity": np.clip(value + 0.2 * noise, 0.05, 0.95),
        "sigma_m": value * np.exp(0.4 * noise),
        "xyz_m": value + 0.08 * noise,
    }[what]
    views, said = images(true), list[str]()
    before = replace(true, **{what: spoilt.astype(np.float32)})
    after = trained(before, views, STEPS, said.append, rasterization, "cpu")

    def error(splats: Splats) -> float:
        return float(np.mean([
            np.abs(rendered(splats, K, SIZE_PX, v.T_world_camera)[0] - v.bgra[..., 2::-1]).mean()
            for v in views
        ]))  # fmt: skip

    assert error(after) < 0.75 * error(before) and len(said) == STEPS
    assert len(after) == len(true) and after.opacity.max() < 1.0
    np.testing.assert_allclose(np.linalg.norm(after.q_wxyz, axis=1), 1.0, atol=1e-5)
    assert after.rgb.min() >= 0.0 and after.rgb.max() <= 255.0


def test_the_loss_is_that_of_kerbl_with_the_ssim_of_scikit_image() -> None:
    metrics = pytest.importorskip("skimage.metrics", exc_type=ImportError)
    rng = np.random.default_rng(5)
    one = rng.uniform(0.0, 1.0, (H, W, 3))
    other = np.clip(0.7 * one + rng.normal(0.1, 0.1, one.shape), 0.0, 1.0)
    ssim = metrics.structural_similarity(
        one, other, win_size=11, channel_axis=2, data_range=1.0, use_sample_covariance=False,
        full=True,
    )[1][5:-5, 5:-5].mean()  # fmt: skip
    found = float(difference(torch.from_numpy(one), torch.from_numpy(other)))
    assert found == pytest.approx(0.8 * np.abs(one - other).mean() + 0.2 * (1.0 - ssim), rel=1e-6)


def test_what_an_image_does_not_hold_is_not_trained() -> None:
    splats = wall()
    (view,) = images(splats, 1)
    empty = view.bgra.copy()
    empty[:, : W // 2] = 0
    after = trained(splats, [replace(view, bgra=empty)], 30, draw=rasterization, device="cpu")
    T = view.T_world_camera
    was, now = (rendered(s, K, SIZE_PX, T)[0][:, : W // 3] for s in (splats, after))
    assert np.abs(now - was).mean() < 0.2 * was.mean()
