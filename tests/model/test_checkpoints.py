"""Checkpoints of every layout load mapped and strictly, weight by weight."""

import gc
from collections.abc import Callable
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
    refused,
    shared_vae,
    split_in_shards,
    write_diffusers,
    write_gcd,
    write_lightning,
    write_svd,
)
from safetensors.torch import load_file
from torch import Tensor

from gcd_model.networks import Networks
from gcd_model.weights.load import digest, inspect_weights, load_weights

UNET = "model.diffusion_model"
CONV = f"{UNET}.input_blocks.1.0.in_layers.2.weight"


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


def test_a_sharded_part_is_put_together(tmp_path: Path) -> None:
    folder = split_in_shards(write_diffusers(tmp_path / "model") / "unet")
    assert_same_weights(load_weights(folder.parent).networks, filled(shared_vae(SMALL_GCD)))


def test_a_part_written_as_a_pickle_loads_too(tmp_path: Path) -> None:
    folder = write_diffusers(tmp_path / "model")
    whole = folder / "vae" / "diffusion_pytorch_model.safetensors"
    torch.save(load_file(whole), whole.with_suffix(".bin"))
    whole.unlink()
    assert_same_weights(load_weights(folder).networks, filled(shared_vae(SMALL_GCD)))


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
    loaded = load_weights(path)
    assert private_bytes() - before < weights / 10
    assert sum(parameter.nbytes for parameter in loaded.networks.parameters()) > 0.9 * weights


def test_writing_into_loaded_weights_leaves_the_file_alone(tmp_path: Path) -> None:
    path = write_gcd(tmp_path)
    before = digest((path,))
    loaded = load_weights(path)
    with torch.no_grad():
        for parameter in loaded.networks.parameters():
            parameter.zero_()
    assert digest((path,)) == before


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


def test_all_that_does_not_fit_is_said_at_once(tmp_path: Path) -> None:
    def change(state: dict[str, Tensor]) -> None:
        state[CONV.replace("weight", "extra")] = state.pop(CONV)
        state[f"{UNET}.out.0.bias"] = torch.zeros(3)

    message = refused(changed(tmp_path, change))
    assert all(word in message for word in ("1 of", "missing", "misshapen", "1 unexpected names"))


def test_a_missing_weight_that_tells_the_architecture_is_named(tmp_path: Path) -> None:
    name = f"{UNET}.out.2.weight"
    assert name in refused(changed(tmp_path, lambda state: drop(state, [name])))


def test_leftovers_are_recognised_and_counted(tmp_path: Path) -> None:
    report = inspect_weights(write_gcd(tmp_path))
    assert {leftover.kind: leftover.tensors for leftover in report.leftovers} == {
        "CLIP text tower": 3,
        "decoder of the condition VAE": 2,
        "LPIPS": 1,
        "EMA": 1,
    }
    assert next(left.size for left in report.leftovers if left.kind == "LPIPS") == 16
