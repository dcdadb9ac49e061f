import pytest

from gcd_train.recipe import OptimiserRecipe
from gcd_train.recipe_data import Budget
from gcd_train.training.optimiser import rate_factor

SMALL = OptimiserRecipe(rate=1.5e-3, warm_up=50, flat=0.3, final=0.02)


@pytest.mark.parametrize(
    ("update", "share", "factor"),
    [(0, 0.0, 0.02), (24, 0.01, 0.5), (49, 0.02, 1.0), (500, 0.3, 1.0), (900, 0.65, 0.51), (1000, 1.0, 0.02)],
)
def test_the_rate_warms_up_stays_flat_and_falls(update: int, share: float, factor: float) -> None:
    assert rate_factor(update, share, SMALL) == pytest.approx(factor)


def test_the_papers_rate_is_constant() -> None:
    paper = OptimiserRecipe(kind="adam", rate=2e-5)
    assert {rate_factor(update, update / 13000, paper) for update in (0, 1, 6500, 13000)} == {1.0}


def test_a_cosine_falls_slowly_first_and_last() -> None:
    recipe = OptimiserRecipe(rate=1.0, final=0.0, shape="cosine")
    assert [rate_factor(9, share, recipe) for share in (0.0, 0.5, 1.0)] == pytest.approx([1.0, 0.5, 0.0])
    assert rate_factor(9, 0.1, recipe) > 0.97


def test_a_budget_is_used_by_updates_or_by_minutes() -> None:
    assert Budget(updates=200).share(50, 1e9) == 0.25
    assert Budget(minutes=2).share(10**9, 30.0) == 0.25
    assert Budget(updates=200).share(300, 0.0) == 1.0
