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
