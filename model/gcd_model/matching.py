"""Strict matching of a file's weights to a network's parameters: nothing missing, nothing unknown, all of one shape."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from gcd_model.architecture import Naming, Shapes
from gcd_model.errors import CheckpointError
from gcd_model.weight_names import GCD_CONDITION_VAE, IMAGE, Form, Levels, Source

_FIRST = 5  # names an error lists

_TEXT_TOWER = (
    r"positional_embedding|text_projection|logit_scale|attn_mask|token_embedding\.weight"
    r"|ln_final\.(weight|bias)|transformer\..+"
)
LEFTOVERS = {
    "CLIP text tower": rf"conditioner\.embedders\.0\.open_clip\.model\.({_TEXT_TOWER})",
    "decoder of the condition VAE": rf"{re.escape(GCD_CONDITION_VAE)}\.(decoder|post_quant_conv)\..+",
    "LPIPS": r"lpips\..+",
    "EMA": r"model_ema\..+",
    "noise table": r"denoiser\.sigmas",
    "position numbers": rf"{re.escape(IMAGE)}\.embeddings\.position_ids",
}
"""Published weights that inference does not use, by the whole name. Anything else that is left over is an error."""


@dataclass(frozen=True, slots=True)
class Match:
    """Where every parameter comes from, and what stays behind.

    sources: our names. leftovers: the kinds of LEFTOVERS that occur, each with its published names.
    """

    sources: dict[str, Source]
    leftovers: dict[str, list[str]]


def match_weights(expected: Shapes, shapes: Shapes, naming: Naming, levels: Levels) -> Match:
    """Pair our parameters with published weights.

    Args:
        expected: our names and shapes. shapes: those of the file.
    Raises:
        CheckpointError: says how many weights are missing, unknown and misshapen, and the first five of each.
    """
    sources = {name: naming(name, levels) for name in expected}
    missing = [
        published
        for name, source in sources.items()
        for published in ([name] if source is None else [n for n in source.names if n not in shapes])
    ]
    found = {name: source for name, source in sources.items() if source is not None}
    used = {name for source in found.values() for name in source.names}
    leftovers, unknown = _sorted_out(name for name in shapes if name not in used)
    misshapen = [line for name, source in found.items() for line in _misfit(expected[name], source, shapes)]
    _require_fit(len(expected), missing, unknown, misshapen)
    return Match(found, leftovers)


def _sorted_out(names: Iterable[str]) -> tuple[dict[str, list[str]], list[str]]:
    """Recognised leftovers by kind, and the rest."""
    patterns = {kind: re.compile(pattern) for kind, pattern in LEFTOVERS.items()}
    leftovers: dict[str, list[str]] = {}
    unknown: list[str] = []
    for name in names:
        kind = next((kind for kind, pattern in patterns.items() if pattern.fullmatch(name)), None)
        (unknown if kind is None else leftovers.setdefault(kind, [])).append(name)
    return leftovers, unknown


def _misfit(wanted: tuple[int, ...], source: Source, shapes: Shapes) -> list[str]:
    """One line if the published tensors do not make ours; none if they do or are missing anyway."""
    given = [shapes[name] for name in source.names if name in shapes]
    if len(given) < len(source.names) or published_fit(wanted, given, source.form):
        return []
    return [f"{source.names[0]} wants {list(published_shape(wanted, source))}, got {list(given[0])}"]


def published_shape(wanted: tuple[int, ...], source: Source) -> tuple[int, ...]:
    """Shape of each published tensor that makes one of ours."""
    if source.form == "stacked":
        return (wanted[0] // len(source.names), *wanted[1:])
    if source.form == "transposed":
        return wanted[::-1]
    return wanted[:2] if source.form == "pixelwise" else wanted


def published_fit(wanted: tuple[int, ...], given: Sequence[tuple[int, ...]], form: Form) -> bool:
    """Whether published tensors of these shapes make one of ours."""
    if form == "pixelwise" and given[0] == wanted:
        return True  # some converters keep the 1x1 convolution
    names = tuple("" for _ in given)
    return all(shape == published_shape(wanted, Source(names, form)) for shape in given)


def _require_fit(expected: int, missing: list[str], unknown: list[str], misshapen: list[str]) -> None:
    faults = [
        f"{len(names)} of {expected} weights are {what}, first: {', '.join(names[:_FIRST])}"
        for what, names in (("missing", missing), ("misshapen", misshapen))
        if names
    ]
    if unknown:
        faults.append(f"{len(unknown)} unexpected names, first: {', '.join(unknown[:_FIRST])}")
    if faults:
        raise CheckpointError(
            f"{'; '.join(faults)}. Nothing was loaded: the file is damaged, or of another architecture than GCD's"
        )
