"""How a launch file wants views drawn, in the model's words."""

from gcd_model import RenderOptions, Sampler, Traits, sampler_of
from gcd_node.config import ModelSection


def drawing_options(section: ModelSection) -> RenderOptions:
    """What [model] says of drawing; without a seed, which is the window's."""
    return RenderOptions(
        quality=section.quality,
        steps=section.steps,
        solver=section.solver,
        guidance=section.guidance,
        guidance_interval=section.guidance_interval,
        samples=section.samples,
        motion_bucket=section.motion_bucket,
    )


def sampler_in_use(section: ModelSection, traits: Traits) -> Sampler:
    """The same in full: what [model] leaves out as quality and checkpoint have it."""
    return sampler_of(traits.config.sampling, drawing_options(section))
