"""Adapters beside a base: what they add, which base they stand on, and what is refused."""

from pathlib import Path

import msgspec
import pytest
import torch
from published import (
    HEADS,
    SMALL_GCD,
    convert,
    filled,
    fixed_view,
    load,
    shared_vae,
    write_diffusers,
    write_gcd,
    write_svd,
)
from small_models import draw

from gcd_model.errors import CheckpointError
from gcd_model.loading import load_synthesizer
from gcd_model.weights.adapter import DIFFUSION, Adapter, adapted, base_digest, carried_over, unshared
from gcd_model.weights.card import FAMILIES, Card
from gcd_model.weights.load import load_adapted, read_adapter
from gcd_model.weights.save import write_adapter

LAYER = "unet.middle.0.attention.spatial.attention.query"
RANK, ALPHA = 3, 6.0
FIXED = fixed_view(SMALL_GCD)


def adapter(base: str | None = None) -> Adapter:
    """For a steered model on a base without camera."""
    networks = filled(SMALL_GCD, seed=5)
    camera = {n: v for n, v in networks.state_dict().items() if n.startswith(("camera.", "unet.embed_camera."))}
    width = networks.state_dict()[f"{LAYER}.weight"].shape[0]
    factors = {f"{LAYER}.down": draw(RANK, width, seed=1), f"{LAYER}.up": draw(width, RANK, seed=2)}
    return Adapter(
        rank=RANK,
        alpha=ALPHA,
        base=base or base_digest(filled(FIXED).state_dict()),
        card=Card(name="steered", config=SMALL_GCD, family=FAMILIES["kubric90"], move_time=13),
        tensors=factors | camera,
    )


def test_base_and_adapter_are_the_bases_weights_the_factors_and_the_whole_weights() -> None:
    given, base = adapter(), filled(FIXED).state_dict()
    joined = adapted(filled(FIXED), given)
    assert joined.config == SMALL_GCD
    factors = given.tensors[f"{LAYER}.up"] @ given.tensors[f"{LAYER}.down"]
    for name, value in joined.state_dict().items():
        if name == f"{LAYER}.weight":
            torch.testing.assert_close(value, base[name] + ALPHA / RANK * factors, rtol=1e-6, atol=1e-6)
        else:
            assert torch.equal(value, given.tensors[name] if name in given.tensors else base[name]), name


def test_an_adapter_survives_its_file(tmp_path: Path) -> None:
    given, path = adapter(), tmp_path / "adapter.safetensors"
    write_adapter(path, given, overwrite=False)
    again = read_adapter(path)
    assert (again.rank, again.alpha, again.base, again.card) == (given.rank, given.alpha, given.base, given.card)
    assert set(again.tensors) == set(given.tensors)
    assert all(torch.equal(again.tensors[name], tensor) for name, tensor in given.tensors.items())


def test_the_base_is_told_by_its_values_whatever_file_holds_them(tmp_path: Path) -> None:
    path, given = write_svd(tmp_path), adapter()
    convert(path, tmp_path / "ours.safetensors")
    write_adapter(tmp_path / "adapter.safetensors", given, overwrite=False)
    for base in (path, tmp_path / "ours.safetensors"):
        loaded = load_adapted(load(base), read_adapter(tmp_path / "adapter.safetensors"))
        assert loaded.family is not None
        assert (loaded.name, loaded.family.name, loaded.card.move_time) == ("steered", "kubric90", 13)


def test_a_synthesizer_loads_base_and_adapter_and_its_digest_tells_them_apart(tmp_path: Path) -> None:
    base = write_svd(tmp_path)
    write_adapter(tmp_path / "adapter.safetensors", adapter(), overwrite=False)
    plain = load_synthesizer(base, device="cpu", **HEADS)
    joined = load_synthesizer(base, device="cpu", adapter=tmp_path / "adapter.safetensors", **HEADS)
    assert joined.traits.config.camera == "spherical"
    assert plain.traits.sha256_12 != joined.traits.sha256_12


def test_another_base_is_refused_by_its_digest() -> None:
    with pytest.raises(CheckpointError):
        adapted(filled(FIXED), adapter(base="f" * 12))
    with pytest.raises(CheckpointError):
        adapted(filled(FIXED, seed=1), adapter())


def test_an_adapter_is_no_model_and_a_model_no_adapter(tmp_path: Path) -> None:
    write_adapter(tmp_path / "adapter.safetensors", adapter(), overwrite=False)
    with pytest.raises(CheckpointError):
        load(tmp_path / "adapter.safetensors")
    with pytest.raises(CheckpointError):
        read_adapter(write_gcd(tmp_path))
    with pytest.raises(CheckpointError):
        read_adapter(tmp_path / "absent.safetensors")


@pytest.mark.parametrize(
    ("name", "shape"), [(f"{LAYER}.down", (2, 64)), ("unet.middle.9.query.up", (4, RANK)), ("unet.nothing", (4,))]
)
def test_an_adapter_that_does_not_fit_is_refused(name: str, shape: tuple[int, ...]) -> None:
    given = adapter()
    tensors = {**given.tensors, name: torch.zeros(shape)}
    broken = Adapter(rank=RANK, alpha=ALPHA, base=given.base, card=given.card, tensors=tensors)
    with pytest.raises(CheckpointError):
        adapted(filled(FIXED), broken)


def test_a_model_without_camera_gives_all_but_the_camera() -> None:
    over = carried_over(filled(FIXED), SMALL_GCD)
    assert {name.rsplit(".", 1)[0] for name in over.fresh} == {
        "camera.proj",
        "unet.embed_camera.0",
        "unet.embed_camera.2",
    }
    state = filled(FIXED).state_dict()
    assert set(over.weights) == set(state)
    assert all(over.weights[name] is not None and torch.equal(over.weights[name], state[name]) for name in state)


def test_from_scratch_keeps_autoencoders_and_image_tower_alone() -> None:
    over = carried_over(filled(), SMALL_GCD, anew=DIFFUSION)
    kept = {name.partition(".")[0] for name in over.weights}
    assert kept == {"image_encoder", "target_encoder", "own_condition_encoder", "decoder"}
    assert {name.partition(".")[0] for name in over.fresh} == {"unet", "camera"}


def test_a_diffusers_folder_starts_the_papers_two_encoders(tmp_path: Path) -> None:
    over = carried_over(load(write_diffusers(tmp_path / "model")).networks, SMALL_GCD)
    wanted = unshared(filled(shared_vae(SMALL_GCD)).state_dict())
    assert set(over.weights) == set(wanted)
    assert all(torch.equal(over.weights[name], wanted[name]) for name in wanted)


def test_another_architecture_is_named_by_its_first_weights() -> None:
    narrow = msgspec.structs.replace(SMALL_GCD, unet=msgspec.structs.replace(SMALL_GCD.unet, embedding_width=32))
    with pytest.raises(CheckpointError):
        carried_over(filled(), narrow)
