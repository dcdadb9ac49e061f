"""What only a GPU can show."""

import copy
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace

import pytest
import torch
from small_models import TINY, random_clip, relative_error, tiny_driving, tiny_synthesizer, tiny_traits

from gcd_model.clip import Augmentation, Clip, View
from gcd_model.config import SVD_14
from gcd_model.diffusion import RenderOptions, unit_noise
from gcd_model.engines.cuda import CudaEngine, CudaOptions
from gcd_model.engines.gpu_layout import psnr_db
from gcd_model.errors import Cancelled, DeviceMemoryError
from gcd_model.geometry import SphericalDelta
from gcd_model.networks import random_networks
from gcd_model.synthesizer import Download, Synthesizer, out_of_memory_is_our_error

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.timeout(900),  # the first use of a block compiles it
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]


def rendered(synthesizer: Synthesizer, options: RenderOptions) -> list[View]:
    traits = synthesizer.traits
    angles = (None, None) if traits.config.camera == "none" else (30.0, -20.0)
    paths = [traits.plan_view(None if a is None else SphericalDelta(azimuth_deg=a)) for a in angles]
    clip = random_clip(traits.config)
    noise = Augmentation(noise=unit_noise(tuple(clip.video.shape), 0))  # a GPU would draw another
    return synthesizer.render(synthesizer.encode(clip, noise), paths, options)


@pytest.mark.parametrize(("dtype", "error"), [(torch.float32, 1e-2), (torch.bfloat16, 0.1)])  # TF32 convolutions
def test_a_gpu_computes_what_the_cpu_computes(dtype: torch.dtype, error: float) -> None:
    def views(device: str, dtype: torch.dtype) -> list[View]:
        networks = random_networks(TINY, seed=0).to(device, dtype)
        networks.decoder.float()
        traits = tiny_traits(precision=str(dtype), device=device)
        return rendered(Synthesizer(networks, traits), RenderOptions(steps=3, samples=2))

    for mine, other in zip(views("cuda", dtype), views("cpu", torch.float32), strict=True):
        assert mine.samples.device.type == mine.latents.device.type == "cpu"
        assert relative_error(mine.latents, other.latents) < error


def test_a_clip_may_lie_on_the_gpu_and_a_full_device_is_our_own_error_and_leaves_the_device_usable() -> None:
    synthesizer = Synthesizer(random_networks(TINY, seed=0).cuda(), tiny_traits(device="cuda"))
    clip = random_clip()
    assert synthesizer.encode(Clip(video=clip.video.cuda(), fps=clip.fps)).latents.is_cuda
    with pytest.raises(DeviceMemoryError):
        out_of_memory_is_our_error(lambda: torch.empty(2**50, device="cuda"))()
    assert torch.ones(3, device="cuda").sum().item() == 3


GRAPHS = CudaOptions(backend=None, half_decoder=False)
VARIANTS = {"graphs": GRAPHS, "compiled": CudaOptions(graphs=False, half_decoder=False), "both": CudaOptions()}


@pytest.fixture
def exact() -> Iterator[None]:
    """Without TF32, so that differences are rounding alone."""
    matmul, cudnn = torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = False
    yield
    torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32 = matmul, cudnn


def on_gpu(synthesizer: Synthesizer, options: CudaOptions | None) -> Synthesizer:
    """The same weights on the GPU, behind the engine or, with None, behind plain torch."""
    networks = copy.deepcopy(synthesizer.networks).cuda()
    engine = None if options is None else CudaEngine(networks, options)
    return Synthesizer(networks, replace(synthesizer.traits, device="cuda"), engine)


@pytest.mark.usefixtures("exact")
@pytest.mark.parametrize(
    ("make", "variant"), [*((tiny_synthesizer, name) for name in VARIANTS), (tiny_driving, "graphs")]
)
def test_the_engine_computes_what_plain_torch_computes(make: Callable[[], Synthesizer], variant: str) -> None:
    plain = make()
    engine = on_gpu(plain, VARIANTS[variant])
    for options in (
        RenderOptions(steps=3, samples=2),
        RenderOptions(steps=5, seed=3, samples=2, solver="dpmpp_2m", guidance=(1.0, 3.0)),
        RenderOptions(steps=4, guidance=(1.0, 3.0), guidance_interval=(0.5, 100.0), whole_levels=True),
    ):
        for mine, other in zip(rendered(engine, options), rendered(plain, options), strict=True):
            assert relative_error(mine.latents, other.latents) < 1e-4
            near = 0.02 if options.whole_levels else 1e-3
            assert relative_error(mine.samples.float(), other.samples.float()) < near
            if mine.classes is not None and other.classes is not None:
                assert (mine.classes == other.classes).float().mean() > 0.99


def test_products_in_8_bits_stay_near_plain_torch() -> None:
    plain = tiny_synthesizer()
    engines = (on_gpu(plain, CudaOptions(float8=True)), plain)
    for mine, other in zip(*(rendered(each, RenderOptions(steps=3)) for each in engines), strict=True):
        assert psnr_db(mine.samples, other.samples) > 30


def test_the_loop_neither_allocates_nor_waits_for_the_device_and_a_second_window_records_and_compiles_nothing() -> None:
    from torch._dynamo.utils import counters

    engine, allocated = on_gpu(tiny_synthesizer(), VARIANTS["both"]), list[int]()
    rendered(engine, RenderOptions(steps=3))
    compiled, held = counters["stats"]["unique_graphs"], torch.cuda.memory_allocated()

    def note(done: int, steps: int) -> None:
        allocated.append(torch.cuda.memory_stats()["allocation.all.allocated"])
        torch.cuda.set_sync_debug_mode("error" if done % 6 else "default")  # within a view

    try:
        rendered(engine, RenderOptions(steps=6, seed=2, progress=note))
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert len(allocated) == 12
    assert len(set(allocated[:6])) == len(set(allocated[6:])) == 1
    assert counters["stats"]["unique_graphs"] == compiled
    assert torch.cuda.memory_allocated() == held


def test_a_window_is_abandoned_after_the_step_in_which_the_wish_came() -> None:
    engine, stop = on_gpu(tiny_synthesizer(), VARIANTS["graphs"]), threading.Event()
    with pytest.raises(Cancelled):
        rendered(engine, RenderOptions(steps=5, progress=lambda done, _: done == 2 and stop.set(), cancel=stop))
    assert torch.cuda.current_stream().query()  # nothing is left to do
    assert rendered(engine, RenderOptions(steps=5))[0].samples.isfinite().all()


def test_a_download_holds_what_the_device_had_and_lies_in_pinned_memory() -> None:
    source = torch.arange(1 << 20, device="cuda", dtype=torch.uint8)
    download = Download(source)
    expected = source.cpu()
    del source
    torch.zeros(1 << 20, device="cuda", dtype=torch.uint8)  # would take the memory that the copy is read from
    assert download.result().is_pinned()
    assert torch.equal(download.result(), expected)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_full_size_window_equals_plain_torch_within_bfloat16_and_ten_gigabytes() -> None:
    networks = random_networks(SVD_14, seed=0)
    traits = tiny_traits(SVD_14, precision="bfloat16", device="cuda")
    for module in networks.children():
        module.to("cuda", torch.bfloat16)
    networks.decoder.float()
    clip, path = random_clip(SVD_14), traits.plan_view(SphericalDelta(azimuth_deg=30.0))
    options = RenderOptions(steps=2)
    plain = Synthesizer(networks, traits)
    (other,) = plain.render(plain.encode(clip), [path], options)
    engine = Synthesizer(networks, traits, CudaEngine(networks))  # in place: no more plain
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats()
    (mine,) = engine.render(engine.encode(clip), [path], options)
    assert relative_error(mine.latents, other.latents) < 0.05
    assert torch.cuda.max_memory_allocated() < 10e9
