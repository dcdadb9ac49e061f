"""Whatever is wrong or hostile in a file is said in one line, and nothing in it ever runs."""

import json
import pickle
import sys
import types
import zipfile
from pathlib import Path

import pytest
import torch
from published import (
    assert_same_weights,
    filled,
    gcd_state,
    refused,
    split_in_shards,
    write_diffusers,
    write_gcd,
    write_lightning,
    write_svd,
)
from safetensors.torch import save_file

from gcd_model.weights.load import inspect_weights, load_weights

UNET = "model.diffusion_model"
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


def test_foreign_objects_beside_the_weights_do_not_matter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    callback = foreign_class(monkeypatch)(monitor="loss")
    listed = Listed([1, 2, 3])
    listed.note = "kept in the instance's dictionary"
    entries = {"callbacks": {"best": callback}, "loops": [listed, {1, 2}, Path("a/b")], "hyper_parameters": callback}
    path = write_lightning(tmp_path / "a.ckpt", gcd_state(filled()), **entries)
    monkeypatch.undo()
    assert_same_weights(load_weights(path).networks, filled())
    assert set(entries) < set(inspect_weights(path).other_entries)


def test_a_foreign_object_among_the_weights_is_refused_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_lightning(tmp_path / "a.ckpt", gcd_state(filled()) | {"extra": foreign_class(monkeypatch)()})
    monkeypatch.undo()
    message = refused(path)
    assert "made_up_trainer.Callback" in message
    assert "'extra'" in message


@pytest.mark.parametrize("place", ["callbacks", "optimizer_states"])
def test_hostile_code_beside_the_weights_never_runs(tmp_path: Path, place: str) -> None:
    trace = tmp_path / "trace"
    path = write_lightning(tmp_path / "a.ckpt", gcd_state(filled()), **{place: [Hostile(trace)]})
    assert_same_weights(load_weights(path).networks, filled())
    assert not trace.exists()
    pickle.loads(pickle.dumps(Hostile(trace)))
    assert trace.exists(), "the attack must work on pickle itself, else this test shows nothing"


def test_hostile_code_among_the_weights_is_refused_and_never_runs(tmp_path: Path) -> None:
    trace = tmp_path / "trace"
    path = write_lightning(tmp_path / "a.ckpt", gcd_state(filled()) | {CONV: Hostile(trace)})
    assert "refused" in refused(path)
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


def write_pickle(path: Path, program: bytes) -> Path:
    """A torch zip whose pickle is the given program."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", program)
        archive.writestr("archive/version", "3\n")
        archive.writestr("archive/byteorder", "little")
    return path


def test_a_tensor_larger_than_its_storage_is_refused(tmp_path: Path) -> None:
    huge = torch.zeros(1).expand(10**12)
    path = write_lightning(tmp_path / "a.ckpt", gcd_state(filled()) | {CONV: huge})
    assert f"{CONV} claims 4000000000000 bytes and stores 4" in refused(path)


def test_quantised_weights_are_refused(tmp_path: Path) -> None:
    state = gcd_state(filled())
    path = write_lightning(tmp_path / "a.ckpt", state | {CONV: state[CONV].to(torch.int8)})
    assert refused(path).startswith(f"1 weights are stored as int8, first: {CONV}")


def cut(path: Path, keep: float) -> Path:
    path.write_bytes(path.read_bytes()[: int(keep * path.stat().st_size)])
    return path


def test_truncated_files_say_so(tmp_path: Path) -> None:
    assert "truncated" in refused(cut(write_gcd(tmp_path), 0.7))
    assert "truncated" in refused(cut(write_svd(tmp_path), 0.7))
    assert "ends within its header" in refused(cut(write_svd(tmp_path, "b.safetensors"), 0.0001))
    folder = write_diffusers(tmp_path / "model")
    cut(folder / "vae" / "diffusion_pytorch_model.safetensors", 0.7)
    assert refused(folder).startswith("its file vae/diffusion_pytorch_model.safetensors is damaged or truncated")


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "is empty (0 bytes); fetch it again"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n", "run `git lfs pull`"),
        (b"\n<!DOCTYPE html><html><body>Sign in</body></html>", "is a web page"),
        (b"text, no weights", "is neither a torch zip"),
        ((50).to_bytes(8, "little") + b"{" * 50, "is damaged or truncated safetensors"),
        ((1 << 60).to_bytes(8, "little") + b"{" * 50, "too long to be true"),
        ((5000).to_bytes(8, "little") + b"{" * 50, "ends within its header (58 bytes"),
        (b"PK\x03\x04 and then nothing", "is a truncated or damaged torch zip"),
        (pickle.dumps({"a": 1}, protocol=2), "torch's old format"),
    ],
)
def test_what_is_no_checkpoint_is_named_with_a_remedy(tmp_path: Path, content: bytes, said: str) -> None:
    (tmp_path / "a.ckpt").write_bytes(content)
    assert said in refused(tmp_path / "a.ckpt")


def test_a_pickle_of_more_than_any_checkpoint_needs_is_not_read(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.ckpt", "w") as archive:
        archive.writestr("a/data.pkl", b"\x80\x02" + b"]" * 2**24)
        archive.writestr("a/version", "3")
    assert "its pickle has" in refused(tmp_path / "a.ckpt")


def test_zips_of_another_kind_are_refused(tmp_path: Path) -> None:
    for inner, said in (("a/b.txt", "without data.pkl"), ("a/constants.pkl", "TorchScript")):
        with zipfile.ZipFile(tmp_path / "a.ckpt", "w") as archive:
            archive.writestr(inner, "x")
        assert said in refused(tmp_path / "a.ckpt")
    with zipfile.ZipFile(tmp_path / "a.ckpt", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a/data.pkl", "x" * 100)
    assert "compressed" in refused(tmp_path / "a.ckpt")


def test_a_path_to_nothing_or_to_the_wrong_folder_is_said(tmp_path: Path) -> None:
    assert "there is no such file" in refused(tmp_path / "absent.ckpt")
    assert refused(tmp_path).startswith("is a folder without unet, vae, image_encoder")
    folder = write_diffusers(tmp_path / "model")
    assert "is one part of a diffusers model" in refused(folder / "unet" / "diffusion_pytorch_model.safetensors")
    (folder / "vae" / "diffusion_pytorch_model.safetensors").unlink()
    assert "its folder vae holds no weights (found: config.json)" in refused(folder)


def test_weights_of_another_model_are_named(tmp_path: Path) -> None:
    save_file({"model.layers.0.mlp.weight": torch.zeros(2)}, tmp_path / "llm.safetensors")
    assert refused(tmp_path / "llm.safetensors").startswith("holds 1 tensors of no layout known here, first: model.lay")
    torch.save({"epoch": 3, "weights": {}}, tmp_path / "a.pt")
    assert "has no entry 'state_dict' (found: epoch, weights)" in refused(tmp_path / "a.pt")
    torch.save([1, 2], tmp_path / "b.pt")
    assert refused(tmp_path / "b.pt").startswith("holds a list")
    torch.save({"state_dict": [1]}, tmp_path / "c.pt")
    assert "its state_dict is a list" in refused(tmp_path / "c.pt")


def test_an_index_cannot_lead_out_of_its_folder(tmp_path: Path) -> None:
    part = split_in_shards(write_diffusers(tmp_path / "model") / "unet")
    index = part / "diffusion_pytorch_model.safetensors.index.json"
    index.write_text(json.dumps({"weight_map": {"a": "../../secret.safetensors"}}))
    assert "plain file names" in refused(part.parent)
    index.write_text(json.dumps({"weight_map": {"a": "gone.safetensors"}}))
    assert "lacks 1 shards, first: gone.safetensors" in refused(part.parent)
    index.write_text("{")
    assert "cannot be used" in refused(part.parent)


def test_an_image_tower_with_another_activation_is_refused(tmp_path: Path) -> None:
    folder = write_diffusers(tmp_path / "model")
    (folder / "image_encoder" / "config.json").write_text('{"hidden_act": "quick_gelu"}')
    assert "activation 'quick_gelu'" in refused(folder)


def test_a_record_shorter_than_its_tensor_is_refused_rather_than_read_past_its_end(tmp_path: Path) -> None:
    whole, short = write_gcd(tmp_path), tmp_path / "short.ckpt"
    with zipfile.ZipFile(whole) as source, zipfile.ZipFile(short, "w") as target:
        records = [entry for entry in source.infolist() if "/data/" in entry.filename]
        largest = max(records, key=lambda entry: entry.file_size).filename
        for entry in source.infolist():
            content = source.read(entry)
            target.writestr(entry.filename, content[: len(content) // 2] if entry.filename == largest else content)
    assert "should hold" in refused(short)
