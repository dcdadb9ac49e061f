"""The most memory one implementation of a model takes: in a process of its own, because a peak does not come down.

python -m gcd_node.load.model_memory JSON, which is a MemoryTask; prints MemoryFigures as JSON.
"""

import os
import subprocess
import sys

import msgspec
import torch

from gcd_model import ImplementationName, MemoryFigures, ModelBenchOptions, StageName, bench_model, load_measured
from gcd_node.errors import NodeError
from gcd_node.load.process_meter import PrivatePeak, memory

_GIGABYTE = 1e9


class MemoryTask(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What the process does. weights: of a file or of the package, so that they can stay there; see ModelBenchOptions
    for the rest."""

    weights: str
    implementation: ImplementationName
    stages: tuple[StageName, ...]
    device: str
    dtype: str | None
    height: int | None
    width: int | None
    steps: int | None
    guidance: tuple[float, float] | None
    threads: int | None
    without_camera: bool


def measured_memory(task: MemoryTask) -> MemoryFigures:
    """Do the task in a process of its own. Raises NodeError if it fails."""
    command = [sys.executable, "-m", "gcd_node.load.model_memory", msgspec.json.encode(task).decode()]
    done = subprocess.run(command, stdout=subprocess.PIPE, check=False)  # noqa: S603
    if done.returncode != 0:
        raise NodeError(
            f"the process that measures the memory of {task.implementation} ended with {done.returncode}; its last "
            "words are above, and -9 means that the machine ran out of memory"
        )
    return msgspec.json.decode(done.stdout.splitlines()[-1], type=MemoryFigures)


def own_memory(task: MemoryTask) -> MemoryFigures:
    """Do the task here and look at what this process held at most."""
    if task.threads is not None:
        torch.set_num_threads(task.threads)
    with PrivatePeak(os.getpid()) as private:
        synthesizer = load_measured(task.weights, device=task.device, dtype=task.dtype)
        bench_model(synthesizer, _options(task))
    on_gpu = synthesizer.traits.device.startswith("cuda")
    return MemoryFigures(
        resident_gb=memory(os.getpid()).peak_resident / _GIGABYTE,
        private_gb=private.bytes / _GIGABYTE,
        device_gb=torch.cuda.max_memory_allocated() / _GIGABYTE if on_gpu else None,
    )


def _options(task: MemoryTask) -> ModelBenchOptions:
    """One window of that implementation alone."""
    return ModelBenchOptions(
        height=task.height,
        width=task.width,
        steps=task.steps,
        guidance=task.guidance,
        repeats=1,
        warm=0,
        stages=task.stages,
        implementations=(task.implementation,),
        without_camera=task.without_camera,
        count=False,
    )


def main() -> None:
    """Run the task of the command line."""
    task = msgspec.json.decode(sys.argv[1], type=MemoryTask)
    sys.stdout.write(msgspec.json.encode(own_memory(task)).decode() + "\n")


if __name__ == "__main__":
    main()
