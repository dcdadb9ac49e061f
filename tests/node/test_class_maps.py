"""Class maps from the model to a reader: what is published, for which models, and what a reader makes of it."""

import threading
from pathlib import Path

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
from gcd_client.subscriber import ReceivedView, StatusSubscriber, ViewSubscriber
from gcd_model import DRIVING_CLASSES, Traits
from gcd_node.messages import ontology
from gcd_node.publisher import Publisher
from gcd_node.sockets import PublisherOptions

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


def test_a_class_map_says_what_its_numbers_mean() -> None:
    header = published(painting_traits(), 14).of("cls")[0].header
    assert header.encoding == "class8"
    assert header.range == (0, 12)
    assert header.classes is not None
    assert [each.id for each in header.classes] == list(range(13))
    assert [(each.name, each.colour) for each in header.classes] == [
        (each.name, each.colour) for each in DRIVING_CLASSES
    ]


def test_the_meta_note_holds_the_ontology_too() -> None:
    box = published(painting_traits(), 14)
    meta = next(fields for topic, fields in box.notes if topic == "meta")
    told = box.of("cls")[0].header.classes
    assert told is not None
    assert meta["classes"] == [{"id": each.id, "name": each.name, "colour": each.colour} for each in told]


def test_the_end_of_stream_is_said_for_class_maps_too() -> None:
    box = published(painting_traits())
    assert {message.topic for message in box.ends} == {"view/main/win", "view/main/frm", "view/main/cls"}
    assert {message.header.window_id for message in box.ends} == {1}


@pytest.mark.parametrize("family", ["kubric90", "driving", "svd"])
def test_a_model_without_a_class_head_publishes_none(family: str) -> None:
    box = published(traits(family))
    assert box.of("cls") == []
    assert "view/main/cls" not in {message.topic for message in box.ends}
    assert next(fields for topic, fields in box.notes if topic == "meta")["classes"] == []
    assert ontology(traits(family)) == ()


def test_of_several_samples_the_first_ones_class_map_is_published() -> None:
    box = published(painting_traits(), 14, samples=3)
    drawn = fake_classes(painting_traits(), 3)
    assert drawn is not None
    assert np.array_equal(images(box.of("cls")[0])[..., 0], drawn[0].numpy())
    assert len(box.of("std")) == 1


def test_class_maps_are_never_made_lossy() -> None:
    raw, packed = (published(painting_traits(), 14, encoding=encoding) for encoding in ("rgb8", "jpeg"))
    assert packed.of("win")[0].header.encoding == "jpeg"
    assert packed.of("cls")[0].header.encoding == "class8"
    assert bytes(packed.of("cls")[0].payload) == bytes(raw.of("cls")[0].payload)


def test_a_reader_in_another_thread_gets_map_and_meaning_over_real_sockets(tmp_path: Path) -> None:
    options = PublisherOptions(
        data=f"ipc://{tmp_path}/d", status=f"ipc://{tmp_path}/s", lockstep=True, min_subscribers=1, end_delay_ms=0
    )
    received: list[ReceivedView] = []

    def read() -> None:
        with ViewSubscriber(options.data, "main", "cls", conflate=False) as views:
            received.extend(views)

    with Publisher(options) as publisher:
        reader = threading.Thread(target=read, daemon=True)
        reader.start()
        made_node(fake_config(), FakeSynthesizer(painting_traits()), FakeSource(28, fps=10.0), publisher).run()
        with StatusSubscriber(f"ipc://{tmp_path}/s", ("meta",)) as notes:
            meta = notes.receive(5000)
        reader.join(10)
    drawn = fake_classes(painting_traits(), 1)
    assert drawn is not None
    assert [view.header.window_id for view in received] == [0, 1]
    assert np.array_equal(received[1].images[..., 0], drawn[0].numpy())
    palette = np.array([each.colour for each in DRIVING_CLASSES], np.uint8)
    assert np.array_equal(received[1].colours, palette[drawn[0].numpy()])
    assert meta is not None
    assert [each["name"] for each in meta.fields["classes"]] == [each.name for each in DRIVING_CLASSES]
