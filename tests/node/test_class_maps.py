"""Class maps from the model to a reader: what is published, for which models, and what a reader makes of it."""

import numpy as np
import pytest
from fakes import (
    HEIGHT,
    WIDTH,
    Box,
    FakeSource,
    FakeSynthesizer,
    fake_classes,
    fake_config,
    made_node,
    painting_traits,
    traits,
)

from gcd_client.images import images
from gcd_model import Traits
from gcd_node.messages import ontology

pytestmark = pytest.mark.timeout(30)


def published(made: Traits, frames: int = 28, **options: int) -> Box:
    box = Box()
    made_node(fake_config(**options), FakeSynthesizer(made), FakeSource(frames, fps=10.0), box).run()
    return box


def test_every_window_of_a_model_that_makes_class_maps_comes_with_its_own() -> None:
    made = painting_traits()
    box = published(made)
    maps, windows = box.of("cls"), box.of("win")
    assert [each.header.window_id for each in maps] == [0, 1]
    assert images(maps[0]).shape == (14, HEIGHT, WIDTH, 1)
    drawn = fake_classes(made, 1)
    assert drawn is not None
    assert maps[0].header.classes == ontology(made)
    assert np.array_equal(images(maps[0])[..., 0], drawn[0].numpy())
    for drawing, window in zip(maps, windows, strict=True):
        same = ("t_capture_ns", "source_from_view", "view_rev", "intrinsics", "frame_role", "quality", "model")
        assert all(getattr(drawing.header, name) == getattr(window.header, name) for name in same)


def test_the_meta_note_holds_the_ontology_too() -> None:
    box = published(painting_traits(), 14)
    meta = next(fields for topic, fields in box.notes if topic == "meta")
    told = box.of("cls")[0].header.classes
    assert told is not None
    assert meta["classes"] == [{"id": each.id, "name": each.name, "colour": each.colour} for each in told]


@pytest.mark.parametrize("family", ["kubric90", "driving", "svd"])
def test_a_model_without_a_class_head_publishes_none(family: str) -> None:
    box = published(traits(family))
    assert box.of("cls") == []
    assert "view/main/cls" not in {message.topic for message in box.ends}
    assert next(fields for topic, fields in box.notes if topic == "meta")["classes"] == []
    assert ontology(traits(family)) == ()
