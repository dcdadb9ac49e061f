"""The network as the sampler calls it: preconditioned and guided."""

from typing import Protocol

from torch import Tensor

from gcd_model.conditioning import Conditioning
from gcd_model.noise import preconditioning
from gcd_model.sampler import guided
from gcd_model.schedule import Schedule
from gcd_model.unet import StageInputs, UNetPlan, VideoUNet


class Backbone(Protocol):
    """Whatever evaluates the network F."""

    def plan(self, labels: Tensor, given: Conditioning) -> UNetPlan:
        """All that does not depend on the pixels. labels: float32 [S], c_noise of every step, anywhere."""
        ...

    def predict(self, rows: Tensor, condition: Tensor, inputs: tuple[StageInputs, ...]) -> Tensor:
        """One evaluation, see `VideoUNet.forward`. rows: float32 [N, C, h, w] -> float32, the same shape."""
        ...


class TorchBackbone:
    """The U-Net as it is, in its own precision. Source: `Backbone`."""

    def __init__(self, unet: VideoUNet) -> None:
        self._unet = unet

    def plan(self, labels: Tensor, given: Conditioning) -> UNetPlan:
        """See Backbone."""
        on_device = labels.to(self._unet.stem.weight.device)
        return self._unet.plan(on_device, given.vector, given.camera, given.tokens, repeats=given.branches)

    def predict(self, rows: Tensor, condition: Tensor, inputs: tuple[StageInputs, ...]) -> Tensor:
        """See Backbone."""
        return self._unet(rows.to(self._unet.stem.weight), condition, inputs).float()


class Denoiser:
    """D(x, sigma_i) with guidance, for one batch of views."""

    def __init__(self, backbone: Backbone, given: Conditioning, schedule: Schedule) -> None:
        self._backbone, self._given, self._schedule = backbone, given, schedule
        levels = preconditioning(schedule.sigmas[:-1], schedule.prediction)
        self._c_in, self._c_out, self._c_skip = (c.tolist() for c in (levels.c_in, levels.c_out, levels.c_skip))
        self._plan = backbone.plan(levels.c_noise.float(), given)
        self._guidance = schedule.guidance.to(given.latents.device)

    def __call__(self, x: Tensor, step: int) -> Tensor:
        """x: [K, T, C, h, w] float32 -> the same shape."""
        branches = 2 if self._schedule.guided[step] else 1
        rows = (x * self._c_in[step]).flatten(0, 1).repeat(branches, 1, 1, 1)
        raw = self._network(rows, step, branches).unflatten(0, (-1, *x.shape[:2]))
        denoised = self._c_skip[step] * x + self._c_out[step] * raw  # [R, K, T, C, h, w]
        return guided(denoised[0], denoised[1], self._guidance) if branches == 2 else denoised[0]

    def _network(self, rows: Tensor, step: int, branches: int) -> Tensor:
        condition, inputs = self._given.latents, self._plan.step(step)
        if branches < self._given.branches:
            condition = condition.chunk(self._given.branches)[-1]
            inputs = tuple(_conditional(each, self._given.branches) for each in inputs)
        return self._backbone.predict(rows, condition, inputs)


def _conditional(inputs: StageInputs, branches: int) -> StageInputs:
    """What the conditional rows alone are given; they come last."""
    spatial, temporal = inputs.spatial_cross, inputs.temporal_cross
    return StageInputs(
        inputs.spatial_embedding.chunk(branches)[-1],
        inputs.temporal_embedding.chunk(branches)[-1],
        None if spatial is None else spatial.chunk(branches)[-1],
        None if temporal is None else temporal.chunk(branches)[-1],
    )
