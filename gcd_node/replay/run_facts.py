"""What two runs were made from, side by side: every difference that may explain a difference of pixels, by name."""

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import msgspec

from gcd_node.errors import DamagedRunError
from gcd_node.replay.manifest import Manifest

ABSENT = "-"
"""Shown for what one of the runs does not have."""

_MAX_CONFIG = 256 * 1024
_MOST_DOTS = 200  # of a name of n parts tomllib keeps all n beginnings: 200 kB of them took 40 GB
_SECTIONS = ("strict", "source", "model", "view", "window")  # what a replay uses of a launch file


@dataclass(frozen=True, kw_only=True, slots=True)
class Fact:
    """Something the runs A and B do not have in common. name: such as `config model.steps` or `weights sha256_12`."""

    name: str
    a: str
    b: str


def different_facts(a: Manifest, b: Manifest) -> tuple[Fact, ...]:
    """Everything that differs: settings, weights, recording, versions, machine, size, totals, troubles; in this order.

    Raises:
        DamagedRunError: the configuration of a manifest is not TOML.
    """
    all_a, all_b = dict(_facts(a)), dict(_facts(b))
    names = dict.fromkeys((*all_a, *all_b))
    pairs = ((name, all_a.get(name, ABSENT), all_b.get(name, ABSENT)) for name in names)
    facts = (Fact(name=_shown(name), a=_shown(a), b=_shown(b)) for name, a, b in pairs if a != b)
    return tuple(sorted(facts, key=lambda fact: _GROUPS.index(_group(fact))))


_GROUPS = ("config", "weights", "source", "version", "machine", "size", "total", "trouble")


def _group(fact: Fact) -> str:
    return fact.name.partition(" ")[0]


def _shown(text: str) -> str:
    """Without control characters: a manifest may come from a stranger, and terminals obey some of them."""
    return "".join(char if char.isprintable() else "?" for char in text)


def _facts(manifest: Manifest) -> Iterator[tuple[str, str]]:
    config = _config(manifest.config)
    yield from _flat("config", {key: config[key] for key in _SECTIONS if key in config})
    yield from _flat("weights", msgspec.to_builtins(manifest.weights))
    yield from _flat("source", msgspec.to_builtins(manifest.source))
    yield from _flat("version", manifest.versions)
    yield from _flat("machine", msgspec.to_builtins(manifest.machine))
    yield from _flat("size", {**msgspec.to_builtins(manifest.size), "fps": manifest.fps})
    yield from _flat("total", msgspec.to_builtins(manifest.totals))
    for trouble in manifest.troubles:
        yield f"trouble {trouble.code} in window {trouble.window_id}", trouble.detail


def _config(text: str) -> Mapping[str, object]:
    try:
        if len(text) > _MAX_CONFIG or any(line.count(".") > _MOST_DOTS for line in text.splitlines()):
            raise ValueError(f"{len(text)} characters, or names of more than {_MOST_DOTS} parts")
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise DamagedRunError(
            f"the config in manifest.json is not TOML: {error}; replay the recording again"
        ) from error


def _flat(group: str, table: Mapping[str, object], place: str = "") -> Iterator[tuple[str, str]]:
    """Names and values of all leaves, tables within tables joined by points."""
    for key, value in table.items():
        if isinstance(value, dict):
            yield from _flat(group, value, f"{place}{key}.")
        elif value is not None:
            yield f"{group} {place}{key}", value if isinstance(value, str) else msgspec.json.encode(value).decode()
