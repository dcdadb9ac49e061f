"""The drop world: some things lie about, some are thrown among them, sixteen cameras stand around."""

from gcd_train.scenes.drop.things import DropLabel
from gcd_train.scenes.drop.world import FPS, HFOV_DEG, drop_scene, orbit_cameras

__all__ = ["FPS", "HFOV_DEG", "DropLabel", "drop_scene", "orbit_cameras"]
