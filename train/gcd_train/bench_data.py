"""What data costs on this machine: making scenes, reading them, drawing targets from their points, bytes per sample.

Times are CPU seconds of this process, all threads together: what else the machine does hardly shows in them.
"""

import os
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

import msgspec
import numpy as np
import torch

from gcd_train.datasets.dataset4d import Dataset4D
from gcd_train.datasets.kubric4d import Kubric4D
from gcd_train.datasets.parallel_domain4d import ParallelDomain4D
from gcd_train.datasets.picture_files import bytes_read
from gcd_train.datasets.trajectories import DRIVING, MAX90, Sampling
from gcd_train.datasets.view_pairs import ViewPairs
from gcd_train.layouts.scene_writer import SceneFormat, SceneMade, write_scene
from gcd_train.map_items import one_thread_each
from gcd_train.pointcloud import published_picture
from gcd_train.scenes.worlds import SCENE_WORLDS, SceneWorld

CLIP_FRAMES = 14
_FIRST_SEED = 3_000_000  # in no data set
_TARGETS = 7


class Figure(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One measured number.

    median, lowest, highest, count: of what was measured, in `unit`. wanted: at most this on two cores, None where
    nothing was set. published: what the released tools need for the same, in words. note: how it was come by.
    """

    name: str
    unit: str
    median: float
    lowest: float
    highest: float
    count: int
    wanted: float | None = None
    published: str = ""
    note: str = ""


class DataReport(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """cores: of the machine; everything ran on one. machine_load: average of the last minute before. quick: scenes were
    made in part and their figures extrapolated. shrink: pictures were so much smaller; their figures compare with none.
    """

    cores: int
    machine_load: float
    quick: bool
    shrink: int
    figures: tuple[Figure, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class BenchDataOptions:
    """scenes: whole ones of each world and edition. quick: make only the first frames of each and extrapolate, from
    two scenes of so many frames. samples: training samples read whole; not in quick mode. shrink: divide the pictures'
    sides by this, for trying it out.
    """

    scenes: int = 1
    quick: bool = False
    samples: int = 2
    shrink: int = 1
    quick_frames: tuple[int, int] = (2, 6)


@dataclass(frozen=True, kw_only=True, slots=True)
class _Kind:
    """A world. published_mb: what the released tools read for one training sample of its data set."""

    world: SceneWorld
    cameras: int
    open: Callable[[Path], Dataset4D]
    sampling: Sampling
    published_mb: float


@dataclass(frozen=True, kw_only=True, slots=True)
class _Edition:
    """How scenes are stored, and what a whole one may cost: compact without, or as published with anti-aliasing."""

    name: str
    compact: bool
    oversample: int
    wanted_cpu_s: float
    wanted_mb: float | None


# 14 frames of the released point-cloud caches: 42.5 MB each for Kubric-4D, 64 MB for ParallelDomain-4D.
_KINDS = (
    _Kind(world=SCENE_WORLDS["drop"], cameras=16, open=Kubric4D.open, sampling=MAX90, published_mb=595.0),
    _Kind(world=SCENE_WORLDS["driving"], cameras=19, open=ParallelDomain4D.open, sampling=DRIVING, published_mb=896.0),
)
_EDITIONS = (
    _Edition(name="compact", compact=True, oversample=1, wanted_cpu_s=90.0, wanted_mb=60.0),
    _Edition(name="published", compact=False, oversample=2, wanted_cpu_s=220.0, wanted_mb=None),
)


def bench_data(folder: Path, options: BenchDataOptions, on_part: Callable[[str], None]) -> DataReport:
    """Measure everything, one after another, with scenes made in `folder`; `on_part` is told what comes next.

    Raises:
        RenderError: nothing can be drawn here. OSError: the disk is full, or cannot be written.
    """
    load = os.getloadavg()[0]
    one_thread_each()
    figures: list[Figure] = []
    with _one_thread():
        for kind in _KINDS:
            write_scene(folder / "unmeasured", kind.world, _form(kind.world, _EDITIONS[0], options, 1), _FIRST_SEED)
            for edition in _EDITIONS:
                on_part(f"{kind.world.name}, {edition.name}: making scenes")
                place = folder / f"{kind.world.name}-{'compact' if edition.compact else 'published'}"
                figures += _making(place, kind, edition, options)
                on_part(f"{kind.world.name}, {edition.name}: reading and drawing")
                figures += _using(place, kind, edition, options)
    if options.shrink != 1:
        figures = [msgspec.structs.replace(each, wanted=None, published="") for each in figures]
    return DataReport(
        cores=os.cpu_count() or 1,
        machine_load=load,
        quick=options.quick,
        shrink=options.shrink,
        figures=tuple(figures),
    )


def _making(place: Path, kind: _Kind, edition: _Edition, options: BenchDataOptions) -> Iterator[Figure]:
    """Cost and size of whole scenes."""
    whole, note = kind.world.frames, f"{kind.world.frames} frames, {kind.cameras} cameras"
    if options.quick:
        few, more = options.quick_frames
        made = [_made(place / str(n), kind, edition, options, n, _FIRST_SEED) for n in (few, more)]
        cpu_s = [extrapolated(few, made[0].cpu_s, more, made[1].cpu_s, whole)]
        mb = [extrapolated(few, made[0].size / 1e6, more, made[1].size / 1e6, whole)]
        note = f"extrapolated from {few} and {more} of {whole} frames, {kind.cameras} cameras"
    else:
        seeds = range(_FIRST_SEED, _FIRST_SEED + options.scenes)
        made = [_made(place / str(whole), kind, edition, options, whole, seed) for seed in seeds]
        cpu_s, mb = [each.cpu_s for each in made], [each.size / 1e6 for each in made]
    name = f"{kind.world.name}, {edition.name}: whole scene"
    yield _figure(name, "CPU s", cpu_s, wanted=edition.wanted_cpu_s, note=note)
    yield _figure(name, "MB", mb, wanted=edition.wanted_mb, note=note)


def _using(place: Path, kind: _Kind, edition: _Edition, options: BenchDataOptions) -> Iterator[Figure]:
    """Cost of reading a time step, of drawing a target from it, and of a whole training sample."""
    frames = options.quick_frames[1] if options.quick else kind.world.frames
    data = kind.open(place / str(frames))
    scene, name = data.scenes[0], f"{kind.world.name}, {edition.name}"
    steps = range(0, frames, max(1, frames // 6))
    data.views(scene, 0)  # metadata is read once a scene
    reading = [_reading(data, scene, step) for step in steps]
    yield _figure(f"{name}: reading a time step", "CPU s", [cpu_s for cpu_s, _ in reading], note="from memory")
    if edition.compact:
        yield _drawing(kind, data, scene)
    told = f"{kind.published_mb:g} MB, cached clouds"
    if options.quick:
        mb = [CLIP_FRAMES * size / 1e6 for _, size in reading]
        note = f"{CLIP_FRAMES} times a time step"
        yield _figure(f"{name}: read for a training sample", "MB", mb, published=told, note=note)
        return
    pairs = ViewPairs(data, kind.sampling)
    samples = [_sampled(pairs, number) for number in range(options.samples)]
    yield _figure(f"{name}: read for a training sample", "MB", [mb for _, mb in samples], published=told)
    drawn = f"reads {CLIP_FRAMES} time steps, draws all targets"
    yield _figure(f"{name}: a training sample", "CPU s", [cpu_s for cpu_s, _ in samples], note=drawn)


def _drawing(kind: _Kind, data: Dataset4D, scene: str) -> Figure:
    """Targets along one of the paths that training draws."""
    views, lens = data.views(scene, 0), data.lens(scene)
    draw = kind.sampling.draw(np.random.default_rng(0), kind.world.frames, kind.world.fps)
    poses = draw.world_from_target[:: CLIP_FRAMES // _TARGETS]
    published_picture(views, poses[0], lens)
    points = sum(view.depth.size for view in views) / 1e6
    return _figure(
        f"{kind.world.name}: drawing a 384x256 target",
        "CPU s",
        [_cpu_s(lambda pose=pose: published_picture(views, pose, lens)) for pose in poses],
        wanted=1.0 if kind.world.name == "drop" else None,
        published="a GPU of its own",
        note=f"{len(views)} views, {points:.1f} M points; splatted at 420x280, filled, resized",
    )


def _made(root: Path, kind: _Kind, edition: _Edition, options: BenchDataOptions, frames: int, seed: int) -> SceneMade:
    return write_scene(root, kind.world, _form(kind.world, edition, options, frames), seed)


def _form(world: SceneWorld, edition: _Edition, options: BenchDataOptions, frames: int) -> SceneFormat:
    form = SceneFormat.of(world, oversample=edition.oversample, compact=edition.compact)
    return replace(form, frames=frames, width=form.width // options.shrink, height=form.height // options.shrink)


def extrapolated(few: int, at_few: float, more: int, at_more: float, whole: int) -> float:
    """What `whole` frames would take, on the straight line through what `few` and `more` took."""
    return at_few + (at_more - at_few) * (whole - few) / (more - few)


def _reading(data: Dataset4D, scene: str, step: int) -> tuple[float, int]:
    """CPU seconds and bytes of a time step, all cameras."""
    before = bytes_read()
    cpu_s = _cpu_s(lambda: data.views(scene, step))
    return cpu_s, bytes_read() - before


def _sampled(pairs: ViewPairs, number: int) -> tuple[float, float]:
    """CPU seconds and megabytes of a training sample."""
    started = time.process_time()
    sample = pairs.sample(number)
    return time.process_time() - started, sample.bytes_read / 1e6


def _cpu_s(work: Callable[[], object]) -> float:
    started = time.process_time()
    work()
    return time.process_time() - started


def _figure(
    name: str, unit: str, values: Sequence[float], *, wanted: float | None = None, published: str = "", note: str = ""
) -> Figure:
    return Figure(
        name=name,
        unit=unit,
        median=median(values),
        lowest=min(values),
        highest=max(values),
        count=len(values),
        wanted=wanted,
        published=published,
        note=note,
    )


@contextmanager
def _one_thread() -> Generator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
