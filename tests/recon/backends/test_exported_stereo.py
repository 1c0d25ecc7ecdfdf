"""Belief propagation exported as ONNX gives the compiled labels, by ONNX Runtime."""

from __future__ import annotations

import io

import numpy as np
import pytest

from recon.stereo.belief_propagation import BeliefPropagationConfig, belief_propagation
from recon.stereo.brightness_transfer import match_brightness
from recon.types import U8
from service.bench.stereo import scene

ACCEPT_ALL = {"min_evidence": 0, "min_contrast": 0, "occlusion_tolerance": -1, "speckle_px": 0}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("width", "height", "labels", "settings"),
    [
        (64, 36, 8, {"iterations": 2, "levels": 2}),
        (43, 25, 7, {"iterations": 1, "levels": 3, "min_disparity": -3}),
        (30, 61, 5, {"iterations": 1, "min_disparity": 4, "smoothness_truncation": 1.5}),
    ],
)
def test_labels_are_the_compiled_ones(
    width: int, height: int, labels: int, settings: dict[str, float]
) -> None:
    """Odd sizes, levels, other first labels, another smoothness."""
    pytest.importorskip("torch")
    runtime = pytest.importorskip("onnxruntime")
    from recon.backends.exported_stereo import export_stereo

    config = BeliefPropagationConfig(**{**ACCEPT_ALL, **settings})  # type: ignore[arg-type]
    left, right = scene(width, height, labels)
    want = belief_propagation(left, right, labels, config).px
    model = io.BytesIO()
    export_stereo(model, (height, width), labels, config)
    session = runtime.InferenceSession(model.getvalue(), providers=["CPUExecutionProvider"])

    def image(gray: U8) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
        return gray.astype(np.float32)[None, None]

    right = match_brightness(
        left, right, labels, config.min_disparity
    )  # the model does not do that
    (found,) = session.run(None, {"left": image(left), "right": image(right)})
    got = found[0, 0] - config.min_disparity
    known = np.isfinite(want)
    assert known.mean() > 0.7
    np.testing.assert_allclose(got[known], want[known], atol=1e-4)
