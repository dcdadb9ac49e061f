"""A robot arm at a table: reach, grasp, lift, carry, place and push, with real contact physics."""

from gcd_train.scenes.tabletop.scene import UNITS_A_METRE, Episode, tabletop_episode, tabletop_scene, upright_base
from gcd_train.scenes.tabletop.simulation import FPS
from gcd_train.scenes.tabletop.things import TabletopClass

__all__ = [
    "FPS",
    "UNITS_A_METRE",
    "Episode",
    "TabletopClass",
    "tabletop_episode",
    "tabletop_scene",
    "upright_base",
]
