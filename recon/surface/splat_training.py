"""Gaussians trained further on their images by gradient descent, on a CUDA device.

Optional, and not measured yet: it has run on a processor only, with a slow renderer of the tests in
place of gsplat's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from recon import se3
from recon.surface.splats import Splats
from recon.surface.texture_views import TextureView
from recon.types import F32

RATES = {"offset": 0.02, "log_sigma": 5e-3, "q": 1e-3, "logit": 5e-2, "rgb": 2.5e-3}
"""Steps of Adam, those of the reference implementation of Kerbl et al. 2023
(doi:10.1145/3592433); places move in units of each one's own sigma, as depth images placed them."""

SSIM_SHARE = 0.2
"""Of the loss, as there; the rest is the mean absolute difference."""

SSIM_PX, SSIM_C1, SSIM_C2 = 11, 0.01**2, 0.03**2
"""Window and constants (Wang et al. 2004, doi:10.1109/TIP.2003.819861)."""

MAX_TRAINED = 0.999
"""A viewer's logit of 1 is infinite."""

Draw = Callable[..., tuple[Any, Any, Any]]
"""``gsplat.rasterization``: colours (1, h, w, 3), opacities and more of Gaussians as tensors."""


def trained(
    splats: Splats,
    views: Sequence[TextureView],
    steps: int,
    progress: Callable[[str], None] = lambda _: None,
    draw: Draw | None = None,
    device: str = "cuda",
) -> Splats:
    """As many Gaussians, after so many steps of one view each; ``progress`` is called per step.

    ``draw`` is gsplat's by default. Raises ImportError without torch or gsplat.
    """
    import torch

    if draw is None:
        import gsplat

        draw = gsplat.rasterization
    assert draw is not None

    def tensor(array: Any) -> Any:
        return torch.from_numpy(np.ascontiguousarray(array, np.float32)).to(device)

    xyz, sigma = tensor(splats.xyz_m), tensor(splats.sigma_m)
    reach = sigma.mean(dim=1, keepdim=True)
    free = {
        "offset": torch.zeros_like(xyz),
        "log_sigma": sigma.log(),
        "q": tensor(splats.q_wxyz),
        "logit": torch.logit(tensor(splats.opacity)),
        "rgb": tensor(splats.rgb / 255.0),
    }
    for one in free.values():
        one.requires_grad_()
    groups = [{"params": [free[name]], "lr": rate} for name, rate in RATES.items()]
    adam = torch.optim.Adam(groups, eps=1e-15)
    rng, order = np.random.default_rng(0), list[int]()
    for _ in range(steps):
        progress("training Gaussians")
        order = order or rng.permutation(len(views)).tolist()
        view = views[order.pop()]
        h, w = view.bgra.shape[:2]
        K = view.K.copy()
        K[:2, 2] += 0.5  # from the corner of a pixel, not from its middle
        image, _, _ = draw(
            xyz + reach * free["offset"],
            free["q"],
            free["log_sigma"].exp(),
            free["logit"].sigmoid(),
            free["rgb"],
            tensor(se3.inverse(view.T_world_camera))[None],
            tensor(K)[None],
            w,
            h,
        )
        is_there = tensor(view.bgra[..., 3:] > 0)
        wanted = tensor(view.bgra[..., 2::-1] / 255.0)
        loss = difference(image[0] * is_there, wanted * is_there)
        adam.zero_grad()
        loss.backward()
        adam.step()

    def array(values: Any) -> F32:
        return np.asarray(values.detach().cpu().numpy(), np.float32)

    q = free["q"] / free["q"].norm(dim=1, keepdim=True)
    return Splats(
        array(xyz + reach * free["offset"]),
        array(q),
        array(free["log_sigma"].exp()),
        array(free["logit"].sigmoid().clamp(max=MAX_TRAINED)),
        array(255.0 * free["rgb"].clamp(0.0, 1.0)),
    )


def difference(image: Any, wanted: Any) -> Any:
    """The loss of two images (h, w, 3) of 0 to 1, at least SSIM_PX wide and high."""
    from torch.nn.functional import avg_pool2d

    def mean(values: Any) -> Any:
        return avg_pool2d(values.permute(2, 0, 1)[None], SSIM_PX, 1)

    a, b = mean(image), mean(wanted)
    aa, bb, ab = mean(image**2) - a**2, mean(wanted**2) - b**2, mean(image * wanted) - a * b
    ssim = (2 * a * b + SSIM_C1) * (2 * ab + SSIM_C2)
    ssim = ssim / ((a**2 + b**2 + SSIM_C1) * (aa + bb + SSIM_C2))
    return (1.0 - SSIM_SHARE) * (image - wanted).abs().mean() + SSIM_SHARE * (1.0 - ssim.mean())
