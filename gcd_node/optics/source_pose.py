"""Where the source camera stands: on a sphere around the scene, or mounted on a vehicle; which, the model decides."""

from gcd_model import ASSUMED_SOURCE, FAMILIES, CameraMount, OptionError, Spherical, Traits
from gcd_node.config import SourcePose

_MOUNT_TOLERANCE_M, _MOUNT_TOLERANCE_DEG = 0.05, 0.5


def require_usable(pose: SourcePose | None, traits: Traits) -> None:
    """Refuse a pose in words the model does not know, or where it cannot use a camera.

    Raises:
        OptionError: angles for a model that is not steered by them, a mount for one that cannot use it; a camera below
            the ground, for a model that warps by it.
    """
    steered, warps = traits.config.camera != "none", traits.mount is not None
    if pose is None or traits.live:  # that one has a use for either
        return
    if pose.on_vehicle and not warps:
        reason = "is steered by angles" if steered else "sees nothing but the pictures"
        remedy = "; state elevation and radius instead" if steered else "; leave it out"
        raise OptionError(f"{traits.name} {reason} and has no use for a mount (height, forward, left, tilt){remedy}")
    if pose.on_sphere and not steered:
        remedy = "; state the mount instead: height, forward, left, tilt" if warps else "; leave them out"
        raise OptionError(f"{traits.name} is not steered by angles and has no use for elevation and radius{remedy}")
    if pose.on_sphere:
        traits.check_source(stated_sphere(pose) or ASSUMED_SOURCE)


def stated_sphere(pose: SourcePose | None) -> Spherical | None:
    """The camera on the sphere, None if nobody stated it. Raises PoseError."""
    if pose is None or pose.on_vehicle:
        return None
    return Spherical(
        azimuth_deg=0.0,
        elevation_deg=ASSUMED_SOURCE.elevation_deg if pose.elevation_deg is None else pose.elevation_deg,
        radius_m=ASSUMED_SOURCE.radius_m if pose.radius is None else pose.radius,
    )


def stated_mount(pose: SourcePose | None, hfov_deg: float | None, traits: Traits) -> CameraMount | None:
    """The camera on its vehicle, for a model that warps; None if nothing was stated, or for other models. For the live
    model only where a mount was stated: it knows where the ground is then, and does without otherwise.

    hfov_deg: horizontal field of view of the picture the model is given, None if nobody knows.
    Raises:
        OptionError: numbers that no camera has.
    """
    trained = CameraMount(hfov_deg=assumed_hfov_deg(pose)) if traits.live else traits.mount
    if trained is None or (pose is None and hfov_deg is None):
        return None
    if traits.live and (pose is None or not pose.on_vehicle):
        return None
    stated = SourcePose() if pose is None else pose
    return CameraMount(
        height_m=trained.height_m if stated.height_m is None else stated.height_m,
        forward_m=trained.forward_m if stated.forward_m is None else stated.forward_m,
        left_m=trained.left_m if stated.left_m is None else stated.left_m,
        tilt_deg=trained.tilt_deg if stated.tilt_deg is None else stated.tilt_deg,
        hfov_deg=trained.hfov_deg if hfov_deg is None else hfov_deg,
    )


def assumed_hfov_deg(pose: SourcePose | None) -> float:
    """Field of view that the live model takes a camera to have where nobody states one: of the orbits' training for a
    camera on a sphere, else of the vehicle's."""
    orbits = FAMILIES["kubric90"].hfov_deg
    return orbits if pose is not None and pose.on_sphere and orbits is not None else CameraMount().hfov_deg


def is_foreign(mount: CameraMount | None, traits: Traits) -> bool:
    """Whether the camera stands or looks otherwise than in training; its field of view is another matter."""
    trained = traits.mount
    if mount is None or trained is None:
        return False
    away_m = (
        mount.height_m - trained.height_m,
        mount.forward_m - trained.forward_m,
        mount.left_m - trained.left_m,
    )
    turned_deg = abs(mount.tilt_deg - trained.tilt_deg)
    return max(map(abs, away_m)) > _MOUNT_TOLERANCE_M or turned_deg > _MOUNT_TOLERANCE_DEG


def in_words(mount: CameraMount | None, pose: SourcePose | None, traits: Traits) -> str:
    """Where a model that warps by planes, or the live model, takes the source camera to stand, and whether that is
    assumed; empty for other models, whose pictures do not depend on it, and for the live model where nothing is stated.

    mount: as `stated_mount` gives it.
    """
    mount = mount or traits.mount
    if traits.plane_warp is None and not (traits.live and pose is not None):
        return ""
    if mount is not None:
        stated = pose is not None and pose.on_vehicle
        where = f"{mount.height_m:g} m above the ground, {mount.forward_m:g} m ahead, tilted {mount.tilt_deg:g} degrees"
    else:
        stated = pose is not None and pose.on_sphere
        source = stated_sphere(pose) or ASSUMED_SOURCE
        where = f"at an elevation of {source.elevation_deg:g} degrees and a radius of {source.radius_m:g}"
    return f"the source camera {where} ({'stated' if stated else 'assumed: state it in [source.pose]'})"
