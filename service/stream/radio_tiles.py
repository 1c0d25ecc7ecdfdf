"""A keyframe's coarse layer as tiles of the narrow radio, and back; their table in a store, which
also holds the newest first depth."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from recon.camera_model import scaled_K
from recon.types import DepthMap, Keyframe, Pose
from service.stream import codec, planes
from service.stream.database import Database, blob, is_number
from service.stream.radio_messages import CELLS, RadioTile, unpack_pose, unpack_tile
from service.stream.records import PoseRecord

GRID_WIDTH_PX = 40


def tiles_of(coarse: Keyframe) -> list[RadioTile]:
    """The non-empty tiles of a keyframe's coarse layer, at most 40 px across."""
    depth = coarse.depth
    full = planes.planes_of(depth, coarse.bgr, coarse.fresh)
    factor = -(-full.known.shape[1] // GRID_WIDTH_PX)
    small = planes.reduce(full, factor)
    K = scaled_K(depth.K, 1.0 / factor, 1.0 / factor)
    h, w = small.known.shape
    out = []
    for index in range(-(-h // CELLS) * -(-w // CELLS)):
        v, u = divmod(index, -(-w // CELLS))
        cut = np.s_[v * CELLS : (v + 1) * CELLS, u * CELLS : (u + 1) * CELLS]
        known = small.known[cut]
        if not known.any():
            continue
        cells = np.full((CELLS, CELLS), np.nan, np.float32)
        cells[: known.shape[0], : known.shape[1]] = np.where(known, small.depth_m[cut], np.nan)
        bgr = np.zeros((CELLS, CELLS, 3), np.uint8)
        bgr[: known.shape[0], : known.shape[1]] = small.bgr[cut]
        sigma = small.sigma_m[cut][known & (small.sigma_m[cut] > 0)]
        out.append(
            RadioTile(
                coarse.seq,
                coarse.time_ns,
                (w, h),
                index,
                K,
                depth.T_world_camera,
                float(np.median(sigma)) if sigma.size else float("nan"),
                cells,
                bgr,
            )
        )
    return out


def keyframe_of(tiles: Sequence[RadioTile]) -> Keyframe | None:
    """The keyframe shown by the tiles of one grid; None without tiles.

    During a correction some tiles have the old pose and scale and some the new; only tiles of the
    most frequent pose are used.
    """
    if not tiles:
        return None
    poses = Counter(tile.T_world_camera.tobytes() for tile in tiles)
    shared = poses.most_common(1)[0][0]
    tiles = [tile for tile in tiles if tile.T_world_camera.tobytes() == shared]
    first = tiles[0]
    w, h = first.grid_px
    rows, columns = -(-h // CELLS), -(-w // CELLS)
    depth = np.full((rows * CELLS, columns * CELLS), np.nan, np.float32)
    sigma = np.full_like(depth, np.nan)
    bgr = np.zeros((*depth.shape, 3), np.uint8)
    for tile in tiles:
        if tile.grid_px != first.grid_px:
            continue
        v, u = divmod(tile.index, columns)
        cut = np.s_[v * CELLS : (v + 1) * CELLS, u * CELLS : (u + 1) * CELLS]
        depth[cut] = tile.depth_m
        sigma[cut] = np.where(np.isfinite(tile.depth_m), np.float32(tile.sigma_m), np.nan)
        bgr[cut] = tile.bgr
    depth, sigma, bgr = depth[:h, :w], sigma[:h, :w], bgr[:h, :w]
    fresh = np.isfinite(depth)
    T = first.T_world_camera
    return Keyframe(
        first.seq,
        first.time_unix_ns,
        DepthMap(depth, sigma, fresh.astype(np.uint8), first.K, T),
        bgr,
        Pose(T, np.diag([1e-4] * 3 + [0.25] * 3)),
        fresh,
    )


class RadioStore:
    """The ``radio`` table of a scan's database."""

    def __init__(self, database: Database) -> None:
        self._db = database

    def add(self, kind: str, number: int, part: int, data: bytes) -> bool:
        """Store a message ("tile" or "pose"), the newest of its number; False if already known. A
        tile is of a keyframe that is done: it ends a first depth up to that one."""
        with self._db.lock:
            sql = "SELECT 1 FROM radio WHERE kind = ? AND number = ? AND part = ? AND data = ?"
            if self._db.one(sql, (kind, number, part, data)) is not None:
                return False
            row = (kind, number, part, data)
            drop = "DELETE FROM radio WHERE kind = 'first' AND ? = 'tile' AND number <= ?"
            put = "INSERT OR REPLACE INTO radio VALUES (?, ?, ?, ?)"
            self._db.write([(drop, (kind, number)), (put, row)])
            return True

    def put_first(self, seq: int, data: bytes) -> None:
        """Store a keyframe's first depth, a layer; it replaces the former keyframe's."""
        drop, row = "DELETE FROM radio WHERE kind = 'first'", ("first", seq, 0, data)
        self._db.write([(drop, ()), ("INSERT INTO radio VALUES (?, ?, ?, ?)", row)])

    def drop_first(self) -> None:
        self._db.write([("DELETE FROM radio WHERE kind = 'first'", ())])

    def keyframe(self, seq: int) -> Keyframe | None:
        """The keyframe shown by its tiles, else by its first depth; None without any."""
        sql = "SELECT data FROM radio WHERE kind = 'tile' AND number = ? ORDER BY part"
        tiles = [unpack_tile(blob(row[0])) for row in self._db.all(sql, (seq,))]
        found = keyframe_of([tile[1] for tile in tiles if tile is not None])
        if found is not None:
            return found
        sql = "SELECT data FROM radio WHERE kind = 'first' AND number = ?"
        first = self._db.one(sql, (seq,))
        decoded = None if first is None else codec.decode([blob(first[0])])
        return decoded if decoded is not None and decoded.seq == seq else None

    def seqs(self) -> set[int]:
        sql = f"SELECT DISTINCT number FROM radio WHERE kind = 'tile' AND {is_number('number')}"
        return {row[0] for row in self._db.all(sql)}

    def poses(self) -> list[PoseRecord]:
        rows = self._db.all("SELECT data FROM radio WHERE kind = 'pose' ORDER BY number")
        found = [unpack_pose(blob(row[0])) for row in rows]
        return [message[2] for message in found if message is not None]
