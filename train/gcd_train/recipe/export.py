"""What comes out of a run."""

from typing import Literal

import msgspec


class ExportRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Weight files that a run writes at its end, each under the recipe's name.

    layouts: "gcd-node" is our `.safetensors`; "gcd-ckpt" the `.ckpt` of the released code, for the paper's networks
    alone. dtype: what weights are stored in; the `.ckpt` is always float32.
    """

    layouts: tuple[Literal["gcd-node", "gcd-ckpt"], ...] = ("gcd-node",)
    dtype: Literal["float16", "bfloat16", "float32"] = "float16"

    def __post_init__(self) -> None:
        if "gcd-node" not in self.layouts:
            raise ValueError('export.layouts must name "gcd-node", which is what a run is measured with at its end')
