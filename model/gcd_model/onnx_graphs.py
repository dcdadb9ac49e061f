"""The networks of one checkpoint as separate graphs, each of fixed size: what an exporter turns into files.

Every graph takes one clip or one frame, so that nothing in it has to be worked out at run time: guidance branches,
views and samples are further runs of the same graph. What does not depend on the pixels is not part of a step: it comes
from graphs of its own, all stages side by side in one tensor.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from gcd_model.config import CAMERA_FEATURES, ModelConfig
from gcd_model.layers import Layers, TokenAttention, prepare
from gcd_model.networks import Networks
from gcd_model.onnx_manifest import GraphName
from gcd_model.temporal import SpatialBlock, TemporalBlock
from gcd_model.unet import Stage, StageInputs, VideoUNet
from gcd_model.vae import Encoder, TemporalDecoder


@dataclass(frozen=True, kw_only=True, slots=True)
class Graph:
    """One graph to export. inputs: by name, of the sizes it will always have; their values do not matter."""

    name: GraphName
    module: nn.Module
    inputs: dict[str, Tensor]
    outputs: tuple[str, ...]

    @property
    def weight_bytes(self) -> int:
        """Of its parameters, whether or not the graph uses them all."""
        return sum(tensor.nbytes for tensor in self.module.state_dict().values())


class ConditionEncoder(nn.Module):
    """A frame to the mean of its latents."""

    def __init__(self, encoder: Encoder) -> None:
        super().__init__()
        self.encoder = encoder

    def forward(self, frames: Tensor) -> Tensor:
        """[1, 3, H, W] in [-1, 1] -> [1, C, h, w], unscaled."""
        return self.encoder(frames).mean


class Embeddings(nn.Module):
    """Noise level, micro-conditioning and camera, projected for every stage of the U-Net."""

    def __init__(self, unet: VideoUNet, camera: nn.Linear | None) -> None:
        super().__init__()
        self.unet, self.camera = unet, camera

    def forward(self, label: Tensor, vector: Tensor, camera: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """label: [1], c_noise. vector: [T, V]. camera: [T, F], features -> spatial and temporal, [T, sum of C] each."""
        told = None if self.camera is None or camera is None else self.camera(camera)
        stages = self.unet.plan(label, vector, told, None).stages
        spatial = torch.cat([stage.spatial_embedding[0] for stage in stages], dim=1)
        return spatial, torch.cat([stage.temporal_embedding[0] for stage in stages], dim=1)


class Crosses(nn.Module):
    """What the image tokens add in every transformer of the U-Net."""

    def __init__(self, unet: VideoUNet) -> None:
        super().__init__()
        attending = [stage.attention for stage in unet.all_stages() if stage.attention is not None]
        self.spatial = _tokens(attention.spatial for attention in attending)
        self.temporal = _tokens(attention.temporal for attention in attending)

    def forward(self, tokens: Tensor) -> tuple[Tensor, Tensor]:
        """[T, D] -> [T, sum of C] and, of the first frame alone, [1, sum of C]."""
        spatial = torch.cat([token(tokens) for token in self.spatial], dim=1)
        return spatial, torch.cat([token(tokens[:1]) for token in self.temporal], dim=1)


def _tokens(blocks: Iterable[SpatialBlock | TemporalBlock]) -> Layers[TokenAttention]:
    return Layers[TokenAttention](block.token for block in blocks if block.token is not None)


class Step(nn.Module):
    """One evaluation of the U-Net over one clip."""

    def __init__(self, unet: VideoUNet) -> None:
        super().__init__()
        self.unet = unet
        self.widths = [stage.res.spatial.norm2.num_channels for stage in unet.all_stages()]
        self.attends = [_sees_tokens(stage) for stage in unet.all_stages()]

    def forward(
        self,
        latents: Tensor,
        condition: Tensor,
        spatial_embedding: Tensor,
        temporal_embedding: Tensor,
        spatial_cross: Tensor | None = None,
        temporal_cross: Tensor | None = None,
    ) -> Tensor:
        """latents: [T, C, h, w], condition: [T, C', h, w], see `VideoUNet`; the rest from `Embeddings`, `Crosses`.

        Returns the prediction [T, C, h, w].
        """
        inputs = [
            StageInputs(*each)
            for each in zip(
                spatial_embedding.split(self.widths, dim=1),
                temporal_embedding.split(self.widths, dim=1),
                self._crosses(spatial_cross),
                self._crosses(temporal_cross),
                strict=True,
            )
        ]
        return self.unet(latents, condition, inputs)

    def _crosses(self, packed: Tensor | None) -> Sequence[Tensor | None]:
        if packed is None:
            return [None] * len(self.widths)
        widths = [width for width, attends in zip(self.widths, self.attends, strict=True) if attends]
        parts = iter(packed.split(widths, dim=1))
        return [next(parts) if attends else None for attends in self.attends]


def _sees_tokens(stage: Stage) -> bool:
    return stage.attention is not None and stage.attention.spatial.token is not None


class Decoder(nn.Module):
    """The latents of one clip to pictures."""

    def __init__(self, decoder: TemporalDecoder, frames: int) -> None:
        super().__init__()
        self.decoder, self.frames = decoder, frames

    def forward(self, latents: Tensor) -> Tensor:
        """[T, C, h, w], unscaled -> [T, 3, H, W], about [-1, 1]."""
        return self.decoder(latents, self.frames)


def graphs(networks: Networks) -> tuple[Graph, ...]:
    """Every graph of a checkpoint, at the size its config states."""
    sizes = _Sizes.of(networks.config)
    made = (*_conditioning_graphs(networks, sizes), _step_graph(networks, sizes), _decoder_graph(networks, sizes))
    for graph in made:
        prepare(graph.module)
    return made


@dataclass(frozen=True, slots=True)
class _Sizes:
    """Lengths of the axes. frames: T. height, width: pixels; rows, columns: latents."""

    config: ModelConfig
    frames: int
    height: int
    width: int
    rows: int
    columns: int

    @classmethod
    def of(cls, config: ModelConfig) -> "_Sizes":
        factor = config.vae.down_factor
        height, width = config.height, config.width
        return cls(config, config.frames, height, width, height // factor, width // factor)

    def latents(self, channels: int) -> Tensor:
        """[T, channels, h, w]."""
        return torch.zeros(self.frames, channels, self.rows, self.columns)

    def pictures(self, *before: int) -> Tensor:
        """[..., 3, H, W]."""
        return torch.zeros(*before, 3, self.height, self.width)


def _conditioning_graphs(networks: Networks, sizes: _Sizes) -> Iterator[Graph]:
    """What is computed once a window."""
    unet, tower, config = networks.unet, networks.image_encoder, networks.config
    if tower is not None:
        side = tower.config.image_size
        yield Graph(
            name="image_encoder", module=tower, inputs={"pixels": torch.zeros(1, 3, side, side)}, outputs=("token",)
        )
        tokens = torch.zeros(sizes.frames, tower.config.output_width)
        crosses = ("spatial_cross", "temporal_cross")
        yield Graph(name="crosses", module=Crosses(unet), inputs={"tokens": tokens}, outputs=crosses)
    encoder = ConditionEncoder(networks.condition_encoder)
    yield Graph(name="condition_encoder", module=encoder, inputs={"frames": sizes.pictures(1)}, outputs=("latents",))
    told = {"label": torch.zeros(1), "vector": torch.zeros(sizes.frames, config.unet.vector_width)}
    if networks.camera is not None:
        told["camera"] = torch.zeros(sizes.frames, CAMERA_FEATURES[config.camera])
    camera = None if networks.camera is None else networks.camera.proj
    embeddings = ("spatial_embedding", "temporal_embedding")
    yield Graph(name="embeddings", module=Embeddings(unet, camera), inputs=told, outputs=embeddings)


def step_graph(networks: Networks) -> Graph:
    """The U-Net alone, which is most of what there is to export."""
    step = _step_graph(networks, _Sizes.of(networks.config))
    prepare(step.module)
    return step


def _step_graph(networks: Networks, sizes: _Sizes) -> Graph:
    """What is computed once a step."""
    config, step = networks.config.unet, Step(networks.unet)
    embedding = torch.zeros(sizes.frames, sum(step.widths))
    inputs = {
        "latents": sizes.latents(config.latent_channels),
        "condition": sizes.latents(config.condition_channels),
        "spatial_embedding": embedding,
        "temporal_embedding": embedding.clone(),
    }
    if networks.image_encoder is not None:
        crossed = sum(width for width, attends in zip(step.widths, step.attends, strict=True) if attends)
        inputs["spatial_cross"] = torch.zeros(sizes.frames, crossed)
        inputs["temporal_cross"] = torch.zeros(1, crossed)
    return Graph(name="step", module=step, inputs=inputs, outputs=("prediction",))


def _decoder_graph(networks: Networks, sizes: _Sizes) -> Graph:
    """What is computed once a view."""
    latents = sizes.latents(networks.config.vae.latent_channels)
    decoder = Decoder(networks.decoder, sizes.frames)
    return Graph(name="decoder", module=decoder, inputs={"latents": latents}, outputs=("pictures",))
