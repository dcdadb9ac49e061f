"""ZeroNVS on random weights in the published layout, against a straight calculation of its formulas."""

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest
import torch
import torch.nn.functional as F
from driving_plane import PlaneClips, seen_of
from made_records import note, record
from torch import Tensor

from gcd_model.diffusion import unit_noise
from gcd_model.errors import CheckpointError
from gcd_train.errors import RecipeError
from gcd_train.evaluation.clips import PairedSet
from gcd_train.evaluation.methods import EvaluateOptions, baselines, planned
from gcd_train.evaluation.store import RunKeeper
from gcd_train.evaluation.zeronvs import ZeroNVS, ZeroNvsNetworks, best_scale, camera_numbers, open_zeronvs

pytest.importorskip("diffusers", reason="needs the extra `zeronvs`: pip install 'gcd-node[zeronvs]'")
pytest.importorskip("transformers", reason="needs the extra `zeronvs`: pip install 'gcd-node[zeronvs]'")

WIDTHS, VAE_WIDTHS, TOKEN, TIME = (32, 64), (32, 32, 32, 32), 24, 128
CLIP_WIDTH, CLIP_LAYERS, PATCH, PLACES = 64, 2, 14, 4
SIZE, STEPS, SCALE = 64, 3, 4.0


# --- the published names: shapes by name, as Stable Diffusion's and CLIP's first publications have them ---------------


def layer(name: str, *shape: int) -> Iterator[tuple[str, tuple[int, ...]]]:
    yield f"{name}.weight", shape
    yield f"{name}.bias", shape[:1]


def block(
    name: str, inputs: int, width: int, parts: tuple[str, ...], skip: str
) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Two norms and two convolutions; a time embedding where there are five parts."""
    norm_1, conv_1, norm_2, conv_2, *time = parts
    yield from layer(f"{name}.{norm_1}", inputs)
    yield from layer(f"{name}.{conv_1}", width, inputs, 3, 3)
    yield from layer(f"{name}.{norm_2}", width)
    yield from layer(f"{name}.{conv_2}", width, width, 3, 3)
    for each in time:
        yield from layer(f"{name}.{each}", width, TIME)
    if inputs != width:
        yield from layer(f"{name}.{skip}", width, inputs, 1, 1)


def unet_block(name: str, inputs: int, width: int) -> Iterator[tuple[str, tuple[int, ...]]]:
    parts = ("in_layers.0", "in_layers.2", "out_layers.0", "out_layers.3", "emb_layers.1")
    yield from block(name, inputs, width, parts, "skip_connection")


def unet_attention(name: str, width: int) -> Iterator[tuple[str, tuple[int, ...]]]:
    yield from layer(f"{name}.norm", width)
    yield from layer(f"{name}.proj_in", width, width, 1, 1)
    inside = f"{name}.transformer_blocks.0"
    for number, context in ((1, width), (2, TOKEN)):
        yield f"{inside}.attn{number}.to_q.weight", (width, width)
        yield f"{inside}.attn{number}.to_k.weight", (width, context)
        yield f"{inside}.attn{number}.to_v.weight", (width, context)
        yield from layer(f"{inside}.attn{number}.to_out.0", width, width)
    yield from layer(f"{inside}.ff.net.0.proj", 8 * width, width)
    yield from layer(f"{inside}.ff.net.2", width, 4 * width)
    for number in (1, 2, 3):
        yield from layer(f"{inside}.norm{number}", width)
    yield from layer(f"{name}.proj_out", width, width, 1, 1)


def unet() -> Iterator[tuple[str, tuple[int, ...]]]:
    narrow, wide = WIDTHS
    yield from layer("time_embed.0", TIME, narrow)
    yield from layer("time_embed.2", TIME, TIME)
    yield from layer("input_blocks.0.0", narrow, 8, 3, 3)
    for place, inputs, width in ((1, narrow, narrow), (2, narrow, narrow), (4, narrow, wide), (5, wide, wide)):
        yield from unet_block(f"input_blocks.{place}.0", inputs, width)
    for place in (1, 2):
        yield from unet_attention(f"input_blocks.{place}.1", narrow)
    yield from layer("input_blocks.3.0.op", narrow, narrow, 3, 3)
    yield from unet_block("middle_block.0", wide, wide)
    yield from unet_attention("middle_block.1", wide)
    yield from unet_block("middle_block.2", wide, wide)
    for place, skipped in enumerate((wide, wide, narrow)):
        yield from unet_block(f"output_blocks.{place}.0", wide + skipped, wide)
    yield from layer("output_blocks.2.1.conv", wide, wide, 3, 3)
    for place, inputs in ((3, wide + narrow), (4, 2 * narrow), (5, 2 * narrow)):
        yield from unet_block(f"output_blocks.{place}.0", inputs, narrow)
        yield from unet_attention(f"output_blocks.{place}.1", narrow)
    yield from layer("out.0", narrow)
    yield from layer("out.2", 4, narrow, 3, 3)


def autoencoder() -> Iterator[tuple[str, tuple[int, ...]]]:
    parts, width = ("norm1", "conv1", "norm2", "conv2"), VAE_WIDTHS[0]
    for half, step, blocks, ins, outs in (("encoder", "down", 2, 3, 8), ("decoder", "up", 3, 4, 3)):
        yield from layer(f"{half}.conv_in", width, ins, 3, 3)
        for level in range(len(VAE_WIDTHS)):
            for number in range(blocks):
                yield from block(f"{half}.{step}.{level}.block.{number}", width, width, parts, "nin_shortcut")
            if level != (len(VAE_WIDTHS) - 1 if half == "encoder" else 0):
                yield from layer(f"{half}.{step}.{level}.{step}sample.conv", width, width, 3, 3)
        for number in (1, 2):
            yield from block(f"{half}.mid.block_{number}", width, width, parts, "nin_shortcut")
        yield from layer(f"{half}.mid.attn_1.norm", width)
        for each in ("q", "k", "v", "proj_out"):
            yield from layer(f"{half}.mid.attn_1.{each}", width, width, 1, 1)
        yield from layer(f"{half}.norm_out", width)
        yield from layer(f"{half}.conv_out", outs, width, 3, 3)
    yield from layer("quant_conv", 8, 8, 1, 1)
    yield from layer("post_quant_conv", 4, 4, 1, 1)


def image_tower() -> Iterator[tuple[str, tuple[int, ...]]]:
    yield "class_embedding", (CLIP_WIDTH,)
    yield "positional_embedding", (PLACES + 1, CLIP_WIDTH)
    yield "conv1.weight", (CLIP_WIDTH, 3, PATCH, PATCH)
    yield "proj", (CLIP_WIDTH, TOKEN)
    for each in ("ln_pre", "ln_post"):
        yield from layer(each, CLIP_WIDTH)
    for number in range(CLIP_LAYERS):
        name = f"transformer.resblocks.{number}"
        yield f"{name}.attn.in_proj_weight", (3 * CLIP_WIDTH, CLIP_WIDTH)
        yield f"{name}.attn.in_proj_bias", (3 * CLIP_WIDTH,)
        yield from layer(f"{name}.attn.out_proj", CLIP_WIDTH, CLIP_WIDTH)
        yield from layer(f"{name}.mlp.c_fc", 4 * CLIP_WIDTH, CLIP_WIDTH)
        yield from layer(f"{name}.mlp.c_proj", CLIP_WIDTH, 4 * CLIP_WIDTH)
        for each in ("ln_1", "ln_2"):
            yield from layer(f"{name}.{each}", CLIP_WIDTH)


def state(*, averaged: bool = True) -> dict[str, Tensor]:
    """A checkpoint's `state_dict`; the plain weights of the U-Net are nonsense where there are moving averages."""
    random = torch.Generator().manual_seed(0)
    parts = {
        "model.diffusion_model": unet(),
        "first_stage_model": autoencoder(),
        "cond_stage_model.model.visual": image_tower(),
        "cc_projection": [("weight", (TOKEN, TOKEN + 19)), ("bias", (TOKEN,))],
    }
    made = {f"{part}.{name}": filled(shape, random) for part, shapes in parts.items() for name, shape in shapes}
    if averaged:
        for name in [name for name in made if name.startswith("model.")]:
            made["model_ema." + name.removeprefix("model.").replace(".", "")] = made[name]
            made[name] = torch.full_like(made[name], torch.nan)
    return {**made, "cond_stage_model.model.logit_scale": torch.ones(()), "betas": torch.zeros(1000)}


def filled(shape: tuple[int, ...], random: torch.Generator) -> Tensor:
    """Weights that keep the size of what goes through; about 1 for the scale of a norm, which a bias has, too."""
    values = torch.randn(shape, generator=random)
    return 0.5 + 0.1 * values if len(shape) == 1 else values / math.sqrt(math.prod(shape[1:]))


def write(path: Path, tensors: dict[str, Tensor]) -> Path:
    torch.save({"epoch": 3, "state_dict": tensors, "optimizer_states": []}, path)
    return path


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("weights") / "zeronvs.ckpt", state())


@pytest.fixture(scope="module")
def networks(weights: Path) -> ZeroNvsNetworks:
    return open_zeronvs(str(weights), "cpu", None)


# --- the formulas, straight ------------------------------------------------------------------------------------------


def told_by_hand(source_from_target: Tensor, vfov: float) -> list[float]:
    """OpenGL's y and z run the other way: signs change where one of row and column is such an axis."""
    entries = [[float(value) for value in row] for row in source_from_target]
    for row in range(3):
        for column in range(4):
            turns = (row in (1, 2)) + (column in (1, 2))
            entries[row][column] *= (-1) ** turns
        entries[row][3] = 5 * math.tanh(entries[row][3] / (10 * SCALE))
    return [value for row in entries for value in row] + [vfov, math.sin(vfov), math.cos(vfov)]


def embedded_by_hand(picture: Tensor) -> Tensor:
    """CLIP's image tower in the words of its publication: [3, H, W] -> [D]."""
    w = {name.removeprefix("cond_stage_model.model.visual."): value for name, value in state().items()}
    side = PATCH * math.isqrt(PLACES)
    x = F.interpolate(picture[None], size=(side, side), mode="bicubic", align_corners=True) / 2 + 0.5
    mean, deviation = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)
    x = (x - torch.tensor(mean)[:, None, None]) / torch.tensor(deviation)[:, None, None]
    x = F.conv2d(x, w["conv1.weight"], stride=PATCH).flatten(2)[0].T
    x = torch.cat([w["class_embedding"][None], x]) + w["positional_embedding"]

    def norm(x: Tensor, name: str) -> Tensor:
        return F.layer_norm(x, (CLIP_WIDTH,), w[f"{name}.weight"], w[f"{name}.bias"])

    x = norm(x, "ln_pre")
    for number in range(CLIP_LAYERS):
        name = f"transformer.resblocks.{number}"
        attended, _ = F.multi_head_attention_forward(
            *(norm(x, f"{name}.ln_1")[:, None],) * 3,
            *(CLIP_WIDTH, 1),
            *(w[f"{name}.attn.in_proj_weight"], w[f"{name}.attn.in_proj_bias"], None, None, False, 0.0),
            *(w[f"{name}.attn.out_proj.weight"], w[f"{name}.attn.out_proj.bias"]),
        )
        x = x + attended[:, 0]
        inner = F.linear(norm(x, f"{name}.ln_2"), w[f"{name}.mlp.c_fc.weight"], w[f"{name}.mlp.c_fc.bias"])
        inner = inner * torch.sigmoid(1.702 * inner)
        x = x + F.linear(inner, w[f"{name}.mlp.c_proj.weight"], w[f"{name}.mlp.c_proj.bias"])
    return norm(x[0], "ln_post") @ w["proj"]


@torch.no_grad()
def drawn_by_hand(networks: ZeroNvsNetworks, picture: Tensor, camera: Tensor, noises: list[Tensor]) -> Tensor:
    """DDIM with eta 1 and guidance 3 from its formulas; noises: the first latents, then each step's."""
    kept = torch.cumprod(1 - torch.linspace(0.00085**0.5, 0.012**0.5, 1000, dtype=torch.float64) ** 2, 0)
    projection = state()
    token = projection["cc_projection.weight"] @ torch.cat([embedded_by_hand(picture), camera])
    token = (token + projection["cc_projection.bias"])[None, None]
    seen = networks.vae.encode(picture[None]).latent_dist.mean  # not scaled
    stride = 1000 // STEPS
    x = noises[0].double()
    for t, noise in zip(reversed(range(1, STEPS * stride + 1, stride)), noises[1:], strict=True):
        told, free = (
            networks.unet(torch.cat([x.float(), on * seen], dim=1), t, encoder_hidden_states=on * token).sample.double()
            for on in (1.0, 0.0)
        )
        guided = free + 3 * (told - free)
        now, before = kept[t], kept[max(t - stride, 0)]
        clean = (x - (1 - now).sqrt() * guided) / now.sqrt()
        spread = ((1 - before) / (1 - now) * (1 - now / before)).sqrt()
        x = before.sqrt() * clean + (1 - before - spread**2).sqrt() * guided + spread * noise
    return (networks.vae.decode(x.float() / 0.18215).sample[0] / 2 + 0.5).clamp(0, 1)


def test_camera_numbers_are_those_calculated_by_hand() -> None:
    poses = seen_of(PlaneClips.make(1)[0]).cameras.source_from_target
    found = camera_numbers(poses, 50.0, SCALE)
    assert found.shape == (len(poses), 19)
    assert found[-1].tolist() == pytest.approx(told_by_hand(poses[-1], math.radians(50)), abs=1e-6)
    assert found[0, :16].tolist() == torch.eye(4).flatten().tolist()  # there the target camera is the source's
    assert float(camera_numbers(poses * 1e6, 50.0, SCALE)[:, 3].abs().max()) <= 5.0


def test_a_view_is_the_one_calculated_by_hand(networks: ZeroNvsNetworks) -> None:
    random = torch.Generator().manual_seed(1)
    picture, camera = torch.rand(3, SIZE, SIZE, generator=random) * 2 - 1, torch.randn(19, generator=random)
    steps = torch.Generator().manual_seed(7)
    first = unit_noise((1, 4, SIZE // 8, SIZE // 8), 7)
    noises = [first, *(torch.randn(first.shape, generator=steps) for _ in range(STEPS))]
    made = networks.view(picture, camera, seed=7, steps=STEPS)
    assert float(made.std()) > 0.05
    torch.testing.assert_close(made, drawn_by_hand(networks, picture, camera, noises), atol=1e-4, rtol=0)


def test_each_frame_is_seen_alone_in_its_middle_and_shown_there(networks: ZeroNvsNetworks) -> None:
    clip = seen_of(PlaneClips.make(1, frames=3)[0], key="plane-0")
    method = ZeroNVS(networks=lambda: networks, scale=SCALE, steps=1, size=SIZE, samples=2)
    made = method.predict(clip)
    first, second = (draw.video for draw in made.draws)
    assert made.crop == (8, 0, 32, 32)  # of 48 x 32
    assert first.shape == (3, 3, 32, 32)
    assert not torch.equal(first, second)
    changed = clip.source.copy()
    changed[1] = 255 - changed[1]
    changed[:, :, :8], changed[:, :, -8:] = 0, 0
    other = replace(method, samples=1).predict(replace(clip, source=changed, source_depth=clip.source_depth * 0)).video
    assert [torch.equal(a, b) for a, b in zip(first, other, strict=True)] == [True, False, True]
    assert method.name == "zeronvs (scale 4)"
    for shared in (False, True):
        one, two = (
            replace(method, samples=1, shared_noise=shared).predict(replace(clip, key=key)).video for key in "ab"
        )
        assert torch.equal(one, two) == shared


# --- what is refused, and the search of the scale --------------------------------------------------------------------


def options(path: Path, scale: str = "4", **more: object) -> EvaluateOptions:
    return EvaluateOptions(data=[], device="cpu", zeronvs=str(path), zeronvs_scale=scale, **more)


def plane() -> PairedSet:
    return PairedSet.of(PlaneClips.make(1), "plane")


def without(part: str) -> dict[str, Tensor]:
    return {name: value for name, value in state().items() if not name.startswith(part)}


@pytest.mark.parametrize(
    ("tensors", "words"),
    [
        (without("cc_projection"), "another method"),
        (without("cond_stage_model"), "another method"),
        ({**state(), "cc_projection.weight": torch.zeros(TOKEN, TOKEN + 4)}, "Zero-1-to-3"),
        (without("first_stage_model.decoder.mid.attn_1.q.weight"), "autoencoder"),
        (without("model_ema.diffusion_modelout2bias") | {"model.diffusion_model.out.2.bias": torch.zeros(5)}, "U-Net"),
        (without("cond_stage_model.model.visual.ln_post.bias"), "ln_post.bias"),
        ({"state": torch.zeros(2)}, "another method"),
        (without("cc_projection.weight"), "no matrix"),
    ],
)
def test_files_of_other_methods_and_broken_ones_are_refused(
    tmp_path: Path, tensors: dict[str, Tensor], words: str
) -> None:
    path = write(tmp_path / "other.ckpt", tensors)
    with pytest.raises(CheckpointError, match=words) as caught:
        baselines(["zeronvs"], plane(), options(path))
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_it_is_built_from_its_options_and_says_what_it_is(weights: Path) -> None:
    (method,) = baselines(["zeronvs"], plane(), options(weights, samples=2, seed=3))
    assert isinstance(method, ZeroNVS)
    assert (method.scale, method.samples, method.seed, method.privileged) == (4.0, 2, 3, False)
    told = {"baseline": "zeronvs", "scale": "4", "scale chosen": "as given", "steps": "100", "guidance": "3"}
    assert told.items() <= method.details.items()
    for wrong in ({"scale": "0"}, {"scale": "nan"}, {"scale": None}):
        with pytest.raises(RecipeError):
            baselines(["zeronvs"], plane(), options(weights, **wrong))
    with pytest.raises(RecipeError, match="which --methods does not name"):
        planned(options(weights, methods=["copy_source"]))


def test_the_scale_is_the_best_of_a_run_on_other_clips_of_the_kind(tmp_path: Path) -> None:
    clips = plane()
    told = {"baseline": "zeronvs", "weights": "ab"}
    named = {f"zeronvs (scale {scale})": {**told, "scale": scale} for scale in ("2", "5", "10")}
    keeper = RunKeeper(tmp_path)
    keeper.begin(note(methods=named, kind=clips.kind))
    for (name, _), psnr_db in zip(named.items(), (11.0, 14.0, 13.0), strict=True):
        keeper.keep(record(name, "a", psnr_db=psnr_db))
    keeper.keep(record("zeronvs (scale 10)", "b", psnr_db=90.0))  # no other scale has this clip
    scale, chosen = best_scale(tmp_path, clips, "ab")
    assert (scale, "14.00" in chosen) == (5.0, True)
    for other in (replace(clips, kind="orbit"), replace(clips, identity=note().data_identity)):
        with pytest.raises(RecipeError):
            best_scale(tmp_path, other, "ab")
    with pytest.raises(RecipeError, match="these weights"):
        best_scale(tmp_path, clips, "cd")
    keeper.keep(record("zeronvs (scale 2)", clips.keys[0]))
    with pytest.raises(RecipeError, match="other scenes"):
        best_scale(tmp_path, clips, "ab")
    alone = RunKeeper(tmp_path / "alone")
    alone.begin(msgspec.structs.replace(note(kind=clips.kind), methods=dict(list(named.items())[:1])))
    alone.keep(record("zeronvs (scale 2)", "a"))
    with pytest.raises(RecipeError, match="two scales"):
        best_scale(tmp_path / "alone", clips, "ab")
