"""A pickle reader that can rebuild tensors and nothing else.

A checkpoint of somebody else may name any function of any module and ask to have it called. Here only tensor
rebuilding is real; every other name becomes an inert placeholder, which takes whatever the file does to it and
keeps none of it. So foreign classes (a trainer's callbacks, an option container) do not stop us, and nothing runs.
"""

import io
import pickle
import zipfile
from collections import OrderedDict
from collections.abc import Callable

import torch

from gcd_model.errors import CheckpointError


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

    def __setstate__(self, state: object) -> None:
        """Forgets it."""

    def __setitem__(self, key: object, value: object) -> None:
        """Forgets it."""

    def append(self, item: object) -> None:
        """Forgets it."""

    def extend(self, items: object) -> None:
        """Forgets them."""

    def add(self, item: object) -> None:
        """Forgets it."""


def _sealed(function: Callable[..., object]) -> object:
    """The function as an object without attributes, which a pickle can call but not change."""

    class Sealed:
        __slots__ = ()

        def __call__(self, *arguments: object) -> object:
            return function(*arguments)

    return Sealed()


def _tensor_of_parameter(data: object, *_rest: object) -> object:
    """A parameter counts as its tensor."""
    return data


class UntypedBytes(Placeholder):
    """The storage class of the newest dtypes, of which torch asks the dtype only."""

    __slots__ = ()
    dtype = torch.uint8


_DTYPES = (
    *("float64", "float32", "float16", "bfloat16", "float8_e4m3fn", "float8_e5m2"),
    *("int64", "int32", "int16", "int8", "uint8", "bool", "complex64", "complex128"),
)
_ALLOWED: dict[tuple[str, str], object] = {
    ("collections", "OrderedDict"): OrderedDict,
    ("torch", "Size"): torch.Size,
    ("torch", "device"): torch.device,
    ("torch._utils", "_rebuild_parameter"): _sealed(_tensor_of_parameter),
    ("torch._utils", "_rebuild_parameter_with_state"): _sealed(_tensor_of_parameter),
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
    """Reads a pickle for nothing but the storages it refers to; every name is a placeholder."""

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


def claimed_storages(pickled: bytes) -> dict[str, int]:
    """Bytes a checkpoint's pickle says its storages have, by key. Raises whatever a damaged pickle raises."""
    census = _Census(pickled)
    census.load()
    return census.claims


def check_storages(archive: zipfile.ZipFile) -> None:
    """Whether every record of an open torch zip holds what its pickle claims: a short one would be read past its end.

    Raises:
        CheckpointError: a record is missing or too short.
    """
    entries = {entry.filename: entry.file_size for entry in archive.infolist()}
    pickled = next(name for name in entries if name.endswith("/data.pkl"))
    for key, claimed in claimed_storages(archive.read(pickled)).items():
        there = entries.get(f"{pickled.removesuffix('data.pkl')}data/{key}", 0)
        if there < claimed:
            raise CheckpointError(
                f"tensor record {key} should hold {claimed} bytes and holds {there}: damaged, refused"
            )


_STORAGE_BYTES = {
    **dict.fromkeys(("DoubleStorage", "LongStorage", "ComplexFloatStorage"), 8),
    **dict.fromkeys(("FloatStorage", "IntStorage"), 4),
    **dict.fromkeys(("HalfStorage", "BFloat16Storage", "ShortStorage"), 2),
    "ComplexDoubleStorage": 16,
}
"""Bytes per element of torch's typed storages; 1 for all others."""


def _placeholder_class(origin: str) -> type[Placeholder]:
    return type("Placeholder", (Placeholder,), {"__slots__": (), "origin": origin})
