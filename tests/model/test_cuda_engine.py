"""The engine for GPUs on a CPU: the same numbers as plain torch, recorded, compiled or not, whatever is replayed."""

import copy
import os
import threading
from collections.abc import Callable, Generator, Hashable, Iterable
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from small_models import TINY, TINY_DRIVING, random_clip, relative_error, tiny_driving, tiny_synthesizer
from tape import TapeRecorder
from torch import nn

from gcd_model.clip import Clip, View
from gcd_model.config import ModelConfig
from gcd_model.diffusion import RenderOptions, Schedule
from gcd_model.engines.cuda import CudaEngine, CudaGraphs, CudaOptions, Recorder, Replay, keep_compiled, recent, regions
from gcd_model.engines.gpu_layout import (
    Float8,
    Float8Linear,
    checked_decoder,
    join_attention,
    linear,
    multiply_in_float8,
    psnr_db,
)
from gcd_model.errors import Cancelled, DeviceMemoryError, OptionError
from gcd_model.geometry import SphericalDelta, Trajectory
from gcd_model.layers import Attention, ResBlock
from gcd_model.loading import load_synthesizer
from gcd_model.networks import Networks
from gcd_model.synthesizer import Synthesizer

PLAIN = CudaOptions(backend=None, arranged=False, half_decoder=False)


def with_engine(
    synthesizer: Synthesizer, recorder: Recorder | None = None, options: CudaOptions = PLAIN
) -> Synthesizer:
    """The same checkpoint behind the engine."""
    engine = CudaEngine(copy.deepcopy(synthesizer.networks), options, recorder)
    return Synthesizer(synthesizer.networks, synthesizer.traits, engine)


def views_of(synthesizer: Synthesizer, options: RenderOptions, clip: Clip, azimuths: tuple[float, ...]) -> list[View]:
    return synthesizer.render(synthesizer.encode(clip), orbits(synthesizer, azimuths), options)


def orbits(synthesizer: Synthesizer, azimuths: tuple[float, ...]) -> list[Trajectory]:
    steered = synthesizer.traits.config.camera != "none"
    deltas = (SphericalDelta(azimuth_deg=azimuth) if steered else None for azimuth in azimuths)
    return [synthesizer.traits.plan_view(delta) for delta in deltas]


@pytest.fixture(scope="module")
def plain() -> Synthesizer:
    return tiny_synthesizer()


def assert_alike(ours: Iterable[View], theirs: Iterable[View]) -> None:
    for mine, other in zip(ours, theirs, strict=True):
        assert relative_error(mine.latents, other.latents) < 1e-5
        assert relative_error(mine.samples, other.samples) < 1e-5


@pytest.mark.parametrize(
    ("options", "engine", "azimuths"),
    [
        (RenderOptions(steps=2, samples=2, guidance=(1.0, 2.5)), PLAIN, (30.0, -20.0)),
        (
            RenderOptions(steps=3, solver="dpmpp_2m", guidance=(1.0, 3.0), guidance_interval=(0.5, 100.0)),
            replace(PLAIN, arranged=True),
            (30.0,),
        ),
    ],
    ids=["Euler steps of several views and samples", "multistep, guided at times, arranged"],
)
def test_the_engine_is_plain_torch(
    plain: Synthesizer, options: RenderOptions, engine: CudaOptions, azimuths: tuple[float, ...]
) -> None:
    if options.guidance_interval is not None:
        assert set(Schedule.of(TINY, options).guided) == {True, False}
    found = (views_of(each, options, random_clip(), azimuths) for each in (with_engine(plain, options=engine), plain))
    assert_alike(*found)


def test_a_painted_view_of_the_engine_is_plain_torchs_bit_by_bit_class_maps_too() -> None:
    plain = tiny_driving()
    engine = with_engine(plain, TapeRecorder())
    for seed in (0, 1):
        clip, options = random_clip(TINY_DRIVING, seed=seed), RenderOptions(steps=2, seed=seed)
        (mine,), (other,) = (views_of(each, options, clip, (0.0,)) for each in (engine, plain))
        for name in ("latents", "samples", "classes"):
            assert torch.equal(getattr(mine, name), getattr(other, name)), name


def test_what_was_recorded_serves_other_clips_paths_steps_solvers_and_guidance(plain: Synthesizer) -> None:
    """Nothing of the first window may be left in the second: Python numbers do not survive a recording."""
    tape = TapeRecorder()
    engine = with_engine(plain, tape)
    views_of(engine, RenderOptions(steps=2), random_clip(), (30.0,))
    recorded = tape.recorded
    assert recorded == 6  # the tower and the encoder for two frames and for one, a step, the decoder
    others = (
        RenderOptions(steps=1, seed=3, guidance=(1.0, 4.0), motion_bucket=17.0),
        RenderOptions(steps=3, seed=4, solver="dpmpp_2m", guidance=(2.0, 1.0)),
        RenderOptions(steps=2, seed=5, solver="heun"),
    )
    for seed, options in enumerate(others, start=1):
        clip = Clip(video=random_clip(seed=seed).video, fps=7.0)
        assert_alike(*(views_of(s, options, clip, (-70.0,)) for s in (engine, plain)))
    assert tape.recorded == recorded


def test_guided_and_plain_steps_are_recorded_once_for_any_number_of_views_and_samples(plain: Synthesizer) -> None:
    tape = TapeRecorder()
    engine = with_engine(plain, tape)
    features = engine.encode(random_clip())
    before = tape.recorded
    interval = RenderOptions(steps=2, guidance=(1.0, 3.0), guidance_interval=(0.0, 100.0))
    for _ in range(2):
        engine.render(features, orbits(engine, (30.0,)), interval)
    assert tape.recorded - before == 3  # two kinds of step, one decoder
    engine.render(features, orbits(engine, (30.0, 10.0)), replace(interval, samples=2))
    assert tape.recorded - before == 3


@pytest.mark.parametrize("wrap", [with_engine, lambda plain: plain], ids=["engine", "plain torch"])
def test_a_window_is_abandoned_between_two_steps_and_the_next_one_is_whole(
    plain: Synthesizer, wrap: Callable[[Synthesizer], Synthesizer]
) -> None:
    engine, stop, told = wrap(plain), threading.Event(), list[tuple[int, int]]()
    features, path = engine.encode(random_clip()), orbits(engine, (30.0,))

    def note(*progress: int) -> None:
        told.append(progress)  # type: ignore[arg-type]
        stop.set()

    with pytest.raises(Cancelled):
        engine.render(features, path, RenderOptions(steps=2, progress=note, cancel=stop))
    assert told == [(1, 2)]
    stop.clear()
    options = RenderOptions(steps=2, cancel=stop)
    mine, other = (s.render(features, path, options)[0] for s in (engine, plain))
    assert torch.equal(mine.latents, other.latents)


class Full(Recorder):
    """A device that is full when the fifth piece of work, a step, is recorded."""

    def __init__(self) -> None:
        self.recorded, self.forgotten = 0, 0

    def record(self, work: Replay) -> Replay:
        self.recorded += 1
        if self.recorded == 5:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.")
        return super().record(work)

    def forget(self) -> None:
        self.forgotten += 1


def test_a_full_device_drops_what_was_recorded_and_the_next_window_starts_anew(plain: Synthesizer) -> None:
    full = Full()
    engine = with_engine(plain, full)
    features, path, options = engine.encode(random_clip()), orbits(engine, (30.0,)), RenderOptions(steps=1)
    with pytest.raises(DeviceMemoryError):
        engine.render(features, path, options)
    assert full.forgotten == 1
    mine, other = (s.render(features, path, options)[0] for s in (engine, plain))
    assert torch.equal(mine.latents, other.latents)
    assert full.recorded == 7  # the step that did not fit, then that step and the decoder


def test_only_the_shapes_last_used_are_kept() -> None:
    kept: dict[Hashable, str] = {}
    made: list[int] = []

    def make(key: int) -> str:
        made.append(key)
        return str(key)

    for key in (1, 2, 1, 3, 1, 2):
        assert recent(kept, key, lambda key=key: make(key), limit=2) == str(key)
    assert made == [1, 2, 3, 2]


@pytest.mark.parametrize("config", [TINY, TINY_DRIVING])
def test_every_convolution_of_the_unet_but_its_ends_lies_in_a_compiled_region(config: ModelConfig) -> None:
    networks = (tiny_synthesizer if config is TINY else tiny_driving)(config).networks
    inside = {id(part) for region in regions(networks.unet) for part in region.modules()}
    outside = [
        name
        for name, part in networks.unet.named_modules()
        if isinstance(part, torch.nn.Conv2d | torch.nn.Conv3d) and id(part) not in inside
    ]
    assert outside == ["stem", "conv_out"]


def test_compiled_code_is_kept_in_the_folder_that_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GCD_CACHE_DIR", str(tmp_path))
    for name in ("TORCHINDUCTOR_CACHE_DIR", "TRITON_CACHE_DIR"):
        monkeypatch.setenv(name, "")  # so that it is as before in the end
        monkeypatch.delenv(name)
    keep_compiled()
    assert os.environ["TORCHINDUCTOR_CACHE_DIR"] == str(tmp_path / "compiled" / torch.__version__)
    assert (tmp_path / "compiled" / torch.__version__).is_dir()


def test_whole_levels_are_the_nearest_to_the_same_pictures(plain: Synthesizer) -> None:
    features = plain.encode(random_clip())
    (fine,), (coarse,) = (
        plain.render(features, orbits(plain, (30.0,)), RenderOptions(steps=1, samples=2, whole_levels=levels))
        for levels in (False, True)
    )
    assert coarse.samples.dtype == torch.uint8
    assert (coarse.samples / 255 - fine.samples).abs().max() <= 0.5 / 255 + 1e-6
    assert coarse.samples.float().std() > 1
    assert coarse.std is not None
    assert fine.std is not None
    assert torch.allclose(coarse.std, fine.std, atol=0.5 / 255)


def test_an_engine_that_cannot_be_is_refused_before_anything_is_loaded(tmp_path: Path) -> None:
    with pytest.raises(OptionError):
        load_synthesizer(tmp_path / "absent.ckpt", device="cpu", engine="cuda")


class StubStream:
    def wait_stream(self, other: "StubStream") -> None:
        pass


@contextmanager
def broken_capture(_graph: object, **_options: object) -> Generator[None]:
    """As torch does it: to end a capture that broke off is an error of its own."""
    try:
        yield
    except torch.OutOfMemoryError:
        raise RuntimeError("operation failed due to a previous error during capture")  # noqa: B904  as torch does


def test_want_of_memory_in_a_recording_is_told_as_such(monkeypatch: pytest.MonkeyPatch) -> None:
    """The real recorder, with the device's part stubbed out."""
    for name in ("CUDAGraph", "graph_pool_handle"):
        monkeypatch.setattr(torch.cuda, name, object)
    for name in ("Stream", "current_stream"):
        monkeypatch.setattr(torch.cuda, name, StubStream)
    monkeypatch.setattr(torch.cuda, "stream", lambda _: nullcontext())
    monkeypatch.setattr(torch.cuda, "graph", broken_capture)
    runs: list[bool] = []

    def work() -> None:
        runs.append(torch.backends.cudnn.benchmark)
        if len(runs) == 3:
            raise torch.OutOfMemoryError("CUDA out of memory.")

    before = torch.backends.cudnn.benchmark
    with pytest.raises(torch.OutOfMemoryError):
        CudaGraphs().record(work)
    assert runs == [True] * 3  # twice to warm up, once to record
    assert torch.backends.cudnn.benchmark == before


@pytest.fixture
def networks() -> Networks:
    """Random networks of float32."""
    return tiny_synthesizer().networks


def make_faint(networks: Networks) -> None:
    """Pictures that are nearly grey, so that bfloat16 cannot be far off."""
    with torch.no_grad():
        for layer in (networks.decoder.conv_out, networks.decoder.mix_frames):
            assert isinstance(layer, nn.Conv2d | nn.Conv3d)
            layer.weight.mul_(0.03)
            assert layer.bias is not None
            layer.bias.zero_()


@pytest.mark.parametrize(
    ("loud", "faint", "dtype"),
    [(False, False, torch.float16), (True, True, torch.bfloat16), (True, False, torch.float32)],
)
def test_the_engine_decodes_in_half_precision_where_pictures_stay_alike(
    networks: Networks, loud: bool, faint: bool, dtype: torch.dtype
) -> None:
    if faint:
        make_faint(networks)
    if loud:  # more than float16 holds; the norms that follow take it back
        for block in networks.decoder.modules():
            if isinstance(block, ResBlock):
                block.conv1.weight.data.mul_(1e7)
    decoder, psnr = checked_decoder(networks)
    assert decoder.stem.weight.dtype == dtype
    assert psnr > 50
    taken = copy.deepcopy(networks)
    engine = CudaEngine(taken, CudaOptions(backend=None))
    assert taken.decoder.stem.weight.dtype == dtype
    assert networks.decoder.stem.weight.dtype == torch.float32
    assert engine.decode(torch.zeros(TINY.frames, 4, 2, 2)).dtype == torch.float32


@pytest.mark.slow
def test_compiled_blocks_are_plain_torch_compiling_is_heard_and_many_shapes_are_allowed(plain: Synthesizer) -> None:
    from torch._dynamo import config

    told: list[int] = []
    compiled = with_engine(plain, options=CudaOptions(backend="eager", half_decoder=False))
    asked = RenderOptions(steps=2, guidance=(1.0, 2.5), progress=lambda done, _: told.append(done))
    views = views_of(compiled, asked, random_clip(TINY), (30.0,))
    assert told.count(0) > 10
    assert (told, set(told)) == (sorted(told), {0, 1, 2})  # it never runs backwards
    assert_alike(views, views_of(plain, replace(asked, progress=None), random_clip(TINY), (30.0,)))
    assert config.recompile_limit >= 256
    assert config.accumulated_recompile_limit >= 4096


def test_a_second_gpu_is_the_current_one_while_its_engine_works(monkeypatch: pytest.MonkeyPatch) -> None:
    entered: list[torch.device] = []

    class On(nullcontext[None]):
        def __init__(self, device: torch.device) -> None:
            entered.append(device)
            super().__init__()

    engine = CudaEngine(copy.deepcopy(tiny_synthesizer().networks), PLAIN)
    monkeypatch.setattr(torch.cuda, "device", On)
    monkeypatch.setattr(CudaEngine, "like", SimpleNamespace(device=torch.device("cuda:1")))
    with engine._at_work():
        assert entered == [torch.device("cuda:1")]


def test_joined_attention_is_plain_attention_in_the_same_memory() -> None:
    attention, x = Attention(8, 2).requires_grad_(False), torch.randn(3, 5, 8)
    expected = attention(x)
    join_attention(attention)
    assert relative_error(attention(x), expected) < 1e-6
    assert attention.key.weight.untyped_storage().data_ptr() == attention.joint.untyped_storage().data_ptr()
    changed = Attention(8, 2)
    changed.key = nn.Sequential(changed.key)  # as an adapter does
    join_attention(changed)
    assert type(changed) is Attention


def test_products_in_8_bits_stay_near_plain_torch_and_leave_an_adapter_alone(plain: Synthesizer) -> None:
    """On random weights of widths of 32: 37 to 38 dB; bfloat16 keeps 47."""
    options = RenderOptions(steps=3, guidance=(1.0, 1.5))
    (other,) = views_of(plain, options, random_clip(), (30.0,))
    for arranged in (False, True):
        engine = with_engine(plain, options=replace(PLAIN, float8=True, arranged=arranged))
        (mine,) = views_of(engine, options, random_clip(), (30.0,))
        assert 32 < psnr_db(mine.samples, other.samples) < 45
    changed = Attention(16, 2)
    changed.key = nn.Sequential(changed.key)  # as an adapter does
    multiply_in_float8(changed)
    assert [type(each) for each in changed.children()].count(Float8Linear) == 3
    narrow = Attention(8, 2)
    multiply_in_float8(narrow)
    assert type(narrow.out) is nn.Linear


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e4])
def test_a_product_in_8_bits_errs_by_less_than_a_sixteenth_whatever_its_rows_are_scaled_by(scale: float) -> None:
    x, weight, bias = torch.randn(2, 5, 32), torch.randn(48, 32), torch.randn(48)
    x[0, 0] *= scale
    expected = nn.functional.linear(x, weight, bias)
    made = linear(x, Float8.of(weight), bias)
    errors = (made - expected).norm(dim=-1) / expected.norm(dim=-1)
    assert 0 < errors.max() < 1 / 16
