"""A student whose decoder leaves out its finest level: what it starts from, what it learns, what is exported."""

import json
from copy import deepcopy
from pathlib import Path

import pytest
import torch
from msgspec.structs import replace
from test_distillation import STAGE, distiller, tiny
from tiny_driving import write_untrained
from tiny_world import FRAMES, HEIGHT, WIDTH, TinyClips

from gcd_model import Clip, RenderOptions, load_synthesizer
from gcd_model.checkpoints import load_weights, save_weights
from gcd_model.config import DRIVING_SMALL
from gcd_model.own_format import Card
from gcd_train.checkpoint import load_state
from gcd_train.datasets.clip_source import to_network
from gcd_train.distillation.distiller import Distiller
from gcd_train.errors import RecipeError
from gcd_train.model_setup import digest_of

DECODER = {**STAGE, "clips": 1, "batch": 2, "run": 2, "finetune_vae": True, "vae_rate": 1.0, "imitate": 1.0}
ALONE: dict[str, object] = {"paired": None, "student": {"coarse": 1}, "decoder": DECODER}


@pytest.fixture(scope="module")
def teacher(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_untrained(tmp_path_factory.mktemp("teacher"))


@pytest.fixture(scope="module")
def run(teacher: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole distillation in which the decoder alone learns."""
    folder = tmp_path_factory.mktemp("coarse")
    distiller(tiny(teacher, **ALONE), folder).run()
    return folder


def made(recipe_distiller: Distiller) -> dict[str, torch.Tensor]:
    """The networks with the coarser decoder, as its training starts."""
    return recipe_distiller._coarser(recipe_distiller._merged()).state_dict()


def test_what_is_left_starts_as_the_teacher_has_it(teacher: Path, tmp_path: Path) -> None:
    given = load_weights(teacher).networks.state_dict()
    start = made(distiller(tiny(teacher, **ALONE), tmp_path))
    assert all(name in given for name in start)
    anew = {name for name, value in start.items() if not torch.equal(value, given[name])}
    layers = {name.removeprefix("decoder.").split(".")[0] for name in anew}
    assert {"conv_out", "mix_frames"} <= layers <= {"conv_out", "mix_frames", "norm_out"}
    assert not start["decoder.conv_out.weight"].any()


def test_the_export_has_the_small_decoder_and_all_else_of_its_teacher(run: Path, teacher: Path) -> None:
    given = load_weights(teacher).networks
    shipped = load_weights(run / "tiny-student.safetensors").networks
    assert (given.config.vae.left_out, shipped.config.vae.left_out) == (0, 1)
    state, before = shipped.state_dict(), given.state_dict()
    others = [name for name in state if not name.startswith(("decoder.", "plane_mix."))]
    assert others
    assert all(torch.equal(state[name], before[name].half()) for name in others)
    learned = load_state(run / "decoder" / "state.pt", "decoder").best
    assert state["decoder.conv_out.weight"].any()
    assert all(torch.equal(state[name], value.half()) for name, value in learned.items() if name in state)
    assert not any(name.startswith("decoder.levels.2.") for name in state)


def test_the_export_renders_views_of_the_same_size(run: Path) -> None:
    synthesizer = load_synthesizer(run / "tiny-student.safetensors")
    features = synthesizer.encode(Clip(video=to_network(TinyClips(1).rgb(0)[0]), fps=10.0))
    view = synthesizer.render(features, [synthesizer.traits.plan_view()], RenderOptions())[0]
    assert view.video.shape[-4:] == (FRAMES, 3, HEIGHT, WIDTH)
    assert view.video.std() > 0.01


def test_it_says_how_far_it_is_from_what_it_imitates(run: Path) -> None:
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    said = [line for line in lines if line["kind"] == "loss" and line["stage"] == "decoder"]
    assert said
    assert all(line["imitated"] > 0 and line["loss"] > line["imitated"] for line in said)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"decoder": None}, "decoder that has to learn"),
        ({"decoder": {**DECODER, "finetune_vae": False, "imitate": 0.0}}, "decoder that has to learn"),
        ({"decoder": {**DECODER, "finetune_vae": False}}, "imitate is for a decoder that learns"),
        ({"student": {"coarse": 0}}, "learns in"),
        ({"student": {"coarse": 1, "train": "lora"}}, "adapter would lie beside"),
        ({"student": {"coarse": 1, "steps": 2}}, "nothing teaches other steps"),
    ],
)
def test_a_coarse_decoder_that_cannot_learn_is_refused(teacher: Path, changes: dict[str, object], said: str) -> None:
    with pytest.raises(RecipeError, match=said):
        tiny(teacher, **{**ALONE, **changes})


def test_a_decoder_without_levels_is_refused(teacher: Path, tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match=r"student.coarse cannot be 3: .* 0 to 2 levels"):
        distiller(tiny(teacher, **{**ALONE, "student": {"coarse": 3}}), tmp_path)


def test_a_teacher_of_several_steps_is_sampled_as_before(tmp_path: Path) -> None:
    loaded = load_weights(write_untrained(tmp_path))
    sampling = replace(loaded.networks.config.sampling, steps=3, guidance=(1.0, 2.0))
    config = replace(loaded.networks.config, sampling=sampling)
    card = Card(name="steps", config=config, family="driving", move_time=FRAMES - 1, trained=False)
    save_weights(loaded.networks, tmp_path / "steps.safetensors", card)
    made_of = distiller(tiny(tmp_path / "steps.safetensors", **ALONE), tmp_path / "run")._merged()
    assert made_of.config.sampling == sampling


def identities(teacher: Path, folder: Path, levels: int = 1) -> tuple[str, str]:
    """What predictions and the decoder's state of a distillation belong to."""
    asked = distiller(tiny(teacher, **{**ALONE, "student": {"coarse": levels}}), folder)
    merged = asked._merged()
    return asked._predictions_identity(merged), asked._decoder_identity(merged)


def test_a_state_belongs_to_what_it_started_from_and_what_it_is_built_as(teacher: Path, tmp_path: Path) -> None:
    loaded = load_weights(teacher)
    networks, config = loaded.networks.float(), loaded.networks.config
    card = Card(name="other", config=config, family="driving", move_time=FRAMES - 1, trained=False)
    first, again = identities(teacher, tmp_path), identities(teacher, tmp_path)
    assert first == again
    coarser = identities(teacher, tmp_path, levels=2)
    assert coarser[0] == first[0]  # predictions are the teacher's own
    assert coarser[1] != first[1]
    for number, part in enumerate(("decoder.conv_out.bias", "plane_mix.choice.bias")):
        changed = deepcopy(networks)
        with torch.no_grad():
            changed.get_parameter(part).add_(0.5)
        save_weights(changed, tmp_path / f"{number}.safetensors", card)
        other = identities(tmp_path / f"{number}.safetensors", tmp_path)
        assert other[1] != first[1]
        assert (other[0] != first[0]) == (number == 0)


def test_states_of_models_without_it_stay_what_they_were() -> None:
    assert digest_of(DRIVING_SMALL.vae, 1) == "6f91de04"  # as before there was a coarser decoder
    assert digest_of(replace(DRIVING_SMALL.vae, coarse=0), 1) == "6f91de04"
    assert digest_of(replace(DRIVING_SMALL.vae, coarse=1), 1) != "6f91de04"
