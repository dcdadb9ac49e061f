"""`gcd-train calibrate`: how far the deviation over samples can be trusted, and the scale that corrects it."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Option, echo

from gcd_train.cli.common import errors_shown, progress_bar, say
from gcd_train.errors import DataError, RecipeError

if TYPE_CHECKING:
    from gcd_train.evaluation.calibration import Distances
    from gcd_train.evaluation.clips import EvaluationSet
    from gcd_train.evaluation.predictors import Predictor


def calibrate_command(
    data: Annotated[list[Path], Option(help="Held-out clips: folders of pairs, or a folder in a published layout.")],
    weights: Annotated[str, Option(help="package:NAME or a path.")],
    out: Annotated[Path, Option(help="Folder for calibration.json, calibration.md and reliability.png.")],
    store: Annotated[
        Path | None, Option(help="Also write the weights with the scale here, a new .safetensors file.")
    ] = None,
    samples: Annotated[int, Option(min=2, help="Draws of each view; the scale is for as many.")] = 4,
    steps: Annotated[int | None, Option(min=1, help="Steps of the sampler instead of the shipped number.")] = None,
    seed: Annotated[int, Option(min=0, help="Of the noise samples begin with.")] = 0,
    split: Annotated[str | None, Option(help="Only scenes of a split, by its name such as driving-test.")] = None,
    limit: Annotated[int | None, Option(min=1, help="Only the first so many scenes.")] = None,
    device: Annotated[str, Option(help="auto, cpu, cuda or cuda:N.")] = "auto",
    dtype: Annotated[str | None, Option(help="float32, bfloat16 or float16.")] = None,
) -> None:
    """Measure how often the truth lies within the intervals of the samples, and the scale that makes it as meant."""
    with errors_shown():
        from gcd_model import RenderOptions, convert_weights, load_synthesizer
        from gcd_train.evaluation.calibration import CalibrationNote, calibrate, write_calibration
        from gcd_train.evaluation.methods import SynthesizedViews
        from gcd_train.evaluation.opening import ClipOptions, open_clips
        from gcd_train.pictures import require_matplotlib

        require_matplotlib()  # now, not after an hour
        path = None if store is None else _weights_file(weights, store, steps)
        model = load_synthesizer(weights, device=device, dtype=dtype)
        if model.traits.live:
            raise RecipeError(
                f"{model.traits.name} states its own spread; gcd_train.live.measure says how well it holds"
            )
        clips, notes = open_clips(ClipOptions(data=data, split=split, limit=limit, seed=seed), model.traits)
        for line in notes:
            say(line)
        views = SynthesizedViews.of(lambda: model, clips, RenderOptions(steps=steps, samples=samples, seed=seed))
        if views.paints_classes:
            raise RecipeError(f"{model.traits.name} paints classes, which have no intervals; calibrate one of colours")
        measured, unreadable = _measured(clips, views)
        note = CalibrationNote(
            weights=model.traits.name,
            sha256_12=model.traits.sha256_12,
            data=tuple(map(str, data)),
            data_identity=clips.identity,
            clips=len(measured),
            unreadable=unreadable,
            samples=samples,
            steps=steps or model.traits.config.sampling.steps,
            seed=seed,
            found=calibrate(measured),
        )
        text = write_calibration(note, out)
        if path is not None and store is not None:
            convert_weights(path, store, uncertainty_scale=note.found.scale)
            say(
                f"{store} holds the scale {note.found.scale:.3g}: for {samples} samples in {note.steps} steps, and "
                "scenes like these; with other --samples it is wrong"
            )
    echo(text)
    if note.warning:
        say(f"warning: {note.warning}")
    say(f"wrote {out}/calibration.json, calibration.md and reliability.png")


def _weights_file(weights: str, store: Path, steps: int | None) -> Path:
    """The file whose copy gets the scale; what is wrong with --store is said before anything is measured."""
    from gcd_model import weights_path

    if steps is not None:
        raise RecipeError("a stored scale is for the steps that ship: leave out --steps, or --store")
    if store.exists() or store.suffix != ".safetensors" or not store.parent.is_dir():
        raise RecipeError(f"--store wants the name of a new .safetensors file in a folder that exists, got {store}")
    if weights.startswith("random:"):
        raise RecipeError(f"{weights} is no file that a scale could be stored with; leave out --store")
    return weights_path(weights)


def _measured(clips: "EvaluationSet", views: "Predictor") -> "tuple[Sequence[tuple[str, Distances]], tuple[str, ...]]":
    """Of every clip that can be read; of the others the reason. Raises DataError where none can."""
    from gcd_train.evaluation.calibration import distances

    measured: list[tuple[str, Distances]] = []
    unreadable: list[str] = []
    with progress_bar("held-out clips", len(clips.keys)) as show:
        for number, key in enumerate(clips.keys, 1):
            try:
                clip = clips.clip(key)
            except DataError as error:
                unreadable.append(f"{key}: {error}")
                say(f"left out {key}: {error}")
            else:
                measured.append((clip.scene, distances(clip, views.predict(clip.seen))))
            show(number)
    if not measured:
        raise DataError(f"none of the {len(clips.keys)} clips can be read: {unreadable[0]}")
    return measured, tuple(unreadable)
