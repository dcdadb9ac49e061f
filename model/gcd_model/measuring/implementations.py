"""The ways of computing a checkpoint that can be measured beside each other."""

from dataclasses import replace
from importlib.util import find_spec
from typing import Literal, get_args

from gcd_model.engine import Engine, TorchEngine
from gcd_model.errors import OptionError
from gcd_model.layers import prepare
from gcd_model.measuring.flops import window_flops
from gcd_model.measuring.published_form import require_published, without_camera
from gcd_model.measuring.report import StageName
from gcd_model.measuring.subject import Work
from gcd_model.networks import Networks, empty_networks
from gcd_model.synthesizer import Synthesizer
from gcd_model.traits import Traits

ImplementationName = Literal[
    "ours",
    "ours on cuda",
    "ours on cuda, float32 decoder",
    "ours, compiled alone",
    "ours, graphs alone",
    "diffusers",
    "diffusers compiled",
]
"""ours: plain torch. ours on cuda: compiled, as CUDA graphs, the decoder in the precision that its check allows; and
what that is made of. diffusers: its own modules on the same tensors, as they are; compiled: the same behind
torch.compile."""

IMPLEMENTATIONS: tuple[ImplementationName, ...] = get_args(ImplementationName)


def is_peer(name: ImplementationName) -> bool:
    """Whether somebody else's modules compute it."""
    return name.startswith("diffusers")


def comparable(synthesizer: Synthesizer, *, bare: bool) -> tuple[Networks, Traits]:
    """The networks that all sides compute, and what they are. bare: as diffusers has them, without the camera.

    Raises OptionError where diffusers has no such networks.
    """
    networks, traits = synthesizer.networks, synthesizer.traits
    if not bare:
        return networks, traits
    networks.eval()  # drops what was derived from the weights: the stripped ones derive their own
    stripped = without_camera(networks)
    require_published(stripped.config)
    return stripped, replace(traits, config=stripped.config)


def engine_named(name: ImplementationName, networks: Networks) -> Engine:
    """An engine for networks of `comparable`, on any device, meta too. Tensors are shared wherever that is possible.

    Raises OptionError where the peer is not installed.
    """
    if is_peer(name):
        return _peer(networks, compiled=name == "diffusers compiled")
    if name != "ours":
        return _cuda(name, networks)
    networks.requires_grad_(False)
    prepare(networks)
    return TorchEngine(networks)


def counted_flops(name: ImplementationName, traits: Traits, work: Work) -> dict[StageName, int]:
    """See `window_flops`; compiling changes nothing in it."""
    plain: ImplementationName = "diffusers" if is_peer(name) else "ours"
    return window_flops(engine_named(plain, empty_networks(traits.diffusion)), traits.diffusion, work)


def _peer(networks: Networks, *, compiled: bool) -> Engine:
    _require_diffusers()
    from gcd_model.measuring.peer_diffusers import DiffusersEngine, compile_modules, diffusers_modules

    modules = diffusers_modules(networks)
    return DiffusersEngine(compile_modules(modules) if compiled else modules)


def _cuda(name: ImplementationName, networks: Networks) -> Engine:
    """With a copy of what it lays out anew, since others use the same networks."""
    from gcd_model.compiled_regions import twin
    from gcd_model.cuda_engine import CudaEngine, CudaOptions

    variants: dict[ImplementationName, CudaOptions] = {
        "ours on cuda, float32 decoder": CudaOptions(decoder="float32"),
        "ours, compiled alone": CudaOptions(graphs=False),
        "ours, graphs alone": CudaOptions(backend=None, channels_last=False, decoder="float32"),
    }
    return CudaEngine(twin(networks), variants.get(name))


def _require_diffusers() -> None:
    missing = [name for name in ("diffusers", "transformers") if find_spec(name) is None]
    if missing:
        raise OptionError(f"--peer diffusers needs {' and '.join(missing)}; pip install diffusers transformers")
