"""The network as the sampler calls it: preconditioned, guided, with the class logits of the last step."""

import torch
from torch import Tensor

from gcd_model.class_head import ClassHead
from gcd_model.conditioning import Conditioning
from gcd_model.config import Prediction
from gcd_model.noise import preconditioning
from gcd_model.sampler import guided
from gcd_model.unet import VideoUNet


class Denoiser:
    """D(x, sigma_i) with guidance, for one batch of views.

    class_logits: [K*T, classes, h', w'], float32, of the conditional branch, once the last step is done; None
        before that and without class head.
    """

    def __init__(
        self,
        unet: VideoUNet,
        head: ClassHead | None,
        given: Conditioning,
        sigmas: Tensor,
        guidance: Tensor,
        prediction: Prediction,
    ) -> None:
        """sigmas: [S + 1], the sampler's. guidance: [T], scale per frame."""
        self._unet, self._head, self._given, self._guidance = unet, head, given, guidance
        levels = preconditioning(sigmas[:-1], prediction)
        self._c_in, self._c_out, self._c_skip = (c.tolist() for c in (levels.c_in, levels.c_out, levels.c_skip))
        labels = levels.c_noise.float().to(unet.stem.weight.device)
        self._plan = unet.plan(labels, given.vector, given.camera, given.tokens, repeats=given.branches)
        self.class_logits: Tensor | None = None

    def __call__(self, x: Tensor, step: int) -> Tensor:
        """x: [K, T, C, h, w] float32 -> the same shape."""
        branches = self._given.branches
        rows = (x * self._c_in[step]).flatten(0, 1).to(self._unet.stem.weight).repeat(branches, 1, 1, 1)
        raw = self._network(rows, step).float().unflatten(0, (-1, *x.shape[:2]))
        denoised = self._c_skip[step] * x + self._c_out[step] * raw  # [R, K, T, C, h, w]
        return guided(denoised[0], denoised[1], self._guidance) if branches == 2 else denoised[0]

    def _network(self, rows: Tensor, step: int) -> Tensor:
        inputs = self._plan.step(step)
        if self._head is None or step + 1 < len(self._c_in):
            return self._unet(rows, self._given.latents, inputs)
        features = self._unet.features(rows, self._given.latents, inputs)
        conditional = features.chunk(self._given.branches)[-1]
        self.class_logits = self._head(conditional).float()
        return self._unet.project(features)


def start_noise(noise: Tensor, sigmas: Tensor, views: int) -> Tensor:
    """Where sampling starts: unit noise [S, T, C, h, w] -> [views * S, T, C, h, w], as strong as the first level."""
    return noise.repeat(views, 1, 1, 1, 1) * torch.sqrt(sigmas[0] ** 2 + 1).item()
