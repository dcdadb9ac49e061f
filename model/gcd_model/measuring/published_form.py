"""Networks in the form that others have, too: nothing of ours, no camera. Needs none of the others installed."""

from msgspec.structs import replace

from gcd_model.config import ModelConfig
from gcd_model.errors import OptionError
from gcd_model.networks import Networks, empty_networks


def require_published(config: ModelConfig) -> None:
    """Raises OptionError for what diffusers has no module for."""
    unet = config.unet
    lacks = {
        "camera control": config.camera != "none",
        "switches of ours (patches, x0-prediction)": config.is_ours,
        "a U-Net without image tower": config.image_encoder is None,
        "an embedding that is not four times as wide as the first level": unet.embedding_width != 4 * unet.width,
    }
    found = [what for what, present in lacks.items() if present]
    if found:
        raise OptionError(
            f"diffusers has no module for {', nor for '.join(found)}; measure this model without --peer, or another "
            "one with it: random:full, random:kubric90 or a published checkpoint"
        )


def without_camera(networks: Networks) -> Networks:
    """The same networks, sharing all tensors, without the camera's embedding: diffusers knows none.

    It is a small map of one vector per frame, computed once a window.
    """
    config = networks.config
    if config.camera == "none":
        return networks
    bare = empty_networks(replace(config, camera="none", unet=replace(config.unet, camera_width=0)))
    kept = {
        name: value
        for name, value in networks.state_dict().items()
        if not name.startswith(("camera.", "unet.embed_camera."))
    }
    bare.load_state_dict(kept, strict=True, assign=True)
    return bare
