"""From a path to what is shown: which layout it is, and which clip."""

from pathlib import Path

from gcd_train.datasets.kubric4d import Kubric4D
from gcd_train.datasets.ontology import read_ontology
from gcd_train.datasets.parallel_domain4d import ParallelDomain4D
from gcd_train.errors import DataError, RecipeError
from gcd_train.layouts import kubric4d_names, parallel_domain4d_names
from gcd_train.show.clips import ShowOptions, dataset_clip
from gcd_train.show.footage import Footage
from gcd_train.show.pair_clips import pair_clip


def open_scene(path: Path, options: ShowOptions, clip_seed: int | None = None) -> Footage:
    """The clip of a scene folder, or of a folder of pair shards.

    clip_seed: of which clip, in pair shards only.
    Raises: DataError if there is no such folder or it is of no known layout, FileFault (a DataError) naming the file
    that cannot be read, RecipeError for options that do not fit.
    """
    path = path.resolve()
    if path.suffix == ".zip" or (path / "world.json").exists():
        if options.start is not None or options.stride is not None:
            raise RecipeError(
                "pair shards hold finished clips: leave out --start and --stride, or name one with --clip"
            )
        return pair_clip(path.parent if path.suffix == ".zip" else path, _seed_of(path, clip_seed))
    if clip_seed is not None:
        raise RecipeError("--clip names a clip of pair shards; choose one of a scene with --start, --stride and --seed")
    if not path.is_dir():
        raise DataError(f"{path} is no folder; give a scene such as scn00000 or scene_000000, or pair shards")
    if kubric4d_names.scene_number(path.name) is not None:
        return dataset_clip(_orbit_set(path), path.name, options)
    if parallel_domain4d_names.scene_number(path.name) is not None:
        return dataset_clip(_driving_set(path), path.name, options)
    raise DataError(_guess(path))


def _orbit_set(path: Path) -> Kubric4D:
    """With the views that are there: to look at a scene not all are needed."""
    views = [
        camera
        for view, camera in enumerate(kubric4d_names.CAMERAS)
        if kubric4d_names.metadata_path(path, view).exists()
    ]
    return Kubric4D(path.parent, [path.name], cameras=views or kubric4d_names.CAMERAS, instances=True)


def _driving_set(path: Path) -> ParallelDomain4D:
    """With the cameras that are there, and with classes where the scene has that layer."""
    cameras = [camera for camera in parallel_domain4d_names.CAMERAS if (path / "rgb" / camera).is_dir()]
    classes = (path / "semantic_segmentation_2d").is_dir()
    ontology = read_ontology(parallel_domain4d_names.ontology_folder(path)) if classes else None
    return ParallelDomain4D(
        path.parent,
        [path.name],
        cameras=cameras or parallel_domain4d_names.CAMERAS,
        classes=classes,
        ontology=ontology,
    )


def _seed_of(path: Path, clip_seed: int | None) -> int | None:
    """The clip to show: as asked, or the first of a shard that was named itself."""
    if clip_seed is not None or path.suffix != ".zip":
        return clip_seed
    number = path.stem.split("-")[1:2]
    return int(number[0]) if number and number[0].isdecimal() else None


def _guess(path: Path) -> str:
    """What to give instead of a folder that is no scene."""
    inside = sorted(child.name for child in path.iterdir() if child.is_dir())
    scenes = [
        name
        for name in inside
        if kubric4d_names.scene_number(name) is not None or parallel_domain4d_names.scene_number(name) is not None
    ]
    if scenes:
        return f"{path} is a set of {len(scenes)} scenes; show one, such as {path / scenes[0]}"
    return (
        f"{path} is no scene: its name is neither scnNNNNN (Kubric-4D) nor scene_NNNNNN (ParallelDomain-4D), and it "
        "has no world.json (pair shards); give the folder of one scene, with its own name"
    )
