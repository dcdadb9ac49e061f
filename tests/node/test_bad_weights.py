"""F25: a checkpoint that is not whole is refused whole, and says what it lacks."""

from pathlib import Path

from cameras import Bench
from rig import Rig
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from tiny_weights import write_tiny

from gcd_model import ViewSynthesizer
from gcd_node.config import ModelSection
from gcd_node.session import load_model

WAITING = "life = {autostart = false}"


def test_f25_weights_that_lack_some_are_refused_with_the_first_five_names_and_how_many(tmp_path: Path) -> None:
    whole = write_tiny(tmp_path)
    damaged, tensors = tmp_path / "damaged.safetensors", load_file(whole)
    with safe_open(whole, "pt") as file:
        facts = file.metadata()
    lost = sorted(tensors)[:7]
    save_file({name: tensor for name, tensor in tensors.items() if name not in lost}, damaged, metadata=facts)
    loaded: list[ViewSynthesizer] = []

    def load(_: ModelSection) -> ViewSynthesizer:
        loaded.append(load_model(ModelSection(weights=str(damaged))))
        return loaded[0]

    with Rig(tmp_path, Bench(), load, more=WAITING) as rig:
        rig.ask("configure")
        message = rig.await_event("BAD_ARG")["message"]
        rig.await_state("unconfigured")
    named = [name for name in lost if name in message]
    assert "7 of " in message
    assert len(named) == 5
    assert loaded == []
