"""From a recipe's [data] and the folders a user names to what a run learns from and is measured on."""

from dataclasses import dataclass
from filecmp import cmp
from pathlib import Path
from typing import TypeVar

from gcd_model import Family, ModelConfig
from gcd_model.networks import Networks
from gcd_train.datasets.clip_frames import DRIVING_FRAMES, KUBRIC_FRAMES, FrameSampling
from gcd_train.datasets.clip_source import PaintedClips
from gcd_train.datasets.dataset4d import Dataset4D
from gcd_train.datasets.kubric4d import Kubric4D
from gcd_train.datasets.ontology import Ontology
from gcd_train.datasets.paired import PairedClips, data_folders, require_apart
from gcd_train.datasets.parallel_domain4d import ParallelDomain4D
from gcd_train.datasets.sample_clips import SampleClips
from gcd_train.datasets.skips import Skips
from gcd_train.datasets.splits import Part, kubric_split, present, read_split, require_none_shared
from gcd_train.datasets.trajectories import DrivingSampling, OrbitSampling, Sampling
from gcd_train.datasets.videos import VideoClips, VideoSamples
from gcd_train.datasets.view_pairs import ViewPairs
from gcd_train.errors import DataError, RecipeError
from gcd_train.latent_cache import CachedLatents
from gcd_train.latent_cache.batches import CachedBatches
from gcd_train.layouts.manifest import MANIFEST, read_manifest
from gcd_train.lerobot.pairs import LeRobotOptions, LeRobotPairs
from gcd_train.pair_batches import PairBatches
from gcd_train.recipe import Recipe
from gcd_train.recipe_data import DataRecipe
from gcd_train.run_data import DataPlaces, RunData
from gcd_train.sample_loader import Samples
from gcd_train.training.objective import BatchMaker, BatchSource
from gcd_train.training.setup import Precision, digest_of

_FIXED_SEED = 0  # of the clips that are measured on: the same ones in every run
Set = TypeVar("Set", Kubric4D, ParallelDomain4D)


def open_data(recipe: Recipe, config: ModelConfig, family: Family, places: DataPlaces) -> RunData:
    """Open what a recipe's [data] says the folders hold.

    Raises:
        DataError: no such data there, nothing is left to measure on, or both parts share scenes or episodes.
        RecipeError: an option does not fit the data or the family.
    """
    if recipe.data.task == "image-to-video":
        require_image_to_video(recipe, config)
    opening = _Opening(recipe, config, family, places)
    match recipe.data.kind:
        case "pairs":
            return opening.pairs()
        case "kubric4d" | "parallel_domain4d":
            return opening.views()
        case "lerobot":
            return opening.lerobot()
        case "cache":
            return opening.cache()


@dataclass(frozen=True, slots=True)
class _Opening:
    recipe: Recipe
    config: ModelConfig
    family: Family
    places: DataPlaces

    @property
    def _data(self) -> DataRecipe:
        return self.recipe.data

    def pairs(self) -> RunData:
        valid = self._valid_folder("pairs have no split of their own")
        return open_pairs(self.recipe, self.config, self.places.data, valid)

    def views(self) -> RunData:
        if self._data.kind == "kubric4d":
            self._require_family_covers_orbit()
            return self._views(*self._parts(self._kubric(self.places.data)))
        return self._views(*self._parts(self._driving(self.places.data)))

    def lerobot(self) -> RunData:
        held_out = 0 if self.places.valid else self._data.held_out
        learned = self._episodes(self.places.data, (0, -held_out or None))
        held = self._episodes(self.places.valid or self.places.data, (-held_out, None))
        require_none_shared(_shared_episodes(learned, held))
        return RunData(
            clips=self._clips(learned, len(learned), learned.fps),
            valid=self._clips(held, len(held.episodes), held.fps),
            batches=self._sampled(learned),
        )

    def cache(self) -> RunData:
        if self.recipe.vae is not None or self.recipe.latents is not None:
            raise RecipeError("a latent cache is of a frozen autoencoder: leave out [vae] and [latents]")
        cache, valid = CachedLatents.open(self.places.data), self._valid_folder("a latent cache holds no pictures")
        self._require_drawn_as_cached(cache)
        held = self._driving(valid)
        if self._data.split == "last" or self._data.split_file is not None:
            held = held.only(self._part(held, "val"))
        require_none_shared(set(cache.scenes) & set(held.scenes))
        clips = self._one_rate(held, held.fps)

        def batches(networks: Networks, precision: Precision, /) -> BatchSource:
            cached = CachedBatches(cache, self.config, self.recipe.unet, precision, self._data.path)
            cached.require_encoders(networks)
            return cached

        return RunData(clips=clips, valid=clips, batches=batches)

    def _views(self, learned: Kubric4D | ParallelDomain4D, held: Kubric4D | ParallelDomain4D) -> RunData:
        require_none_shared(_shared_scenes(learned, held))
        sampling = sampling_of(self.recipe, self.config.frames)
        return RunData(
            clips=self._one_rate(learned, learned.fps, repeats=self._data.repeats),
            valid=self._one_rate(held, held.fps),
            batches=self._sampled(self._pairs(learned, sampling, self.recipe.seed, self._data.repeats)),
        )

    def _kubric(self, root: Path) -> Kubric4D:
        data = self._data
        if data.cameras is None:
            return Kubric4D.open(root, published=data.published)
        return Kubric4D.open(root, cameras=data.cameras, published=data.published)

    def _driving(self, root: Path) -> ParallelDomain4D:
        data, classes = self._data, self._data.modality == "semantic"
        if data.cameras is None:
            return ParallelDomain4D.open(root, classes=classes)
        return ParallelDomain4D.open(root, cameras=data.cameras, classes=classes)

    def _parts(self, whole: Set) -> tuple[Set, Set]:
        """What to learn from, and what to measure on."""
        if self.places.valid is not None:
            held = self._kubric(self.places.valid) if isinstance(whole, Kubric4D) else self._driving(self.places.valid)
            return whole, held  # pyright: ignore[reportReturnType]  # opened as the other one was
        learned, held_out = (self._part(whole, part) for part in ("train", "val"))
        if not learned or not held_out:
            raise DataError(
                f"{self.places.data} has {len(whole.scenes)} scenes: {len(learned)} to learn from and {len(held_out)} "
                'to measure on; give --valid FOLDER, or hold out the last ones with data.split "last" and data.held_out'
            )
        return whole.only(learned), whole.only(held_out)

    def _part(self, whole: Kubric4D | ParallelDomain4D, part: Part) -> tuple[str, ...]:
        data, scenes = self._data, tuple(whole.scenes)
        if data.split == "last":
            first_held = max(len(scenes) - data.held_out, 0)
            return scenes[:first_held] if part == "train" else scenes[first_held:]
        if isinstance(whole, Kubric4D):
            return kubric_split(scenes, part)
        if data.split_file is None:
            raise RecipeError(
                "ParallelDomain-4D is split by a file: give data.split_file, or --valid FOLDER, or hold out the last "
                'scenes with data.split "last"'
            )
        return present(read_split(Path(data.split_file), part), scenes, Skips(), data.split_file)

    def _pairs(
        self, data: Kubric4D | ParallelDomain4D, sampling: Sampling, seed: int, repeats: int, *, class_ids: bool = False
    ) -> ViewPairs:
        told = self._data
        return ViewPairs(
            data,
            sampling,
            seed,
            (self.config.width, self.config.height),
            repeats=repeats,
            modality="classes" if told.modality == "semantic" else "rgb",
            class_ids=class_ids,
            exact=told.exact,
            published=told.published,
        )

    def _one_rate(self, data: Kubric4D | ParallelDomain4D, fps: float, repeats: int = 1) -> SampleClips:
        """Clips at the rate that the recipe names, forwards; always the same ones."""
        wanted = self.recipe.unet.fps
        stride = max(round(fps / wanted), 1)
        if fps / stride != wanted:
            raise RecipeError(f"unet.fps is {wanted:g}, and no stride makes that of the set's {fps:g}")
        sampling = sampling_of(self.recipe, self.config.frames, stride=stride)
        painted = self._data.modality == "semantic"
        pairs = self._pairs(data, sampling, _FIXED_SEED, repeats, class_ids=painted)
        return self._clips(pairs, len(pairs), wanted, data.ontology if painted else None)

    def _clips(self, samples: Samples, count: int, fps: float, ontology: Ontology | None = None) -> SampleClips:
        origin = digest_of(self._data, str(self.places.data))
        if self._data.task == "image-to-video":
            samples, count = VideoSamples(samples), 2 * count
        return SampleClips(samples, count, camera=self.config.camera, fps=fps, origin=origin, ontology=ontology)

    def _sampled(self, samples: Samples) -> BatchMaker:
        recipe = self.recipe
        if recipe.data.task == "image-to-video":
            samples = VideoSamples(samples)

        def batches(networks: Networks, precision: Precision, /) -> BatchSource:
            loader = recipe.data.loader
            return PairBatches(samples, networks, recipe.unet, self.family, precision, loader, recipe.seed)

        return batches

    def _episodes(self, folder: Path, episodes: tuple[int, int | None]) -> LeRobotPairs:
        told = self._data.lerobot
        options = LeRobotOptions(
            frames=self.config.frames,
            fps=self.recipe.unet.fps,
            size=(self.config.width, self.config.height),
            tolerance_s=told.tolerance_s,
            cameras=told.cameras,
            calibration=None if told.calibration is None else Path(told.calibration),
            repeats=self._data.repeats,
            motion=round(self.recipe.unet.motion_bucket),
            episodes=episodes,
        )
        return LeRobotPairs(folder, self.recipe.seed, options)

    def _valid_folder(self, why: str) -> Path:
        if self.places.valid is None:
            raise DataError(f"{why}: give --valid FOLDER to measure on")
        return self.places.valid

    def _require_drawn_as_cached(self, cache: CachedLatents) -> None:
        """What a cache was made of cannot be drawn otherwise. Raises RecipeError naming the option."""
        data, told, kept = self._data, self._data.frames, cache.index.identity
        wrong = {
            "data.modality": (data.modality == "semantic") != kept.emphasis,
            "data.move_time": data.move_time not in (None, 0 if data.path == "direct" else self.config.frames - 1),
            "data.frames.strides": told.strides is not None and set(told.strides) != set(kept.plan.strides),
            "data.frames.latest_start": told.latest_start is not None,
            "data.frames.reverse": bool(told.reverse),
            "data.frames.reach_last": told.reach_last,
        }
        named = [name for name, is_wrong in wrong.items() if is_wrong]
        if named:
            kind = "class colours" if kept.emphasis else "colour"
            raise RecipeError(
                f"{cache.folder} holds {kind} at strides {kept.plan.strides}, forwards, up to the last frame but one; "
                f"the recipe's {', '.join(named)} wants another thing: change the recipe, or make the cache anew"
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


def _shared_scenes(learned: Dataset4D, held: Dataset4D) -> list[str]:
    """Scenes of one name, and of one world where they are ours."""

    def world(folder: Path) -> str | None:
        return read_manifest(folder).world if (folder / MANIFEST).exists() else None

    both = sorted(set(learned.scenes) & set(held.scenes))
    return [scene for scene in both if world(learned.folder(scene)) == world(held.folder(scene))]


def _shared_episodes(learned: LeRobotPairs, held: LeRobotPairs) -> list[str]:
    """Episodes of one number whose rows lie in the same file, or in one with the same content."""
    places = {episode.number: episode.data for episode in learned.episodes}

    def same(one: Path, other: Path) -> bool:
        return one.is_file() and other.is_file() and cmp(one, other, shallow=False)

    return [each.name for each in held.episodes if each.number in places and same(places[each.number], each.data)]


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
        motion = round(recipe.unet.motion_bucket)
        return DrivingSampling(move_time=move_time, motion=motion, frames=chosen)
    orbit = data.orbit
    return OrbitSampling(
        max_azimuth_deg=orbit.max_azimuth_deg,
        max_elevation_deg=orbit.max_elevation_deg,
        max_radius_m=orbit.max_radius_m,
        azimuth_deg=orbit.azimuth_deg,
        elevation_deg=orbit.elevation_deg,
        radius_m=orbit.radius_m,
        move_time=move_time,
        frames=chosen,
    )


_VIDEO_FAMILY = "svd"


def open_pairs(recipe: Recipe, config: ModelConfig, data: Path, valid: Path) -> RunData:
    """The pairs of two folders, or of the folders in them.

    Raises:
        DataError: no such data there, both share scenes, or their cameras go another way than the recipe says.
        RecipeError: the recipe's task does not go together with its model or its latents.
    """
    if recipe.data.task == "image-to-video":
        return _videos(recipe, config, data, valid)
    clips, held_out = PairedClips.open(data), PairedClips.open(valid)
    require_apart(clips, held_out)
    for each, folder in ((clips, data), (held_out, valid)):
        _require_path(each, folder, recipe)
    if recipe.data.modality == "semantic":
        return RunData(clips=PaintedClips(clips), valid=PaintedClips(held_out))
    return RunData(clips=clips, valid=held_out)


def require_image_to_video(recipe: Recipe, config: ModelConfig) -> None:
    """Raises RecipeError if the recipe's model is made for something else than a video out of its first frame."""
    model = recipe.model
    if model.family != _VIDEO_FAMILY:
        raise RecipeError(
            f'data.task "image-to-video" makes a model without views, model.family is {model.family!r}: give '
            f'model.family "{_VIDEO_FAMILY}"'
        )


def _videos(recipe: Recipe, config: ModelConfig, data: Path, valid: Path) -> RunData:
    """Both sides of all pairs; the folders in one need not go the same way."""
    _require_plain_latents(recipe, config)
    learned, held_out = (tuple(map(PairedClips.open, data_folders(place))) for place in (data, valid))
    for one in learned:
        for other in held_out:
            require_apart(one, other)
    return RunData(clips=VideoClips(learned), valid=VideoClips(held_out), parts=learned)


def _require_plain_latents(recipe: Recipe, config: ModelConfig) -> None:
    """Encoded pairs serve as videos where both sides were encoded alike."""
    latents = recipe.latents
    if recipe.unet.source != "latents" or latents is None:
        return
    if latents.augmentation or latents.sample or not config.vae.shared:
        raise RecipeError(
            'data.task "image-to-video" takes both sides of the encoded pairs as videos: it wants one shared '
            'autoencoder, latents.augmentation 0 and latents.sample false; or give unet.source "pixels"'
        )


def _require_path(clips: PairedClips, folder: Path, recipe: Recipe) -> None:
    goal, reached = recipe.data.goal_frame(clips.frames), clips.trajectory(0).at_goal.index(True)
    if goal != reached:
        raise DataError(
            f"the cameras in {folder} are at their goal in frame {reached}, the recipe's data.path says frame {goal}; "
            "change data.path, or make the clips with `gcd-train generate driving --path direct` or gradual"
        )
