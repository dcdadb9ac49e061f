"""The video U-Net of Stable Video Diffusion.

Nothing that is constant over a window or a schedule is computed in `forward`: `plan` does that once.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gcd_model.config import UNetConfig
from gcd_model.layers import Downsample, Layers, TokenAttention, Upsample, embedding_mlp, sinusoid, zeroed
from gcd_model.temporal import TemporalShare, VideoResBlock, VideoTransformer


@dataclass(frozen=True, slots=True)
class StageInputs:
    """What a stage needs besides the pixels, for one denoising step; of a U-Net that of all stages, side by side.

    embeddings: [N, C], noise level, micro-conditioning and camera, projected for the stage.
    crosses: what the image token adds; spatial [N, C], temporal [B, C]; None without attention or image tower.
    """

    spatial_embedding: Tensor
    temporal_embedding: Tensor
    spatial_cross: Tensor | None
    temporal_cross: Tensor | None

    def chunk(self, parts: int) -> tuple["StageInputs", ...]:
        """Of each clip, or of each guidance branch, in order."""
        every = (self.spatial_embedding, self.temporal_embedding, self.spatial_cross, self.temporal_cross)
        chunks = [[None] * parts if each is None else each.chunk(parts) for each in every]
        return tuple(StageInputs(*part) for part in zip(*chunks, strict=True))


@dataclass(frozen=True, slots=True)
class UNetPlan:
    """All that the U-Net takes besides pixels, for every step of a schedule: all stages side by side.

    embeddings: [S, N, sum of C]. crosses: of all attending stages, as in StageInputs; they do not depend on the step.
    repeats: how often the rows of the embeddings repeat in the batch (2 when an unconditional branch rides along).
    """

    spatial_embedding: Tensor
    temporal_embedding: Tensor
    spatial_cross: Tensor | None
    temporal_cross: Tensor | None
    repeats: int = 1

    def step(self, index: int) -> StageInputs:
        """What `VideoUNet.forward` takes at one step."""
        spatial, temporal = (
            each[index].repeat(self.repeats, 1) for each in (self.spatial_embedding, self.temporal_embedding)
        )
        return StageInputs(spatial, temporal, self.spatial_cross, self.temporal_cross)


class Stage(nn.Module):
    """A residual block and, where the level attends, a transformer."""

    def __init__(self, in_channels: int, out_channels: int, config: UNetConfig, *, attends: bool, frames: int) -> None:
        super().__init__()
        self.res = VideoResBlock(
            in_channels,
            out_channels,
            groups=config.norm_groups,
            embedding_width=config.embedding_width,
            eps=1e-5,
            share=TemporalShare(of_sigmoid="space", initial=0.5),
        )
        self.attention = (
            VideoTransformer(
                out_channels,
                head_width=config.head_width,
                context_width=config.context_width,
                groups=config.norm_groups,
                frames=frames,
            )
            if attends
            else None
        )

    def forward(self, x: Tensor, inputs: StageInputs, frames: int | None) -> Tensor:
        """x: [N, C, h, w] -> [N, C', h, w]. frames: None for unrelated frames."""
        x = self.res(x, frames, inputs.spatial_embedding, inputs.temporal_embedding)
        if self.attention is None:
            return x
        return self.attention(x, frames, inputs.spatial_cross, inputs.temporal_cross)


class DownLevel(nn.Module):
    """Stages at one resolution, then half of it."""

    def __init__(self, in_channels: int, level: int, config: UNetConfig, frames: int) -> None:
        super().__init__()
        width, attends = config.widths[level], config.attention[level]
        self.stages = Layers[Stage](
            Stage(in_channels if i == 0 else width, width, config, attends=attends, frames=frames)
            for i in range(config.blocks_per_level)
        )
        self.down = Downsample(width, pad="both") if level + 1 < len(config.widths) else None


class UpLevel(nn.Module):
    """Stages at one resolution, each taking one skip connection, then twice that resolution."""

    def __init__(self, in_channels: int, skips: list[int], level: int, config: UNetConfig, frames: int) -> None:
        super().__init__()
        width, attends = config.widths[level], config.attention[level]
        self.stages = Layers[Stage](
            Stage((in_channels if i == 0 else width) + skips.pop(), width, config, attends=attends, frames=frames)
            for i in range(config.blocks_per_level + 1)
        )
        self.up = Upsample(width) if level > 0 else None


class VideoUNet(nn.Module):
    """Noisy latents and source latents in, prediction out.

    Source: Blattmann et al. 2023 (SVD); the camera vector as in Van Hoorick et al. 2024 (GCD), section 3.2.
    """

    def __init__(self, config: UNetConfig, frames: int) -> None:
        super().__init__()
        self.config, self.frames = config, frames
        width, embedding = config.width, config.embedding_width
        self.embed_noise = embedding_mlp(width, embedding, embedding)
        self.embed_vector = embedding_mlp(config.vector_width, embedding, embedding)
        self.embed_camera = embedding_mlp(config.camera_width, embedding, embedding) if config.camera_width else None
        self.stem = nn.Conv2d(config.latent_channels + config.condition_channels, width, 3, padding=1)
        before = [width, *config.widths[:-1]]
        self.down = Layers[DownLevel](DownLevel(before[i], i, config, frames) for i in range(len(config.widths)))
        self.middle = Layers[Stage](
            Stage(config.widths[-1], config.widths[-1], config, attends=attends, frames=frames)
            for attends in (True, False)
        )
        skips, above = _skip_widths(config), [*config.widths[1:], config.widths[-1]]
        self.up = Layers[UpLevel](
            UpLevel(above[i], skips, i, config, frames) for i in reversed(range(len(config.widths)))
        )
        self.norm_out = nn.GroupNorm(config.norm_groups, width, eps=1e-5)
        self.conv_out = nn.Conv2d(width, config.latent_channels, 3, padding=1)
        self._start_as_identity()

    def plan(
        self, noise_labels: Tensor, vector: Tensor, camera: Tensor | None, tokens: Tensor | None, *, repeats: int = 1
    ) -> UNetPlan:
        """Compute all that does not depend on the pixels.

        Args:
            noise_labels: [S] one per step (or [S, N]), c_noise. vector: [N, V], micro-conditioning.
            camera: [N, camera_width] or None. tokens: [N * repeats, D] image tokens of the whole batch, or None.
            repeats: how often the N rows occur in the batch (2 with an unconditional branch).
        """
        labels = noise_labels if noise_labels.ndim == 2 else noise_labels[:, None]
        embedding = self.embed_noise(sinusoid(labels, self.config.width).to(vector.dtype)) + self.embed_vector(vector)
        if self.embed_camera is not None:
            assert camera is not None, "this U-Net wants a camera vector"
            embedding = embedding + self.embed_camera(camera)  # [S, N, E]
        stages = list(self.all_stages())
        spatial = torch.cat([stage.res.spatial.project(embedding) for stage in stages], dim=-1)
        temporal = torch.cat([stage.res.temporal.project(embedding) for stage in stages], dim=-1)
        return UNetPlan(spatial, temporal, *self._crosses(tokens), repeats)

    def _crosses(self, tokens: Tensor | None) -> tuple[Tensor | None, Tensor | None]:
        if tokens is None:
            return None, None
        spatial, temporal = self.token_layers()
        of_clips = tokens[:: self.frames]  # across frames only the first frame's token counts
        return torch.cat([layer(tokens) for layer in spatial], 1), torch.cat([layer(of_clips) for layer in temporal], 1)

    def token_layers(self) -> tuple[list[TokenAttention], list[TokenAttention]]:
        """What takes the image token: within frames, and across them."""
        attending = [stage.attention for stage in self.all_stages() if stage.attention is not None]
        blocks = [(each.spatial.token, each.temporal.token) for each in attending]
        return [each for each, _ in blocks if each is not None], [each for _, each in blocks if each is not None]

    def all_stages(self) -> Iterator[Stage]:
        """Every stage in the order of the forward pass."""
        for level in self.down:
            yield from level.stages
        yield from self.middle
        for level in self.up:
            yield from level.stages

    def forward(self, latents: Tensor, condition: Tensor, inputs: StageInputs, *, image_mode: bool = False) -> Tensor:
        """One evaluation of the network F.

        Args:
            latents: [B*T, C, h, w], scaled noisy latents. condition: [B*T, C', h, w], source latents, unscaled.
            inputs: one step of a plan made for this batch.
            image_mode: leave out every layer across frames; the rows are then unrelated frames, any number of them.
        Returns:
            [B*T, C, h, w].
        """
        frames = None if image_mode else self.frames
        inputs_left = self._by_stage(inputs)
        x = self.stem(torch.cat([latents, condition], dim=1))
        skips = [x]
        for level in self.down:
            for stage in level.stages:
                x = stage(x, next(inputs_left), frames)
                skips.append(x)
            if level.down is not None:
                x = level.down(x)
                skips.append(x)
        for stage in self.middle:
            x = stage(x, next(inputs_left), frames)
        for level in self.up:
            for stage in level.stages:
                x = stage(torch.cat([x, skips.pop()], dim=1), next(inputs_left), frames)
            if level.up is not None:
                x = level.up(x)
        return self.conv_out(F.silu(self.norm_out(x)))

    def _by_stage(self, inputs: StageInputs) -> Iterator[StageInputs]:
        """Every stage's own, in the order of the forward pass."""
        widths = [stage.res.spatial.norm2.num_channels for stage in self.all_stages()]
        attending = [stage.attention is not None for stage in self.all_stages()]
        spatial, temporal = (each.split(widths, 1) for each in (inputs.spatial_embedding, inputs.temporal_embedding))
        crossed = [width for width, attends in zip(widths, attending, strict=True) if attends]
        crosses = [
            None if x is None else iter(x.split(crossed, 1)) for x in (inputs.spatial_cross, inputs.temporal_cross)
        ]
        for own, across, attends in zip(spatial, temporal, attending, strict=True):
            yield StageInputs(own, across, *(next(each) if attends and each is not None else None for each in crosses))

    def start_apart(self) -> None:
        """Make all transformers across frames the identity too: for learning from single frames first, then clips."""
        for stage in self.all_stages():
            if stage.attention is not None:
                stage.attention.start_apart()

    def _start_as_identity(self) -> None:
        for stage in self.all_stages():
            zeroed(stage.res.spatial.conv2)
            zeroed(stage.res.temporal.conv2)
            if stage.attention is not None:
                zeroed(stage.attention.proj_out)
        zeroed(self.conv_out)


def _skip_widths(config: UNetConfig) -> list[int]:
    """Channels of the stem and of every stage and down-sampling, in forward order."""
    widths = [config.width]
    for level, width in enumerate(config.widths):
        widths += [width] * (config.blocks_per_level + (level + 1 < len(config.widths)))
    return widths
