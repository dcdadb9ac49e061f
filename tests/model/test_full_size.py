"""One guided full-size step, ours against diffusers: the same numbers in less memory; both times are printed.

    python test_full_size.py write|ours|diffusers|export FOLDER

Each side works in a process of its own, so that its time and its peak memory are its own. `write` puts random weights
under diffusers' names into FOLDER/unet.safetensors; `ours` and `diffusers` map them into memory, run both branches of
14 frames at 32x48 latents in one batch, float32, store the result, and print a line of JSON: seconds of the step, CPU
seconds of the step and of building, peak resident memory in GB, mapped pages included: whoever copies the 6 GB of
weights has them twice. `export` exports the step with weights that take no memory, and prints what came out.
"""

import json
import math
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
import torch
from safetensors.torch import load_file, save_file
from small_models import draw, give_published_epsilon, randomise, relative_error
from torch import Tensor, nn

from gcd_model.conditioning import micro_conditioning
from gcd_model.config import SVD_14
from gcd_model.engines.torch import arrange
from gcd_model.layers import prepare
from gcd_model.networks import empty_networks
from gcd_model.unet import VideoUNet
from gcd_model.weights.names import Levels, published_names

FRAMES, HEIGHT, WIDTH, BRANCHES = 14, 32, 48, 2
MICRO = (12.0, 127.0, 0.02)
NOISE_LABEL = 0.3

Step = Callable[[Tensor, Tensor], Tensor]
"""Latents [2*T, 8, h, w] and tokens [2, 1024] -> [2*T, 4, h, w]."""


def _diffusers_unet() -> nn.Module:
    """On the meta device, with the published epsilon in the blocks where diffusers has another.

    Imported here, so that our own process does not hold diffusers in memory.
    """
    from diffusers.models.unets.unet_spatio_temporal_condition import UNetSpatioTemporalConditionModel

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


def _ours(weights: dict[str, Tensor]) -> Step:
    config = msgspec.structs.replace(SVD_14.unet, camera_width=0)
    with torch.device("meta"):
        unet = VideoUNet(config, FRAMES)
    theirs = {name: published_names(f"unet.{name}", "diffusers", Levels())[0] for name in unet.state_dict()}
    ours = {name: weights[published.removeprefix("unet/")] for name, published in theirs.items()}
    unet.load_state_dict(ours, assign=True)
    prepare(unet)
    arrange(unet)

    def step(latents: Tensor, tokens: Tensor) -> Tensor:
        vector = micro_conditioning(*MICRO, config.vector_width).expand(FRAMES, -1)
        per_frame = tokens.repeat_interleave(FRAMES, dim=0)
        plan = unet.plan(torch.tensor([NOISE_LABEL]), vector, None, per_frame)
        return unet(latents[:, :4], latents[:, 4:], *plan.step(0, BRANCHES))

    return step


def _diffusers(weights: dict[str, Tensor]) -> Step:
    unet = _diffusers_unet()
    unet.load_state_dict(weights, assign=True)

    def step(latents: Tensor, tokens: Tensor) -> Tensor:
        clips, label = latents.unflatten(0, (BRANCHES, FRAMES)), torch.tensor(NOISE_LABEL)
        return unet(clips, label, tokens[:, None], torch.tensor([MICRO] * BRANCHES)).sample.flatten(0, 1)

    return step


def _measure(folder: Path, build: Callable[[dict[str, Tensor]], Step], name: str) -> None:
    started = time.process_time()
    with torch.inference_mode():
        step = build(load_file(folder / "unet.safetensors"))
        prepared, wall = time.process_time(), time.perf_counter()
        # the unconditional branch gets a token of zeros
        tokens = torch.cat([torch.zeros(1, 1024), draw(1, 1024, seed=2)])
        result = step(draw(BRANCHES * FRAMES, 8, HEIGHT, WIDTH, seed=1), tokens)
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


_SMALL = 64
"""Numbers that make a tensor worth a place beside the graph: 256 bytes. Below are constants of shapes and shares."""


def _fill(module: nn.Module) -> None:
    """One zero, seen from everywhere: weights of the right shapes without memory."""
    for name, parameter in list(module.named_parameters(recurse=False)):
        zeros = torch.zeros(1).expand(parameter.shape) if parameter.ndim else torch.zeros(())
        setattr(module, name, nn.Parameter(zeros, requires_grad=False))
    for child in module.children():
        _fill(child)


def _export(folder: Path) -> None:
    import onnx

    from gcd_model.engines.onnx_export import graphs, write_graph

    networks = empty_networks(SVD_14)
    _fill(networks)
    graph = next(each for each in graphs(networks) if each.name == "step")
    files = write_graph(graph, folder)
    model = onnx.load(folder / "step.onnx", load_external_data=False)
    large = [each for each in model.graph.initializer if math.prod(each.dims) > _SMALL]
    apart = [each for each in model.graph.initializer if each.data_location == onnx.TensorProto.EXTERNAL]
    found = {
        "inputs": {name: each.shape for name, each in graph.inputs.items()},
        "files": list(files),
        "graph_mb": (folder / "step.onnx").stat().st_size / 1e6,
        "data_gb": (folder / "step.onnx.data").stat().st_size / 1e9,
        "weights": len(large),
        "apart": len(apart),
        "nodes": len(model.graph.node),
        "peak_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
        "cpu_s": sum(resource.getrusage(resource.RUSAGE_SELF)[:2]),
    }
    sys.stdout.write(json.dumps(found) + "\n")


def _warmed(folder: Path) -> Path:
    """Read the weights once, so that neither side waits for the disk."""
    with (folder / "unet.safetensors").open("rb") as file:
        while file.read(2**26):
            pass
    return folder


def _run(task: str, folder: Path) -> str:
    path = os.pathsep.join(entry for entry in sys.path if entry)
    done = subprocess.run(
        [sys.executable, __file__, task, str(folder)],
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=5400,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@pytest.mark.slow
@pytest.mark.timeout(10800)
def test_a_guided_full_size_step_equals_diffusers_in_less_memory_and_both_costs_are_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two branches of 14 frames of 32x48 latents, float32, random weights; each side in a process of its own."""
    try:
        _run("write", tmp_path)
        costs = {side: json.loads(_run(side, _warmed(tmp_path)).splitlines()[-1]) for side in ("ours", "diffusers")}
        results = {side: load_file(tmp_path / f"{side}.safetensors")["result"] for side in costs}
    finally:
        (tmp_path / "unet.safetensors").unlink(missing_ok=True)  # 6 GB
    error = relative_error(results["ours"], results["diffusers"])
    with capsys.disabled():
        for side, cost in costs.items():
            figures = ", ".join(f"{name} {value:.4g}" for name, value in cost.items())
            sys.stdout.write(f"\n{side}: {figures}")
        sys.stdout.write(f"\nrelative difference of the results: {error:.2e}\n")
    assert results["ours"].abs().max() > 0.1
    assert error < 1e-4
    assert costs["ours"]["cpu_s"] > 0
    assert costs["ours"]["peak_gb"] <= costs["diffusers"]["peak_gb"]


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_the_full_size_step_is_exported_within_twelve_gigabytes(tmp_path: Path) -> None:
    """Structure and memory alone: nothing is run."""
    pytest.importorskip("onnxscript", reason="needs the extra `onnx`")
    found = json.loads(_run("export", tmp_path).splitlines()[-1])
    assert found["peak_gb"] <= 12.0
    assert found["inputs"]["latents"] == [14, 4, 32, 48]
    assert found["inputs"]["crosses"][0] == 14
    assert found["files"] == ["step.onnx", "step.onnx.data"]
    assert found["graph_mb"] < 50, "weights stand in the graph"
    assert 4.5 < found["data_gb"] < 6.2, "cross-attention, position and embedding weights are no part of a step"
    assert found["apart"] == found["weights"] > 500


if __name__ == "__main__":
    task, target = sys.argv[1], Path(sys.argv[2])
    if task in ("write", "export"):
        (_write if task == "write" else _export)(target)
    else:
        _measure(target, _ours if task == "ours" else _diffusers, task)
