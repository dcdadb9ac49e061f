"""Data folders: written whole or not at all, continued, read back as they were drawn."""

import os
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import numpy as np
import pytest
from headless import drawn, needs_egl
from tiny_world import ran

from gcd_train.data.pairs import PairedClips
from gcd_train.errors import DataError
from gcd_train.scenes.driving.world import driving_scene
from gcd_train.scenes.pair_writer import generate, shard_path, write_shard
from gcd_train.scenes.renderer import Renderer
from gcd_train.scenes.worlds import World

TINY = World(name="driving", width=48, height=32, frames=2, fps=10.0, hfov_deg=85.0, oversample=1, clips_per_shard=2)


@needs_egl
def test_clips_are_read_as_they_were_drawn(tmp_path: Path) -> None:
    list(generate(tmp_path, TINY, range(3), workers=1))
    clips = PairedClips.open(tmp_path)
    assert (len(clips), clips.frames, clips.height, clips.width, clips.fps) == (3, 2, 32, 48, 10.0)
    clip = clips[2]
    assert clip.seed == 2
    for name, view in drawn(driving_scene(2, frames=2), 48, 32).items():
        np.testing.assert_array_equal(getattr(clip, name), view.rgb)
        np.testing.assert_array_equal(getattr(clip, f"{name}_classes"), view.classes)
        if name == "source":
            np.testing.assert_array_equal(clip.source_instances, view.instances)
        np.testing.assert_allclose(getattr(clip, f"{name}_depth"), view.depth.clip(0, 255.99), atol=1 / 256)


@needs_egl
def test_generation_goes_on_where_it_stopped_and_makes_every_scene_once(tmp_path: Path) -> None:
    just_cut, abandoned = (tmp_path / f"shard-0000000{first}-2.123.partial" for first in (2, 9))
    for leftover in (just_cut, abandoned):
        leftover.write_bytes(b"cut off")
    os.utime(abandoned, (0, 0))
    list(generate(tmp_path, TINY, range(2), workers=1))
    first = shard_path(tmp_path, range(2))
    written = first.stat().st_mtime_ns
    assert list(generate(tmp_path, TINY, range(1, 4), workers=1)) == [1, 3]
    assert first.stat().st_mtime_ns == written
    assert list(PairedClips.open(tmp_path).seeds) == [0, 1, 2, 3]
    assert not abandoned.exists()


@needs_egl
def test_a_damaged_shard_is_named(tmp_path: Path) -> None:
    list(generate(tmp_path, TINY, range(2), workers=1))
    shard = shard_path(tmp_path, range(2))
    shard.write_bytes(shard.read_bytes()[:-200])
    with pytest.raises(DataError, match=shard.name):
        PairedClips.open(tmp_path)


def test_folders_without_data_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"world\.json"):
        PairedClips.open(tmp_path)
    (tmp_path / "world.json").write_bytes(msgspec.json.encode(TINY))
    with pytest.raises(DataError, match="no finished shard"):
        PairedClips.open(tmp_path)
    (tmp_path / "world.json").write_text('{"name": 3}')
    with pytest.raises(DataError, match=r"world\.json cannot be used"):
        PairedClips.open(tmp_path)


@needs_egl
def test_the_command_makes_clips(tmp_path: Path) -> None:
    line = f"generate driving --out {tmp_path / 'data'} --clips 1"
    size = "--width 48 --height 32 --frames 2 --oversample 1 --workers 1"
    code, said = ran(*f"{line} {size}".split())
    assert code == 0, said
    code, said = ran(*line.split())
    assert (code, "choose another folder" in said) == (66, True)


@needs_egl
def test_a_scene_in_two_shards_counts_once(tmp_path: Path) -> None:
    write_shard(tmp_path, TINY, range(2))
    write_shard(tmp_path, TINY, range(1, 3))
    (tmp_path / "world.json").write_bytes(msgspec.json.encode(TINY))
    clips = PairedClips.open(tmp_path)
    assert list(clips.seeds) == [0, 1, 2]


@pytest.mark.slow
@needs_egl
def test_sigterm_stops_the_workers_and_keeps_whole_shards(tmp_path: Path) -> None:
    size = "--width 48 --height 32 --frames 2 --oversample 1 --clips-per-shard 1"
    line = f"generate driving --out {tmp_path} --clips 5000 --workers 2 {size}".split()
    code = "from gcd_train.cli.main import main; main()"
    running = subprocess.Popen([sys.executable, "-c", code, *line], stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
    while not list(tmp_path.glob("*.zip")) and time.monotonic() < deadline:
        time.sleep(0.1)
    running.terminate()
    _, said = running.communicate(timeout=60)  # returns only once no worker holds the pipe any more
    assert running.returncode == 130, said
    assert "run the same line to go on" in said
    assert len(PairedClips.open(tmp_path)) >= 1
    assert not list(tmp_path.glob("*.partial"))


@needs_egl
def test_a_failing_scene_leaves_no_shard(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError("driver lost")

    monkeypatch.setattr(Renderer, "views", broken)
    with pytest.raises(RuntimeError, match="driver lost"):
        write_shard(tmp_path, TINY, range(2))
    assert list(tmp_path.iterdir()) == []
