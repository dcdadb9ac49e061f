"""The checkpoint to be measured: any that loads, and random weights at full size, made on the fly."""

from collections.abc import Collection
from pathlib import Path

from msgspec.structs import replace

from gcd_model.config import SVD_14, ModelConfig
from gcd_model.errors import OptionError
from gcd_model.families import KUBRIC90
from gcd_model.live.synthesizer import LiveSynthesizer
from gcd_model.loading import load_synthesizer, placed_synthesizer, random_weights
from gcd_model.measuring.report import STAGES, StageName
from gcd_model.networks import LoadedWeights, random_networks
from gcd_model.own_format import NO_DIFFUSION, Card, Entry
from gcd_model.synthesizer import Synthesizer
from gcd_model.weights_export import Content, write_safetensors

FULL = "random:full"
"""The published architecture with random weights: 1.5 billion numbers in the U-Net alone, 6 GB in float32."""


def load_measured(
    weights: str, *, device: str = "auto", dtype: str | None = None, stages: Collection[StageName] = STAGES
) -> Synthesizer:
    """What `load_synthesizer` loads, or FULL.

    stages: of FULL, networks of stages that are not asked for are small ones.
    Raises: CheckpointError, OptionError as `load_synthesizer`.
    """
    if weights != FULL:
        made = load_synthesizer(weights, device=device, dtype=dtype)
        if isinstance(made, LiveSynthesizer):
            raise OptionError(f"{made.traits.name} {NO_DIFFUSION}")
        return made
    return placed_synthesizer(_full_size(stages), device=device, dtype=dtype)


def save_random(weights: str, out: Path, stages: Collection[StageName] = STAGES) -> None:
    """Random weights as a file, so that processes can map it into memory. weights: random:FAMILY or FULL.

    Raises: OptionError as `load_synthesizer`; CheckpointError if it cannot be written.
    """
    loaded = _full_size(stages) if weights == FULL else random_weights(weights.removeprefix("random:"))
    tensors = loaded.networks.state_dict()
    card = Card(
        name=loaded.name,
        config=loaded.networks.config,
        family=None if loaded.family is None else loaded.family.name,
        move_time=loaded.move_time,
        trained=False,
    )
    entries = {name: Entry(tuple(tensor.shape), tensor.dtype) for name, tensor in tensors.items()}
    write_safetensors(out, Content(entries, tensors.__getitem__, card.to_metadata()), overwrite=False)


def full_size_config(stages: Collection[StageName]) -> ModelConfig:
    """SVD_14, where networks of no stage asked for are narrow; what they hand on has the same shape."""
    everything = "window" in stages
    tower, vae = SVD_14.image_encoder, SVD_14.vae
    if tower is not None and not everything and "tower" not in stages:
        tower = replace(tower, width=64, layers=1, heads=1, hidden_width=64)
    if not everything and not {"encode", "decode"} & set(stages):
        vae = replace(vae, width=32, blocks_per_level=1)
    return replace(SVD_14, image_encoder=tower, vae=vae)


def _full_size(stages: Collection[StageName]) -> LoadedWeights:
    networks = random_networks(full_size_config(stages), seed=0)
    return LoadedWeights(
        name="random-full",
        networks=networks,
        family=KUBRIC90,
        move_time=networks.config.frames - 1,
        trained=False,
        sha256_12="0" * 12,
    )
