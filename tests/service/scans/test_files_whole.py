"""Files that appear whole or not at all, also when several write one at once."""

from __future__ import annotations

import errno
import os
import re
import resource
import stat
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from recon.types import PointCloud
from service.errors import OutsideError
from service.scans.fused_cloud import write_laz
from service.scans.writing import filling_folder, write_whole, writing, writing_folder


def test_two_writers_of_one_file_do_not_mix(tmp_path: Path) -> None:
    path, both = tmp_path / "dsm.tif", threading.Barrier(2)
    faults: list[Exception] = []

    def write(text: str) -> None:
        try:
            with writing(path) as part:
                part.write_text(text)
                both.wait(10.0)
        except Exception as error:
            faults.append(error)

    texts = ["a" * 1000, "b" * 2000]
    threads = [threading.Thread(target=write, args=(text,)) for text in texts]
    for one in threads:
        one.start()
    for one in threads:
        one.join()
    assert faults == [] and path.read_text() in texts
    assert [p.name for p in tmp_path.iterdir()] == ["dsm.tif"]


def _killed(writer: str, makes: str, path: Path) -> None:
    """A process that is killed while it writes ``path`` with ``writer``, and leaves one name."""
    killed = (
        f"import os, sys, pathlib; from service.scans.writing import {writer}\n"
        f"with {writer}(pathlib.Path(sys.argv[1])) as part:\n"
        f"    {makes}; os.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-c", killed, str(path)], check=False)
    assert len(list(path.parent.iterdir())) == 1


def test_what_a_killed_process_left_goes_with_the_next_attempt(tmp_path: Path) -> None:
    path = tmp_path / "cloud[1].laz"
    _killed("writing", "part.write_text('half')", path)
    with writing(path) as part:
        part.write_text("whole")
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_a_folder_that_a_killed_process_left_goes_with_the_next_attempt(tmp_path: Path) -> None:
    path = tmp_path / "tiles"
    _killed("writing_folder", "(part / 'one').touch()", path)
    for name in ("first", "second"):
        with writing_folder(path) as part:
            (part / name).touch()
    assert [p.name for p in tmp_path.iterdir()] == ["tiles"]
    assert [p.name for p in path.iterdir()] == ["second"]


def test_files_that_only_look_like_ours_stay(tmp_path: Path) -> None:
    """On a stranger's card any name may be there; none keeps a file from being written."""
    names = [
        f".dsm.tif.{n}.part" for n in ("copy-of", "-1", "99999999999999999999-1", "7-a", "²-1")
    ]
    for name in names:
        (tmp_path / name).touch()
    with writing(tmp_path / "dsm.tif") as part:
        part.write_text("whole")
    assert {p.name for p in tmp_path.iterdir()} == {*names, "dsm.tif"}


def test_a_file_system_that_cannot_sync_folders_takes_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sync = os.fsync

    def of_files_alone(handle: int) -> None:
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        sync(handle)

    monkeypatch.setattr(os, "fsync", of_files_alone)
    write_whole(tmp_path / "a", "whole")
    assert (tmp_path / "a").read_text() == "whole"

    def broken(_: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(os, "fsync", broken)
    with pytest.raises(OutsideError, match="Input/output"):
        write_whole(tmp_path / "a", "other")
    assert (tmp_path / "a").read_text() == "whole"


def test_a_failure_names_the_file_as_it_will_be_called(tmp_path: Path) -> None:
    with (
        pytest.raises(OutsideError, match=re.escape(f"cannot write {tmp_path}/a/b.txt (")),
        filling_folder(tmp_path / "a") as part,
    ):
        (part / "b.txt").mkdir()  # a folder where the file should go
        write_whole(part / "b.txt", "whole")
    with (
        pytest.raises(OutsideError, match=re.escape(f"cannot write {tmp_path}/a (")),
        filling_folder(tmp_path / "a"),
    ):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_is_an_error_of_the_disk_to_a_compressed_cloud(tmp_path: Path) -> None:
    """No file may become larger than 30 kB: the compressor itself fails."""
    many = np.random.default_rng(0).normal(0, 50, (20_000, 3)).astype(np.float32)
    ones = np.ones(many.shape, np.uint8)
    cloud = PointCloud(many, ones, many[:, 0], ones[:, 0])
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, limits[1]))
    try:
        with pytest.raises(OSError):
            write_laz(tmp_path / "cloud.laz", [(cloud, None, None)], None, 0)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
