"""How weights are updated and averaged."""

from typing import Annotated, Literal, TypeAlias

import msgspec
from msgspec import Meta

from gcd_train.recipe.values import NotNegative, Positive, Share

OptimiserKind: TypeAlias = Literal["adam", "adamw", "adam8bit", "adamw8bit"]


class OptimiserRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The optimiser and its learning rate.

    warm_up: updates from 0 to `rate`. flat: share of the budget at `rate`; then down to `final` times the rate.
    clip: largest norm of the whole gradient, left out for none.
    kind: "adam8bit" and "adamw8bit" keep their moments in 8 bits (torchao). Adam adds the weight decay to the gradient,
    AdamW takes it off the weights; published is Adam with none.
    """

    kind: OptimiserKind = "adamw"
    rate: Positive
    betas: tuple[Share, Share] = (0.9, 0.999)
    weight_decay: NotNegative = 0.0
    warm_up: Annotated[int, Meta(ge=0)] = 0
    flat: Share = 0.0
    final: Share = 1.0
    shape: Literal["linear", "cosine"] = "linear"
    clip: Positive | None = None


class EmaRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The average of the weights that is measured and exported. See `ema_decay`.

    limit: largest decay. horizon: length of the average as a share of the updates so far; left out, the ramp
    (1 + k) / (10 + k).
    """

    limit: Share = 0.999
    horizon: Positive | None = None
