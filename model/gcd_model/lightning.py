"""What a Lightning checkpoint holds, once it is read: weights, optimizer state, the rest. Opens nothing."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import cast

from torch import Tensor

from gcd_model.errors import CheckpointError
from gcd_model.gcd_layout import NOTES
from gcd_model.restricted_pickle import Placeholder

_WEIGHTS, _OPTIMIZER, _FACTS = "state_dict", "optimizer_states", "hyper_parameters"


@dataclass(frozen=True, slots=True)
class Contents:
    """tensors: by published name. optimizer_size: bytes. other_entries: names of further top-level entries.

    notes: what `gcd_layout` left among the hyper-parameters, empty in files of others.
    """

    tensors: dict[str, Tensor]
    optimizer_size: int = 0
    other_entries: tuple[str, ...] = ()
    notes: dict[str, str] = field(default_factory=dict[str, str])


def contents(root: object) -> Contents:
    """Sort out what a checkpoint file holds at its root: `state_dict` and companions, or tensors alone.

    Raises:
        CheckpointError: no weights, or something else than tensors among them. Elsewhere anything may stand.
    """
    if not isinstance(root, dict):
        raise CheckpointError(f"holds {_what(root)}, wanted a dictionary with the entry {_WEIGHTS!r}")
    entries = cast("dict[object, object]", root)
    if _WEIGHTS not in entries:
        if not any(isinstance(value, Tensor) for value in entries.values()):
            names = ", ".join(str(key) for key in list(entries)[:5])
            raise CheckpointError(f"has no entry {_WEIGHTS!r} (found: {names}); it holds no weights")
        return Contents(_weights(entries))
    others = (str(key) for key in entries if key not in (_WEIGHTS, _OPTIMIZER))
    size = _stored_bytes(entries.get(_OPTIMIZER))
    return Contents(_weights(entries[_WEIGHTS]), size, tuple(others), _notes(entries.get(_FACTS)))


def _notes(facts: object) -> dict[str, str]:
    """Our notes, if they are what we write: text to text."""
    noted = cast("dict[object, object]", facts).get(NOTES) if isinstance(facts, dict) else None
    if not isinstance(noted, dict):
        return {}
    texts = cast("dict[object, object]", noted).items()
    return {key: value for key, value in texts if isinstance(key, str) and isinstance(value, str)}


def _weights(state: object) -> dict[str, Tensor]:
    if not isinstance(state, dict):
        raise CheckpointError(f"its {_WEIGHTS} is {_what(state)}, wanted a dictionary of tensors")
    found: dict[str, Tensor] = {}
    for name, value in cast("dict[object, object]", state).items():
        if not isinstance(name, str) or not isinstance(value, Tensor):
            raise CheckpointError(
                f"{_what(value)} stands among the weights, at {name!r}: refused; wanted are tensors only"
            )
        _require_backing(name, value)
        found[name] = value
    return found


def _require_backing(name: str, tensor: Tensor) -> None:
    """A few bytes can claim to be a huge tensor by repeating themselves; real weights do not."""
    claimed, there = tensor.numel() * tensor.element_size(), tensor.untyped_storage().nbytes()
    if claimed > there:
        raise CheckpointError(f"{name} claims {claimed} bytes and stores {there}: refused")


def _what(value: object) -> str:
    if isinstance(value, Placeholder):
        return f"an object of {value.origin}"
    if isinstance(value, type):
        return f"the class {getattr(value, 'origin', value.__name__)}"
    return f"a {type(value).__name__}"


def _stored_bytes(value: object) -> int:
    """Bytes of all tensors in nested containers, from their headers alone."""
    return sum(tensor.numel() * tensor.element_size() for tensor in _tensors(value, set()))


def _tensors(value: object, seen: set[int]) -> Iterator[Tensor]:
    if id(value) in seen:
        return
    seen.add(id(value))
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, Mapping):
        for item in cast("Mapping[object, object]", value).values():
            yield from _tensors(item, seen)
    elif isinstance(value, list | tuple):
        for item in cast("list[object]", value):
            yield from _tensors(item, seen)
