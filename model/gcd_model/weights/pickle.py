"""A pickle reader that can rebuild tensors and nothing else.

A checkpoint of somebody else may name any function of any module and ask to have it called. Here only tensor
rebuilding is real; every other name becomes an inert placeholder, which takes whatever the file does to it and
keeps none of it. So foreign classes (a trainer's callbacks, an option container) do not stop us, and nothing runs.
"""

import functools
import io
import pickle
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import cast

import torch
from torch import Tensor

from gcd_model.errors import CheckpointError
from gcd_model.weights.card import NOTES


class Placeholder:
    """Stands for an object of a class or function we do not call.

    It takes every step of the pickle protocol (construction, state, items) and forgets it.
    """

    __slots__ = ()
    origin = "an unknown class"

    def __new__(cls, *_args: object, **_options: object) -> "Placeholder":
        """Any arguments."""
        return object.__new__(cls)

    def __init__(self, *_args: object, **_options: object) -> None:
        """Keeps nothing."""

    def __call__(self, *_args: object, **_options: object) -> "Placeholder":
        """A placeholder used as a function gives itself."""
        return self

    def forget(self, *_args: object) -> None:
        """What state, items and elements of a foreign object come to."""

    __setstate__ = __setitem__ = append = extend = add = forget


def _sealed(function: Callable[..., object]) -> object:
    """The function as an object without attributes, which a pickle can call but not change."""

    class Sealed:
        __slots__ = ()

        def __call__(self, *arguments: object) -> object:
            return function(*arguments)

    return Sealed()


class UntypedBytes(Placeholder):
    """The storage class of the newest dtypes, of which torch asks the dtype only."""

    __slots__ = ()
    dtype = torch.uint8


def _data_of(data: object, *_rest: object) -> object:
    """A parameter counts as its tensor."""
    return data


_DTYPES = (
    *("float64", "float32", "float16", "bfloat16", "float8_e4m3fn", "float8_e5m2"),
    *("int64", "int32", "int16", "int8", "uint8", "bool", "complex64", "complex128"),
)
_ALLOWED: dict[tuple[str, str], object] = {
    ("collections", "OrderedDict"): OrderedDict,
    ("torch", "Size"): torch.Size,
    ("torch", "device"): torch.device,
    ("torch._utils", "_rebuild_parameter"): _sealed(_data_of),
    ("torch._utils", "_rebuild_parameter_with_state"): _sealed(_data_of),
    ("torch.storage", "UntypedStorage"): UntypedBytes,
    ("torch", "UntypedStorage"): UntypedBytes,
    **{("torch", name): getattr(torch, name) for name in _DTYPES},
}
_REBUILDING = {("torch._utils", "_rebuild_tensor_v2"), ("torch._utils", "_rebuild_tensor_v3")}


class RestrictedUnpickler(pickle.Unpickler):
    """Unpickler whose names are tensor rebuilding or placeholders. torch itself adds the storages."""

    def find_class(self, module_name: str, global_name: str, /) -> object:
        """What a name of the file stands for. torch's own rebuilding is the only code that is looked up."""
        if (module_name, global_name) in _REBUILDING:
            return _sealed(super().find_class(module_name, global_name))
        allowed = _ALLOWED.get((module_name, global_name))
        return _placeholder_class(f"{module_name}.{global_name}") if allowed is None else allowed


class RestrictedPickle:
    """What `torch.load` takes as its pickle module."""

    Unpickler = RestrictedUnpickler


class _Census(pickle.Unpickler):
    """Reads a pickle for nothing but the bytes it says its storages have, by key; every name is a placeholder."""

    def __init__(self, pickled: bytes) -> None:
        super().__init__(io.BytesIO(pickled))
        self.claims: dict[str, int] = {}

    def find_class(self, module_name: str, global_name: str, /) -> object:
        """A placeholder."""
        return _placeholder_class(global_name)

    def persistent_load(self, pid: object) -> object:
        """Takes down a storage: kind, class, key, place, number of elements."""
        if isinstance(pid, tuple) and len(pid) == 5 and isinstance(pid[4], int):
            width = _STORAGE_BYTES.get(getattr(pid[1], "origin", ""), 1)
            self.claims[str(pid[2])] = max(self.claims.get(str(pid[2]), 0), width * pid[4])
        return Placeholder()


def check_storages(archive: zipfile.ZipFile) -> None:
    """Whether every record of an open torch zip holds what its pickle claims: a short one would be read past its end.

    Raises: CheckpointError if not; whatever a damaged pickle raises.
    """
    entries = {entry.filename: entry.file_size for entry in archive.infolist()}
    pickled = next(name for name in entries if name.endswith("/data.pkl"))
    if entries[pickled] > _LARGEST_PICKLE:
        raise CheckpointError(f"its pickle has {entries[pickled]} bytes, more than {_LARGEST_PICKLE}: refused")
    census = _Census(archive.read(pickled))
    census.load()
    for key, claimed in census.claims.items():
        there = entries.get(f"{pickled.removesuffix('data.pkl')}data/{key}", 0)
        if there < claimed:
            raise CheckpointError(
                f"tensor record {key} should hold {claimed} bytes and holds {there}: damaged, refused"
            )


_LARGEST_PICKLE = 16 * 2**20
"""Of a torch zip, in bytes; the pickle of a full-size training with its optimizer has two million."""
_STORAGE_BYTES = {
    **dict.fromkeys(("DoubleStorage", "LongStorage", "ComplexFloatStorage"), 8),
    **dict.fromkeys(("FloatStorage", "IntStorage"), 4),
    **dict.fromkeys(("HalfStorage", "BFloat16Storage", "ShortStorage"), 2),
    "ComplexDoubleStorage": 16,
}
"""Bytes per element of torch's typed storages; 1 for all others."""


@functools.lru_cache(maxsize=4096)
def _placeholder_class(origin: str) -> type[Placeholder]:
    return type("Placeholder", (Placeholder,), {"__slots__": (), "origin": origin})


# --- what a Lightning checkpoint holds -------------------------------------------------------------------------------


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
    others = tuple(str(key) for key in entries if key not in (_WEIGHTS, _OPTIMIZER))
    size = sum(tensor.numel() * tensor.element_size() for tensor in _tensors(entries.get(_OPTIMIZER), set()))
    return Contents(_weights(entries[_WEIGHTS]), size, others, _notes(entries.get(_FACTS)))


def _notes(facts: object) -> dict[str, str]:
    """Our notes, if they are what we write: text to text."""
    noted = cast("dict[object, object]", facts).get(NOTES) if isinstance(facts, dict) else None
    texts = cast("dict[object, object]", noted).items() if isinstance(noted, dict) else ()
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
        claimed, there = value.numel() * value.element_size(), value.untyped_storage().nbytes()
        if claimed > there:  # a few bytes can claim to be a huge tensor by repeating themselves; real weights do not
            raise CheckpointError(f"{name} claims {claimed} bytes and stores {there}: refused")
        found[name] = value
    return found


def _what(value: object) -> str:
    if isinstance(value, Placeholder):
        return f"an object of {value.origin}"
    if isinstance(value, type):
        return f"the class {getattr(value, 'origin', value.__name__)}"
    return f"a {type(value).__name__}"


def _tensors(value: object, seen: set[int]) -> Iterator[Tensor]:
    """All in nested containers, each once."""
    if id(value) in seen:
        return
    seen.add(id(value))
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, Mapping | list | tuple):
        items = value.values() if isinstance(value, Mapping) else value
        for item in cast("Iterable[object]", items):
            yield from _tensors(item, seen)
