"""What training costs: memory of an update of the full model, clips a second, and how much of the device is used.

    python tools/bench_train.py --no-measure     # memory alone, counted from shapes, for any machine
    python tools/bench_train.py --small          # and updates of a small model, timed here

Memory is counted without weights or pictures: the forward pass runs on fake tensors, and whatever the graph keeps for
the way back is alive afterwards. The rest is measured with random weights and pictures, which cost what others do.
"""

import argparse
import json
import time
import weakref
from contextlib import contextmanager
from dataclasses import dataclass
from statistics import median

import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import FlopCounterMode, sdpa_flop_count

from gcd_model.config import SMALL, SVD_14
from gcd_model.networks import empty_networks, random_networks
from gcd_model.unet import Stage, VideoUNet
from gcd_model.weights.card import FAMILIES
from gcd_train.data.batches import encode_frames
from gcd_train.recipe import LoraRecipe, LossRecipe, ModelRecipe, NoiseRecipe, OptimiserRecipe, UNetRecipe
from gcd_train.recipe_data import Budget, ComputeRecipe
from gcd_train.training.distributed import recompute_blocks
from gcd_train.training.objective import Batch, Denoiser, diffusion_loss, drop_streams
from gcd_train.training.optimiser import ParameterGroup, build_optimiser
from gcd_train.training.setup import Conditioner, Draws, Precision
from gcd_train.training.trainable import add_lora, halve_frozen, is_adapted, let_train

KUBRIC_CLIPS = 10_000 * 56  # of the published recipe: iterations times batch
PEAK_FLOPS = {"H100": 989e12, "H200": 989e12, "A100": 312e12, "L40S": 362e12, "L40": 181e12}  # dense bfloat16
LORA_RANK = 32
FLOAT32_MORE = 2  # bytes more than in bfloat16
PASSING = 4  # gradients of a block's largest tensor that are alive at once while it is gone back through
CPU_ATTENTION = torch.ops.aten._scaled_dot_product_flash_attention_for_cpu  # which torch's counter does not know
PLANS = {  # bytes of a parameter's weight, gradient and state, and whether autocast computes with bfloat16 copies
    "Adam, float32 weights": (4, 4, 8, True),
    "8-bit Adam, float32 weights": (4, 4, 2, True),
    "8-bit Adam, bfloat16 weights": (2, 2, 2, False),
    f"LoRA, rank {LORA_RANK}, bfloat16 base": (2, 4, 8, False),
}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--small", action="store_true", help="measure a small model; the full one is for a GPU")
    parser.add_argument("--clips", type=int, default=1, help="of an update")
    parser.add_argument("--updates", type=int, default=10, help="measured ones, after three others")
    parser.add_argument("--eight-bit", action="store_true", help="8-bit Adam (torchao)")
    parser.add_argument("--no-recompute", dest="recompute", action="store_false", help="keep the blocks' insides")
    parser.add_argument("--no-measure", dest="measure", action="store_false", help="only count memory")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    kept = kept_by_update(SVD_14)
    memory = [row(name, kept, cached=cached) for name in PLANS for cached in (False, True)]
    speed = []
    if options.measure:
        config = SMALL if options.small else SVD_14
        flops = 3 * (kept_by_update(config) if options.small else kept).flops // 4
        speed = [measured(config, options, flops, cached=cached) for cached in (True, False)]
    if options.json:
        print(json.dumps({"torch": torch.__version__, "device": device_name(), "memory": memory, "speed": speed}))
        return
    print("One clip's update of the full model, GB, counted from shapes\n")
    show(memory)
    if speed:
        model = "small" if options.small else "full"
        print(f"\n{options.clips} clips an update, {model} model, {flops / 1e12:.3g} TFLOP a clip; {device_name()}\n")
        show(speed)


def show(rows):
    print("| " + " | ".join(rows[0]) + " |\n|" + " --- |" * len(rows[0]))
    for each in rows:
        cells = (f"{value:.3g}" if isinstance(value, float) else str(value) for value in each.values())
        print("| " + " | ".join(cells) + " |")


def device_name():
    return torch.cuda.get_device_name() if torch.cuda.is_available() else f"CPU, {torch.get_num_threads()} threads"


# Memory, counted.


@dataclass
class Kept:
    """Bytes of one clip's update, all in bfloat16. everything: what the graph keeps. blocks: of it, if of the U-Net's
    blocks only the inputs are kept. working: the most that going back through one block takes beside. norms: what
    `working` grows by as norms compute and keep in float32. weights: of the block that has most of them. flops: of
    forward, backward and, again, forward."""

    everything: int
    blocks: int
    working: int
    norms: int
    weights: int
    flops: int


class LiveBytes(TorchDispatchMode):
    """Bytes of all storages made inside that are still alive."""

    def __init__(self):
        super().__init__()
        self.live = self.largest = 0
        self._known = {}

    def leave_out(self, tensors):
        """Do not count these, such as weights, when views of them are made."""
        for tensor in tensors:
            storage = tensor.untyped_storage()
            self._known[storage._cdata] = weakref.ref(storage)

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        made = func(*args, **(kwargs or {}))
        for leaf in tree_leaves(made):
            if isinstance(leaf, Tensor):
                self._watch(leaf)
        return made

    def _watch(self, tensor):
        storage = tensor.untyped_storage()
        key, size = storage._cdata, storage.nbytes()
        if key not in self._known:
            self.live += size
            self.largest = max(self.largest, size)
            self._known[key] = weakref.ref(storage, lambda _: self._gone(key, size))

    def _gone(self, key, size):
        self.live -= size
        del self._known[key]


@dataclass
class Block:
    before: int = 0
    input: int = 0
    kept: int = 0
    largest: int = 0
    norms: int = 0
    weights: int = 0


def kept_by_update(config):
    """Count what one clip's forward pass keeps, in bfloat16, at the config's size."""
    height, width = config.height // config.vae.down_factor, config.width // config.vae.down_factor
    frames, shape = config.frames, config.unet
    with FakeTensorMode(), half_weights():
        unet = VideoUNet(shape, frames).train()
        rows = torch.zeros(frames, shape.latent_channels, height, width)
        condition = torch.zeros(frames, shape.condition_channels, height, width)
        vector = torch.zeros(frames, shape.vector_width)
        camera = torch.zeros(frames, shape.camera_width) if shape.camera_width else None
        tokens = None if shape.context_width is None else torch.zeros(frames, shape.context_width)
        live, blocks = LiveBytes(), []
        live.leave_out(unet.parameters())
        attention = {CPU_ATTENTION: lambda query, key, value, *_, **__: sdpa_flop_count(query, key, value)}
        flops = FlopCounterMode(display=False, custom_mapping=attention)
        with flops, live, watched(unet, live, blocks):
            plan = unet.plan(torch.zeros(1, frames), vector, camera, tokens)
            made = unet(rows, condition, *plan.step(0))
            held = live.live
        del made, plan
    return Kept(
        everything=held,
        blocks=held - sum(block.kept for block in blocks) + sum(block.input for block in blocks),
        working=max(block.kept + PASSING * block.largest for block in blocks),
        norms=max(block.norms for block in blocks),
        weights=max(block.weights for block in blocks),
        flops=4 * flops.get_total_flops(),
    )


@contextmanager
def half_weights():
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.bfloat16)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


@contextmanager
def watched(unet, live, blocks):
    """Fill in `blocks` while the network runs, one for each of its stages."""
    open_blocks = []

    def enter(module, inputs):
        weights = sum(weight.numel() * weight.element_size() for weight in module.parameters())
        size = inputs[0].numel() * inputs[0].element_size()
        open_blocks.append(Block(before=live.live, input=size, weights=weights))
        live.largest = 0

    def leave(*_):
        block = open_blocks.pop()
        block.kept, block.largest = live.live - block.before, live.largest
        blocks.append(block)

    def normed(module, _inputs, made):
        copied = 2 * FLOAT32_MORE * made.numel()  # what came in, in float32
        kept = FLOAT32_MORE * made.numel() if isinstance(module, nn.GroupNorm) else 0  # for the activation after it
        for block in open_blocks:
            block.norms += copied + kept

    stages = [part for part in unet.modules() if isinstance(part, Stage)]
    norms = [part for part in unet.modules() if isinstance(part, nn.GroupNorm | nn.LayerNorm)]
    handles = [part.register_forward_pre_hook(enter) for part in stages]
    handles += [part.register_forward_hook(leave) for part in stages]
    handles += [part.register_forward_hook(normed) for part in norms]
    try:
        yield
    finally:
        for handle in handles:
            handle.remove()


def parameters_of(config):
    """Parameters that are trained (U-Net and camera embedder), those of the frozen encoders, and an adapter's."""
    networks = empty_networks(config)
    frozen = (networks.target_encoder, networks.condition_encoder, networks.image_encoder)
    counts = [
        sum(parameter.numel() for module in modules if module is not None for parameter in module.parameters())
        for modules in ((networks.unet, networks.camera), frozen)
    ]
    recipe = LoraRecipe(rank=LORA_RANK)
    with torch.device("meta"):
        add_lora(networks, recipe, seed=0)
    return *counts, sum(value.numel() for name, value in networks.named_parameters() if is_adapted(name, recipe))


def row(name, kept, *, cached):
    """Memory of one clip's update of the full model, the blocks' inputs kept and their insides recomputed, GB. Not in
    it: the driver's own, workspaces of libraries, fragments of the allocator."""
    weight, gradient, state, copies = PLANS[name]
    parameters, frozen, adapter = parameters_of(SVD_14)
    adapter *= name.startswith("LoRA")
    trained = adapter or parameters
    parts = {
        "encoders": 0.0 if cached else 2 * frozen / 1e9,
        "weights": (weight * parameters + 4 * adapter) / 1e9,
        "gradients": gradient * trained / 1e9,
        "state": state * trained / 1e9,
        "activations": (kept.blocks + kept.working + kept.norms + copies * kept.weights) / 1e9,
    }
    return {"": name + (", latents cached" if cached else ""), **parts, "all": sum(parts.values())}


# Updates, measured.


def measured(config, options, flops, *, cached):
    """Time updates of random clips. cached: the frozen networks have run before the clock starts."""
    frozen = "bfloat16" if torch.cuda.is_available() else "float32"  # CPU kernels are slow in it
    precision = Precision.of(ComputeRecipe(precision="bfloat16", frozen=frozen))
    work, device, rates = Updates(config, options, precision, cached=cached), precision.device, []
    cuda = device.type == "cuda"
    if cuda:
        torch.cuda.reset_peak_memory_stats(device)
    for number in range(3 + options.updates):
        started = clock(device)
        work.update(number)
        if number >= 3:
            rates.append(options.clips / (clock(device) - started))
    most = next((peak for part, peak in PEAK_FLOPS.items() if part in device_name()), None)
    return {
        "": "latents cached" if cached else "encoded each time",
        "clips/s": median(rates),
        "lowest": min(rates),
        "highest": max(rates),
        "arithmetic used": "not known" if most is None else flops * median(rates) / most,
        "peak GB": torch.cuda.max_memory_allocated(device) / 1e9 if cuda else "-",
        "hours for Kubric-4D": KUBRIC_CLIPS / median(rates) / 3600 if cuda and not options.small else "-",
    }


def clock(device):
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


class Updates:
    """Updates as the U-Net stage makes them, on random clips."""

    def __init__(self, config, options, precision, *, cached):
        kind = "adam8bit" if options.eight_bit else "adam"
        self.recipe = UNetRecipe(
            budget=Budget(updates=3 + options.updates),
            optimiser=OptimiserRecipe(kind=kind, rate=2e-5),
            source="pixels",
            noise=NoiseRecipe(),
            loss=LossRecipe(),
        )
        self.precision, self.clips = precision, options.clips
        networks = random_networks(config, seed=0)
        let_train(networks, ModelRecipe(), seed=0)
        if precision.half:
            halve_frozen(networks)
        self.networks = precision.placed(networks)
        self.denoiser = Denoiser(networks.unet, config.prediction, networks.camera)
        if options.recompute:
            recompute_blocks(self.denoiser, 1)
        trained = [parameter for parameter in self.denoiser.parameters() if parameter.requires_grad]
        self.optimiser = build_optimiser([ParameterGroup(parameters=trained)], self.recipe.optimiser)
        self.conditioner = Conditioner(config, self.recipe, precision, FAMILIES["kubric90"])
        self.kept = self.batch(0) if cached else None

    def update(self, number):
        batch, recipe = self.kept or self.batch(number), self.recipe
        self.optimiser.zero_grad(set_to_none=True)
        draws = Draws(1, "bench", number, self.precision.device)
        loss = diffusion_loss(
            self.denoiser,
            batch,
            draws,
            self.precision,
            noise=recipe.noise,
            loss=recipe.loss,
            channel_weights=None,
            step=number,
        )
        loss.total.backward()
        self.optimiser.step()

    def batch(self, number):
        config, draws = self.networks.config, Draws(0, "bench", number, self.precision.device)
        rows = self.clips * config.frames
        source, target = (
            self.precision.frames(draws.normal(rows, 3, config.height, config.width).clamp(-1, 1)) for _ in range(2)
        )
        encoded = encode_frames(self.networks, self.recipe, source, target, draws)
        condition, tokens = drop_streams(encoded.source, encoded.tokens, config.frames, draws, self.recipe)
        return Batch(
            target=encoded.target,
            condition=condition,
            vector=self.conditioner.vector(torch.full((rows,), self.recipe.fps), torch.full((rows,), 100.0)),
            tokens=tokens,
            emphasis=encoded.emphasis,
            frames=config.frames,
            camera=draws.normal(rows, 13),
        )


if __name__ == "__main__":
    main()
