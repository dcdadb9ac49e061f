"""One full-size U-Net forward in a process of its own, so that its time and its peak memory are its own.

    python full_size_worker.py write|ours|diffusers FOLDER

`write` puts random weights under diffusers' names into FOLDER/unet.safetensors; the other two map them into memory,
run one branch of 14 frames at 32x48 latents in float32, store the result, and print a line of JSON.
"""

import json
import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path

import msgspec
import torch
from diffusers.models.unets.unet_spatio_temporal_condition import UNetSpatioTemporalConditionModel
from naming import from_diffusers_unet
from safetensors.torch import load_file, save_file
from small_models import draw, give_published_epsilon, randomise
from torch import Tensor

from gcd_model.conditioning import micro_conditioning
from gcd_model.config import SVD_14
from gcd_model.layers import prepare
from gcd_model.unet import VideoUNet

FRAMES, HEIGHT, WIDTH = 14, 32, 48
MICRO = (12.0, 127.0, 0.02)
NOISE_LABEL = 0.3


def _diffusers_unet() -> UNetSpatioTemporalConditionModel:
    """On the meta device, with the published epsilon in the blocks where diffusers has another."""
    with torch.device("meta"):
        unet = UNetSpatioTemporalConditionModel(num_frames=FRAMES)
    give_published_epsilon(unet)
    return unet.eval()


def _write(folder: Path) -> None:
    unet = _diffusers_unet().to_empty(device="cpu")
    with torch.no_grad():
        for name, parameter in unet.named_parameters():
            parameter.fill_(1.0 if "norm" in name and name.endswith(".weight") else 0.0)
    randomise(unet)
    save_file(unet.state_dict(), folder / "unet.safetensors")


def _ours(weights: dict[str, Tensor]) -> Callable[[Tensor, Tensor], Tensor]:
    config = msgspec.structs.replace(SVD_14.unet, camera_width=0)
    with torch.device("meta"):
        unet = VideoUNet(config, FRAMES)
    unet.load_state_dict(from_diffusers_unet(weights, unet), assign=True)
    prepare(unet)

    def forward(latents: Tensor, token: Tensor) -> Tensor:
        vector = micro_conditioning(*MICRO, config.vector_width).expand(FRAMES, -1)
        plan = unet.plan(torch.tensor([NOISE_LABEL]), vector, None, token.expand(FRAMES, -1))
        return unet(latents[:, :4], latents[:, 4:], plan.step(0))

    return forward


def _diffusers(weights: dict[str, Tensor]) -> Callable[[Tensor, Tensor], Tensor]:
    unet = _diffusers_unet()
    unet.load_state_dict(weights, assign=True)

    def forward(latents: Tensor, token: Tensor) -> Tensor:
        return unet(latents[None], torch.tensor(NOISE_LABEL), token[None], torch.tensor([MICRO])).sample[0]

    return forward


def _measure(folder: Path, build: Callable[[dict[str, Tensor]], Callable[[Tensor, Tensor], Tensor]], name: str) -> None:
    started = time.process_time()
    with torch.inference_mode():
        forward = build(load_file(folder / "unet.safetensors"))
        prepared = time.process_time()
        wall = time.perf_counter()
        result = forward(draw(FRAMES, 8, HEIGHT, WIDTH, seed=1), draw(1, 1024, seed=2))
        wall = time.perf_counter() - wall
    save_file({"result": result.contiguous()}, folder / f"{name}.safetensors")
    line = {
        "wall_s": wall,
        "cpu_s": time.process_time() - prepared,
        "build_cpu_s": prepared - started,
        "peak_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9,
        "threads": torch.get_num_threads(),
    }
    sys.stdout.write(json.dumps(line) + "\n")


if __name__ == "__main__":
    task, target = sys.argv[1], Path(sys.argv[2])
    if task == "write":
        _write(target)
    else:
        _measure(target, _ours if task == "ours" else _diffusers, task)
