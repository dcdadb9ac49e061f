"""Which camera is opened again after it was lost."""

from msgspec.structs import replace

from gcd_node.config import SourceConfig
from gcd_node.frame import SourceInfo


def same_camera(config: SourceConfig, before: SourceInfo) -> SourceConfig:
    """Settings that open the camera again that was open before.

    An OAK that was taken because it was the only one is asked for by its id from then on: another one, plugged in
    meanwhile, stands elsewhere and has another lens. Everything else is found where it was.
    """
    if config.kind == "oak" and config.device is None:
        return replace(config, device=before.id)
    return config
