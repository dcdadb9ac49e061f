"""What is measured: weights, baselines and saved frames, each by a name, a way to make it anywhere, and what it is."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

from gcd_model import RenderOptions, ViewSynthesizer, inspect_weights, load_synthesizer, sampler_of
from gcd_model.config import SemanticClass
from gcd_model.loading import packaged_weights
from gcd_train.errors import DataError, RecipeError
from gcd_train.evaluation.baselines import BaselineSettings, build, described, usual_baselines
from gcd_train.evaluation.model_views import ClipFacts, SynthesizedViews
from gcd_train.evaluation.predictors import Predictor
from gcd_train.evaluation.runner import Maker
from gcd_train.evaluation.saved_frames import SavedFrames
from gcd_train.evaluation.store import FRAMES_IN
from gcd_train.evaluation.svd import VANILLA_SVD

HEXPLANE = "hexplane_"
"""What the name of every HexPlane begins with; the number of its views follows."""
_SVD = "svd"
"""The family of image-to-video weights."""
_DIGITS = 12


@dataclass(frozen=True, kw_only=True, slots=True)
class Method:
    """One row of a table. make: the method itself, in any process. told: what it is, for `run.json`."""

    name: str
    make: Maker
    told: dict[str, str]


@dataclass(frozen=True, kw_only=True, slots=True)
class Weights:
    """Weights by name or path, and where they compute; see `load_synthesizer`."""

    path: str
    device: str = "auto"
    dtype: str | None = None

    def open(self) -> ViewSynthesizer:
        """The model, opened once in each process. Raises CheckpointError."""
        return _opened(self)


def of_weights(weights: Weights, clips: ClipFacts, options: RenderOptions, steps: Sequence[int]) -> tuple[Method, ...]:
    """The weights as they ship, then with each other number of steps.

    Args:
        options: all but the steps. steps: the shipped number is passed over.
    Raises:
        DataError: the weights do not fit the clips. CheckpointError: they cannot be opened.
    """
    shipped = weights.open().traits.config.sampling.steps
    others = [number for number in dict.fromkeys(steps) if number != shipped]
    return tuple(_of_weights(weights, clips, replace(options, steps=number)) for number in (None, *others))


def of_baselines(names: Sequence[str] | None, settings: BaselineSettings, trained_on: str) -> tuple[Method, ...]:
    """Baselines by name; those that need nothing but the data where none are named.

    Args:
        trained_on: identity of the training clips, "nothing" without.
    Raises:
        RecipeError: there is none of a name, or it lacks what it needs.
    """
    chosen = usual_baselines(settings) if names is None else names
    if VANILLA_SVD in chosen and settings.svd is not None:
        _require_image_to_video(settings.svd)
    for name in chosen:
        if name != VANILLA_SVD or settings.svd is None:
            build(name, settings)  # to refuse at once; weights are opened where they are used
    return tuple(
        Method(
            name=name,
            make=partial(build, name, settings),
            told=described(name, settings, trained_on),
        )
        for name in chosen
    )


def require_views(names: Sequence[str], others: int) -> None:
    """Raises RecipeError where a HexPlane wants more views than there are. others: cameras beside the source."""
    for name in names:
        views = name.removeprefix(HEXPLANE)
        if name != views and views.isdecimal() and int(views) > others + 1:
            there = f"{others} beside the source" if others else "the source alone"
            raise RecipeError(
                f"{name} wants {views} cameras, and these clips have {there}; give {HEXPLANE}{others + 1} or less"
            )


def of_saved_frames(
    named: Sequence[str], painted: Sequence[SemanticClass], *, privileged: Sequence[str] = ()
) -> tuple[Method, ...]:
    """Methods whose frames lie in folders.

    Args:
        named: `NAME=FOLDER` each. painted: the classes in whose colours they are; empty for photographs. privileged:
            names of those that were given more than the source video.
    Raises:
        RecipeError: one has no name or no folder, or a privileged one is none of them. DataError: there is no such
            folder.
    """
    methods = tuple(_of_saved_frames(each, tuple(painted), privileged) for each in named)
    names = [method.name for method in methods]
    unknown = [name for name in privileged if name not in names]
    if unknown:
        raise RecipeError(
            f"--privileged wants the name of a method of --predictions, got {unknown[0]!r}; "
            f"there are {', '.join(names) or 'none'}"
        )
    return methods


def _require_image_to_video(weights: str) -> None:
    """Raises RecipeError for weights that say they do something else; CheckpointError if they cannot be opened."""
    kind, _, name = weights.partition(":")
    if kind == "random":
        family = name
    else:
        family = inspect_weights(packaged_weights(name) if kind == "package" else weights).family or _SVD
    if family != _SVD:
        raise RecipeError(
            f"{VANILLA_SVD} wants weights that make a video out of a picture, {weights} is of the family {family}; "
            "give svd.safetensors"
        )


def require_names_apart(methods: Sequence[Method]) -> None:
    """Raises RecipeError where two methods have one name."""
    names = [method.name for method in methods]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise RecipeError(
            f"each method needs a name of its own, got {twice[0]} twice; rename the frames of --predictions"
        )


def _of_weights(weights: Weights, clips: ClipFacts, options: RenderOptions) -> Method:
    made = SynthesizedViews.of(weights.open(), clips, options)
    traits = made.synthesizer.traits
    used = sampler_of(traits.config.sampling, options)
    told = {
        "weights": traits.sha256_12,
        "family": "unknown" if traits.family is None else traits.family.name,
        "steps": str(used.steps),
        "solver": used.solver,
        "guidance": "{:g} to {:g}".format(*used.guidance),
        "samples": str(options.samples),
        "seed": str(options.seed),
        "precision": traits.precision,
    }
    if used.guidance_interval is not None:
        told["guided from"] = "{:g} to {:g}".format(*used.guidance_interval)
    return Method(name=made.name, make=partial(_synthesized, weights, options, made.painted), told=told)


def _synthesized(weights: Weights, options: RenderOptions, painted: tuple[SemanticClass, ...]) -> Predictor:
    return SynthesizedViews(synthesizer=weights.open(), options=options, painted=painted)


@lru_cache(maxsize=1)
def _opened(weights: Weights) -> ViewSynthesizer:
    return load_synthesizer(weights.path, device=weights.device, dtype=weights.dtype)


def _of_saved_frames(named: str, painted: tuple[SemanticClass, ...], privileged: Sequence[str]) -> Method:
    name, separator, folder = named.partition("=")
    if not (name and separator and folder):
        raise RecipeError(f"frames of another method are given as NAME=FOLDER, got {named!r}")
    place = Path(folder).resolve()
    SavedFrames.open(name, place)  # to refuse at once
    more = name in privileged
    told = {FRAMES_IN: str(place), "digest": _listing(place)} | ({"privileged": "yes"} if more else {})
    return Method(name=name, make=partial(SavedFrames.open, name, place, painted=painted, privileged=more), told=told)


def _listing(folder: Path) -> str:
    """Digest of the names and contents of all files below: frames that are made anew are another method."""
    digest = hashlib.sha256()
    try:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                with path.open("rb") as file:
                    content = hashlib.file_digest(file, "sha256").hexdigest()
                digest.update(f"{path.relative_to(folder)} {content}\n".encode())
    except OSError as error:
        raise DataError(f"{folder} cannot be read ({error}); give NAME=FOLDER") from error
    return digest.hexdigest()[:_DIGITS]
