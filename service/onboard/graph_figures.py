"""What the pose graph of a flight says of itself, for the scan's summary."""

from __future__ import annotations

from typing import Any

import numpy as np

from recon.graph.pose_graph import PoseGraph
from recon.graph.sensor_offsets import Constants
from service.stream.records import pack_covariance, pack_motion

MOST_LOOPS = 300
"""Loops that a summary carries with their motions; of more, an even sample."""


def graph_figures(graph: PoseGraph) -> dict[str, Any] | None:
    """Residuals by kind of factor, loops and readings left out, fit for JSON; None when empty.

    ``nodes`` of the ``keyframes`` are in the graph; the others ride on them.
    ``loops.motions`` are the accepted loops as refinement takes them: two keyframes, seven
    numbers of the motion and 21 of its covariance.
    """
    if len(graph) < 2:
        return None
    accepted = graph.metric_loops()
    step = max(1, -(-len(accepted) // MOST_LOOPS))
    edges = graph.loops
    return {
        "keyframes": graph.entered,
        "nodes": len(graph),
        "residuals": {
            kind: {
                "count": len(rows),
                "rms": round(float(np.sqrt(np.mean(np.square(rows)))), 4),
            }
            for kind, rows in graph.residuals().items()
            if rows.size
        },
        "loops": {
            "used": sum(edge.accepted for edge in edges),
            "waiting": sum(not edge.accepted for edge in edges),
            "pairs": [[edge.a, edge.b, edge.accepted] for edge in edges][-2 * MOST_LOOPS :],
            "motions": [
                [
                    loop.a,
                    loop.b,
                    [float(f"{v:.9g}") for v in pack_motion(loop.T_a_b)],
                    [float(f"{v:.6g}") for v in pack_covariance(loop.covariance)],
                ]
                for loop in accepted[::step]
            ],
        },
        **_constants(graph.constants()),
        "left_out": {str(k): int(v) for k, v in graph.counts.items()},
    }


def _constants(found: Constants) -> dict[str, Any]:
    """Boresight and altitude's zero. ``boresight.deg`` turns the reported camera about its x, y
    and z axes (right, down, ahead); it is used when it is sure."""
    one, datum = found.boresight, found.datum
    return {
        "boresight": {
            "deg": [round(float(v), 3) for v in np.degrees(one.turn)],
            "sigma_deg": [round(float(v), 3) for v in np.degrees(one.sigma)],
            "sure": one.is_sure,
        },
        "altitude_datum": {
            "shift_m": round(datum.shift_m, 3),
            "sigma_m": round(datum.sigma_m, 3) if np.isfinite(datum.sigma_m) else None,
        },
    }
