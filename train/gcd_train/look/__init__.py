"""Scenes and real videos to look at: contact sheets, videos, a page."""
