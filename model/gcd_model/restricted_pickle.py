"""A pickle reader that can rebuild tensors and nothing else.

A checkpoint of somebody else may name any function of any module and ask to have it called. Here only tensor
rebuilding is real; every other name becomes an inert placeholder, which takes whatever the file does to it and
keeps none of it. So foreign classes (a trainer's callbacks, an option container) do not stop us, and nothing runs.
"""

import pickle
from collections import OrderedDict
from collections.abc import Callable

import torch


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


def _placeholder_class(origin: str) -> type[Placeholder]:
    return type("Placeholder", (Placeholder,), {"__slots__": (), "origin": origin})
