"""Small random checkpoints in every published layout, as their publishers would have written them."""

import gzip
import json
from collections.abc import Mapping
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import msgspec
import pytest
import torch
from safetensors.torch import save_file
from small_models import randomise
from torch import Tensor, nn

from gcd_model.config import ImageEncoderConfig, ModelConfig, UNetConfig, VAEConfig
from gcd_model.errors import CheckpointError
from gcd_model.networks import Networks
from gcd_model.unet import VideoUNet
from gcd_model.weights.load import convert_weights, inspect_weights, load_weights
from gcd_model.weights.names import GCD_UNET, Levels, Naming, published_names, taken_apart

MANIFEST = Path(__file__).parents[2].parent / "shared" / "spec" / "checkpoint-manifest.json.gz"

SMALL_GCD = ModelConfig(
    frames=14,
    unet=UNetConfig(
        width=32,
        multipliers=(1, 2),
        attention=(False, True),
        blocks_per_level=1,
        embedding_width=64,
        head_width=64,
        context_width=48,
        vector_width=48,
        camera_width=24,
        norm_groups=32,
    ),
    vae=VAEConfig(width=32, multipliers=(1, 2), blocks_per_level=1, norm_groups=32),
    image_encoder=ImageEncoderConfig(
        image_size=28, patch=14, width=64, layers=2, heads=16, hidden_width=96, output_width=48
    ),
)
"""Widths that the published 32 groups can work with."""

HEADS = {"head_width": 64, "image_heads": 16}
"""What published layouts do not tell of it, but for diffusers' config.json."""
load = partial(load_weights, **HEADS)
inspect = partial(inspect_weights, **HEADS)
convert = partial(convert_weights, **HEADS)


def fixed_view(config: ModelConfig) -> ModelConfig:
    """The config without camera control."""
    return msgspec.structs.replace(config, camera="none", unet=msgspec.structs.replace(config.unet, camera_width=0))


def shared_vae(config: ModelConfig) -> ModelConfig:
    """The config as a diffusers folder has it: no camera control, one encoder for all frames."""
    return fixed_view(msgspec.structs.replace(config, vae=msgspec.structs.replace(config.vae, shared=True)))


@lru_cache
def filled(config: ModelConfig = SMALL_GCD, seed: int = 0) -> Networks:
    """Networks whose every parameter is random. They are shared: copy them before changing them."""
    networks = Networks(config)
    randomise(networks, seed)
    return networks


def published_state(networks: Networks, naming: Naming) -> dict[str, Tensor]:
    """All weights by published name."""
    state = _renamed(networks.state_dict(), naming, Levels.of(networks.config))
    return {name: tensor.clone(memory_format=torch.contiguous_format) for name, tensor in state.items()}


def _renamed(weights: Mapping[str, Tensor], naming: Naming, levels: Levels) -> dict[str, Tensor]:
    parts = (taken_apart(published_names(name, naming, levels), value.detach()) for name, value in weights.items())
    return {name: tensor for part in parts for name, tensor in part.items()}


def released_unet(unet: VideoUNet, *, gradients: bool = False) -> dict[str, Tensor]:
    """Weights (or gradients, where there is one) as the released code calls them: `input_blocks.0.0.weight`."""
    levels = Levels(attention=unet.config.attention, unet_blocks=unet.config.blocks_per_level)
    values = {f"unet.{name}": each.grad if gradients else each for name, each in unet.named_parameters()}
    renamed = _renamed({name: each for name, each in values.items() if each is not None}, "gcd", levels)
    return {name.removeprefix(f"{GCD_UNET}."): value for name, value in renamed.items()}


def diffusers_state(module: nn.Module, own: str, folder: str) -> dict[str, Tensor]:
    """State of the diffusers (or transformers) module that corresponds to ours.

    own: what `Networks` calls our module. folder: what precedes the names of theirs, "unet/".
    """
    weights = {f"{own}.{name}": value for name, value in module.state_dict().items()}
    return {name.removeprefix(folder): each for name, each in _renamed(weights, "diffusers", Levels()).items()}


def gcd_state(networks: Networks) -> dict[str, Tensor]:
    """Weights by Stability's names, with the leftovers published files have."""
    clip, vae = "conditioner.embedders.0.open_clip.model", "conditioner.embedders.3.encoder"
    return published_state(networks, "gcd") | {
        f"{clip}.token_embedding.weight": torch.ones(7, 4),
        f"{clip}.logit_scale": torch.tensor(1.0),
        f"{clip}.transformer.resblocks.0.ln_1.weight": torch.ones(4),
        f"{vae}.decoder.conv_in.weight": torch.ones(4, 4, 3, 3),
        f"{vae}.post_quant_conv.bias": torch.ones(4),
    }


def write_lightning(path: Path, state: Mapping[str, Any], **entries: Any) -> Path:
    """A `.ckpt` with optimizer state, as the trainer writes it."""
    moments = {0: {"step": torch.tensor(3.0), "exp_avg": torch.zeros(50), "exp_avg_sq": torch.zeros(50)}}
    root = {
        "epoch": 1,
        "global_step": 1250,
        "state_dict": dict(state),
        "optimizer_states": [{"state": moments, "param_groups": [{"lr": 2e-5}]}],
    }
    torch.save(root | entries, path)
    return path


def write_gcd(folder: Path, name: str = "kubric_gradual_max90.ckpt", config: ModelConfig = SMALL_GCD) -> Path:
    """A Lightning checkpoint of GCD with LPIPS and EMA leftovers."""
    extra = {"lpips.lin0.model.1.weight": torch.ones(1, 4, 1, 1), "model_ema.decay": torch.tensor(0.999)}
    return write_lightning(folder / name, gcd_state(filled(config)) | extra)


def write_svd(folder: Path, name: str = "svd.safetensors") -> Path:
    """The base model's single file."""
    save_file(gcd_state(filled(fixed_view(SMALL_GCD))), folder / name)
    return folder / name


def diffusers_parts(config: ModelConfig | None = None) -> dict[str, dict[str, Tensor]]:
    """Weights of the three folders, by name within each."""
    state = published_state(filled(shared_vae(SMALL_GCD) if config is None else config), "diffusers")
    parts: dict[str, dict[str, Tensor]] = {}
    for name, tensor in state.items():
        part, _, inner = name.partition("/")
        parts.setdefault(part, {})[inner] = tensor
    return parts


def stem_of(part: str) -> str:
    """What the libraries call the weights of a part."""
    return "model" if part == "image_encoder" else "diffusion_pytorch_model"


def write_diffusers(folder: Path, *, half: bool = False, configs: bool = True) -> Path:
    """A diffusers folder, in float16 under the variant's names with `half`."""
    facts: dict[str, dict[str, object]] = {
        "unet": {"num_attention_heads": [1, 1], "num_frames": 14, "sample_size": 96},
        "vae": {"scaling_factor": 0.18215, "force_upcast": True},
        "image_encoder": {"num_attention_heads": 16, "hidden_act": "gelu"},
    }
    for part, state in diffusers_parts().items():
        (folder / part).mkdir(parents=True)
        name = f"{stem_of(part)}{'.fp16' if half else ''}.safetensors"
        save_file({k: v.half() if half else v for k, v in state.items()}, folder / part / name)
        if configs:
            (folder / part / "config.json").write_text(json.dumps(facts[part]))
    return folder


def manifest(layout: str) -> dict[str, tuple[int, ...]]:
    """Names and shapes of a published file, or of the folder "diffusers", at full size; skips the test without them."""
    if not MANIFEST.is_file():
        pytest.skip(f"needs {MANIFEST}")
    with gzip.open(MANIFEST) as file:
        lists = json.load(file)
    parts = {f"{part}/": lists[f"diffusers_{part}"] for part in ("unet", "vae", "image_encoder")}
    whole = parts if layout == "diffusers" else {"": lists[layout]}
    return {f"{part}{name}": tuple(e["shape"]) for part, entries in whole.items() for name, e in entries.items()}


def assert_same_weights(ours: Networks, theirs: Networks) -> None:
    state, wanted = ours.state_dict(), theirs.state_dict()
    assert list(state) == list(wanted)
    for name, tensor in wanted.items():
        torch.testing.assert_close(state[name], tensor, rtol=0, atol=0, msg=name)


def refused(path: Path) -> str:
    """The one line a file is refused with; it begins with the file's name."""
    with pytest.raises(CheckpointError) as caught:
        load(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message.removeprefix(f"{path}: ")
