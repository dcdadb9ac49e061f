"""Named set-ups: the published model, and the small ones that are trained and run on a CPU."""

from msgspec.structs import replace

from gcd_model.config.model import ModelConfig
from gcd_model.config.networks import ImageEncoderConfig, SamplingConfig, UNetConfig, VAEConfig
from gcd_model.config.switches import ClassHeadConfig, PlaneMixConfig, PlaneWarpConfig, SemanticClass, warp_channels

SVD_14 = ModelConfig()
"""Stable Video Diffusion, 14 frames, as Generative Camera Dolly finetunes it on Kubric-4D."""

SMALL = ModelConfig(
    height=128,
    width=192,
    unet=UNetConfig(
        width=32,
        multipliers=(1, 2, 3),
        attention=(False, True, True),
        blocks_per_level=1,
        embedding_width=128,
        head_width=32,
        context_width=64,
        vector_width=96,
        camera_width=32,
        norm_groups=8,
    ),
    vae=VAEConfig(width=16, multipliers=(1, 2, 3, 3), blocks_per_level=1, norm_groups=8),
    image_encoder=ImageEncoderConfig(
        image_size=56, patch=14, width=64, layers=2, heads=2, hidden_width=128, output_width=64
    ),
    sampling=SamplingConfig(steps=2),
)
"""The same model at widths a CPU runs in a second: for `random:FAMILY`, and for tests."""

DRIVING_CLASSES = (
    SemanticClass(name="sky", colour=(122, 176, 230)),
    SemanticClass(name="road", colour=(92, 88, 104)),
    SemanticClass(name="lane_marking", colour=(246, 240, 196)),
    SemanticClass(name="pavement", colour=(214, 140, 190)),
    SemanticClass(name="terrain", colour=(150, 196, 104)),
    SemanticClass(name="building", colour=(156, 110, 84)),
    SemanticClass(name="vegetation", colour=(36, 112, 62)),
    SemanticClass(name="pole", colour=(232, 196, 40)),
    SemanticClass(name="car", colour=(38, 76, 214)),
    SemanticClass(name="truck", colour=(16, 186, 196)),
    SemanticClass(name="cyclist", colour=(158, 40, 150)),
    SemanticClass(name="person", colour=(226, 44, 52)),
    SemanticClass(name="own_car", colour=(255, 128, 16)),
)
"""Ontology of our procedural driving world, by id."""

DRIVING_SMALL = ModelConfig(
    height=128,
    width=192,
    camera="none",
    unet=UNetConfig(
        latent_channels=12,
        condition_channels=12 + warp_channels(PlaneWarpConfig(), 8),
        width=48,
        multipliers=(1, 2, 3),
        attention=(False, False, True),
        blocks_per_level=1,
        embedding_width=192,
        head_width=48,
        context_width=None,
        vector_width=96,
        camera_width=0,
        norm_groups=8,
    ),
    vae=VAEConfig(
        latent_channels=12,
        width=32,
        multipliers=(1, 2, 3),
        blocks_per_level=1,
        norm_groups=8,
        scale=1.0,
        shared=True,
        patch=2,
        linear=True,
    ),
    image_encoder=None,
    sampling=SamplingConfig(
        steps=1, sigma_max=80.0, sigma_min=0.6, guidance=(1.0, 1.0), shared_noise=True, augmentation=0.0
    ),
    prediction="x0",
    plane_warp=PlaneWarpConfig(),
    plane_mix=PlaneMixConfig(),
    class_head=ClassHeadConfig(classes=DRIVING_CLASSES),
)
"""A top-down view of the road at widths that are trained on a CPU in hours; with all switches that are ours."""

DRIVING_SEMANTIC_SMALL = replace(
    DRIVING_SMALL,
    plane_mix=None,
    class_head=None,
    semantic_classes=DRIVING_CLASSES,
    sampling=SamplingConfig(
        steps=4, sigma_max=80.0, sigma_min=0.3, guidance=(1.0, 1.0), shared_noise=True, augmentation=0.0
    ),
)
"""The same view painted in class colours, as the paper's semantic models paint it; in several steps, so that edges
come out sharp. Without the plane mix: the source's own colours have no place in such a picture."""

PLAIN_SMALL = replace(
    DRIVING_SMALL,
    unet=replace(DRIVING_SMALL.unet, condition_channels=DRIVING_SMALL.vae.latent_channels),
    plane_warp=None,
    plane_mix=None,
    class_head=None,
    sampling=SamplingConfig(
        steps=4, sigma_max=80.0, sigma_min=0.3, guidance=(1.0, 1.0), shared_noise=True, augmentation=0.0
    ),
)
"""The widths of DRIVING_SMALL in the paper's form: the source's latents are all the condition, and several Euler steps
draw the view; no warps, no plane mix, no class map. For studies of the paper's findings. What is left of ours is
x0-prediction, one noise for all frames and the autoencoder."""

_STAGE = PlaneWarpConfig(frame="stage", hfov_deg=53.13)

OBJECTS_SMALL = replace(
    DRIVING_SMALL,
    camera="spherical",
    unet=replace(DRIVING_SMALL.unet, condition_channels=12 + warp_channels(_STAGE, 8), camera_width=96),
    plane_warp=_STAGE,
    class_head=None,
)
"""Orbits about a heap of objects, steered by angles and radius; widths and switches of DRIVING_SMALL, no class map."""
