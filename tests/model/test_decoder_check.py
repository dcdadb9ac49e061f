"""When the decoder may compute in bfloat16."""

import pytest
import torch
from small_models import TINY, tiny_synthesizer
from torch import nn

from gcd_model.engines.cuda import CudaEngine, CudaOptions, checked_decoder, twin
from gcd_model.networks import Networks


@pytest.fixture
def networks() -> Networks:
    """Random networks of float32."""
    return tiny_synthesizer().networks


def make_faint(networks: Networks) -> None:
    """Pictures that are nearly grey, so that bfloat16 cannot be far off."""
    with torch.no_grad():
        for layer in (networks.decoder.conv_out, networks.decoder.mix_frames):
            assert isinstance(layer, nn.Conv2d | nn.Conv3d)
            layer.weight.mul_(0.03)
            assert layer.bias is not None
            layer.bias.zero_()


@pytest.mark.parametrize(("faint", "dtype"), [(True, torch.bfloat16), (False, torch.float32)])
def test_the_engine_decodes_in_bfloat16_where_pictures_stay_alike(
    networks: Networks, faint: bool, dtype: torch.dtype
) -> None:
    if faint:
        make_faint(networks)
    assert (checked_decoder(networks)[1] > 50) == faint
    taken = twin(networks)
    engine = CudaEngine(taken, CudaOptions(backend=None, channels_last=False))
    assert taken.decoder.stem.weight.dtype == dtype
    assert networks.decoder.stem.weight.dtype == torch.float32
    assert engine.decode(torch.zeros(TINY.frames, 4, 2, 2)).dtype == torch.float32
