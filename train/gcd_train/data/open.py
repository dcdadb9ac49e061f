"""From a recipe's [data] and the folders a user names to what a run learns from and is measured on."""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import msgspec
import torch

from gcd_model.config import ModelConfig
from gcd_model.weights.card import Family
from gcd_train.data import kubric4d, parallel_domain4d
from gcd_train.data.cache import CachedLatents
from gcd_train.data.dataset4d import Dataset4D, Ontology
from gcd_train.data.files import MANIFEST, Skips, read_manifest
from gcd_train.data.kubric4d import Kubric4D
from gcd_train.data.lerobot import LeRobotPairs
from gcd_train.data.pairs import PairedClips, data_folders
from gcd_train.data.parallel_domain4d import ParallelDomain4D
from gcd_train.data.paths import DRIVING_FRAMES, KUBRIC_FRAMES, DrivingSampling, FrameSampling, OrbitSampling, Sampling
from gcd_train.data.pictures import PictureOptions, ViewPairs
from gcd_train.data.sample import Bytes, Clips, MadeClips, Sample, Samples, VideoSamples, painted, video_clips
from gcd_train.data.splits import Part, kubric_split, present, read_split, require_apart
from gcd_train.data.videos import FilmedPairs, filmed_scenes
from gcd_train.errors import DataError, RecipeError
from gcd_train.recipe import Recipe
from gcd_train.recipe_data import DataRecipe
from gcd_train.training.setup import digest_of

_FIXED_SEED = 0  # of the clips that are measured on: the same ones in every run
_VIDEO_FAMILY = "svd"


@dataclass(frozen=True, kw_only=True, slots=True)
class RunData:
    """clips: to learn from, for stages that take them one by one, all at the recipe's fps. valid: held out.

    drawn: what the U-Net's batches are made of where it is neither encoded clips nor `clips`.
    """

    clips: Clips
    valid: Clips
    drawn: Samples | CachedLatents | None = None


def open_data(recipe: Recipe, config: ModelConfig, family: Family, data: Path, valid: Path | None = None) -> RunData:
    """Open what a recipe's [data] says the folders hold.

    data: to learn from. valid: held out; None to hold out a part of `data`.

    Raises:
        DataError: no such data there, nothing is left to measure on, or both parts share scenes or episodes.
        RecipeError: an option does not fit the data or the family.
    """
    if recipe.data.task == "image-to-video" and recipe.model.family != _VIDEO_FAMILY:
        raise RecipeError(
            f'data.task "image-to-video" makes a model without views, model.family is {recipe.model.family!r}: give '
            f'model.family "{_VIDEO_FAMILY}"'
        )
    if config.splat == "given" and recipe.data.kind in ("lerobot", "videos"):
        raise RecipeError(f'data.kind {recipe.data.kind!r} has no depth to splat with: set model.splat to "estimated"')
    opening = _Opening(recipe, config, family, data, valid)
    match recipe.data.kind:
        case "pairs":
            return opening.pairs()
        case "kubric4d" | "parallel_domain4d":
            return opening.views()
        case "lerobot":
            return opening.lerobot()
        case "videos":
            return opening.videos()
        case "cache":
            return opening.cache()


@dataclass(frozen=True, slots=True)
class _Opening:
    recipe: Recipe
    config: ModelConfig
    family: Family
    folder: Path
    valid: Path | None

    @property
    def _data(self) -> DataRecipe:
        return self.recipe.data

    def pairs(self) -> RunData:
        data, valid = self.folder, self._valid_folder("pairs have no split of their own")
        if self._data.task == "image-to-video":  # both sides of all pairs: the folders need not go the same way
            learned, held = (tuple(map(PairedClips.open, data_folders(place))) for place in (data, valid))
            require_apart(
                *({name: world for each in part for name, world in each.scenes.items()} for part in (learned, held))
            )
            return RunData(clips=video_clips(learned), valid=video_clips(held))
        with_depth = self.config.splat == "given"
        clips, held_out = (replace(PairedClips.open(place), depth=with_depth) for place in (data, valid))
        require_apart(clips.scenes, held_out.scenes)
        for each, folder in ((clips, data), (held_out, valid)):
            goal, reached = self._data.goal_frame(each.frames), each.trajectory(0).at_goal.index(True)
            if goal != reached:
                raise DataError(
                    f"the cameras in {folder} are at their goal in frame {reached}, the recipe's data.path says frame "
                    f"{goal}; change data.path, or make the clips with `gcd-train generate driving --path` so"
                )
        if self._data.modality == "semantic":
            return RunData(clips=painted(clips), valid=painted(held_out))
        return RunData(clips=clips, valid=held_out)

    def views(self) -> RunData:
        if self._data.kind == "kubric4d":
            self._require_family_covers_orbit()
        whole, valid = self._dataset(self.folder), self.valid
        learned, held = (whole, self._dataset(valid)) if valid is not None else self._parts(whole)
        require_apart(_worlds_of(learned), _worlds_of(held))
        sampling = sampling_of(self.recipe, self.config.frames)
        return RunData(
            clips=self._one_rate(learned, learned.fps, repeats=self._data.repeats),
            valid=self._one_rate(held, held.fps),
            drawn=self._sides(self._pairs(learned, sampling, self.recipe.seed, self._data.repeats)),
        )

    def lerobot(self) -> RunData:
        held_out = 0 if self.valid else self._data.held_out
        learned = self._episodes(self.folder, (0, -held_out or None))
        held = self._episodes(self.valid or self.folder, (-held_out, None))
        require_apart(*({episode.name: episode.data for episode in part.episodes} for part in (learned, held)))
        return self._run(learned, held, len(held.episodes), held.fps)

    def videos(self) -> RunData:
        scenes, held_out = filmed_scenes(self.folder), self._data.held_out
        if self.valid is None:
            if len(scenes) <= held_out:
                raise DataError(
                    f"{self.folder} has {len(scenes)} scenes, and data.held_out keeps {held_out} of them to "
                    "measure on; hold out fewer, or give --valid FOLDER"
                )
            learned, held = scenes[:-held_out], scenes[-held_out:]
        else:
            learned, held = scenes, filmed_scenes(self.valid)
        require_apart(*({scene.name: scene.cameras[0].video for scene in part} for part in (learned, held)))
        fps, seed, repeats = self.recipe.unet.fps, self.recipe.seed, self._data.repeats
        size, frames = (self.config.width, self.config.height), self.config.frames
        pairs = FilmedPairs(learned, size=size, frames=frames, fps=fps, seed=seed, repeats=repeats)
        valid = FilmedPairs(held, size=size, frames=frames, fps=fps, seed=_FIXED_SEED)
        return self._run(pairs, valid, len(valid), fps)

    def _run(self, learned: Samples, held: Samples, count: int, fps: float) -> RunData:
        """count: of the clips that are measured on."""
        made = partial(self._clips, fps=fps, drawn_by=(self.recipe.seed,))
        clips, valid = made(learned, len(learned)), made(held, count)
        return RunData(clips=clips, valid=valid, drawn=self._sides(learned))

    def cache(self) -> RunData:
        if self.recipe.vae is not None or self.recipe.latents is not None:
            raise RecipeError("a latent cache is of a frozen autoencoder: leave out [vae] and [latents]")
        cache, valid = CachedLatents.open(self.folder), self._valid_folder("a latent cache holds no pictures")
        self._require_drawn_as_cached(cache)
        held = self._dataset(valid)
        if self._data.split == "last" or self._data.split_file is not None:
            held = held.only(self._part(held.scenes, "val"))
        require_apart(dict.fromkeys(cache.scenes, ""), dict.fromkeys(held.scenes, ""))
        clips = self._one_rate(held, held.fps)
        return RunData(clips=clips, valid=clips, drawn=cache)

    def _dataset(self, root: Path) -> Dataset4D:
        cameras, published = self._data.cameras, self._data.published
        if self._data.kind == "kubric4d":
            return Kubric4D(root, cameras=cameras or kubric4d.CAMERAS, published=published)
        classes = self._data.modality == "semantic"
        return ParallelDomain4D(root, cameras=cameras or parallel_domain4d.CAMERAS, classes=classes)

    def _parts(self, whole: Dataset4D) -> tuple[Dataset4D, Dataset4D]:
        """What to learn from, and what to measure on, of one folder."""
        learned, held_out = (self._part(whole.scenes, part) for part in ("train", "val"))
        if not learned or not held_out:
            raise DataError(
                f"{self.folder} has {len(whole.scenes)} scenes: {len(learned)} to learn from and {len(held_out)} "
                'to measure on; give --valid FOLDER, or hold out the last ones with data.split "last" and data.held_out'
            )
        return whole.only(learned), whole.only(held_out)

    def _part(self, scenes: tuple[str, ...], part: Part) -> tuple[str, ...]:
        data = self._data
        if data.split == "last":
            first_held = max(len(scenes) - data.held_out, 0)
            return scenes[:first_held] if part == "train" else scenes[first_held:]
        if data.kind == "kubric4d":
            return kubric_split(scenes, part)
        if data.split_file is None:
            raise RecipeError(
                "ParallelDomain-4D is split by a file: give data.split_file, or --valid FOLDER, or hold out the last "
                'scenes with data.split "last"'
            )
        return present(read_split(Path(data.split_file), part), scenes, Skips(), data.split_file)

    def _pairs(
        self, data: Dataset4D, sampling: Sampling, seed: int, repeats: int, *, class_ids: bool = False
    ) -> ViewPairs:
        recipe = self._data
        options = PictureOptions(
            size=(self.config.width, self.config.height),
            modality="classes" if recipe.modality == "semantic" else "rgb",
            class_ids=class_ids,
            depth=self.config.splat == "given",
            exact=recipe.exact,
            published=recipe.published,
            device=_splat_device(recipe),
        )
        return ViewPairs(data, sampling, seed, options, repeats=repeats)

    def _one_rate(self, data: Dataset4D, fps: float, repeats: int = 1) -> Clips:
        """Clips at the rate that the recipe names, forwards; always the same ones."""
        wanted = self.recipe.unet.fps
        stride = max(round(fps / wanted), 1)
        if fps / stride != wanted:
            raise RecipeError(f"unet.fps is {wanted:g}, and no stride makes that of the set's {fps:g}")
        sampling = sampling_of(self.recipe, self.config.frames, stride=stride)
        semantic = self._data.modality == "semantic"
        pairs = self._pairs(data, sampling, _FIXED_SEED, repeats, class_ids=semantic)
        return self._clips(pairs, len(pairs), wanted, data.ontology if semantic else None)

    def _clips(
        self,
        samples: Samples,
        count: int,
        fps: float,
        ontology: Ontology | None = None,
        drawn_by: tuple[int, ...] = (),
    ) -> Clips:
        """drawn_by: what more decides which frames a clip has; sets of one origin are the same."""
        sides, config = self._sides(samples), self.config
        size = (config.frames, config.height, config.width)
        return MadeClips(
            make=sides.sample if ontology is None else partial(_placed, sides, ontology.places),
            seeds=range(count if sides is samples else 2 * count),
            camera=self.config.camera,
            fps=fps,
            origin=digest_of(self._data, str(self.folder), fps, size, drawn_by),
            classes=() if ontology is None else ontology.classes,
        )

    def _sides(self, samples: Samples) -> Samples:
        return VideoSamples(samples) if self._data.task == "image-to-video" else samples

    def _episodes(self, folder: Path, episodes: tuple[int, int | None]) -> LeRobotPairs:
        options = self._data.lerobot
        return LeRobotPairs(
            folder,
            self.recipe.seed,
            frames=self.config.frames,
            fps=self.recipe.unet.fps,
            size=(self.config.width, self.config.height),
            cameras=options.cameras,
            calibration=None if options.calibration is None else Path(options.calibration),
            repeats=self._data.repeats,
            episodes=episodes,
        )

    def _valid_folder(self, why: str) -> Path:
        if self.valid is None:
            raise DataError(f"{why}: give --valid FOLDER to measure on")
        return self.valid

    def _require_drawn_as_cached(self, cache: CachedLatents) -> None:
        """What a cache was made of cannot be drawn otherwise. Raises RecipeError naming the options."""
        data, unet, config, kept = self._data, self.recipe.unet, self.config, cache.index.identity
        frames = data.frames
        wrong = {
            "model.camera": config.camera != "none",
            "model.frames": config.frames != kept.plan.clip_frames,
            "model.splat": config.splat != kept.splat,
            "model.height and model.width": (config.height, config.width) != (kept.height, kept.width),
            "unet.augmentation": unet.augmentation != kept.augmentation,
            "unet.loss.class_weights": unet.loss.class_weights != "none" and not kept.emphasis,
            "data.path": data.path not in kept.plan.paths,
            "data.modality": (data.modality == "semantic") != kept.emphasis,
            "data.move_time": data.move_time not in (None, 0 if data.path == "direct" else config.frames - 1),
            "data.frames.strides": frames.strides is not None and set(frames.strides) != set(kept.plan.strides),
            "data.frames.latest_start": frames.latest_start is not None,
            "data.frames.reverse": bool(frames.reverse),
            "data.frames.reach_last": frames.reach_last,
        }
        named = [name for name, is_wrong in wrong.items() if is_wrong]
        if named:
            kind = "class colours" if kept.emphasis else "colour"
            raise RecipeError(
                f"{cache.folder} holds {' and '.join(kept.plan.paths)} clips in {kind}, {kept.plan.clip_frames} "
                f"frames of {kept.width}x{kept.height} at strides {kept.plan.strides}, forwards, of one path, up to "
                f"the last frame but one, with augmentation {kept.augmentation:g}; the recipe's {', '.join(named)} "
                "wants another thing: change the recipe, or make the cache anew"
            )

    def _require_family_covers_orbit(self) -> None:
        orbit, limits = self._data.orbit, self.family.limits
        if limits is None:
            return
        largest = (orbit.max_azimuth_deg, orbit.max_elevation_deg, orbit.max_radius_m)
        allowed = (limits.azimuth_deg, limits.elevation_deg, limits.radius_m)
        if any(far > most for far, most in zip(largest, allowed, strict=True)):
            raise RecipeError(
                f"data.orbit goes to {largest} (azimuth, elevation, radius), family {self.family.name} to {allowed}: "
                "nobody could ask for the views beyond; change model.family or data.orbit"
            )


def _placed(samples: Samples, places: Bytes, number: int) -> Sample:
    """A sample whose class ids are their places in the ontology."""
    sample = samples.sample(number)
    return replace(sample, target_classes=places[sample.target_classes])


def _worlds_of(data: Dataset4D) -> dict[str, str]:
    """Scenes by name, with their world where they are ours."""
    folders = {scene: data.folder(scene) for scene in data.scenes}
    return {
        scene: read_manifest(folder).world if (folder / MANIFEST).exists() else "" for scene, folder in folders.items()
    }


def sampling_of(recipe: Recipe, frames: int, *, stride: int | None = None) -> Sampling:
    """Frames and camera paths as [data] has them; all clips forwards with one stride, if that is given.

    frames: T. Raises RecipeError for impossible bounds.
    """
    data, told = recipe.data, recipe.data.frames
    orbits = data.kind == "kubric4d"
    released = KUBRIC_FRAMES if orbits else DRIVING_FRAMES
    chosen = FrameSampling(
        clip=frames,
        strides=(stride,) if stride is not None else told.strides or released.strides,
        latest_start=released.latest_start if told.latest_start is None else told.latest_start,
        reach_last=told.reach_last,
        reverse=0.0 if stride is not None else released.reverse if told.reverse is None else told.reverse,
    )
    move_time = data.goal_frame(frames)
    if not orbits:
        return DrivingSampling(move_time=move_time, frames=chosen)
    return OrbitSampling(**msgspec.structs.asdict(data.orbit), move_time=move_time, frames=chosen)


def _splat_device(recipe: DataRecipe) -> str:
    """By its number, as a loader's worker does not know its process's GPU. Raises RecipeError if there is none."""
    if recipe.splat_device == "cpu":
        return "cpu"
    if not torch.cuda.is_available():
        raise RecipeError('data.splat_device is "cuda" but this machine has no CUDA device; use "cpu"')
    return f"cuda:{torch.cuda.current_device()}"
