"""Learning rates, optimisers by name, and the moving average of the weights."""

from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
import torch
from torch import nn

from gcd_train.errors import RecipeError
from gcd_train.recipe import EmaRecipe, OptimiserRecipe
from gcd_train.recipe_data import Budget
from gcd_train.training import optimiser as optimisers
from gcd_train.training.optimiser import Ema, ParameterGroup, build_optimiser, ema_decay, rate_factor, set_rate

SMALL = OptimiserRecipe(rate=1.5e-3, warm_up=50, flat=0.3, final=0.02)
RATE = OptimiserRecipe(rate=0.1, kind="adam")


@pytest.mark.parametrize(
    ("update", "share", "factor"),
    [(0, 0.0, 0.02), (24, 0.01, 0.5), (49, 0.02, 1.0), (500, 0.3, 1.0), (900, 0.65, 0.51), (1000, 1.0, 0.02)],
)
def test_the_rate_warms_up_stays_flat_and_falls(update: int, share: float, factor: float) -> None:
    assert rate_factor(update, share, SMALL) == pytest.approx(factor)


def test_the_papers_rate_is_constant_and_a_cosine_falls_slowly_first_and_last() -> None:
    paper = OptimiserRecipe(kind="adam", rate=2e-5)
    assert {rate_factor(update, update / 13000, paper) for update in (0, 1, 6500, 13000)} == {1.0}
    cosine = OptimiserRecipe(rate=1.0, final=0.0, shape="cosine")
    assert [rate_factor(9, share, cosine) for share in (0.0, 0.5, 1.0)] == pytest.approx([1.0, 0.5, 0.0])
    assert rate_factor(9, 0.1, cosine) > 0.97


def test_a_budget_is_used_by_updates_or_by_minutes() -> None:
    assert Budget(updates=200).share(50, 1e9) == 0.25
    assert Budget(minutes=2).share(10**9, 30.0) == 0.25
    assert Budget(updates=200).share(300, 0.0) == 1.0


# optimisers


def groups(count: int = 3) -> list[ParameterGroup]:
    return [ParameterGroup(parameters=[nn.Parameter(torch.ones(count))])]


@pytest.mark.parametrize(("kind", "wanted"), [("adam", torch.optim.Adam), ("adamw", torch.optim.AdamW)])
def test_torchs_own_optimisers_are_fused(kind: str, wanted: type) -> None:
    made = build_optimiser(groups(), msgspec.structs.replace(RATE, kind=kind))
    assert type(made) is wanted
    assert made.param_groups[0]["fused"] is True


@pytest.mark.parametrize(
    ("kind", "weights", "name"),
    [
        ("adam8bit", "float32", "Adam8bit"),
        ("adamw8bit", "bfloat16", "AdamW8bit"),
        ("adam", "bfloat16", "_AdamW"),
        ("adamw", "bfloat16", "_AdamW"),
    ],
)
def test_8_bit_moments_and_bfloat16_weights_come_from_torchao(
    monkeypatch: pytest.MonkeyPatch, kind: str, weights: Any, name: str
) -> None:
    asked: list[tuple[str, dict[str, Any]]] = []

    def maker(called: str) -> Any:
        return lambda _groups, **named: asked.append((called, named))

    library = SimpleNamespace(**{each: maker(each) for each in ("Adam8bit", "AdamW8bit", "_AdamW")})
    monkeypatch.setattr(optimisers, "import_module", lambda _name: library)
    build_optimiser(groups(), msgspec.structs.replace(RATE, kind=kind), weights)
    ((called, named),) = asked
    rounded = named["bf16_stochastic_round"]
    assert (called, rounded, named["weight_decay"]) == (name, weights == "bfloat16", 0.0)


def test_what_torchao_is_for_is_said_when_it_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ImportError(name)

    monkeypatch.setattr(optimisers, "import_module", missing)
    with pytest.raises(RecipeError, match=r"pip install 'gcd-node\[train\]'"):
        build_optimiser(groups(), msgspec.structs.replace(RATE, kind="adam8bit"))


def test_a_rate_that_is_a_tensor_is_filled() -> None:
    made = build_optimiser(groups(), RATE)
    rate = made.param_groups[0]["lr"] = torch.tensor(0.0)
    set_rate(made, 0, 0.0, RATE)
    assert made.param_groups[0]["lr"] is rate
    assert rate.item() == pytest.approx(0.1)


# the average


@pytest.mark.parametrize(
    ("recipe", "decays"),
    [
        (EmaRecipe(), {0: 0.1, 1: 2 / 11, 90: 0.91, 8990: 0.999, 10**6: 0.999}),  # the published ramp to its limit
        (EmaRecipe(limit=0.998, horizon=0.15), {0: 0.0, 20: 0.75, 100: 15 / 16, 10**6: 0.998}),
    ],
)
def test_the_average_grows_longer_with_the_run(recipe: EmaRecipe, decays: dict[int, float]) -> None:
    assert {update: ema_decay(update, recipe) for update in decays} == pytest.approx(decays)


def module_of(value: float) -> nn.Linear:
    module = nn.Linear(1, 1, bias=False)
    nn.init.constant_(module.weight, value)
    return module


def test_the_average_moves_by_one_minus_the_decay_and_starts_anew_from_the_weights_as_they_are() -> None:
    module = module_of(0.0)
    ema = Ema(module, EmaRecipe())
    nn.init.ones_(module.weight)
    ema.update(1)
    assert ema.state_dict()["weight"].item() == pytest.approx(9 / 11)
    nn.init.constant_(module.weight, 5.0)
    ema.restart()
    assert ema.state_dict()["weight"].item() == 5.0
    ema.update(2)
    assert ema.state_dict()["weight"].item() == 5.0  # of a constant, that constant


def test_the_average_of_bfloat16_weights_is_finer_than_they_are_and_gives_them_back() -> None:
    module = module_of(1.0).bfloat16()
    ema = Ema(module, EmaRecipe(limit=0.999))
    nn.init.constant_(module.weight, 1.5)
    for update in range(1, 4):
        ema.update(10**5 + update)
    average = 1 + 0.5 * (1 - 0.999**3)  # less above 1 than bfloat16 can tell
    with ema.applied():
        assert module.weight.item() == 1.0
    assert module.weight.item() == 1.5
    assert ema.state_dict()["weight"].item() == pytest.approx(average, abs=1e-6)
