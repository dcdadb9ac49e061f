"""Class maps, visibility, depth and a stated spread, from the view that holds them: what is published, and when."""

import numpy as np
import pytest
import torch
from fakes import Box, FakeSource, FakeSynthesizer, fake_classes, fake_config, fake_maps, painting_traits, run, traits

from gcd_client.images import depth_m, images, inverse_depth
from gcd_node.messages import ontology

pytestmark = pytest.mark.timeout(30)
HELD = ("visibility", "inverse_depth")


def published(*holds: str, frames: int = 28, encoding: str = "rgb8") -> Box:
    model = FakeSynthesizer(painting_traits(), holds=holds)
    return run(fake_config(f"publish.encoding={encoding}"), model, FakeSource(frames, fps=10.0))


def test_every_window_of_a_view_that_holds_them_comes_with_its_own() -> None:
    box, made = published(*HELD), painting_traits()
    order = [message.topic.rpartition("/")[2] for message in box.views[:4]]
    assert order == ["win", "cls", "vis", "depth"]
    same = ("window_id", "t_capture_ns", "source_from_view", "view_rev", "intrinsics", "frame_role", "age_ms", "model")
    for kind, proto in (("cls", "gcd/1.0"), ("vis", "gcd/1.1"), ("depth", "gcd/1.1")):
        for message, window in zip(box.of(kind), box.of("win"), strict=True):
            assert all(getattr(message.header, name) == getattr(window.header, name) for name in same)
            assert (message.header.proto, window.header.proto) == (proto, "gcd/1.0")
    assert np.array_equal(images(box.of("vis")[1])[..., 0], fake_maps()["visibility"].numpy())
    drawn, told = fake_classes(made, 1), box.of("cls")[0].header.classes
    assert drawn is not None
    assert told is not None
    assert np.array_equal(images(box.of("cls")[0])[..., 0], drawn[0].numpy())
    assert told == ontology(made)
    assert box.told("meta")[0]["classes"] == [
        {"id": each.id, "name": each.name, "colour": each.colour} for each in told
    ]


@pytest.mark.parametrize("family", ["kubric90", "driving", "svd"])
def test_a_model_without_a_class_head_publishes_no_class_map(family: str) -> None:
    box = run(fake_config(), FakeSynthesizer(traits(family)), FakeSource(28, fps=10.0))
    assert "view/main/cls" not in {message.topic for message in (*box.views, *box.ends)}
    assert box.told("meta")[0]["classes"] == []


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
    windows = iter((HELD, ("visibility",), ("visibility",)))
    model = FakeSynthesizer(traits(), lambda _: setattr(model, "holds", next(windows)))
    box = run(fake_config(), model, FakeSource(42))
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
