"""Checkpoints of every layout load strictly and mapped; whatever is wrong with a file is said in one line."""

import gc
import json
import logging
import pickle
import sys
import types
import zipfile
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
import torch
from published import (
    SMALL_GCD,
    diffusers_parts,
    filled,
    fixed_view,
    gcd_state,
    shared_vae,
    stem_of,
    write_diffusers,
    write_gcd,
    write_lightning,
    write_svd,
)
from safetensors.torch import load_file, save_file
from torch import Tensor

from gcd_model.checkpoints import convert_weights, digest, inspect_weights, load_weights, save_weights
from gcd_model.config import SMALL, ModelConfig
from gcd_model.errors import CheckpointError, OptionError
from gcd_model.networks import Networks
from gcd_model.own_format import Card

UNET = "model.diffusion_model"
CONV = f"{UNET}.input_blocks.1.0.in_layers.2.weight"


def assert_same_weights(ours: Networks, theirs: Networks) -> None:
    state, wanted = ours.state_dict(), theirs.state_dict()
    assert list(state) == list(wanted)
    for name, tensor in wanted.items():
        torch.testing.assert_close(state[name], tensor, rtol=0, atol=0, msg=name)


def refused(path: Path) -> str:
    """The one line a file is refused with; it begins with the file's name."""
    with pytest.raises(CheckpointError) as caught:
        load_weights(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message.removeprefix(f"{path}: ")


# --- every layout gives the same networks --------------------------------------------------------------------------


def test_a_lightning_checkpoint_loads_weight_by_weight(tmp_path: Path) -> None:
    loaded = load_weights(write_gcd(tmp_path))
    assert_same_weights(loaded.networks, filled())
    assert loaded.networks.config == SMALL_GCD
    assert (loaded.name, loaded.trained) == ("kubric_gradual_max90", True)


def test_the_base_model_loads_weight_by_weight(tmp_path: Path) -> None:
    loaded = load_weights(write_svd(tmp_path))
    assert_same_weights(loaded.networks, filled(fixed_view(SMALL_GCD)))
    config = loaded.networks.config
    assert (config.height, config.width, config.sampling.guidance) == (576, 1024, (1.0, 2.5))
    assert (config.unet, config.vae, config.camera) == (fixed_view(SMALL_GCD).unet, SMALL_GCD.vae, "none")


@pytest.mark.parametrize("configs", [True, False], ids=["with config.json", "without"])
def test_a_diffusers_folder_loads_weight_by_weight(tmp_path: Path, configs: bool) -> None:
    loaded = load_weights(write_diffusers(tmp_path / "model", configs=configs))
    assert_same_weights(loaded.networks, filled(shared_vae(SMALL_GCD)))
    assert loaded.networks.config == shared_vae(SMALL_GCD)
    assert loaded.networks.condition_encoder is loaded.networks.target_encoder


def test_a_float16_variant_keeps_its_precision_until_asked(tmp_path: Path) -> None:
    loaded = load_weights(write_diffusers(tmp_path / "model", half=True))
    assert {parameter.dtype for parameter in loaded.networks.parameters()} == {torch.float16}
    wanted = filled(shared_vae(SMALL_GCD)).half().state_dict()
    for name, tensor in loaded.networks.state_dict().items():
        torch.testing.assert_close(tensor, wanted[name].half(), rtol=0, atol=0, msg=name)


def test_full_precision_is_preferred_to_its_float16_variant(tmp_path: Path) -> None:
    folder = write_diffusers(tmp_path / "model")
    for part, state in diffusers_parts().items():
        save_file({k: v.half() for k, v in state.items()}, folder / part / f"{stem_of(part)}.fp16.safetensors")
    assert load_weights(folder).networks.unet.stem.weight.dtype == torch.float32


def test_a_sharded_part_is_put_together(tmp_path: Path) -> None:
    folder = shard(write_diffusers(tmp_path / "model") / "unet")
    assert_same_weights(load_weights(folder.parent).networks, filled(shared_vae(SMALL_GCD)))


def shard(part: Path) -> Path:
    """Split a part's weights in two files with an index, as diffusers does."""
    whole = part / f"{stem_of(part.name)}.safetensors"
    state = load_file(whole)
    whole.unlink()
    files = [f"{whole.stem}-0000{i}-of-00002.safetensors" for i in (1, 2)]
    index = {name: files[i % 2] for i, name in enumerate(state)}
    for file in files:
        save_file({name: state[name] for name in state if index[name] == file}, part / file)
    (part / f"{whole.name}.index.json").write_text(json.dumps({"metadata": {}, "weight_map": index}))
    return part


def test_a_part_written_as_a_pickle_loads_too(tmp_path: Path) -> None:
    folder = write_diffusers(tmp_path / "model")
    whole = folder / "vae" / "diffusion_pytorch_model.safetensors"
    torch.save(load_file(whole), whole.with_suffix(".bin"))
    whole.unlink()
    assert_same_weights(load_weights(folder).networks, filled(shared_vae(SMALL_GCD)))


def test_a_plain_dictionary_of_tensors_counts_as_a_state(tmp_path: Path) -> None:
    torch.save(gcd_state(filled()), tmp_path / "weights.pt")
    assert_same_weights(load_weights(tmp_path / "weights.pt").networks, filled())


def test_the_layout_is_told_by_content_not_by_suffix(tmp_path: Path) -> None:
    path = write_svd(tmp_path).rename(tmp_path / "blob-without-suffix")
    assert inspect_weights(path).layout == "sgm-safetensors"
    assert inspect_weights(write_gcd(tmp_path).rename(tmp_path / "other")).layout == "gcd-ckpt"


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


# --- mapped, not read ----------------------------------------------------------------------------------------------


def private_bytes() -> int:
    """Memory of this process that no file backs."""
    for line in Path("/proc/self/smaps_rollup").read_text().splitlines():
        if line.startswith("Anonymous:"):
            return int(line.split()[1]) << 10
    raise AssertionError("the kernel gives no smaps_rollup")


@pytest.mark.skipif(not Path("/proc/self/smaps_rollup").exists(), reason="needs Linux")
def test_loading_takes_no_memory_of_its_own(tmp_path: Path) -> None:
    wide = msgspec.structs.replace(SMALL_GCD.unet, embedding_width=16384)
    state = gcd_state(Networks(msgspec.structs.replace(SMALL_GCD, unet=wide)))
    weights = sum(tensor.nbytes for tensor in state.values())
    path = write_lightning(tmp_path / "a.ckpt", state, optimizer_states=[{"m": torch.zeros(weights // 4)}])
    assert path.stat().st_size > 60 << 20
    del state
    gc.collect()
    before = private_bytes()
    loaded = load_weights(path)
    assert private_bytes() - before < weights / 10
    assert sum(parameter.nbytes for parameter in loaded.networks.parameters()) > 0.9 * weights


def test_the_optimizer_state_is_weighed_and_not_kept(tmp_path: Path) -> None:
    report = inspect_weights(write_gcd(tmp_path))
    assert report.optimizer_size == 4 + 2 * 50 * 4
    assert report.other_entries == ("epoch", "global_step")


def test_writing_into_loaded_weights_leaves_the_file_alone(tmp_path: Path) -> None:
    path = write_gcd(tmp_path)
    before = digest((path,))
    loaded = load_weights(path)
    with torch.no_grad():
        for parameter in loaded.networks.parameters():
            parameter.zero_()
    assert digest((path,)) == before


# --- foreign and hostile objects -----------------------------------------------------------------------------------


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
    listed.note = "kept in the instance's dictionary"  # type: ignore[attr-defined]
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
    "name",
    ["posix.system", "os.system", "builtins.eval", "builtins.getattr", "torch.load", "torch.storage._load_from_bytes"],
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


# --- strictness ----------------------------------------------------------------------------------------------------


def drop(state: dict[str, Tensor], names: list[str]) -> None:
    for name in names:
        del state[name]


def changed(tmp_path: Path, change: Callable[[dict[str, Tensor]], None]) -> Path:
    state = gcd_state(filled())
    change(state)
    return write_lightning(tmp_path / "a.ckpt", state)


def test_missing_weights_are_counted_and_the_first_five_named(tmp_path: Path) -> None:
    names = [name for name in gcd_state(filled()) if f"{UNET}.output_blocks.1." in name]
    message = refused(changed(tmp_path, lambda state: drop(state, names)))
    assert len(names) > 5
    total = len(filled().state_dict())
    assert message.startswith(f"{len(names)} of {total} weights are missing, first: {', '.join(names[:5])}. Nothing")


def test_unexpected_weights_are_counted_and_the_first_five_named(tmp_path: Path) -> None:
    extra = {f"{UNET}.control.{i}": torch.zeros(1) for i in range(7)}
    message = refused(changed(tmp_path, lambda state: state.update(extra)))
    assert message.startswith(f"7 unexpected names, first: {', '.join(list(extra)[:5])}. Nothing")


def test_misshapen_weights_are_counted_and_both_shapes_given(tmp_path: Path) -> None:
    message = refused(changed(tmp_path, lambda state: state.update({CONV: torch.zeros(32, 32, 1, 1)})))
    assert f"1 of {len(filled().state_dict())} weights are misshapen" in message
    assert f"{CONV} wants [32, 32, 3, 3], got [32, 32, 1, 1]" in message


def test_all_that_does_not_fit_is_said_at_once(tmp_path: Path) -> None:
    def change(state: dict[str, Tensor]) -> None:
        state[CONV.replace("weight", "extra")] = state.pop(CONV)
        state[f"{UNET}.out.0.bias"] = torch.zeros(3)

    message = refused(changed(tmp_path, change))
    assert all(word in message for word in ("1 of", "missing", "misshapen", "1 unexpected names"))


@pytest.mark.parametrize(
    "name",
    [f"{UNET}.input_blocks.0.0.weight", f"{UNET}.out.2.weight", "first_stage_model.encoder.conv_in.weight"],
)
def test_a_missing_weight_that_tells_the_architecture_is_named(tmp_path: Path, name: str) -> None:
    assert name in refused(changed(tmp_path, lambda state: drop(state, [name])))


def test_every_single_missing_weight_is_noticed(tmp_path: Path) -> None:
    """For one name of every kind, so that none is only found by luck."""
    state = gcd_state(filled())
    used = [name for name in state if "open_clip.model." not in name and ".decoder.conv_in" not in name]
    for name in used[:: len(used) // 25]:
        path = write_lightning(tmp_path / "a.ckpt", {n: t for n, t in state.items() if n != name})
        assert name in refused(path)


def test_leftovers_are_recognised_and_counted(tmp_path: Path) -> None:
    report = inspect_weights(write_gcd(tmp_path))
    assert {leftover.kind: leftover.tensors for leftover in report.leftovers} == {
        "CLIP text tower": 3,
        "decoder of the condition VAE": 2,
        "LPIPS": 1,
        "EMA": 1,
    }
    assert next(left.size for left in report.leftovers if left.kind == "LPIPS") == 16


def test_the_decoder_of_the_condition_vae_may_be_absent(tmp_path: Path) -> None:
    def change(state: dict[str, Tensor]) -> None:
        for name in [name for name in state if name.startswith("conditioner.embedders.3.encoder.decoder")]:
            del state[name]

    assert_same_weights(load_weights(changed(tmp_path, change)).networks, filled())


# --- files that are something else ---------------------------------------------------------------------------------


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
        (b"\x00" * 1000, "is neither a torch zip"),
        (b"text, no weights", "is neither a torch zip"),
        ((50).to_bytes(8, "little") + b"{" * 50, "is damaged or truncated safetensors"),
        ((1 << 60).to_bytes(8, "little") + b"{" * 50, "too long to be true"),
        ((5000).to_bytes(8, "little") + b"{" * 50, "ends within its header (58 bytes"),
        (b"PK\x03\x04 and then nothing", "is a truncated or damaged torch zip"),
        (pickle.dumps({"a": 1}, protocol=2), "torch's old format"),
    ],
)
@pytest.mark.parametrize("name", ["a.ckpt", "a.safetensors"])
def test_what_is_no_checkpoint_is_named_with_a_remedy(tmp_path: Path, content: bytes, said: str, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    if name.endswith(".safetensors") and content.startswith(b"PK"):
        said = "rename it to .ckpt"
    assert said in refused(path)


def test_files_of_the_old_format_are_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "old.ckpt"
    torch.save({"state_dict": gcd_state(filled())}, path, _use_new_zipfile_serialization=False)
    message = refused(path)
    assert "old format" in message
    assert "torch.save" in message


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
    part = shard(write_diffusers(tmp_path / "model") / "unet")
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


# --- the family ----------------------------------------------------------------------------------------------------


def test_the_family_follows_option_metadata_name_and_yaml_in_that_order(tmp_path: Path) -> None:
    path = write_gcd(tmp_path, "kubric_direct_max180.ckpt")
    path.with_suffix(".yaml").write_text("move_time: 13\ndelta_azimuth_range: [-90, 90]\n")
    report = inspect_weights(path)
    assert (report.family, report.told_by, report.move_time) == ("kubric180", "file name", 0)
    report = inspect_weights(path, family="kubric90")
    assert (report.family, report.told_by, report.move_time) == ("kubric90", "option", 0)
    other = path.rename(tmp_path / "mine.ckpt")
    other.with_suffix(".yaml").write_text("move_time: 5\ndelta_azimuth_range: [-90, 90]\n")
    report = inspect_weights(other)
    assert (report.family, report.told_by, report.move_time) == ("kubric90", "yaml", 5)
    card = Card(name="small", config=SMALL_GCD, family="kubric180", move_time=7)
    save_weights(filled(), tmp_path / "kubric_gradual_max90.safetensors", card)
    report = inspect_weights(tmp_path / "kubric_gradual_max90.safetensors")
    assert (report.family, report.told_by, report.move_time) == ("kubric180", "metadata", 7)


def test_an_unknown_family_is_said_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = write_gcd(tmp_path, "mine.ckpt")
    with caplog.at_level(logging.WARNING):
        loaded = load_weights(path)
    assert loaded.family is None
    assert loaded.move_time == 13
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "--motion-bucket" in caplog.text
    caplog.clear()
    load_weights(path, family="kubric90")
    assert caplog.records == []


@pytest.mark.parametrize("family", ["driving", "svd"])
def test_a_family_against_the_camera_of_the_weights_is_refused(tmp_path: Path, family: str) -> None:
    with pytest.raises(CheckpointError, match=f"family {family} .*the weights have 'spherical'; name another"):
        load_weights(write_gcd(tmp_path), family=family)


def test_a_published_name_against_the_camera_of_the_weights_is_refused(tmp_path: Path) -> None:
    assert "told by: file name" in refused(write_svd(tmp_path, "kubric_gradual_max90.safetensors"))


def test_an_unknown_family_name_lists_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="kubric90, kubric180, driving, driving-semantic, svd"):
        load_weights(tmp_path / "a.ckpt", family="kubric")


def test_an_early_goal_stays_within_the_frames(tmp_path: Path) -> None:
    assert inspect_weights(write_gcd(tmp_path), frames=5).move_time == 4
    with pytest.raises(OptionError, match="frames must be at least 2"):
        inspect_weights(write_gcd(tmp_path), frames=1)


# --- our own files -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("write", [write_gcd, write_svd, lambda folder: write_diffusers(folder / "m")])
def test_conversion_keeps_every_weight_and_every_fact(tmp_path: Path, write: Callable[[Path], Path]) -> None:
    path, steps = write(tmp_path), list[tuple[int, int]]()
    report = convert_weights(path, tmp_path / "ours.safetensors", progress=lambda *step: steps.append(step))
    before, after = load_weights(path), load_weights(tmp_path / "ours.safetensors")
    assert_same_weights(after.networks, before.networks)
    assert after.networks.config == before.networks.config
    assert (after.family, after.move_time, after.name) == (before.family, before.move_time, before.name)
    assert (report.layout, report.leftovers, report.optimizer_size) == ("gcd-node", (), 0)
    assert steps[-1] == (steps[-1][1],) * 2
    assert [done for done, _ in steps] == sorted(done for done, _ in steps)


def test_our_files_are_safetensors_anybody_can_read(tmp_path: Path) -> None:
    convert_weights(write_gcd(tmp_path), tmp_path / "ours.safetensors", dtype="bfloat16")
    state, wanted = load_file(tmp_path / "ours.safetensors"), filled().state_dict()
    assert set(state) == set(wanted)
    for name, tensor in state.items():
        kept = torch.float32 if name.startswith("decoder.") else torch.bfloat16
        torch.testing.assert_close(tensor, wanted[name].to(kept), rtol=0, atol=0, msg=name)


def test_a_stored_precision_is_kept_unless_asked(tmp_path: Path) -> None:
    report = convert_weights(write_diffusers(tmp_path / "m", half=True), tmp_path / "ours.safetensors")
    assert {network.dtypes for network in report.networks} == {("float16",)}
    report = convert_weights(tmp_path / "ours.safetensors", tmp_path / "wide.safetensors", dtype="float32")
    assert {network.dtypes for network in report.networks} == {("float32",)}


def test_nothing_is_overwritten_unasked_and_nothing_half_written_stays(tmp_path: Path) -> None:
    source, out = write_gcd(tmp_path), tmp_path / "ours.safetensors"
    out.write_bytes(b"precious")
    with pytest.raises(OptionError, match="exists; give another name"):
        convert_weights(source, out)
    assert out.read_bytes() == b"precious"

    def fail(_done: int, _total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        convert_weights(source, out, overwrite=True, progress=fail)
    assert out.read_bytes() == b"precious"
    assert sorted(file.name for file in tmp_path.iterdir()) == [source.name, out.name]
    assert convert_weights(source, out, overwrite=True).layout == "gcd-node"


def test_a_file_can_be_converted_onto_itself(tmp_path: Path) -> None:
    out = tmp_path / "ours.safetensors"
    convert_weights(write_gcd(tmp_path), out)
    convert_weights(out, out, overwrite=True)
    assert_same_weights(load_weights(out).networks, filled())


@pytest.mark.parametrize(("out", "said"), [("ours.ckpt", "ends so"), ("absent/ours.safetensors", "there is no folder")])
def test_an_impossible_output_is_said(tmp_path: Path, out: str, said: str) -> None:
    with pytest.raises(OptionError, match=said):
        convert_weights(write_gcd(tmp_path), tmp_path / out)


def test_random_networks_survive_saving(tmp_path: Path) -> None:
    networks = filled(SMALL)
    card = Card(name="small", config=SMALL, family=None, move_time=3, trained=False)
    save_weights(networks, tmp_path / "a.safetensors", card)
    loaded = load_weights(tmp_path / "a.safetensors", family="kubric90")
    assert_same_weights(loaded.networks, networks)
    assert (loaded.name, loaded.trained, loaded.move_time) == ("small", False, 3)
    assert loaded.networks.config == SMALL


def own_file(tmp_path: Path, **metadata: str) -> Path:
    card = Card(name="small", config=SMALL_GCD, family="kubric90", move_time=13).to_metadata()
    path = tmp_path / "ours.safetensors"
    save_file({k: v.contiguous() for k, v in filled().state_dict().items()}, path, metadata=card | metadata)
    return path


def tampered(**changes: object) -> str:
    fields = msgspec.to_builtins(SMALL_GCD)
    return json.dumps(fields | changes)


@pytest.mark.parametrize(
    ("metadata", "said"),
    [
        ({"gcd.format": "2"}, "this version reads '1'; install a newer"),
        ({"gcd.config": "{"}, "its metadata cannot be used"),
        ({"gcd.config": tampered(shiny=1)}, "unknown field `shiny`"),
        ({"gcd.config": tampered(camera="none")}, "contradicts camera_width"),
        ({"gcd.move_time": "soon"}, "its metadata cannot be used"),
    ],
)
def test_damaged_metadata_is_refused(tmp_path: Path, metadata: dict[str, str], said: str) -> None:
    assert said in refused(own_file(tmp_path, **metadata))


def test_a_config_out_of_proportion_is_refused_before_it_is_built(tmp_path: Path) -> None:
    tower = msgspec.to_builtins(SMALL_GCD.image_encoder) | {"layers": 10**9}
    path = own_file(tmp_path, **{"gcd.config": tampered(image_encoder=tower)})
    assert "describes 1000000004 blocks" in refused(path)


def test_our_files_state_their_heads(tmp_path: Path) -> None:
    assert inspect_weights(own_file(tmp_path), head_width=64, image_heads=16).config == SMALL_GCD
    with pytest.raises(OptionError, match="head_width is 64 in this file"):
        load_weights(own_file(tmp_path), head_width=32)
    assert load_weights(own_file(tmp_path), frames=25).networks.config.frames == 25


# --- digests and reports -------------------------------------------------------------------------------------------


def test_the_digest_of_a_file_is_its_sha256(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"abc")
    assert digest((tmp_path / "a",)) == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


def test_a_large_file_is_digested_by_samples(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gcd_model.checkpoints._SAMPLED_ABOVE", 1 << 20)
    path = tmp_path / "a"
    content = bytearray(8 << 20)
    path.write_bytes(content)
    sampled, full = digest((path,)), digest((path,), full=True)
    assert sampled != full
    for at in (0, (8 << 20) - 1, 4 << 20):
        path.write_bytes(content[:at] + b"\x01" + content[at + 1 :])
        assert digest((path,)) != sampled
    path.write_bytes(content + b"\x00")
    assert digest((path,)) != sampled


def test_a_report_counts_what_the_networks_hold(tmp_path: Path) -> None:
    report, networks = inspect_weights(write_gcd(tmp_path)), filled()
    by_name = {network.name: network.parameters for network in report.networks}
    for name, module in networks.named_children():
        assert by_name[name] == sum(tensor.numel() for tensor in module.state_dict().values())
    assert report.parameters == sum(tensor.numel() for tensor in networks.state_dict().values())
    assert report.sha256_12 == load_weights(write_gcd(tmp_path)).sha256_12
    assert report.size == (tmp_path / "kubric_gradual_max90.ckpt").stat().st_size


@pytest.mark.parametrize("config", [SMALL_GCD, fixed_view(SMALL_GCD)], ids=["steered", "fixed"])
def test_camera_control_follows_the_weights(tmp_path: Path, config: ModelConfig) -> None:
    path = write_gcd(tmp_path, "mine.ckpt", config)
    assert inspect_weights(path).config == config
