"""Procedural worlds: a description of a scene, the renderer that draws it, the writer that stores it."""
