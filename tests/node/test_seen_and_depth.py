"""Visibility, depth and a stated spread, from the view that holds them to a reader: what is published, and when."""

import threading
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from fakes import Box, FakeSource, FakeSynthesizer, fake_config, fake_maps, made_node, painting_traits, traits

from gcd_client.images import depth_m, images, inverse_depth
from gcd_client.subscriber import ReceivedView, ViewSubscriber
from gcd_node.config import PublishConfig
from gcd_node.publisher import Publisher

pytestmark = pytest.mark.timeout(30)
HELD = ("visibility", "inverse_depth")


def published(*holds: str, frames: int = 28, **options: int | str) -> Box:
    box = Box()
    made_node(
        fake_config(**options), FakeSynthesizer(painting_traits(), holds=holds), FakeSource(frames, fps=10.0), box
    ).run()
    return box


def test_every_window_of_a_view_that_holds_them_comes_with_its_own() -> None:
    box = published(*HELD)
    order = [message.topic.rpartition("/")[2] for message in box.views[:4]]
    assert order == ["win", "cls", "vis", "depth"]
    for kind in ("vis", "depth"):
        for message, window in zip(box.of(kind), box.of("win"), strict=True):
            same = ("window_id", "t_capture_ns", "source_from_view", "view_rev", "intrinsics", "frame_role", "age_ms")
            assert all(getattr(message.header, name) == getattr(window.header, name) for name in same)
            assert (message.header.proto, window.header.proto) == ("gcd/1.1", "gcd/1.0")
    assert np.array_equal(images(box.of("vis")[1])[..., 0], fake_maps()["visibility"].numpy())


def test_depth_loses_less_than_a_thousandth_from_0_3_to_200_m_and_none_stays_none() -> None:
    sent, wanted = inverse_depth(published(*HELD, frames=14).of("depth")[0]), fake_maps()["inverse_depth"].numpy()
    known = wanted > 0
    assert wanted[known].min() < 1 / 199
    assert wanted[known].max() > 1 / 0.31
    assert np.array_equal(sent > 0, known)
    assert (np.abs(sent[known] / wanted[known] - 1) < 0.0005).all()


def test_what_is_no_depth_is_published_as_none(monkeypatch: pytest.MonkeyPatch) -> None:
    bad = {**fake_maps(), "inverse_depth": torch.full((14, 64, 96), 0.5)}
    bad["inverse_depth"][:, :, :4] = torch.tensor([torch.nan, torch.inf, -torch.inf, -1.0])
    monkeypatch.setattr("fakes.fake_maps", lambda: bad)
    metres = depth_m(published(*HELD, frames=14).of("depth")[0])
    assert np.isnan(metres[..., :4]).all()
    assert (metres[..., 4:] == 2.0).all()


@pytest.mark.parametrize("holds", [(), ("visibility",), ("inverse_depth",), HELD])
def test_what_a_view_does_not_hold_is_neither_published_nor_ended(holds: tuple[str, ...]) -> None:
    box = published(*holds)
    kinds = {"win", "frm", "cls", *(kind for kind, name in zip(("vis", "depth"), HELD, strict=True) if name in holds)}
    assert {message.topic for message in box.views} == {f"view/main/{kind}" for kind in kinds}
    assert {message.topic for message in box.ends} == {f"view/main/{kind}" for kind in kinds}
    assert len(box.ends) == len(kinds)
    assert {end.header.proto for end in box.ends if end.topic.endswith(("/vis", "/depth"))} <= {"gcd/1.1"}


def test_they_are_never_made_lossy() -> None:
    raw, packed = (published(*HELD, frames=14, encoding=encoding) for encoding in ("rgb8", "jpeg"))
    assert packed.of("win")[0].header.encoding == "jpeg"
    for kind in ("vis", "depth"):
        assert bytes(packed.of(kind)[0].payload) == bytes(raw.of(kind)[0].payload)


def test_a_kind_that_views_hold_no_longer_ends_once() -> None:
    box, windows = Box(), iter((HELD, ("visibility",), ("visibility",)))
    model = FakeSynthesizer(traits(), lambda _: setattr(model, "holds", next(windows)))
    made_node(fake_config(), model, FakeSource(42), box).run()
    assert [message.header.window_id for message in box.of("depth")] == [0]
    ends = {message.topic: message.header.window_id for message in box.ends}
    assert ends == {"view/main/win": 2, "view/main/frm": 2, "view/main/vis": 2, "view/main/depth": 1}
    assert len(box.ends) == len(ends)


def test_one_sample_of_a_model_that_states_its_spread_has_a_deviation() -> None:
    (message,) = published("log_variance", frames=14).of("std")
    assert message.header.scale is not None
    levels = images(message) * message.header.scale
    assert np.allclose(levels, 25.5, atol=0.1)  # a tenth, in grey levels
    assert published(frames=14).of("std") == []
    assert len(published("log_variance", frames=28).ends) == len(published(frames=28).ends) + 1


def test_a_reader_of_both_kinds_gets_exactly_what_was_published_in_order(tmp_path: Path) -> None:
    opened = partial(
        Publisher,
        PublishConfig(data=f"ipc://{tmp_path}/d", status=f"ipc://{tmp_path}/s", min_subscribers=2, end_delay_ms=0),
        lockstep=True,
    )
    received: list[ReceivedView] = []

    def read() -> None:
        with ViewSubscriber(f"ipc://{tmp_path}/d", "main", ("vis", "depth"), conflate=False) as views:
            received.extend(views)

    with opened() as publisher:
        reader = threading.Thread(target=read, daemon=True)
        reader.start()
        model = FakeSynthesizer(traits("driving"), holds=HELD)
        made_node(fake_config(), model, FakeSource(28, fps=10.0), publisher).run()
        reader.join(10)
    topics = ["view/main/vis", "view/main/depth"]
    assert [(view.message.topic, view.header.window_id) for view in received] == [
        (topic, window_id) for window_id in (0, 1) for topic in topics
    ]
    assert np.array_equal(received[2].images[..., 0], fake_maps()["visibility"].numpy())
    assert np.allclose(received[3].inverse_depth, fake_maps()["inverse_depth"].numpy(), rtol=5e-4)
