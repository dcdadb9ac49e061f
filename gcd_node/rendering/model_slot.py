"""The model a node has loaded. It may be exchanged for a lighter one while the node lives."""

from collections.abc import Callable

from msgspec.structs import replace

from gcd_model import Traits, ViewSynthesizer
from gcd_node.config import ModelSection

LoadModel = Callable[[ModelSection], ViewSynthesizer]
"""Loads the model of a launch file; see session.load_model()."""


class ModelSlot:
    """Holds the model; the only reference to it, so that an exchange gives the memory back first."""

    def __init__(self, section: ModelSection, load: LoadModel) -> None:
        """Load it. Raises as `load`."""
        self._section, self._load = section, load
        self._synthesizer: ViewSynthesizer | None = load(section)
        self._traits = self._synthesizer.traits

    @property
    def synthesizer(self) -> ViewSynthesizer:
        """The model in use; loaded anew if the last exchange did not succeed."""
        if self._synthesizer is None:
            self._synthesizer = self._load(self._section)
            self._traits = self._synthesizer.traits
        return self._synthesizer

    @property
    def traits(self) -> Traits:
        """The model's."""
        return self._traits

    @property
    def can_halve(self) -> bool:
        """Whether bfloat16 weights would be smaller, and the device is one that gains by them."""
        return self._traits.device.startswith("cuda") and self._traits.precision == "float32"

    def halve(self) -> None:
        """Let the model go and load it in bfloat16. Raises as `load`."""
        self._synthesizer = None
        self._section = replace(self._section, dtype="bfloat16")
        self._synthesizer = self._load(self._section)
        self._traits = self._synthesizer.traits
