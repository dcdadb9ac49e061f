"""A short name for how a configuration renders."""

import hashlib

import msgspec
from msgspec.structs import replace

from gcd_model import ASSUMED_SOURCE, CameraMount, ModelConfig, Traits
from gcd_node.config import ModelSection, NodeConfig
from gcd_node.model import sampler_in_use
from gcd_node.sources import SourcePose


def config_digest(config: NodeConfig, traits: Traits) -> str:
    """12 hex digits that name how views are rendered from given pictures: not from which camera or recording they
    come, on which device, in which precision or at what pace, nor where they are sent. Seeds follow from it, so that a
    recording of a camera is rendered as the camera was.

    What was left out counts as the value it stands for, wherever the model or its checkpoint decides that; so a default
    changes nothing when it is written out. Two are for the source to decide and count as they are written: `fps` of
    [window], and `hfov_deg` of [source]. `motion_bucket`, where it follows from each path, is the third.

    Args:
        traits: of the model in use.
    """
    source = config.source
    taken = source.resize, source.allow_upscale, source.hfov_deg, _pose(source.pose, traits)
    views = {view_id: view.plain for view_id, view in config.view.items()}
    window = replace(config.window, stride=config.window.stride or traits.config.frames)
    filled = taken, _model(config.model, traits), views, window
    plain = _without_negative_zero(msgspec.to_builtins(filled))
    return hashlib.sha256(msgspec.json.encode(plain, order="deterministic")).hexdigest()[:12]


def _model(section: ModelSection, traits: Traits) -> ModelSection:
    sampling, family = traits.config.sampling, traits.family
    networks = traits.config if isinstance(traits.config, ModelConfig) else None
    tower = None if networks is None else networks.image_encoder
    used = sampler_in_use(section, traits)
    return replace(
        section,
        device="auto",
        threads=None,
        engine=None,
        providers=(),
        dtype=None,
        family=section.family if family is None else family.name,
        quality="exact",
        steps=used.steps,
        solver=used.solver,
        guidance=used.guidance,
        guidance_interval=used.guidance_interval,
        cond_aug=sampling.augmentation if section.cond_aug is None else section.cond_aug,
        move_time=traits.move_time if section.move_time is None else section.move_time,
        motion_bucket=family.motion_bucket if section.motion_bucket is None and family else section.motion_bucket,
        head_width=None if networks is None else networks.unet.head_width,
        image_heads=None if tower is None else tower.heads,
    )


def _pose(pose: SourcePose | None, traits: Traits) -> SourcePose | None:
    """Where the camera stands in the words the model knows; None for a model that has no use for them."""
    stated, mount = pose or SourcePose(), CameraMount()
    if traits.live and stated.on_vehicle:
        return SourcePose(
            height_m=mount.height_m if stated.height_m is None else stated.height_m,
            forward_m=mount.forward_m if stated.forward_m is None else stated.forward_m,
            left_m=mount.left_m if stated.left_m is None else stated.left_m,
            tilt_deg=mount.tilt_deg if stated.tilt_deg is None else stated.tilt_deg,
        )
    if traits.config.camera == "none":
        return None
    return SourcePose(
        elevation_deg=ASSUMED_SOURCE.elevation_deg if stated.elevation_deg is None else stated.elevation_deg,
        radius=ASSUMED_SOURCE.radius_m if stated.radius is None else stated.radius,
    )


def _without_negative_zero(value: object) -> object:
    """-0.0 is written otherwise than 0.0 and means the same."""
    if isinstance(value, dict):
        return {key: _without_negative_zero(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_without_negative_zero(each) for each in value]
    return value + 0.0 if isinstance(value, float) else value
