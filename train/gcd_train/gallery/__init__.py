"""Views of real videos, for which nobody knows the truth: windows of frames, chosen angles, sheets, a page."""

from gcd_train.gallery.page import write_page
from gcd_train.gallery.real_video import RealVideo, WindowChoice, Windowed, find_videos, read_windows
from gcd_train.gallery.viewed import Viewed, ViewRecipe, view_window, write_viewed

__all__ = [
    "RealVideo",
    "ViewRecipe",
    "Viewed",
    "WindowChoice",
    "Windowed",
    "find_videos",
    "read_windows",
    "view_window",
    "write_page",
    "write_viewed",
]
