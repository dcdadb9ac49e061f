"""Files made to break, stop or fill whatever opens them, given to the real commands: each ends in one line, in time.

Every kind of hostile file goes to every door that takes such files, in a process of its own. Logs have their own tests,
`node/test_robot_logs.py`.
"""

import json
import os
import shutil
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import msgspec
import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from warm_commands import LIMIT_MB, LIMIT_S, WarmCommands

from gcd_model.config import PLAIN_SMALL
from gcd_model.weights.card import Card
from gcd_node.auth import new_key_pair, write_key_pair
from gcd_train.data.parallel_domain4d import frame_path
from gcd_train.evaluation.store import RunNote

pytestmark = pytest.mark.timeout(900)
CODES = range(64, 79)
"""What may end a command here: sysexits, as docs/node.md lists them."""

# --- text ------------------------------------------------------------------------------------------------------------


def fifo(path: Path, _: str) -> None:
    os.mkfifo(path)


def zeros(path: Path, _: str) -> None:
    path.symlink_to("/dev/zero")


def loop(path: Path, _: str) -> None:
    path.symlink_to(path)


def folder(path: Path, _: str) -> None:
    path.mkdir()


def sparse(path: Path, _: str) -> None:
    with path.open("wb") as file:
        file.truncate(4 << 30)


def latin(path: Path, syntax: str) -> None:
    path.write_bytes({"json": b'{"\xff\xfe": "\xe9"}', "toml": b'name = "\xff\xe9"'}.get(syntax, b"caf\xe9: \xff\n"))


def nul(path: Path, syntax: str) -> None:
    texts = {"json": '{"file": "a\\u0000b"}', "toml": 'name = "a\\u0000b"', "yaml": 'name: "a\0b"'}
    path.write_text(texts.get(syntax, "a\0b\n"))


def deep(path: Path, syntax: str) -> None:
    start = {"toml": "name = ", "yaml": "image_width: "}.get(syntax, "")
    path.write_text(start + ("[" * 5000 if syntax == "yaml" else "[" * 100_000))


def deep_unknown(path: Path, syntax: str) -> None:
    start = {"toml": "name = ", "yaml": "more: "}.get(syntax, "")
    count = 5000 if syntax == "yaml" else 100_000
    nested = "[" * count + "]" * count
    path.write_text('{"more": ' + nested + "}" if syntax == "json" else start + nested)


def digits(path: Path, syntax: str) -> None:
    start, end = {"json": ('{"format": ', "}"), "toml": ("seed = ", ""), "yaml": ("image_width: ", "")}.get(
        syntax, ("", "")
    )
    path.write_text(f"{start}{'9' * 5000}{end}\n")


def many(path: Path, syntax: str) -> None:
    """A million entries."""
    lines = {"json": '"k{0}": {0},', "toml": "k{0} = {0}\n", "yaml": "k{0}: {0}\n"}.get(syntax, "entry {0}\n")
    text = "".join(lines.format(number) for number in range(1_000_000))
    path.write_text('{"weight_map": {' + text + '"end": 0}}' if syntax == "json" else text)


def dots(path: Path, syntax: str) -> None:
    name = ".".join(["a"] * 100_000)
    path.write_text(f"{name} = 1\n" if syntax == "toml" else f'{{"{name}": 1}}')


def escapes(path: Path, syntax: str) -> None:
    """What a terminal would obey, in a name."""
    name, plain = "\\u001b]0;owned\\u0007\\u001b[2J[/red]", "\x1b]0;owned\x07\x1b[2J[/red]\n"
    path.write_text({"json": f'{{"{name}": 1}}', "toml": f'"{name}" = 1'}.get(syntax, plain))


TEXTS = (fifo, zeros, loop, folder, sparse, latin, nul, deep, deep_unknown, digits, many, dots, escapes)

Prepare = Callable[[Path], object]
FILM = str(Path(__file__).parents[1] / "gcd_node" / "assets" / "drive.mp4")


class Door(NamedTuple):
    """What opens a text of a syntax at a place. prepare: makes what lies around it."""

    syntax: str
    place: str
    command: str
    prepare: Prepare = lambda here: None


def launch_file(here: Path, more: str = "", *, source: str = 'kind = "synthetic"', weights: str = "random:live") -> str:
    text = f'[source]\n{source}\n[model]\nweights = "{weights}"\n[view.top]\n{more}\n'
    (here / "launch.toml").write_text(text)
    return "launch.toml"


def keys(here: Path) -> None:
    write_key_pair(here / "keys", new_key_pair())


def allowing(here: Path) -> None:
    keys(here)
    launch_file(here, '[security]\nkeys = "keys"\nallow = "allow.toml"')


def without_its_key(here: Path) -> None:
    keys(here)
    (here / "keys/public.key").unlink()


def calibrated(here: Path) -> None:
    launch_file(here, source='kind = "file"\npath = "package:drive.mp4"\ncalibration = "camera.yaml"')


def diffusers(here: Path) -> None:
    for part in ("unet", "vae", "image_encoder"):
        (here / "model" / part).mkdir(parents=True)
        save_file({"x": torch.zeros(1)}, here / "model" / part / "model.safetensors")


def index_alone(here: Path) -> None:
    diffusers(here)
    (here / "model/unet/model.safetensors").unlink()


def folders(*names: str) -> Prepare:
    return lambda here: [(here / name).mkdir(parents=True) for name in names]


DRIVING = ("rgb/yaw-0", "rgb/camera0", "calibration", "ontology")
driving_scene = folders(*(f"scene_000000/{name}" for name in DRIVING))
labelled_scene = folders(*(f"scene_000000/{name}" for name in (*DRIVING, "semantic_segmentation_2d")))


def pictured_scene(here: Path) -> None:
    """Its first picture is read before the calibration."""
    driving_scene(here)
    path = frame_path(here / "scene_000000", "yaw-0", "rgb", 0)
    path.write_bytes(cv2.imencode(".png", np.zeros((8, 8, 3), np.uint8))[1].tobytes())


NOTE = RunNote(
    command="x", made="x", versions={}, data=(), data_identity="x", kind="orbit", modality="rgb", protocol="pairs",
    frames=4, height=8, width=8, seed=0, methods={"copy": {}},
)  # fmt: skip


def noted_run(here: Path) -> None:
    (here / "run/records/copy").mkdir(parents=True)
    (here / "run/run.json").write_bytes(msgspec.json.encode(NOTE))


CAMERAS = {"a": {"dtype": "video"}, "b": {"dtype": "video"}}
INFO = {"codebase_version": "v2.1", "fps": 30, "features": CAMERAS, "data_path": "x", "video_path": "y"}


def lerobot(here: Path, episodes: str | None = None) -> None:
    (here / "set/meta").mkdir(parents=True)
    (here / "set/meta/info.json").write_text(json.dumps(INFO))
    if episodes is not None:
        (here / "set/meta/episodes.jsonl").write_text(episodes)


def counted_lerobot(here: Path) -> None:
    lerobot(here, '{"episode_index": 0, "length": 30}\n')


def benchmark(here: Path) -> None:
    (here / "bench/s/e").mkdir(parents=True)
    (here / "bench/splits.json").write_text('{"groups": {"g": ["s"]}}')


BENCHMARK = "gcd-train evaluate --data bench --protocol anyviewbench --out out"
CHECK, INSPECT = "gcd-node check launch.toml", "gcd-node weights inspect model"
EVALUATE, REPORT = "gcd-train evaluate --data scenes --out out", "gcd-train report run --out report"
ON_PAIRS = "gcd-train train package:paper-driving --data pairs --valid pairs --out out"
ON_CACHE = (
    "gcd-train train package:pardom-gradual-rgb --set data.kind=cache --set unet.source=cache --data cache "
    "--valid scenes --out out"
)
PAIRED = f"gcd-node synthesize {FILM} --weights random:live --out out --depth {FILM} --calibration board.json"
KUBRIC, PARALLEL = folders("scn00000"), "gcd-train show scene_000000"
TEXT_DOORS = {
    "launch_of_check": Door("toml", "launch.toml", CHECK),
    "launch_of_run": Door("toml", "launch.toml", "gcd-node run launch.toml"),
    "launch_of_replay": Door("toml", "launch.toml", "gcd-node replay launch.toml --out run"),
    "allow_list": Door("toml", "allow.toml", CHECK, allowing),
    "client_key": Door("key", "keys/public.key", "gcd-node keys show keys", without_its_key),
    "node_key": Door("key", "node.key", "gcd-node status --once --keys keys --node-key node.key", keys),
    "camera_info": Door("yaml", "camera.yaml", CHECK, calibrated),
    "manifest_of_run": Door("json", "a/manifest.json", "gcd-node diff a a", folders("a")),
    "stereo_calibration": Door("json", "board.json", PAIRED),
    "export_manifest": Door(
        "json",
        "export/manifest.json",
        CHECK,
        lambda here: (folders("export")(here), launch_file(here, weights="export")),
    ),
    "diffusers_config": Door("json", "model/unet/config.json", INSPECT, diffusers),
    "diffusers_index": Door("json", "model/unet/diffusion_pytorch_model.safetensors.index.json", INSPECT, index_alone),
    "recipe": Door("toml", "recipe.toml", "gcd-train recipes recipe.toml"),
    "recipe_of_training": Door(
        "toml", "recipe.toml", "gcd-train train recipe.toml --data data --valid valid --out out"
    ),
    "base_of_recipe": Door(
        "toml",
        "base.toml",
        "gcd-train recipes recipe.toml",
        lambda here: (here / "recipe.toml").write_text('base = "base.toml"\n'),
    ),
    "pair_world": Door("json", "pairs/world.json", ON_PAIRS, folders("pairs")),
    "scene_manifest": Door("json", "scn00000/gcd-manifest.json", "gcd-train generate drop --out . --scenes 1", KUBRIC),
    "kubric_metadata": Door("json", "scn00000/scn00000_p0_v4.json", "gcd-train show scn00000", KUBRIC),
    "driving_ontology": Door("json", "scene_000000/ontology/ontology.json", PARALLEL, labelled_scene),
    "driving_calibration": Door("json", "scene_000000/calibration/calibration.json", PARALLEL, pictured_scene),
    "run_note": Door("json", "run/run.json", REPORT, folders("run")),
    "run_record": Door("json", "run/records/copy/clip.json", REPORT, noted_run),
    "controls": Door("json", "controls.json", f"{EVALUATE} --controls controls.json", folders("scenes/scn00000")),
    "split": Door("json", "split.json", f"{EVALUATE} --split split.json", folders("scenes/scene_000000")),
    "scene_list": Door("list", "list.txt", f"{EVALUATE} --list list.txt", folders("scenes/scn00000")),
    "lerobot_info": Door("json", "set/meta/info.json", "gcd-train lerobot set", folders("set/meta")),
    "lerobot_episodes": Door("json", "set/meta/episodes.jsonl", "gcd-train lerobot set", lerobot),
    "lerobot_cameras": Door(
        "json", "cameras.json", "gcd-train lerobot set --calibration cameras.json", counted_lerobot
    ),
    "benchmark_index": Door("json", "bench/splits.json", BENCHMARK, folders("bench")),
    "benchmark_episode": Door("json", "bench/s/e/metadata.json", BENCHMARK, benchmark),
    "cache_index": Door("json", "cache/index.json", ON_CACHE, folders("cache")),
}


# --- the rest --------------------------------------------------------------------------------------------------------

CASES: dict[str, Callable[[Path], tuple[list[str], str]]] = {}
"""By name: what prepares a folder, and gives the command line and the name that its error must tell."""


def add(name: str, function: Callable[[Path], tuple[list[str], str]]) -> None:
    CASES[name] = function


def setting(more: str = "", *arguments: str, **options: str) -> Callable[[Path], tuple[list[str], str]]:
    return lambda here: (["gcd-node", "check", launch_file(here, more, **options), *arguments], "")


def planted(
    write: Callable[[Path], object], place: str, command: str, prepare: Prepare = lambda here: None, count: int = 1
) -> Callable[[Path], tuple[list[str], str]]:
    """A hostile file at a place (or several, numbered), and the command that is to open it."""

    def prepared(here: Path) -> tuple[list[str], str]:
        prepare(here)
        (here / place).parent.mkdir(exist_ok=True)
        for number in range(count):
            write(here / place.format(number))
        return command.split(), Path(place).name if count == 1 else Path(place).parent.name

    return prepared


add("5,000 views", setting("".join(f"[view.v{number}]\n" for number in range(5000))))
add("a path with NUL", setting(source='path = "a\\u0000b.mp4"'))
add("a source of 5,000 characters", setting(source=f'path = "{"a" * 5000}.mp4"'))
add("a folder of 5,000 characters", setting(source=f'kind = "folder"\nfps = 10\npath = "{"a" * 5000}"'))
add("a log of 5,000 characters", setting(source=f'kind = "mcap"\npath = "{"a" * 5000}"'))
add("weights of 5,000 characters", setting(weights="a" * 5000))
add("weights with NUL", setting(weights="a\\u0000b"))
add("packaged weights of 5,000 characters", setting(weights="package:" + "a" * 5000))
add("markup as weights", setting(weights="[/red]"))
add("a calibration of 5,000 characters", setting(source=f'kind = "synthetic"\ncalibration = "{"a" * 5000}"'))
add("keys of 5,000 characters", setting(f'[security]\nkeys = "{"a" * 5000}"\nallow = "b"'))
add("an abstract socket", setting('[publish]\ndata = "ipc://@abstract"'))
add("an endpoint with NUL", setting('[publish]\ndata = "ipc:///tmp/a\\u0000b"'))
add("an endpoint of 5,000 characters", setting(f'[publish]\ndata = "ipc:///tmp/{"a" * 5000}"'))
add("a port of 5,000 digits", setting(f'[publish]\ndata = "tcp://127.0.0.1:{"9" * 5000}"'))
add("infinite rate", setting("[window]\nfps = inf"))
add("NaN as a rate", setting("[window]\nfps = nan"))
add("steps without end", setting("", "--set", "model.steps=1000000000", weights="random:kubric90"))
for given in ("9" * 5000, "[" * 100_000, '"\\u0000"'):
    add(f"--set to {given[:9]}", setting("", "--set", f"window.fps={given}"))
    argv = ["gcd-train", "recipes", "package:tabletop", "--set", f"unet.batch={given}"]
    add(f"gcd-train --set to {given[:9]}", lambda here, argv=argv: (argv, ""))


CARD = Card(name="w", config=PLAIN_SMALL, family=None, move_time=0)


def safetensors(path: Path, header: bytes, size: int = 0) -> None:
    with path.open("wb") as file:
        file.write(len(header).to_bytes(8, "little") + header)
        file.truncate(max(size, 8 + len(header)))


def metadata(path: Path, **changed: str) -> None:
    save_file({"x": torch.zeros(1)}, path, CARD.to_metadata() | changed)


def adapter(path: Path, facts: str) -> None:
    metadata(path, **{"gcd.adapter": facts})


def pickle_bomb(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", b"\x80\x02" + b"(" * 10_000_000 + b".")


def squares(path: Path) -> None:
    """Beside it, what regular expressions take the square of a length for."""
    torch.save({"state_dict": {"x": torch.zeros(1)}}, path)
    parts = ("pardom\n", "azimuth" * 12_000, "\nazimuth:" + "\n" * 80_000, "x\nmodality:" + "\n" * 80_000 + "x")
    path.with_suffix(".yaml").write_text("".join(parts))


def tensor(size: int, **more: object) -> bytes:
    return json.dumps({"x": {"dtype": "F32", "shape": [size // 4], "data_offsets": [0, size]}, **more}).encode()


def tensors(count: int) -> bytes:
    return json.dumps({f"t{n}": {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]} for n in range(count)}).encode()


def config_with(**changed: object) -> str:
    return json.dumps({**msgspec.to_builtins(PLAIN_SMALL), **changed})


def unet_with(**changed: object) -> str:
    return config_with(unet={**msgspec.to_builtins(PLAIN_SMALL.unet), **changed})


WEIGHTS: dict[str, Callable[[Path], None]] = {
    "a pipe": os.mkfifo,
    "endless zeros": lambda path: path.symlink_to("/dev/zero"),
    "a link to itself": lambda path: path.symlink_to(path),
    "a sparse file": lambda path: sparse(path, ""),
    "a header of 99 MB": lambda path: safetensors(path, tensor(4).ljust(99_000_000)),
    "a header nested deep": lambda path: safetensors(path, b'{"x":' + b"[" * 1_000_000),
    "a header that is not UTF-8": lambda path: safetensors(path, b'{"\xff": 1}'),
    "a header of many tensors": lambda path: safetensors(path, tensors(100_000)),
    "2 TB": lambda path: safetensors(path, tensor(2 << 40), (2 << 40) + 200),
    "2 TB of ours": lambda path: safetensors(path, tensor(2 << 40, __metadata__=CARD.to_metadata()), (2 << 40) + 9000),
    "a config nested deep": lambda path: metadata(path, **{"gcd.config": '{"kind": ' + "[" * 100_000}),
    "a config of digits": lambda path: metadata(path, **{"gcd.config": '{"frames": ' + "9" * 5000 + "}"}),
    "a config of NaN": lambda path: metadata(path, **{"gcd.config": '{"frames": NaN}'}),
    "a move time of digits": lambda path: metadata(path, **{"gcd.move_time": "9" * 5000}),
    "a scale of NaN": lambda path: metadata(path, **{"gcd.uncertainty_scale": "nan"}),
    "blocks without end": lambda path: metadata(path, **{"gcd.config": unet_with(blocks_per_level=10**9)}),
    "levels without end": lambda path: metadata(
        path, **{"gcd.config": unet_with(multipliers=[1] * 100_000, attention=[True] * 100_000)}
    ),
    "frames without end": lambda path: metadata(path, **{"gcd.config": config_with(frames=10**15)}),
    "width without end": lambda path: metadata(path, **{"gcd.config": unet_with(width=2**60)}),
    "heads of none": lambda path: metadata(path, **{"gcd.config": unet_with(head_width=0, norm_groups=0)}),
    "a pickle of marks": pickle_bomb,
    "squares in its yaml": squares,
}  # fmt: skip
for about, write in WEIGHTS.items():
    convert = "gcd-node weights convert weights.ckpt out.safetensors"
    add(f"weights: {about}", planted(write, "weights.ckpt", "gcd-node weights inspect weights.ckpt"))
    add(f"weights to convert: {about}", planted(write, "weights.ckpt", convert))

ADAPTERS = {
    "rank 0": '{"rank": 0, "alpha": 1.0, "base": "x"}',
    "a negative rank": '{"rank": -1, "alpha": 1.0, "base": "x"}',
    "alpha 1e308": '{"rank": 1, "alpha": 1e308, "base": "x"}',
    "depth": '{"rank": ' + "[" * 100_000,
    "digits": '{"rank": ' + "9" * 5000 + "}",
}
PACKAGED = Path(__file__).parents[1] / "model/gcd_model/weights/live-small.safetensors"
for about, facts in ADAPTERS.items():
    write = partial(adapter, facts=facts)
    join = f"gcd-train lora merge {PACKAGED} adapter.safetensors out.safetensors"
    add(f"an adapter of {about}", planted(write, "adapter.safetensors", join))


def npy(shape: str) -> bytes:
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header


def npz_bomb(path: Path, name: str = "initial", count: int = 3 << 27) -> None:
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open(f"{name}.npy", "w", force_zip64=True) as member,
    ):
        member.write(npy(f"({count},)"))
        for _ in range(count >> 20):
            member.write(bytes(4 << 20))


def sparse_npy(path: Path) -> None:
    path.write_bytes(npy("(1073741824,)"))
    os.truncate(path, (4 << 30) + 200)


ARRAYS: dict[str, Callable[[Path], None]] = {
    "a pipe": os.mkfifo,
    "endless zeros": lambda path: path.symlink_to("/dev/zero"),
    "a link to itself": lambda path: path.symlink_to(path),
    "a header nested deep": lambda path: path.write_bytes(npy("(" * 5000)) and None,
    "a header nested deep, closed": lambda path: path.write_bytes(npy("(" * 150 + ")" * 150)) and None,
    "a shape without end": lambda path: path.write_bytes(npy(f"({10**18},)")) and None,
    "a shape of digits": lambda path: path.write_bytes(npy(f"({'9' * 5000},)")) and None,
    "a negative shape": lambda path: path.write_bytes(npy("(-1, 4, 4)")) and None,
    "4 GB, sparse": sparse_npy,
    "a bomb": npz_bomb,
    "not UTF-8": lambda path: path.write_bytes(b"PK\x03\x04" + bytes(range(256))) and None,
}
for about, write in ARRAYS.items():
    posed = f"gcd-node synthesize {FILM} --weights random:kubric90 --out out --poses poses.npy"
    add(f"poses: {about}", planted(write, "poses.npy", posed))


def png(width: int, height: int, rows: int = 0) -> bytes:
    def part(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    body = zlib.compress(bytes((1 + 3 * width) * rows))
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + part(b"IHDR", head) + part(b"IDAT", body) + part(b"IEND", b"")


PICTURES: dict[str, Callable[[Path], object]] = {
    "a pipe": os.mkfifo,
    "endless zeros": lambda path: path.symlink_to("/dev/zero"),
    "a link to itself": lambda path: path.symlink_to(path),
    "a folder": Path.mkdir,
    "nothing": Path.touch,
    "a sparse file": lambda path: sparse(path, ""),
    "a head alone": lambda path: path.write_bytes(png(64, 64)[:20]),
    "a billion pixels": lambda path: path.write_bytes(png(32_000, 32_000, 20)),
    "a side without end": lambda path: path.write_bytes(png(2**31 - 1, 2**31 - 1)),
    "TIFF of loops": lambda path: path.write_bytes(b"II*\0" + struct.pack("<IH", 8, 65535) + bytes(12 * 100)),
    "JPEG of marks": lambda path: path.write_bytes(b"\xff\xd8" + b"\xff\xe0\x00\x02" * 500_000),
    "GIF of nothing": lambda path: path.write_bytes(b"GIF89a"),
    "JPEG 2000 of nothing": lambda path: path.write_bytes(b"\x00\x00\x00\x0cjP  \r\n\x87\n" + b"\x00" * 40),
    "SVG": lambda path: path.write_bytes(b"<?xml version='1.0'?><svg width='9" + b"9" * 5000 + b"' height='1'/>"),
    "WebP of nothing": lambda path: path.write_bytes(b"RIFF\xff\xff\xff\xffWEBPVP8X" + bytes(4)),
}
PLACES = ("a pipe", "endless zeros", "a link to itself", "a folder", "nothing", "a sparse file")
GALLERY = "--weights random:kubric90 --out out"


def reading(source: str) -> Prepare:
    return lambda here: launch_file(here, source=source)


for about, write in PICTURES.items():
    folder_of = reading('kind = "folder"\nfps = 10\npath = "pictures"')
    one = "gcd-node synthesize still.png --weights random:live --out out"
    several = f"gcd-train gallery pictures --rate 12 {GALLERY}"
    add(f"a folder of pictures: {about}", planted(write, "pictures/0001.png", CHECK, folder_of))
    add(f"a still: {about}", planted(write, "still.png", one))
    add(f"a gallery of pictures: {about}", planted(write, "pictures/im_{}.png", several, count=16))
for about in PLACES:
    write = PICTURES[about]
    add(f"a video: {about}", planted(write, "film.mp4", CHECK, reading('path = "film.mp4"')))
    add(f"a video for the gallery: {about}", planted(write, "film.mp4", f"gcd-train gallery film.mp4 {GALLERY}"))
    add(f"a log: {about}", planted(write, "log.mcap", CHECK, reading('kind = "mcap"\npath = "log.mcap"')))


def bag(write: Callable[[Path], object]) -> Callable[[Path], tuple[list[str], str]]:
    def database(here: Path) -> None:
        launch_file(here, source='kind = "mcap"\npath = "bag"')
        (here / "bag").mkdir()
        (here / "bag/log_0.db3").write_bytes(b"SQLite format 3\0" + bytes(4000))

    prepared = planted(write, "bag/metadata.yaml", CHECK, database)
    return lambda here: (prepared(here)[0], "bag")


def laughs(path: Path) -> None:
    lines = ["a: &a [x,x,x,x,x,x,x,x,x]"]
    lines += [f"{new}: &{new} [{','.join([f'*{old}'] * 9)}]" for old, new in zip("abcdefgh", "bcdefghi", strict=True)]
    path.write_text("\n".join(lines))


add("a bag's metadata: a pipe", bag(os.mkfifo))
add("a bag's metadata: a sparse file", bag(lambda path: sparse(path, "")))
add("a bag's metadata: depth", bag(lambda path: path.write_text("a: " + "[" * 100_000)))
add("a bag's metadata: laughs", bag(laughs))


def shard(write: Callable[[Path], object]) -> Callable[[Path], tuple[list[str], str]]:
    def world(here: Path) -> None:
        (here / "pairs").mkdir()
        facts = {"name": "driving", "width": 96, "height": 64, "frames": 14, "fps": 10}
        (here / "pairs/world.json").write_text(json.dumps(facts))

    prepared = planted(write, "pairs/shard-00000000.zip", "gcd-train show pairs", world)
    return lambda here: (prepared(here)[0], "pairs")


def scene_bomb(path: Path) -> None:
    name = "00000001/source.rgb.png"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open(name, "w") as member:
        for _ in range(1000):
            member.write(bytes(1 << 20))


for about in PLACES:
    add(f"a shard: {about}", shard(PICTURES[about]))
add("a shard: a bomb", shard(scene_bomb))


@pytest.fixture(scope="module")
def commands() -> Iterator[WarmCommands]:
    with WarmCommands() as started:
        yield started


@pytest.fixture
def here() -> Iterator[Path]:
    """A folder of a short name: a socket's must fit 107 characters."""
    path = Path(tempfile.mkdtemp(prefix="h", dir="/tmp"))
    yield path
    shutil.rmtree(path)


@pytest.mark.slow
@pytest.mark.parametrize("door", TEXT_DOORS)
@pytest.mark.parametrize("kind", TEXTS, ids=lambda kind: kind.__name__)
def test_a_hostile_text_ends_in_one_line_that_names_it(
    commands: WarmCommands, here: Path, door: str, kind: Callable[[Path, str], None]
) -> None:
    syntax, place, command, prepare = TEXT_DOORS[door]
    prepare(here)
    kind(here / place, syntax)
    told = "model" if door == "diffusers_config" and kind in (dots, escapes) else Path(place).name
    require_one_line(commands, command.split(), here, told)  # diffusers' own files have many more keys than are read


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_a_hostile_file_ends_in_one_line_that_names_it(commands: WarmCommands, here: Path, name: str) -> None:
    argv, told = CASES[name](here)
    require_one_line(commands, argv, here, told)


def require_one_line(commands: WarmCommands, argv: list[str], here: Path, name: str) -> None:
    ended = commands.run(argv, here)
    shown = (
        f"{ended.code} after {ended.cpu_s:.1f} s of processor time and {ended.peak_mb:.0f} MB: {ended.output[-3000:]}"
    )
    assert "Traceback" not in ended.output, shown
    assert ended.code in CODES, shown
    assert ended.cpu_s < LIMIT_S, shown
    assert ended.peak_mb < LIMIT_MB, shown
    last = ended.output.strip().splitlines()[-1]
    assert last.startswith(("error: ", "gcd-train: ")) or argv[1] == "generate", shown
    assert name in ended.output, shown
    assert "\x1b" not in ended.output.replace("\x1b[", ""), shown
