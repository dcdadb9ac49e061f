import pytest
import torch
from torch import nn

from gcd_train.recipe import EmaRecipe
from gcd_train.training.optimiser import Ema, ema_decay


@pytest.mark.parametrize(("update", "decay"), [(0, 0.1), (1, 2 / 11), (90, 0.91), (8990, 0.999), (10**6, 0.999)])
def test_the_ramp_rises_to_its_limit(update: int, decay: float) -> None:
    assert ema_decay(update, EmaRecipe()) == pytest.approx(decay)


@pytest.mark.parametrize(("update", "decay"), [(0, 0.0), (20, 0.75), (100, 15 / 16), (10**6, 0.998)])
def test_a_horizon_is_a_share_of_the_updates_so_far(update: int, decay: float) -> None:
    assert ema_decay(update, EmaRecipe(limit=0.998, horizon=0.15)) == pytest.approx(decay)


def module_of(value: float) -> nn.Linear:
    module = nn.Linear(1, 1, bias=False)
    nn.init.constant_(module.weight, value)
    return module


def test_the_average_moves_by_one_minus_the_decay() -> None:
    module = module_of(0.0)
    ema = Ema(module, EmaRecipe())
    nn.init.ones_(module.weight)
    ema.update(1)
    assert ema.state_dict()["weight"].item() == pytest.approx(9 / 11)


def test_applying_the_average_gives_the_weights_back() -> None:
    module = module_of(1.0)
    ema = Ema(module, EmaRecipe())
    nn.init.constant_(module.weight, 5.0)
    with ema.applied():
        assert module.weight.item() == 1.0
    assert module.weight.item() == 5.0
    assert ema.state_dict()["weight"].item() == 1.0


def test_the_average_starts_anew_from_the_weights_as_they_are() -> None:
    module = module_of(1.0)
    ema = Ema(module, EmaRecipe())
    nn.init.constant_(module.weight, 5.0)
    ema.restart()
    assert ema.state_dict()["weight"].item() == 5.0


def test_an_average_of_a_constant_is_that_constant() -> None:
    module = module_of(3.0)
    ema = Ema(module, EmaRecipe())
    for update in range(1, 5):
        ema.update(update)
    assert torch.equal(ema.state_dict()["weight"], module.weight)
