"""`gcd-train cache`: the frozen encoders run once over the driving set."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

from rich.console import Console
from typer import Argument, Option

from gcd_train.cli.common import errors_shown
from gcd_train.errors import DataError, RecipeError

if TYPE_CHECKING:
    from gcd_train.data.cache import SceneShard
    from gcd_train.data.cache_writer import CacheJob
    from gcd_train.data.dataset4d import Dataset4D
    from gcd_train.data.splits import Part

Data: TypeAlias = Annotated[
    Path, Argument(metavar="DATA", help="Folder with scene_000000 and so on (ParallelDomain-4D's layout).")
]
Weights: TypeAlias = Annotated[
    str, Option(help="Checkpoint with the encoders: a path, package:NAME; random:driving, small ones, to try it out.")
]
Out: TypeAlias = Annotated[Path, Option(help="Folder of the cache; run the same line again to go on.")]
Workers: TypeAlias = Annotated[int, Option(min=1, help="Processes; each loads the encoders.")]
Ray: TypeAlias = Annotated[str | None, Option("--ray", help="Address of a Ray cluster (extra `cluster`).")]
Split: TypeAlias = Annotated[
    Literal["train", "val", "test"] | None,
    Option(help="Part of the set, needs --split-file; the whole set if left out."),
]
SplitFile: TypeAlias = Annotated[Path | None, Option(help="JSON with the scenes of train, val and test.")]
Copies: TypeAlias = Annotated[int, Option(min=1, help="Differently noised latents of every source frame.")]
PathChoice: TypeAlias = Annotated[
    Literal["gradual", "direct", "both"],
    Option(help="Clips to encode for: the camera moves (gradual), or is there at once (direct)."),
]
Semantic: TypeAlias = Annotated[bool, Option("--semantic", help="Targets show the classes instead of colour.")]
Exact: TypeAlias = Annotated[
    bool, Option("--exact", help="Draw targets from geometry.npz, which generated scenes have, not from points.")
]
Limit: TypeAlias = Annotated[int | None, Option(min=1, help="Only the first so many scenes.")]
Seed: TypeAlias = Annotated[int, Option(min=0, help="Seed of the pixel noise.")]
FamilyName: TypeAlias = Annotated[
    str | None,
    Option("--family", help="Family of the weights, where the file does not tell (see `gcd-train families`)."),
]
Device: TypeAlias = Annotated[str, Option(help="auto, cpu, cuda or cuda:N.")]
Dtype: TypeAlias = Annotated[str, Option(help="Type the encoders run in: float32, bfloat16 or float16.")]
Batch: TypeAlias = Annotated[
    int, Option(min=1, help="Pictures in one call of the encoder; changes memory, not the latents.")
]

_OUT = Console(highlight=False, soft_wrap=True)


def cache(
    data: Data,
    weights: Weights,
    out: Out,
    workers: Workers = 1,
    ray: Ray = None,
    split: Split = None,
    split_file: SplitFile = None,
    copies: Copies = 4,
    path: PathChoice = "both",
    semantic: Semantic = False,
    exact: Exact = False,
    limit: Limit = None,
    seed: Seed = 0,
    family: FamilyName = None,
    device: Device = "auto",
    dtype: Dtype = "float32",
    batch: Batch = 2,
) -> None:
    """Encode a driving set once, so that training never runs the frozen encoders again."""
    from gcd_train.data.cache import ClipPlan
    from gcd_train.data.cache_writer import CacheJob, DrivingPictures, EncoderChoice, identity_of, load_encoders
    from gcd_train.data.pictures import PictureOptions

    with errors_shown():
        choice = EncoderChoice(weights=weights, family=family, device=device, dtype=dtype, batch=batch)
        config = load_encoders(choice)[0].networks.config
        plan = ClipPlan(clip_frames=config.frames, paths=("gradual", "direct") if path == "both" else (path,))
        scenes = _dataset(data, split, split_file, limit, semantic)
        drawn = PictureOptions(
            size=(config.width, config.height), modality="classes" if semantic else "rgb", exact=exact
        )
        pictures = DrivingPictures(scenes, config.frames, drawn)
        identity = identity_of(choice, pictures, plan, copies=copies, seed=seed)
        _run(CacheJob(folder=out, pictures=pictures, choice=choice, identity=identity), workers, ray)


def _dataset(
    root: Path, split: "Part | None", split_file: Path | None, limit: int | None, semantic: bool
) -> "Dataset4D":
    from gcd_train.data.files import Skips
    from gcd_train.data.parallel_domain4d import ParallelDomain4D
    from gcd_train.data.splits import present, read_split

    data = ParallelDomain4D(root, classes=semantic)
    if (split is None) != (split_file is None):
        raise RecipeError("a part of the set is named with both --split and --split-file; give both or neither")
    scenes = data.scenes
    if split_file is not None and split is not None:
        skips = Skips()
        scenes = present(read_split(split_file, split), data.scenes, skips, split_file)
        for line in skips.lines():
            _OUT.print(line, markup=False)
    return data.only(scenes[:limit])


def _run(job: "CacheJob", workers: int, ray: str | None) -> None:
    from gcd_train.data.cache import only_writer
    from gcd_train.data.cache_writer import cache_scenes

    folder, scenes, started = job.folder, job.pictures.scenes, time.perf_counter()
    encoded, failed, total, there = 0, 0, 0, 0
    with only_writer(folder):
        there = len(_kept(folder, scenes))
        for number, outcome in enumerate(cache_scenes(job, scenes, workers=workers, ray_address=ray), start=1):
            entry = outcome.value
            if entry is None:
                failed += 1
                _OUT.print(f"{outcome.item}  left out: {outcome.error}", markup=False)
                continue
            encoded, total = encoded + 1, total + entry.bytes
            left_s = (time.perf_counter() - started) / number * (len(scenes) - there - number)
            missing = f"  {len(entry.missing)} frames missing" if entry.missing else ""
            _OUT.print(
                f"{outcome.item}  {entry.bytes / 1e6:.2f} MB  {entry.seconds:.1f} s{missing}   {there + encoded} of "
                f"{len(scenes)} scenes, all: {_size(total / encoded * len(scenes))}, {left_s / 60:.0f} min left",
                markup=False,
            )
    _close(folder, scenes, failed)


def _kept(folder: Path, scenes: Sequence[str]) -> "list[SceneShard]":
    """Of these scenes those that the index has."""
    from gcd_train.data.cache import CacheIndex, read_index

    index = read_index(folder, CacheIndex)
    return [] if index is None else [index.scenes[name] for name in scenes if name in index.scenes]


def _size(count: float) -> str:
    """Bytes in words."""
    return f"{count / 1e9:.2f} GB" if count >= 1e9 else f"{count / 1e6:.2f} MB"


def _close(folder: Path, scenes: Sequence[str], failed: int) -> None:
    kept = _kept(folder, scenes)
    if kept:
        size, seconds = sum(entry.bytes for entry in kept), sum(entry.seconds for entry in kept)
        missing = sum(len(entry.missing) for entry in kept)
        _OUT.print(
            f"{folder}: {len(kept)} scenes, {_size(size)}, {size / len(kept) / 1e6:.2f} MB and "
            f"{seconds / len(kept):.1f} s a scene, {missing} frames missing (named in index.json)",
            markup=False,
        )
    if failed:
        raise DataError(f"{failed} of {len(scenes)} scenes could not be cached, see above; the others are whole")
