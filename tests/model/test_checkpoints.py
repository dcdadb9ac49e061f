"""Checkpoints of every layout load mapped and strictly, weight by weight; what is wrong or hostile is refused."""

import gc
import pickle
import sys
import types
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path

import msgspec
import pytest
import torch
from published import (
    SMALL_GCD,
    assert_same_weights,
    filled,
    fixed_view,
    gcd_state,
    inspect,
    load,
    refused,
    shared_vae,
    write_diffusers,
    write_gcd,
    write_lightning,
    write_svd,
)
from torch import Tensor

from gcd_model.config import ModelConfig
from gcd_model.errors import CheckpointError
from gcd_model.networks import Networks
from gcd_model.weights.load import digest, inspect_weights, load_weights

UNET = "model.diffusion_model"


def plain_diffusers(folder: Path) -> Path:
    return write_diffusers(folder / "m", configs=False)


FIXED, SHARED = fixed_view(SMALL_GCD), shared_vae(SMALL_GCD)


@pytest.mark.parametrize(
    ("write", "config"),
    [
        (write_gcd, SMALL_GCD),
        (write_svd, FIXED),
        (lambda folder: write_diffusers(folder / "m"), SHARED),
        (plain_diffusers, SHARED),
    ],
)
def test_every_layout_loads_weight_by_weight_and_never_guesses_heads(
    tmp_path: Path, write: Callable[[Path], Path], config: ModelConfig
) -> None:
    path = write(tmp_path)
    loaded = load(path)
    assert_same_weights(loaded.networks, filled(config))
    assert isinstance(loaded.networks, Networks)
    found = loaded.networks.config
    assert (found.unet, found.vae, found.image_encoder) == (config.unet, config.vae, config.image_encoder)
    assert (found.camera, found.frames) == (config.camera, config.frames)
    assert (loaded.networks.condition_encoder is loaded.networks.target_encoder) == config.vae.shared
    if not (path / "unet" / "config.json").exists():
        for told in ({}, {"head_width": 64}, {"image_heads": 16}):
            with pytest.raises(CheckpointError, match="--head-width" if "head_width" not in told else "--image-heads"):
                load_weights(path, **told)


def test_the_layout_is_told_by_content_not_by_suffix_and_the_base_model_has_its_own_size(tmp_path: Path) -> None:
    path = write_svd(tmp_path)
    config = inspect(path).config
    assert (config.height, config.width, config.sampling.guidance) == (576, 1024, (1.0, 2.5))
    assert inspect(path.rename(tmp_path / "blob-without-suffix")).layout == "sgm-safetensors"
    assert inspect(write_gcd(tmp_path).rename(tmp_path / "other")).layout == "gcd-ckpt"


def test_config_json_tells_heads_frames_and_scale(tmp_path: Path) -> None:
    folder = write_diffusers(tmp_path / "model")
    (folder / "unet" / "config.json").write_text('{"num_attention_heads": 2, "num_frames": 25}')
    (folder / "vae" / "config.json").write_text('{"scaling_factor": 0.5}')
    (folder / "image_encoder" / "config.json").write_text('{"num_attention_heads": 4}')
    config = inspect_weights(folder).config
    assert config.image_encoder is not None
    assert (config.unet.head_width, config.frames, config.vae.scale, config.image_encoder.heads) == (32, 25, 0.5, 4)
    given = inspect_weights(folder, head_width=16, image_heads=8, frames=7).config
    assert given.image_encoder is not None
    assert (given.unet.head_width, given.frames, given.image_encoder.heads) == (16, 7, 8)


def private_bytes() -> int:
    """Memory of this process that no file backs."""
    for line in Path("/proc/self/smaps_rollup").read_text().splitlines():
        if line.startswith("Anonymous:"):
            return int(line.split()[1]) << 10
    raise AssertionError("the kernel gives no smaps_rollup")


@pytest.mark.skipif(not Path("/proc/self/smaps_rollup").exists(), reason="needs Linux")
def test_loading_takes_no_memory_of_its_own(tmp_path: Path) -> None:
    wide = msgspec.structs.replace(SMALL_GCD.unet, embedding_width=2304)
    state = gcd_state(Networks(msgspec.structs.replace(SMALL_GCD, unet=wide)))
    weights = sum(tensor.nbytes for tensor in state.values())
    path = write_lightning(tmp_path / "a.ckpt", state, optimizer_states=[{"m": torch.zeros(weights // 4)}])
    assert path.stat().st_size > 60 << 20
    del state
    gc.collect()
    before = private_bytes()
    loaded = load(path)
    assert private_bytes() - before < weights / 10
    assert sum(parameter.nbytes for parameter in loaded.networks.parameters()) > 0.9 * weights


def test_writing_into_loaded_weights_leaves_the_file_alone(tmp_path: Path) -> None:
    path = write_gcd(tmp_path)
    before = digest((path,))
    loaded = load(path)
    with torch.no_grad():
        for parameter in loaded.networks.parameters():
            parameter.zero_()
    assert digest((path,)) == before


def changed(folder: Path, drop: str, put: dict[str, Tensor] | None = None) -> str:
    """What a checkpoint without the weights of that beginning, and with others, is refused with."""
    state = {name: tensor for name, tensor in gcd_state(filled()).items() if not name.startswith(drop)}
    return refused(write_lightning(folder / "a.ckpt", state | (put or {})))


def test_all_that_does_not_fit_is_counted_and_the_first_five_named(tmp_path: Path) -> None:
    block = f"{UNET}.output_blocks.1."
    names = [name for name in gcd_state(filled()) if name.startswith(block)]
    total = len(filled().state_dict())
    missing = f"{len(names)} of {total} weights are missing, first: {', '.join(names[:5])}"
    assert changed(tmp_path, block).startswith(f"{missing}. Nothing")
    message = changed(tmp_path, block, {f"{UNET}.extra": torch.zeros(2), f"{UNET}.out.0.bias": torch.zeros(3)})
    assert message.startswith(f"{missing}; 1 of {total} weights are misshapen, first: {UNET}.out.0.bias")
    assert f"1 unexpected names, first: {UNET}.extra" in message
    assert f"{UNET}.out.2.weight" in changed(tmp_path, f"{UNET}.out.2.weight")  # without it nothing can be compared


def test_leftovers_are_recognised_and_counted(tmp_path: Path) -> None:
    report = inspect(write_gcd(tmp_path))
    assert {leftover.kind: leftover.tensors for leftover in report.leftovers} == {
        "CLIP text tower": 3,
        "decoder of the condition VAE": 2,
        "LPIPS": 1,
        "EMA": 1,
    }
    assert next(left.size for left in report.leftovers if left.kind == "LPIPS") == 16


# Whatever is wrong or hostile in a file is said in one line, and nothing in it ever runs.

CONV = f"{UNET}.input_blocks.1.0.in_layers.2.weight"


def foreign_class(monkeypatch: pytest.MonkeyPatch) -> type:
    """A class of a module that exists only while the checkpoint is written."""
    module = types.ModuleType("made_up_trainer")
    kind = type("Callback", (dict,), {"__module__": "made_up_trainer"})
    monkeypatch.setattr(module, "Callback", kind, raising=False)
    monkeypatch.setitem(sys.modules, "made_up_trainer", module)
    return kind


class Hostile:
    """Unpickled by pickle itself, creates a file."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[object, ...]:
        return (Path.touch, (self.trace,))


class Listed(list[int]):
    """Rebuilt by appending to an instance with state."""


def test_foreign_objects_and_hostile_code_beside_the_weights_do_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trace = tmp_path / "trace"
    callback, listed, hostile = foreign_class(monkeypatch)(monitor="loss"), Listed([1, 2, 3]), Hostile(trace)
    listed.note = "kept in the instance's dictionary"
    entries = {
        "callbacks": {"best": callback, "worst": hostile},
        "loops": [listed, {1, 2}, Path("a/b")],
        "hyper_parameters": callback,
    }
    path = write_lightning(tmp_path / "a.ckpt", gcd_state(filled()), **entries, optimizer_states=[hostile])
    monkeypatch.undo()
    assert_same_weights(load(path).networks, filled())
    assert set(entries) < set(inspect(path).other_entries)
    assert not trace.exists()
    pickle.loads(pickle.dumps(hostile))
    assert trace.exists(), "the attack must work on pickle itself, else this test shows nothing"


def test_what_is_no_tensor_among_the_weights_is_refused_by_name_and_never_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trace = tmp_path / "trace"
    path = write_lightning(tmp_path / "a.ckpt", gcd_state(filled()) | {"extra": foreign_class(monkeypatch)()})
    monkeypatch.undo()
    message = refused(path)
    assert "made_up_trainer.Callback" in message
    assert "'extra'" in message
    assert CONV in refused(write_lightning(tmp_path / "b.ckpt", gcd_state(filled()) | {CONV: Hostile(trace)}))
    assert not trace.exists()


@pytest.mark.parametrize(
    "name", ["posix.system", "builtins.eval", "builtins.getattr", "torch.load", "torch.storage._load_from_bytes"]
)
def test_no_function_but_rebuilding_is_ever_called(tmp_path: Path, name: str) -> None:
    module, _, function = name.rpartition(".")
    trace = tmp_path / "trace"
    call = f"c{module}\n{function}\n(V{trace}\ntR.".encode()
    assert "object of" in refused(write_pickle(tmp_path / "a.ckpt", call))


def test_a_pickle_cannot_change_what_rebuilds_tensors(tmp_path: Path) -> None:
    change = b"ctorch._utils\n_rebuild_tensor_v2\n(N}(V__defaults__\nNutb."
    assert "cannot be unpickled" in refused(write_pickle(tmp_path / "a.ckpt", change))
    assert torch._utils._rebuild_tensor_v2.__defaults__ == (None,)


STORAGE = b"(Vstorage\nctorch\nFloatStorage\nV%s\nVcpu\nI%d\ntQ"
REBUILT = b"ctorch._utils\n_rebuild_tensor_v2\n(" + STORAGE + b"I%d\n(I%d\nt(I%d\ntI00\nNtR"


@pytest.mark.parametrize(
    ("key", "count", "start", "size", "stride"),
    [
        (b"0", 100, 0, 4, 1),  # more than the record holds
        (b"1", 4, 0, 4, 1),  # no record
        (b"../version", 4, 0, 4, 1),
        (b"0", -4, 0, 4, 1),
        (b"0", 4, 2, 4, 1),  # a tensor that reaches beyond its storage
        (b"0", 4, -2, 4, 1),
        (b"0", 4, 3, 4, -1),
        (b"0", 4, 0, 10**18, 1),
    ],
)
def test_no_tensor_reaches_beyond_its_record(
    tmp_path: Path, key: bytes, count: int, start: int, size: int, stride: int
) -> None:
    program = b"(Va\n" + REBUILT % (key, count, start, size, stride) + b"d."
    message = refused(write_pickle(tmp_path / "a.ckpt", program, {"data/0": bytes(16)}))
    assert "no layout known" not in message, "that a tensor was made"
    whole = b"(Va\n" + REBUILT % (b"0", 4, 0, 4, 1) + b"d."
    assert "no layout known" in refused(write_pickle(tmp_path / "b.ckpt", whole, {"data/0": bytes(16)}))


def write_pickle(path: Path, program: bytes, records: Mapping[str, bytes] | None = None) -> Path:
    """A torch zip whose pickle is the given program."""
    plain = {"data.pkl": program, "version": b"3\n", "byteorder": b"little"} | dict(records or {})
    return zipped(path, {f"archive/{name}": content for name, content in plain.items()})


def with_weight(path: Path, value: Tensor) -> Path:
    """A checkpoint in which one weight is something else."""
    return write_lightning(path, gcd_state(filled()) | {CONV: value})


def zipped(path: Path, names: Mapping[str, bytes], compression: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, content in names.items():
            archive.writestr(name, content)
    return path


def saved(path: Path, content: object) -> Path:
    torch.save(content, path)
    return path


def written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def cut(path: Path, keep: float) -> Path:
    return written(path, path.read_bytes()[: int(keep * path.stat().st_size)])


def diffusers(folder: Path, file: str, content: str | None) -> Path:
    """A folder of diffusers with one file of another content, or without it."""
    write_diffusers(folder)
    (folder / file).unlink() if content is None else (folder / file).write_text(content)
    return folder


def shortened(path: Path) -> Path:
    """The largest record holds half of what its pickle claims."""
    with zipfile.ZipFile(write_gcd(path.parent)) as source:
        content = {entry.filename: source.read(entry) for entry in source.infolist()}
    largest = max((name for name in content if "/data/" in name), key=lambda name: len(content[name]))
    return zipped(path, content | {largest: content[largest][: len(content[largest]) // 2]})


BROKEN: dict[str, Callable[[Path], Path]] = {
    "a tensor larger than its storage": lambda path: with_weight(path, torch.zeros(1).expand(10**12)),
    "quantised weights": lambda path: with_weight(path, gcd_state(filled())[CONV].to(torch.int8)),
    "a record shorter than its tensor": shortened,
    "a truncated zip": lambda path: cut(write_gcd(path.parent), 0.7),
    "truncated safetensors": lambda path: cut(write_svd(path.parent), 0.7),
    "a truncated header": lambda path: cut(write_svd(path.parent), 0.0001),
    "nothing": lambda path: path,
    "an empty file": lambda path: written(path, b""),
    "a pointer of Git LFS": lambda path: written(path, b"version https://git-lfs.github.com/spec/v1\nsize 1\n"),
    "a web page": lambda path: written(path, b"\n<!DOCTYPE html><html><body>Sign in</body></html>"),
    "text": lambda path: written(path, b"text, no weights"),
    "a header that is no JSON": lambda path: written(path, (50).to_bytes(8, "little") + b"{" * 50),
    "a header too long to be true": lambda path: written(path, (1 << 60).to_bytes(8, "little") + b"{" * 50),
    "a header beyond the file": lambda path: written(path, (5000).to_bytes(8, "little") + b"{" * 50),
    "the first bytes of a zip": lambda path: written(path, b"PK\x03\x04 and then nothing"),
    "torch's old format": lambda path: written(path, pickle.dumps({"a": 1}, protocol=2)),
    "a huge pickle": lambda path: zipped(path, {"a/data.pkl": b"\x80\x02" + b"]" * 2**24, "a/version": b"3"}),
    "a zip of something else": lambda path: zipped(path, {"a/b.txt": b"x"}),
    "TorchScript": lambda path: zipped(path, {"a/constants.pkl": b"x", "a/data.pkl": b"x"}),
    "a compressed zip": lambda path: zipped(path, {"a/data.pkl": b"x" * 100}, zipfile.ZIP_DEFLATED),
    "a folder of something else": lambda path: path.parent,
    "one part of diffusers": lambda path: write_diffusers(path) / "unet" / "diffusion_pytorch_model.safetensors",
    "a part without weights": lambda path: diffusers(path, "vae/diffusion_pytorch_model.safetensors", None),
    "a truncated part": lambda path: diffusers(path, "vae/diffusion_pytorch_model.safetensors", "xxxxxxxx{"),
    "another activation": lambda path: diffusers(path, "image_encoder/config.json", '{"hidden_act": "quick_gelu"}'),
    "another model": lambda path: saved(path, {"state_dict": {"model.layers.0.mlp.weight": torch.zeros(2)}}),
    "a checkpoint without weights": lambda path: saved(path, {"epoch": 3, "weights": {}}),
    "a list": lambda path: saved(path, [1, 2]),
    "a list of weights": lambda path: saved(path, {"state_dict": [1]}),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_what_is_no_checkpoint_is_refused_in_one_line_that_begins_with_its_name(tmp_path: Path, kind: str) -> None:
    message = refused(BROKEN[kind](tmp_path / "a.ckpt"))
    assert {"a pointer of Git LFS": "git lfs pull", "a truncated zip": "truncated"}.get(kind, "") in message
