"""What the live model calls the things it sees: one ontology for streets, stages and tables."""

from gcd_model.config import DRIVING_CLASSES, SemanticClass

LIVE_CLASSES = (
    *DRIVING_CLASSES,
    SemanticClass(name="background", colour=(176, 168, 158)),
    SemanticClass(name="table", colour=(196, 142, 92)),
    SemanticClass(name="robot", colour=(70, 70, 78)),
    SemanticClass(name="object", colour=(238, 92, 120)),
)
"""Ids of class maps: the driving world's thirteen, then what stands around a stage or a table."""
