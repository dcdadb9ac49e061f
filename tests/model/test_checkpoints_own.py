"""Families, and files that are written: our own, and those of the released code; read again they are the same bits."""

import json
import logging
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest
import torch
from published import (
    HEADS,
    SMALL_GCD,
    assert_same_weights,
    convert,
    filled,
    fixed_view,
    inspect,
    load,
    manifest,
    refused,
    write_diffusers,
    write_gcd,
    write_svd,
)
from safetensors.torch import save_file
from small_models import TINY, TINY_DRIVING, draw, random_clip, tiny_synthesizer, tiny_traits
from torch import Tensor

from gcd_model import RenderOptions, SphericalDelta, convert_weights, load_synthesizer
from gcd_model.config import SMALL, SVD_14, ModelConfig
from gcd_model.errors import CheckpointError, OptionError
from gcd_model.networks import Networks, empty_networks, random_networks
from gcd_model.synthesizer import Synthesizer
from gcd_model.weights.adapter import CAMERA
from gcd_model.weights.card import FAMILIES, Card, Family, FamilyName, Hints, told_by_name, told_by_yaml
from gcd_model.weights.infer import LEFTOVERS
from gcd_model.weights.load import digest, load_weights, save_weights
from gcd_model.weights.save import gcd_state, write_published

# --- the family ------------------------------------------------------------------------------------------------------


def test_the_family_follows_option_metadata_name_and_yaml_in_that_order(tmp_path: Path) -> None:
    def told(path: Path, **options: str) -> tuple[Family | None, int]:
        report = inspect(path, **options)
        return report.family, report.move_time

    path = write_gcd(tmp_path, "kubric_direct_max180.ckpt")
    path.with_suffix(".yaml").write_text("move_time: 13\ndelta_azimuth_range: [-90, 90]\n")
    assert told(path) == (FAMILIES["kubric180"], 0)
    assert told(path, family="kubric90") == (FAMILIES["kubric90"], 0)
    other = path.rename(tmp_path / "mine.ckpt")
    other.with_suffix(".yaml").write_text("move_time: 5\ndelta_azimuth_range: [-90, 90]\n")
    assert told(other) == (FAMILIES["kubric90"], 5)
    card = Card(name="small", config=SMALL_GCD, family=FAMILIES["kubric180"], move_time=7)
    save_weights(filled(), tmp_path / "kubric_gradual_max90.safetensors", card)
    assert told(tmp_path / "kubric_gradual_max90.safetensors") == (FAMILIES["kubric180"], 7)


def test_an_unknown_family_is_said_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = write_gcd(tmp_path, "mine.ckpt")
    with caplog.at_level(logging.WARNING):
        traits = load_synthesizer(path, device="cpu", **HEADS).traits
    assert (traits.family, traits.move_time) == (None, 13)
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "--motion-bucket" in caplog.text
    caplog.clear()
    load_synthesizer(path, device="cpu", family="kubric90", **HEADS)
    assert caplog.records == []


def test_what_is_told_against_the_weights_or_cannot_be_is_refused_and_an_early_goal_stays_within_the_frames(
    tmp_path: Path,
) -> None:
    path = write_gcd(tmp_path)
    for told, error in (
        ({"family": "driving"}, CheckpointError),
        ({"family": "svd"}, CheckpointError),
        ({"family": "kubric"}, OptionError),
        ({"frames": 1}, OptionError),
    ):
        with pytest.raises(error):
            inspect(path, **told)
    assert inspect(path, frames=5).move_time == 4


@pytest.mark.parametrize("write", [write_gcd, write_svd, lambda folder: write_diffusers(folder / "m")])
def test_conversion_keeps_every_weight_and_every_fact(tmp_path: Path, write: Callable[[Path], Path]) -> None:
    path = write(tmp_path)
    report = convert(path, tmp_path / "ours.safetensors")
    convert(path, tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == (tmp_path / "ours.safetensors").read_bytes()
    before, after = load(path), load(tmp_path / "ours.safetensors")
    assert_same_weights(after.networks, before.networks)
    assert after.networks.config == before.networks.config
    facts = [(each.card.family, each.card.move_time, each.card.name) for each in (before, after)]
    assert facts[0] == facts[1]
    assert (report.layout, report.leftovers, report.optimizer_size) == ("gcd-node", (), 0)


def test_a_stored_precision_is_kept_unless_asked(tmp_path: Path) -> None:
    report = convert(write_diffusers(tmp_path / "m", half=True), tmp_path / "ours.safetensors")
    assert {network.dtypes for network in report.networks} == {("float16",)}
    report = convert(tmp_path / "ours.safetensors", tmp_path / "wide.safetensors", dtype="float32")
    assert {network.dtypes for network in report.networks} == {("float32",)}


def test_nothing_is_overwritten_unasked_and_nothing_half_written_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, out = write_gcd(tmp_path), tmp_path / "ours.safetensors"
    out.write_bytes(b"precious")
    for wrong in (out, tmp_path / "ours.ckpt", tmp_path / "absent" / "ours.safetensors"):
        with pytest.raises(OptionError):
            convert(source, wrong)
    assert out.read_bytes() == b"precious"

    def half(_state: object, partial: Path, _metadata: object) -> None:
        partial.write_bytes(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr("gcd_model.weights.save.save_file", half)
    with pytest.raises(KeyboardInterrupt):
        convert(source, out, overwrite=True)
    monkeypatch.undo()
    assert out.read_bytes() == b"precious"
    assert sorted(file.name for file in tmp_path.iterdir()) == [source.name, out.name]
    assert convert(source, out, overwrite=True).layout == "gcd-node"


def own_file(tmp_path: Path, **metadata: str) -> Path:
    card = Card(name="small", config=SMALL_GCD, family=FAMILIES["kubric90"], move_time=13).to_metadata()
    path = tmp_path / "ours.safetensors"
    save_file({k: v.contiguous() for k, v in filled().state_dict().items()}, path, metadata=card | metadata)
    return path


def tampered(**changes: object) -> str:
    fields = msgspec.to_builtins(SMALL_GCD)
    return json.dumps(fields | changes)


@pytest.mark.parametrize(
    "metadata",
    [
        {"gcd.format": "2"},
        {"gcd.config": "{"},
        {"gcd.config": tampered(shiny=1)},
        {"gcd.config": tampered(camera="none")},
        {"gcd.move_time": "soon"},
        *({"gcd.uncertainty_scale": scale} for scale in ("much", "0", "nan")),
    ],
)
def test_damaged_metadata_is_refused(tmp_path: Path, metadata: dict[str, str]) -> None:
    assert refused(own_file(tmp_path, **metadata))


def test_a_config_out_of_proportion_is_refused(tmp_path: Path) -> None:
    for blocks, said in ((10**9, "`int` <= 256"), (32, "weights are missing")):
        unet = msgspec.to_builtins(SMALL_GCD.unet) | {"blocks_per_level": blocks}
        assert said in refused(own_file(tmp_path, **{"gcd.config": tampered(unet=unet)}))


def test_a_large_file_is_digested_by_samples(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gcd_model.weights.load._SAMPLED_ABOVE", 1 << 20)
    path = tmp_path / "a"
    content = bytearray(8 << 20)
    path.write_bytes(content)
    sampled, full = digest((path,)), digest((path,), full=True)
    assert sampled != full
    for at in (0, (8 << 20) - 1, 4 << 20):
        path.write_bytes(content[:at] + b"\x01" + content[at + 1 :])
        assert digest((path,)) != sampled
    path.write_bytes(content + b"\x00")
    assert digest((path,)) != sampled


@pytest.mark.parametrize(
    ("names", "family", "move_time", "frames"),
    [
        (["kubric_gradual_max90", "kubric_gradual_max90_bf16", "my-KUBRIC_gradual_max90"], "kubric90", 13, None),
        (["kubric_direct_max90"], "kubric90", 0, None),
        (["kubric_gradual_max180"], "kubric180", 13, None),
        (["kubric_direct_max180"], "kubric180", 0, None),
        (["pardom_gradual_rgb"], "driving", 13, None),
        (["pardom_direct_rgb"], "driving", 0, None),
        (["pardom_gradual_semantic"], "driving-semantic", 13, None),
        (["pardom_direct_semantic", "pardom_direct_semantic_bf16"], "driving-semantic", 0, None),
        (["svd", "stable-video-diffusion-img2vid"], "svd", None, None),
        (["svd_xt", "stable-video-diffusion-img2vid-xt"], "svd", None, 25),
        (["", "last", "my_svd_finetune", "kubric_gradual_max900", "kubric_gradual", "svd2"], None, None, None),
    ],
)
def test_published_names_tell_family_move_time_and_frames_and_others_nothing(
    names: list[str], family: FamilyName | None, move_time: int | None, frames: int | None
) -> None:
    wanted = Hints(family=family and FAMILIES[family], move_time=move_time, frames=frames)
    assert [told_by_name(name) for name in names] == [wanted] * len(names)


YAML = """
data:
  params:
    # azimuth_range: [-180.0, 180.0]
    azimuth_range: [0.0, 360.0]
    elevation_range: [0.0, 50.0]
    {azimuth}
    {elevation}
    trajectory: interpol_linear
    move_time: {move_time}  # frames
"""
INLINE = ("delta_azimuth_range: [-{0}, {0}]", "delta_elevation_range: [ -{0}.0 , {0}.0 ]")
BLOCK = ("delta_azimuth_range:\n    - -{0}\n    - {0}", "delta_elevation_range:\n      - -{0}.0\n      - {0}.0")


DRIVING = "input_mode: ego_forward\noutput_mode: topdown1\nmove_time: 13\noutput_modality: {}\n"
KUBRIC90, KUBRIC180 = (Hints(family=FAMILIES[f"kubric{angle}"], move_time=13) for angle in (90, 180))


def ranges(style: tuple[str, str], azimuth: int, elevation: int) -> str:
    return YAML.format(azimuth=style[0].format(azimuth), elevation=style[1].format(elevation), move_time=13)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (ranges(INLINE, 90, 30), KUBRIC90),
        (ranges(BLOCK, 90, 30), KUBRIC90),
        (ranges(INLINE, 180, 60), KUBRIC180),
        (ranges(BLOCK, 180, 60), KUBRIC180),
        (ranges(INLINE, 90, 60), Hints(move_time=13)),  # they contradict each other
        (ranges(INLINE, 45, 30), Hints(move_time=13)),  # of no family
        (DRIVING.format("rgb"), Hints(family=FAMILIES["driving"], move_time=13)),
        (DRIVING.format("segm"), Hints(family=FAMILIES["driving-semantic"], move_time=13)),
        (DRIVING.format("'segm'"), Hints(family=FAMILIES["driving-semantic"], move_time=13)),
        *((text, Hints()) for text in ("", "move_time: soon", "azimuth: [1, 2", "\x00\xff", "a: " + "-" * 200_000)),
        (" " * 200_000, Hints()),
    ],
)
def test_angle_ranges_or_driving_views_of_a_yaml_tell_the_family_and_others_nothing(text: str, told: Hints) -> None:
    assert told_by_yaml(text) == told


def test_each_fact_comes_from_the_first_that_knows_it() -> None:
    named, option = Hints(family=FAMILIES["kubric180"], move_time=0), Hints(family=FAMILIES["kubric90"])
    assert Hints().over(named, Hints(family=FAMILIES["kubric90"], move_time=13)) == named
    assert option.over(named) == Hints(family=FAMILIES["kubric90"], move_time=0)


CARD = Card(name="small", config=TINY, family=FAMILIES["kubric90"], move_time=2, uncertainty_scale=1.75)


def test_the_uncertainty_scale_comes_with_the_weights_and_converting_keeps_or_replaces_it(
    tmp_path: Path,
) -> None:
    file = tmp_path / "small.safetensors"
    save_weights(random_networks(TINY, seed=0), file, CARD)
    assert load_weights(file).card.uncertainty_scale == 1.75
    assert load_synthesizer(file, device="cpu").traits.uncertainty_scale == 1.75
    kept = convert_weights(file, tmp_path / "kept.safetensors", dtype="float16")
    given = convert_weights(file, tmp_path / "given.safetensors", uncertainty_scale=3.0)
    assert (kept.uncertainty_scale, given.uncertainty_scale) == (1.75, 3.0)
    assert_same_weights(load_weights(tmp_path / "given.safetensors").networks, load_weights(file).networks)
    for scale in (0.0, float("nan")):
        with pytest.raises(OptionError):
            convert_weights(file, tmp_path / "bad.safetensors", uncertainty_scale=scale)
    assert not (tmp_path / "bad.safetensors").exists()


def test_views_carry_the_scale_of_their_weights() -> None:
    plain = tiny_synthesizer()
    measured = Synthesizer(plain.networks, replace(tiny_traits(), uncertainty_scale=2.5))
    trajectory, options = plain.traits.plan_view(SphericalDelta(azimuth_deg=20.0)), RenderOptions(samples=2, steps=1)
    (view,) = measured.render(measured.encode(random_clip()), [trajectory], options)
    (other,) = plain.render(plain.encode(random_clip()), [trajectory], options)
    assert view.std is not None
    assert view.uncertainty is not None
    assert torch.equal(view.samples, other.samples)
    assert torch.equal(view.uncertainty, 2.5 * view.std)
    assert other.uncertainty is None
    assert replace(view, samples=view.samples[:1]).uncertainty is None


# --- the .ckpt of the released code -----------------------------------------------------------------------------------


NARROW_HEADS = msgspec.structs.replace(SMALL_GCD, unet=msgspec.structs.replace(SMALL_GCD.unet, head_width=32))


def card(config: ModelConfig, family: str = "kubric90") -> Card:
    return Card(name="mine", config=config, family=FAMILIES[family], move_time=min(7, config.frames - 1))


def written(path: Path, networks: Networks, family: str = "kubric90", overwrite: bool = False) -> Path:
    weights = networks.state_dict()
    write_published(path, weights, card(networks.config, family), carried={}, updates=10, overwrite=overwrite)
    return path


def state_of(path: Path) -> dict[str, Tensor]:
    """As whoever does not know us reads it: tensors and plain containers alone."""
    return torch.load(path, map_location="cpu", weights_only=True)["state_dict"]


def shapes(state: dict[str, Tensor]) -> dict[str, tuple[int, ...]]:
    return {name: tuple(tensor.shape) for name, tensor in state.items()}


def test_names_and_shapes_at_full_size_are_those_of_the_released_file_and_of_the_base_model() -> None:
    weights = empty_networks(SVD_14).state_dict()
    fixed = {name: value for name, value in weights.items() if not name.startswith(CAMERA)}
    for kind, given, config in (("gcd_ckpt", weights, SVD_14), ("svd_safetensors", fixed, fixed_view(SVD_14))):
        released = manifest(kind)
        ours = shapes(gcd_state(given, config, {}))
        leftovers = {name: torch.empty(shape, device="meta") for name, shape in released.items() if name not in ours}
        assert all(any(re.fullmatch(each, name) for each in LEFTOVERS.values()) for name in leftovers)
        assert shapes(gcd_state(given, config, leftovers)) == released


@pytest.mark.parametrize("config", [SMALL_GCD, fixed_view(SMALL_GCD)], ids=["steered", "fixed view"])
def test_what_is_written_is_a_lightning_checkpoint_and_read_again_the_same_bit_for_bit(
    tmp_path: Path, config: ModelConfig
) -> None:
    family = "driving" if config.camera == "none" else "kubric90"
    path = written(tmp_path / "mine.ckpt", filled(config), family)
    loaded, root = load(path), torch.load(path, map_location="cpu", weights_only=True)
    assert_same_weights(loaded.networks, filled(config))
    assert loaded.card == replace(card(config, family), origin=loaded.card.origin)
    assert loaded.layout == "gcd-ckpt"
    assert {"epoch", "pytorch-lightning_version", "state_dict", "hyper_parameters"} <= set(root)
    assert (root["global_step"], root["optimizer_states"]) == (10, [])


def test_leftovers_of_the_file_it_came_from_are_carried_over(tmp_path: Path) -> None:
    source = write_gcd(tmp_path)
    loaded = load(source)
    assert "lpips.lin0.model.1.weight" in loaded.carried
    assert not any(name.startswith("model_ema.") for name in loaded.carried)
    convert(source, tmp_path / "again.ckpt", layout="gcd-ckpt")
    state = state_of(tmp_path / "again.ckpt")
    for name, tensor in loaded.carried.items():
        assert torch.equal(state[name], tensor), name
    assert_same_weights(load(tmp_path / "again.ckpt").networks, filled())


def test_the_base_model_converts_too_and_half_precision_spares_the_decoder(tmp_path: Path) -> None:
    report = convert(write_svd(tmp_path), tmp_path / "half.ckpt", layout="gcd-ckpt", dtype="float16")
    assert (report.layout, report.family) == ("gcd-ckpt", FAMILIES["svd"])
    precisions = {network.name: network.dtypes for network in report.networks}
    assert precisions["unet"] == ("float16",)
    assert precisions["decoder"] == ("float32",)


def test_one_encoder_for_all_frames_becomes_two_that_compute_the_same(tmp_path: Path) -> None:
    folder = write_diffusers(tmp_path / "model")
    convert(folder, tmp_path / "two.ckpt", layout="gcd-ckpt")
    one, two = load(folder).networks, load(tmp_path / "two.ckpt").networks
    assert two.config == fixed_view(SMALL_GCD)
    frames = draw(2, 3, 32, 32)
    with torch.no_grad():
        wanted = one.condition_encoder(frames)
        for encoder in (two.target_encoder, two.condition_encoder):
            torch.testing.assert_close(encoder(frames).mean, wanted.mean, rtol=1e-5, atol=1e-5)
            torch.testing.assert_close(encoder(frames).log_variance, wanted.log_variance, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("config", [TINY_DRIVING, SMALL, NARROW_HEADS], ids=["driving", "small", "narrow heads"])
def test_networks_the_released_code_could_not_build_are_refused(tmp_path: Path, config: ModelConfig) -> None:
    with pytest.raises(OptionError):
        written(tmp_path / "mine.ckpt", Networks(config))
    assert list(tmp_path.iterdir()) == []


def test_a_note_that_lies_about_the_networks_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "mine.ckpt", filled())
    root = torch.load(path, weights_only=True)
    root["hyper_parameters"]["gcd_node"] |= {
        "gcd.config": msgspec.json.encode(TINY_DRIVING).decode(),
        "gcd.family": "",
        "gcd.move_time": "2",
    }
    torch.save(root, path)
    with pytest.raises(CheckpointError):
        load_weights(path)


def test_tensors_that_share_storage_are_written_alone(tmp_path: Path) -> None:
    networks = Networks(SMALL_GCD)
    weights, name = networks.state_dict(), "unet.conv_out.bias"
    bias = weights[name]
    weights[name] = torch.zeros(1_000_000)[: bias.numel()]
    write_published(tmp_path / "mine.ckpt", weights, card(SMALL_GCD), carried={})
    state = state_of(tmp_path / "mine.ckpt")
    assert state["model.diffusion_model.out.2.bias"].untyped_storage().nbytes() == bias.nbytes
