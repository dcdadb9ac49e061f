"""Blocks behind torch.compile. Slow: compiling takes longer than all that is computed."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from small_models import TINY, random_clip, relative_error, tiny_synthesizer

from gcd_model.diffusion import RenderOptions
from gcd_model.engines.cuda import CudaEngine, CudaOptions, twin
from gcd_model.geometry import SphericalDelta
from gcd_model.synthesizer import Synthesizer

_ONE_REGION = """
import json, torch
from pathlib import Path
from gcd_model.engines.cuda import compile_regions, keep_compiled
from gcd_model.layers import ResBlock
keep_compiled(Path({folder!r}))
block = ResBlock(8, 8, groups=4, eps=1e-6).eval().to({device!r})
compile_regions(block, "inductor")
with torch.inference_mode():
    block(torch.zeros(1, 8, 4, 4, device={device!r}))
from torch._dynamo.utils import counters
print(json.dumps({{**counters["inductor"], **counters["aot_autograd"]}}))
"""


def _compile_in_a_process(folder: Path) -> dict[str, int]:
    """How often something compiled was looked for and found."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    environment = {
        name: value for name, value in os.environ.items() if name not in ("TORCHINDUCTOR_CACHE_DIR", "TRITON_CACHE_DIR")
    }
    path = os.pathsep.join(entry for entry in sys.path if entry)
    done = subprocess.run(
        [sys.executable, "-c", _ONE_REGION.format(folder=str(folder), device=device)],
        env=environment | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=900,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_second_process_compiles_nothing_anew(tmp_path: Path) -> None:
    cold, warm = _compile_in_a_process(tmp_path), _compile_in_a_process(tmp_path)
    assert cold.get("autograd_cache_miss", 0) + cold.get("fxgraph_cache_miss", 0) > 0
    assert warm.get("autograd_cache_miss", 0) + warm.get("fxgraph_cache_miss", 0) == 0
    assert warm.get("autograd_cache_hit", 0) + warm.get("fxgraph_cache_hit", 0) > 0


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("backend", ["eager", "aot_eager"])
def test_compiled_blocks_are_plain_torch(backend: str) -> None:
    plain = tiny_synthesizer()
    options = CudaOptions(backend=backend, channels_last=backend == "eager", decoder="float32")
    engine = Synthesizer(plain.networks, plain.traits, CudaEngine(twin(plain.networks), options))
    path = plain.traits.plan_view(SphericalDelta(azimuth_deg=30.0))
    asked = RenderOptions(steps=3, guidance=(1.0, 2.5))
    mine, other = (s.render(s.encode(random_clip(TINY)), [path], asked)[0] for s in (engine, plain))
    assert relative_error(mine.latents, other.latents) < 1e-5
    assert relative_error(mine.samples, other.samples) < 1e-5
