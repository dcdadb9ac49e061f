"""The CLIP image tower: its pixels, and its tokens against transformers."""

import kornia
import pytest
import torch
from naming import diffusers_state
from small_models import draw, randomise, relative_error
from torch.testing import assert_close
from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection

from gcd_model.conditioning import ImageEncoder, clip_pixels
from gcd_model.config import ImageEncoderConfig

TOWER = ImageEncoderConfig(image_size=28, patch=7, width=32, layers=3, heads=4, hidden_width=64, output_width=24)


def test_the_image_token_equals_transformers() -> None:
    ours = ImageEncoder(TOWER)
    randomise(ours)
    theirs = CLIPVisionModelWithProjection(
        CLIPVisionConfig(
            image_size=TOWER.image_size,
            patch_size=TOWER.patch,
            hidden_size=TOWER.width,
            intermediate_size=TOWER.hidden_width,
            num_hidden_layers=TOWER.layers,
            num_attention_heads=TOWER.heads,
            projection_dim=TOWER.output_width,
            hidden_act="gelu",
        )
    ).eval()
    theirs.load_state_dict(diffusers_state(ours, "image_encoder", "image_encoder/"))
    pixels = draw(3, 3, 28, 28)
    with torch.inference_mode():
        expected, result = theirs(pixels).image_embeds, ours(pixels)
    assert result.shape == (3, 24)
    assert relative_error(result, expected) < 1e-5


@pytest.mark.parametrize(("height", "width"), [(64, 96), (300, 200), (224, 224), (30, 400)])
def test_pixels_are_squeezed_by_kornias_antialiased_bicubic_before_the_range_changes(height: int, width: int) -> None:
    frames = draw(2, 3, height, width).clamp(-1, 1)
    squeezed = kornia.geometry.resize(frames, (224, 224), interpolation="bicubic", align_corners=True, antialias=True)
    mean = torch.tensor([0.48145466, 0.4578275, 0.40821073]).reshape(3, 1, 1)
    deviation = torch.tensor([0.26862954, 0.26130258, 0.27577711]).reshape(3, 1, 1)
    assert_close(clip_pixels(frames, 224), ((squeezed + 1) / 2 - mean) / deviation)
