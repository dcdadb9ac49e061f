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
from gcd_model.weights.load import read_adapter
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


def test_an_adapter_survives_its_file_and_its_base_is_told_by_its_values_whatever_file_holds_them(
    tmp_path: Path,
) -> None:
    given, path, base = adapter(), tmp_path / "adapter.safetensors", write_svd(tmp_path)
    write_adapter(path, given, overwrite=False)
    again = read_adapter(path)
    assert (again.rank, again.alpha, again.base, again.card) == (given.rank, given.alpha, given.base, given.card)
    assert set(again.tensors) == set(given.tensors)
    assert all(torch.equal(again.tensors[name], tensor) for name, tensor in given.tensors.items())
    convert(base, tmp_path / "ours.safetensors")
    plain = load_synthesizer(base, device="cpu", **HEADS)
    for file in (base, tmp_path / "ours.safetensors"):
        told = HEADS if file is base else {}
        traits = load_synthesizer(file, device="cpu", adapter=path, **told).traits
        assert (traits.name, traits.family, traits.move_time) == ("steered", FAMILIES["kubric90"], 13)
        assert traits.config.camera == "spherical"
        assert traits.sha256_12 != plain.traits.sha256_12


def test_another_base_is_refused_and_an_adapter_is_no_model_and_a_model_no_adapter(tmp_path: Path) -> None:
    path = tmp_path / "adapter.safetensors"
    write_adapter(path, adapter(), overwrite=False)
    for wrong in (
        lambda: adapted(filled(FIXED), adapter(base="f" * 12)),
        lambda: adapted(filled(FIXED, seed=1), adapter()),
        lambda: load(path),
        lambda: read_adapter(write_gcd(tmp_path)),
        lambda: read_adapter(tmp_path / "absent.safetensors"),
    ):
        with pytest.raises(CheckpointError):
            wrong()


@pytest.mark.parametrize(
    ("name", "shape"), [(f"{LAYER}.down", (2, 64)), ("unet.middle.9.query.up", (4, RANK)), ("unet.nothing", (4,))]
)
def test_an_adapter_that_does_not_fit_is_refused(name: str, shape: tuple[int, ...]) -> None:
    given = adapter()
    tensors = {**given.tensors, name: torch.zeros(shape)}
    broken = Adapter(rank=RANK, alpha=ALPHA, base=given.base, card=given.card, tensors=tensors)
    with pytest.raises(CheckpointError):
        adapted(filled(FIXED), broken)


def test_a_model_without_camera_gives_all_but_the_camera_and_from_scratch_autoencoders_and_tower_alone() -> None:
    over, state = carried_over(filled(FIXED), SMALL_GCD), filled(FIXED).state_dict()
    parts = {name.rsplit(".", 1)[0] for name in over.fresh}
    assert parts == {"camera.proj", "unet.embed_camera.0", "unet.embed_camera.2"}
    assert set(over.weights) == set(state)
    assert all(torch.equal(over.weights[name], state[name]) for name in state)
    over = carried_over(filled(), SMALL_GCD, anew=DIFFUSION)
    kept, fresh = ({name.partition(".")[0] for name in names} for names in (over.weights, over.fresh))
    assert kept == {"image_encoder", "target_encoder", "own_condition_encoder", "decoder"}
    assert fresh == {"unet", "camera"}


def test_a_diffusers_folder_starts_the_papers_two_encoders_and_another_architecture_starts_nothing(
    tmp_path: Path,
) -> None:
    over = carried_over(load(write_diffusers(tmp_path / "model")).networks, SMALL_GCD)
    wanted = unshared(filled(shared_vae(SMALL_GCD)).state_dict())
    assert set(over.weights) == set(wanted)
    assert all(torch.equal(over.weights[name], wanted[name]) for name in wanted)
    narrow = msgspec.structs.replace(SMALL_GCD, unet=msgspec.structs.replace(SMALL_GCD.unet, embedding_width=32))
    with pytest.raises(CheckpointError):
        carried_over(filled(), narrow)
