"""Measuring a model: the peer computes the same function on the same tensors, arithmetic adds up, figures survive JSON.

How long anything takes, no test says.
"""

import ast
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest
import torch
from small_models import TINY, tiny_driving, tiny_synthesizer, tiny_traits
from torch import nn

import gcd_model
from gcd_model.checkpoints import LoadedWeights
from gcd_model.config import PLAIN_SMALL, SVD_14, ModelConfig
from gcd_model.engine import TorchEngine
from gcd_model.errors import OptionError
from gcd_model.families import KUBRIC90
from gcd_model.measuring import ModelBench, ModelBenchOptions, bench_model, load_measured, opening, save_random
from gcd_model.measuring.implementations import counted_flops
from gcd_model.measuring.opening import full_size_config
from gcd_model.measuring.peer_diffusers import DiffusersEngine, DiffusersModules, compile_modules, diffusers_modules
from gcd_model.measuring.published_form import require_published, without_camera
from gcd_model.measuring.subject import Subject, Work, relative_difference, still_clip
from gcd_model.networks import Networks, random_networks
from gcd_model.synthesizer import Synthesizer
from gcd_model.traits import Traits

PUBLISHED = msgspec.structs.replace(TINY, unet=msgspec.structs.replace(TINY.unet, embedding_width=64))
"""Tiny, in the form that diffusers has, too."""

WORK = Work.of(PUBLISHED)
_PEERS = ("diffusers", "transformers", "gcd_model.measuring.peer_diffusers")
ONCE = ModelBenchOptions(repeats=1, warm=0, count=False)


@pytest.fixture(scope="module")
def exact() -> Synthesizer:
    """In double precision, so that rounding does not hide a wrong term."""
    synthesizer = tiny_synthesizer(PUBLISHED)
    synthesizer.networks.double()
    return synthesizer


@pytest.fixture(scope="module")
def bare(exact: Synthesizer) -> Networks:
    """The same networks without a camera."""
    return without_camera(exact.networks)


@pytest.fixture(scope="module")
def modules(bare: Networks) -> DiffusersModules:
    """The same as diffusers has them."""
    return diffusers_modules(bare)


# --- the peer ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("guidance", [(1.0, 1.5), pytest.param((1.0, 1.0), marks=pytest.mark.slow)])
def test_a_window_through_diffusers_equals_ours(exact: Synthesizer, guidance: tuple[float, float]) -> None:
    options = replace(ONCE, implementations=("ours", "diffusers"), guidance=guidance, steps=2)
    (difference,) = bench_model(exact, options).differences
    assert difference.name == "diffusers"
    assert difference.latents < 1e-6
    assert difference.pictures is not None
    assert difference.pictures < 1e-6


def test_the_comparison_would_see_one_wrong_epsilon(
    exact: Synthesizer, modules: DiffusersModules, monkeypatch: pytest.MonkeyPatch
) -> None:
    traits = replace(exact.traits, config=bare_config(PUBLISHED))
    peer = Subject("peer", DiffusersEngine(modules), traits, replace(WORK, steps=1), ("step",))
    right = peer.window().latents
    monkeypatch.setattr(modules.unet.up_blocks[-1].resnets[0].spatial_res_block.norm1, "eps", 1e-3)
    assert relative_difference(right, peer.window().latents) > 1e-5


def test_the_peer_holds_no_weight_of_its_own(bare: Networks, modules: DiffusersModules) -> None:
    """But for queries and keys to a single token, which we keep in another precision, because we never need them."""
    ours = {value.untyped_storage().data_ptr() for value in bare.state_dict().values()}
    theirs = {name: p for part in (modules.vae, modules.tower) for name, p in part.named_parameters()}
    theirs |= {
        name: p
        for name, p in modules.unet.named_parameters()
        if not any(dormant in name for dormant in ("attn2.to_q", "attn2.to_k", ".norm2."))
    }
    assert len(theirs) > 200
    assert [name for name, p in theirs.items() if p.untyped_storage().data_ptr() not in ours] == []


def test_group_norms_are_torchs_own_again_once_the_peer_is_built(modules: DiffusersModules) -> None:
    assert nn.GroupNorm is torch.nn.modules.normalization.GroupNorm
    norms = [each for each in modules.unet.modules() if isinstance(each, nn.GroupNorm)]
    assert {each.num_groups for each in norms} == {PUBLISHED.unet.norm_groups}


@pytest.mark.slow  # brings the compiler along
def test_a_compiled_peer_has_every_network_behind_the_compiler(bare: Networks) -> None:
    compiled = compile_modules(diffusers_modules(bare))
    for module in (compiled.unet, compiled.vae.encoder, compiled.vae.decoder, compiled.tower):
        assert module._compiled_call_impl is not None


def test_nobody_imports_the_peer_unasked() -> None:
    """It would cost every start seconds, and our side of a memory measurement what diffusers itself takes."""
    unasked: list[str] = []
    for path in Path(gcd_model.__file__).parent.rglob("*.py"):
        for node in ast.parse(path.read_text()).body:
            names = [each.name for each in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            unasked += [f"{path.stem}: {name}" for name in names if name.startswith(_PEERS)]
    assert sorted({each.partition(":")[0] for each in unasked}) == ["peer_diffusers"]


def test_the_camera_is_left_out_and_nothing_else() -> None:
    networks = tiny_synthesizer(PUBLISHED).networks
    bare = without_camera(networks)
    assert bare.config.camera == "none"
    gone = set(networks.state_dict()) - set(bare.state_dict())
    assert {name.rpartition(".")[0] for name in gone} == {"camera.proj", "unet.embed_camera.0", "unet.embed_camera.2"}
    assert without_camera(bare) is bare


@pytest.mark.parametrize(
    ("config", "said"),
    [
        (PUBLISHED, "no module for camera control"),
        (PLAIN_SMALL, "switches of ours .* nor for a U-Net without image tower"),
        (
            msgspec.structs.replace(TINY, camera="none", unet=msgspec.structs.replace(TINY.unet, camera_width=0)),
            "four times as wide",
        ),
    ],
)
def test_what_diffusers_has_no_module_for_is_refused(config: ModelConfig, said: str) -> None:
    with pytest.raises(OptionError, match=said):
        require_published(config)


def test_a_still_clip_has_one_picture_within_range() -> None:
    clip = still_clip(3, 32, 64, 12.0)
    assert clip.video.shape == (3, 3, 32, 64)
    assert torch.equal(clip.video[0], clip.video[2])
    assert clip.video.abs().max() <= 1.0
    assert clip.video.std() > 0.1


# --- stages --------------------------------------------------------------------------------------------------------


def test_every_stage_is_measured_and_steps_without_the_one_that_prepares_the_window() -> None:
    options = replace(ONCE, repeats=2, steps=3)
    report = bench_model(tiny_synthesizer(), options)
    (ours,) = report.implementations
    assert [(each.stage, each.runs) for each in ours.stages] == [
        ("tower", 2),
        ("encode", 2),
        ("step", 4),
        ("decode", 2),
        ("window", 2),
    ]
    for each in ours.stages:
        assert 0 < each.median_s <= each.p95_s
        assert each.cpu_s > 0
    assert report.differences == ()


def test_a_window_that_is_not_watched_is_the_same_and_tells_nothing() -> None:
    synthesizer = tiny_synthesizer()
    engine = TorchEngine(synthesizer.networks)
    subject = Subject("ours", engine, synthesizer.traits, replace(Work.of(TINY), steps=1), ("window",))
    watched = subject.window()
    assert set(subject.probe.spent) == {"tower", "encode", "step", "decode"}
    assert torch.equal(subject.window(watched=False).samples, watched.samples)
    assert subject.probe.spent == {}


def test_only_what_was_asked_for_is_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    synthesizer = tiny_synthesizer()
    networks = synthesizer.networks
    for module in (networks.image_encoder, networks.condition_encoder, networks.decoder):
        monkeypatch.setattr(module, "forward", None)
    report = bench_model(synthesizer, replace(ONCE, stages=("step",), steps=1))
    assert [(each.stage, each.runs) for each in report.implementations[0].stages] == [("step", 1)]


def test_a_small_model_is_measured_too() -> None:
    report = bench_model(tiny_driving(), ONCE)
    stages = {each.stage: each.cpu_s for each in report.implementations[0].stages}
    assert stages.keys() == {"encode", "step", "decode", "window"}  # it has no tower
    assert stages["window"] >= stages["step"]


@pytest.mark.parametrize("changes", [{"repeats": 0}, {"warm": -1}, {"stages": ()}, {"implementations": ()}])
def test_a_bench_of_nothing_is_refused(changes: dict[str, object]) -> None:
    with pytest.raises(OptionError, match="at least one window"):
        replace(ONCE, **changes)


def test_a_size_the_network_cannot_take_is_refused() -> None:
    with pytest.raises(OptionError, match=r"multiples of 8 .* got 30x64"):
        Work.of(TINY, height=30)


# --- arithmetic ----------------------------------------------------------------------------------------------------


def bare_traits() -> Traits:
    return replace(tiny_traits(PUBLISHED), config=bare_config(PUBLISHED))


def bare_config(config: ModelConfig) -> ModelConfig:
    unet = msgspec.structs.replace(config.unet, camera_width=0)
    return msgspec.structs.replace(config, camera="none", unet=unet)


@pytest.mark.slow  # counting is slow: seconds each; test_unet_cost.py counts one branch in every run
def test_arithmetic_adds_up() -> None:
    counted = counted_flops("ours", bare_traits(), WORK)
    stages = sum(counted[name] for name in ("tower", "encode", "decode")) + WORK.steps * counted["step"]
    assert 0 < counted["window"] - stages < 0.05 * counted["step"]  # what is prepared once a window


@pytest.mark.slow
def test_diffusers_pays_for_what_our_graph_leaves_out_and_guidance_doubles_a_step() -> None:
    ours, theirs = (counted_flops(name, bare_traits(), WORK) for name in ("ours", "diffusers"))
    assert theirs["encode"] == ours["encode"]  # the same convolutions
    assert theirs["step"] > ours["step"]
    assert theirs["decode"] > ours["decode"]
    alone = counted_flops("ours", bare_traits(), replace(WORK, guidance=(1.0, 1.0)))
    assert ours["step"] == 2 * alone["step"]


@pytest.mark.slow
def test_a_guided_step_at_full_size_costs_what_two_published_branches_cost() -> None:
    full = bare_config(SVD_14)
    traits = replace(tiny_traits(PUBLISHED), config=full)
    ours, theirs = (counted_flops(name, traits, Work.of(full))["step"] / 1e12 for name in ("ours", "diffusers"))
    assert theirs == pytest.approx(2 * 6.265, abs=0.02)
    assert ours <= 2 * (6.265 - 0.485)


# --- weights -------------------------------------------------------------------------------------------------------


def test_networks_that_are_not_measured_at_full_size_are_small_and_hand_on_the_same_shapes() -> None:
    config = full_size_config(("step",))
    assert config.unet == SVD_14.unet
    assert config.size_factor == SVD_14.size_factor
    assert config.vae.width < SVD_14.vae.width
    assert config.image_encoder is not None
    assert config.image_encoder.layers == 1
    assert full_size_config(("window",)) == SVD_14
    assert full_size_config(("decode",)).vae == SVD_14.vae


def test_random_weights_in_a_file_are_the_ones_that_were_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    networks = random_networks(TINY, seed=3)
    asked: list[str] = []

    def made(family: str) -> LoadedWeights:
        asked.append(family)
        return LoadedWeights(
            name="tiny", networks=networks, family=KUBRIC90, move_time=2, trained=False, sha256_12="0" * 12
        )

    monkeypatch.setattr(opening, "random_weights", made)
    out = tmp_path / "random.safetensors"
    save_random("random:kubric90", out)
    assert asked == ["kubric90"]
    written = load_measured(str(out), device="cpu")
    assert (written.traits.config, written.traits.trained, written.traits.family) == (TINY, False, KUBRIC90)
    expected = networks.state_dict()
    assert all(torch.equal(value, expected[name]) for name, value in written.networks.state_dict().items())


# --- figures -------------------------------------------------------------------------------------------------------


def test_figures_survive_json_and_an_unknown_key_does_not() -> None:
    report = bench_model(tiny_driving(), replace(ONCE, stages=("decode", "step")))
    text = msgspec.json.encode(report)
    assert msgspec.json.decode(text, type=ModelBench) == report
    assert [each.stage for each in report.implementations[0].stages] == ["decode", "step"]
    with pytest.raises(msgspec.ValidationError, match="unknown field"):
        msgspec.json.decode(text.replace(b'"model":', b'"modle":'), type=ModelBench)
