"""Named set-ups: the published model, and the small ones that are trained and run on a CPU."""

from gcd_model.config.model import ModelConfig, SemanticClass
from gcd_model.config.networks import ImageEncoderConfig, SamplingConfig, UNetConfig, VAEConfig

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

PLAIN_SMALL = ModelConfig(
    height=128,
    width=192,
    camera="none",
    unet=UNetConfig(
        latent_channels=12,
        condition_channels=12,
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
        steps=4, sigma_max=80.0, sigma_min=0.3, guidance=(1.0, 1.0), shared_noise=True, augmentation=0.0
    ),
    prediction="x0",
)
"""The paper's model at widths that are trained on a CPU in hours: for studies of its findings, and for tests. Ours are
x0-prediction, one noise for all frames and the autoencoder. It takes no camera command: one path."""
