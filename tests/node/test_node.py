"""A node over fakes, from the first frame to the last status: what is published, and how it ends."""

import functools
import random
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace as changed
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import torch
from cameras import frames_at, until
from fakes import HEIGHT, WIDTH, Box, FakeSource, FakeSynthesizer, fake_config, made_node, run, traits

from gcd_client.images import images
from gcd_model import (
    Augmentation,
    CameraMount,
    CheckpointError,
    Clip,
    DeviceMemoryError,
    RenderOptions,
    SourceFeatures,
    ViewFixedError,
    ViewRangeError,
    load_synthesizer,
)
from gcd_model.errors import ShapeError
from gcd_node.config import NodeConfig, PublishConfig
from gcd_node.encoded_frames import EncodedFrames
from gcd_node.errors import EndpointError, ModelFailedError, NodeError, PublisherError, SourceError
from gcd_node.frame import Frame
from gcd_node.pipeline import ending
from gcd_node.publisher import Publisher
from gcd_node.stream_context import StreamContext, prepare_stream
from gcd_node.window import FrameWindow, WindowBuilder

TURNED = "view.main.azimuth_deg=26.0"


def test_every_whole_window_of_a_replay_is_published_once_and_then_its_end() -> None:
    box = run(fake_config(), source=FakeSource(50))
    assert box.ids() == [0, 1, 2]
    assert box.of("win")[1].header.src.seq == tuple(range(14, 28))
    assert {message.topic for message in box.ends} == {"view/main/win", "view/main/frm"}
    assert all(message.header.window_id == 2 for message in box.ends)


def test_the_header_tells_the_whole_story() -> None:
    header = run(fake_config(TURNED), source=FakeSource(14)).of("win")[0].header
    assert header.shape == (14, HEIGHT, WIDTH, 3)
    assert header.t_capture_ns == tuple(round(i * 1e9 / 24) for i in range(14))
    assert header.pose is not None
    assert [pose.az_deg for pose in header.pose] == pytest.approx([2.0 * i for i in range(14)])
    assert header.frame_role == ("in_transit",) * 13 + ("at_goal",)
    assert header.source_from_view[0] == pytest.approx(np.eye(4).ravel())
    assert (header.clock, header.src.fps_cond, header.model.family) == ("replay", 24.0, "kubric90")
    assert header.valid_for_ms == round(2 * 14 / 24 * 1000)
    assert header.t_infer_start_ns <= header.t_infer_end_ns <= header.t_publish_ns
    assert (header.synthetic, header.src_pose.assumed) == (True, True)


def test_single_frames_carry_the_goal_pose_only_and_of_overlapping_windows_each_moment_once() -> None:
    box = run(fake_config(TURNED))
    frames = box.of("frm")
    assert [frame.header.shape for frame in frames] == [(1, HEIGHT, WIDTH, 3)] * 2
    assert [frame.header.src.seq for frame in frames] == [(13,), (27,)]
    assert [frame.header.pose[0].az_deg for frame in frames if frame.header.pose] == [26.0, 26.0]
    assert images(frames[0]).tobytes() == images(box.of("win")[0])[13:].tobytes()
    box = run(fake_config(TURNED, "window.stride=4", "model.move_time=0"), source=FakeSource(56))
    assert [frame.header.src.seq[0] for frame in box.of("frm")] == list(range(54))


def test_realtime_drops_windows_and_never_frames() -> None:
    model, box = FakeSynthesizer(traits(), lambda _: time.sleep(0.2)), Box()
    summary = made_node(fake_config("source.pace=realtime"), model, FakeSource(280), box).run()
    assert summary.frames == 280
    assert summary.dropped > 0
    assert summary.counts.windows + summary.dropped == 20
    assert box.ids() == sorted(set(box.ids()))
    assert box.ids()[-1] == 19


@pytest.mark.parametrize(("family", "error"), [("kubric90", ViewRangeError), ("driving", ViewFixedError)])
@pytest.mark.parametrize("view", ["azimuth_deg = 91.0", 'kind = "orbit", rate_deg_s = 9.0, amplitude_deg = 120.0'])
def test_a_view_the_model_cannot_give_is_refused_at_the_start(family: str, view: str, error: type[Exception]) -> None:
    model = FakeSynthesizer(traits(family))
    with pytest.raises(error):
        run(fake_config(f"view.main={{{view}}}"), model, FakeSource(14, fps=10.0))
    assert model.clips == []


def test_status_and_meta_describe_the_run() -> None:
    box = run(fake_config())
    weights = box.told("meta")[0]["weights"]
    assert (weights["trained"], weights["uncertainty_scale"]) == (False, None)  # nobody measured these
    status = box.told("status")
    states = "unconfigured configuring inactive activating active deactivating shuttingdown finalized"
    assert list(dict.fromkeys(fields["state"] for fields in status)) == states.split()
    assert (status[-1]["window"]["built"], status[-1]["publish"]["sent"]) == (2, len(box.views))
    assert [fields["heartbeat_seq"] for fields in status] == list(range(1, len(status) + 1))


def test_nobody_claims_to_know_where_an_unsteered_camera_stands_and_the_driving_path_is_rigid() -> None:
    box = run(fake_config(), FakeSynthesizer(traits("svd")))
    header = box.of("win")[0].header
    assert (header.source_from_view, header.pose) == (None, None)
    assert set(header.frame_role) == {"in_transit"}
    assert box.of("frm") == []
    header = run(fake_config(), FakeSynthesizer(traits("driving")), FakeSource(14, fps=10.0)).of("win")[0].header
    assert (header.pose, header.pose_units) == (None, "m")
    ahead = np.array(header.source_from_view[-1]).reshape(4, 4)[:3, 3]
    assert ahead == pytest.approx([0.0, 1.55 - 8.0, -8.0 - 1.6])  # above and behind, in the source camera's axes


def test_the_last_status_is_the_end() -> None:
    for act, fails, code, source, model in (
        (None, None, "SRC_ENDED", "ended", "ready"),
        (None, SourceError("unplugged"), "SRC_LOST", "lost", "ready"),
        (DeviceMemoryError("full"), None, "MODEL_FAILED", "closed", "failed"),
        (RuntimeError("shapes differ"), None, "MODEL_FAILED", "closed", "failed"),
        (None, cv2.error("assertion failed"), "SRC_FAILED", "closed", "ready"),
        (None, ShapeError("no such picture"), "SRC_FAILED", "closed", "ready"),
    ):
        drawing, box = FakeSynthesizer(traits(), Mock(side_effect=act)), Box()
        node = made_node(fake_config(), drawing, FakeSource(60, fails=fails), box)
        with nullcontext() if fails is act is None else pytest.raises((SourceError, ModelFailedError)):
            node.run()
        assert box.told("event")[-1]["code"] == code
        last = box.told("status")[-1]
        assert (last["source"]["state"], last["model"]["state"]) == (source, model)
        assert last["level"] == (0 if code == "SRC_ENDED" else 2)


def test_a_failure_keeps_its_own_code() -> None:
    for failure, code in (
        (PublisherError("died"), "PUBLISH_FAILED"),
        (EndpointError("not taken"), "NOT_DELIVERED"),
        (KeyError("ours"), "INTERNAL"),
        (CheckpointError("halved"), "MODEL_FAILED"),
    ):
        assert ending(failure, stopped=False) == ending(failure, stopped=True) == (code, "closed")


def test_an_outbox_that_fails_ends_the_run_and_every_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    box, before = Box(), threading.active_count()
    monkeypatch.setattr(box, "note", Mock(side_effect=[None, None, None, *[NodeError("the publisher stopped")] * 999]))
    model = FakeSynthesizer(traits(), lambda _: time.sleep(0.05))
    with pytest.raises(NodeError):
        made_node(fake_config(), model, FakeSource(100_000, period_s=0.001), box).run()
    assert threading.active_count() == before


def test_a_lockstep_node_that_nobody_reads_still_stops(tmp_path: Path) -> None:
    endpoints = PublishConfig(data=f"ipc://{tmp_path}/d", status=f"ipc://{tmp_path}/s", min_subscribers=1)
    with Publisher(endpoints, lockstep=True, queue_size=2) as publisher:
        node = made_node(fake_config(), FakeSynthesizer(traits()), FakeSource(10_000), publisher)
        thread = threading.Thread(target=node.run)
        thread.start()
        time.sleep(0.3)
        assert publisher.stats.sent == 0
        node.stop()
        thread.join(10)
        assert not thread.is_alive()


# Frames are encoded while their window fills, and once for all windows that hold them: exactly, and not in vain.


T = 14


class Encoder(FakeSynthesizer):
    """Adds the noise it is told to add, and remembers which frames it was given; `before` is called with each."""

    def __init__(
        self, act: Callable[[RenderOptions], None] | None = None, before: Callable[[int], None] | None = None
    ) -> None:
        super().__init__(traits(), act)
        self.encoded: list[int] = []
        self._before = before

    def encode(self, clip: Clip, augmentation: Augmentation | None = None) -> SourceFeatures:
        features = super().encode(clip, augmentation)
        if augmentation is None:  # the warm-up
            return features
        assert clip.frames == 1
        seq = round((clip.video[0, 0, 0, 0].item() + 1) / 2 * 255) - 20
        if self._before is not None:
            self._before(seq)
        self.encoded.append(seq)
        noise = torch.randn(clip.video.shape, generator=torch.Generator().manual_seed(augmentation.seed))
        return changed(features, latents=clip.video + (augmentation.strength or 0.0) * noise)


def config(stride: int = T, *more: str) -> NodeConfig:
    return fake_config(f"window.stride={stride}", "model.cond_aug=0.1", *more)


CONTEXT = prepare_stream(config(), traits(), FakeSource(1).info)


def pixels(box: Box) -> dict[int, bytes]:
    """What was published, by window."""
    return {message.header.window_id: bytes(message.payload) for message in box.of("win")}


def placed(frames: Sequence[Frame], stride: int = T, *, builder: WindowBuilder | None = None) -> list[FrameWindow]:
    builder = builder or WindowBuilder(frames=T, fps=10.0, stride=stride)
    return [window for frame in frames for window in builder.push(frame, frame.stamp_ns)]


def ten_fps(count: int, *, first: int = 0) -> list[Frame]:
    """Pictures of the fakes' size that hold their number."""
    made = frames_at((i * 100.0 for i in range(count)), WIDTH, HEIGHT)
    return [changed(frame, image=frame.image + np.uint8(20)) for frame in made][first:]


def kept() -> EncodedFrames:
    return EncodedFrames(lambda: None)


def same(one: SourceFeatures, other: SourceFeatures) -> bool:
    names = [name for name in ("latents", "tokens", "video") if getattr(one, name) is not None]
    return bool(names) and all(torch.equal(getattr(one, name), getattr(other, name)) for name in names)


def test_windows_that_overlap_agree_to_the_last_bit_on_the_frames_they_share() -> None:
    model, encoded = load_synthesizer("random:driving", device="cpu"), kept()
    picture = np.random.default_rng(0).integers(0, 256, (128, 192, 3), np.uint8)
    frames = [changed(frame, image=np.roll(picture, frame.seq, axis=1)) for frame in frames_at([0, 100, 200, 300, 400])]
    one, two = placed(frames, builder=WindowBuilder(frames=4, fps=10.0, stride=1))
    first, second = (encoded.features(model, window, CONTEXT) for window in (one, two))
    assert same(first.rows(1, 4), second.rows(0, 3))
    assert same(second, kept().features(model, two, CONTEXT))


@functools.cache
def undisturbed(stride: int) -> dict[int, bytes]:
    """The windows of 40 frames that were all there at once."""
    return pixels(run(config(stride), Encoder(), FakeSource(40)))


@pytest.mark.parametrize(
    ("stride", "pace"), [(5, "lockstep"), (T, "realtime"), pytest.param(17, "lockstep", marks=pytest.mark.slow)]
)
def test_views_are_the_same_to_the_last_bit_whatever_the_timing(stride: int, pace: str) -> None:
    wanted = undisturbed(stride)
    assert len(set(wanted.values())) == len(wanted) >= 2
    chance = random.Random(stride)

    def dawdle(_: object) -> None:
        time.sleep(chance.choice([0.0, 0.0, 0.001, 0.02]))

    settings, source = config(stride, f"source.pace={pace}"), FakeSource(40, period_s=0.004)
    model = Encoder(dawdle, dawdle)
    found = pixels(run(settings, model, source))
    assert sorted(set(model.encoded)) == sorted(model.encoded)  # each once
    assert found == (wanted if pace == "lockstep" else {number: wanted[number] for number in found})
    assert max(found) == max(wanted)


def test_when_a_window_is_complete_only_its_last_frame_is_left_to_encode() -> None:
    def waiting(frame: Frame) -> Frame:
        """The last one is given when all those before it are encoded."""
        if frame.seq == T - 1:
            until(lambda: len(model.encoded) == T - 1)
            assert model.asked == []
        return frame

    model = Encoder()
    assert run(config(), model, FakeSource(T, edit=waiting)).ids() == [0]
    assert model.encoded == list(range(T))


@pytest.mark.parametrize(
    "other",
    [changed(CONTEXT, config=config(5, "strict=true")), changed(CONTEXT, mount=CameraMount(height_m=2.0))],
)
def test_what_was_encoded_on_other_terms_is_encoded_anew(other: StreamContext) -> None:
    (window,) = placed(ten_fps(T))
    model, encoded = Encoder(), kept()
    encoded.features(model, window, CONTEXT)
    again = encoded.features(model, window, other)
    assert model.encoded == [*range(T), *range(T)]
    assert same(again, kept().features(Encoder(), window, other))
    encoded.features(model, changed(window, fps=5.0), other)
    encoded.features(model, changed(window, epoch=window.epoch + 1, fps=5.0), other)
    assert len(model.encoded) == 4 * T
