"""Frames are encoded while their window fills, and once for all windows that hold them: exactly, and not in vain."""

import functools
import random
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace as changed

import numpy as np
import pytest
import torch
from cameras import until
from fakes import HEIGHT, WIDTH, Box, FakeSource, FakeSynthesizer, fake_config, run, traits
from media import frames_at

from gcd_model import Augmentation, CameraMount, Clip, RenderOptions, SourceFeatures, load_synthesizer
from gcd_node.config import NodeConfig
from gcd_node.encoded_frames import EncodedFrames
from gcd_node.frame import Frame
from gcd_node.stream_context import StreamContext, prepare_stream
from gcd_node.window import FrameWindow, WindowBuilder

T = 14


class Encoder(FakeSynthesizer):
    """Adds the noise it is told to add, and remembers which frames it was given; `before` is called with each."""

    def __init__(
        self, act: Callable[[RenderOptions], None] | None = None, before: Callable[[int], None] | None = None
    ) -> None:
        super().__init__(traits(), act)
        self.encoded: list[int] = []
        self._before = before

    def encode(
        self, clip: Clip, augmentation: Augmentation | None = None, extra: torch.Tensor | None = None
    ) -> SourceFeatures:
        features = super().encode(clip, augmentation, extra)
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
    tensors = [(one.latents, other.latents), (one.tokens, other.tokens), (one.video, other.video)]
    return all((a is None and b is None) or (a is not None and b is not None and torch.equal(a, b)) for a, b in tensors)


# Laws.


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


@pytest.mark.parametrize(("stride", "pace"), [(5, "lockstep"), (T, "realtime"), (17, "lockstep")])
def test_views_are_the_same_to_the_last_bit_whatever_the_timing(stride: int, pace: str) -> None:
    wanted = undisturbed(stride)
    assert len(set(wanted.values())) == len(wanted) >= 2
    chance = random.Random(stride)

    def dawdle(_: object) -> None:
        time.sleep(chance.choice([0.0, 0.0, 0.001, 0.02]))

    settings, source = config(stride, f"source.pace={pace}"), FakeSource(40, period_s=0.004)
    found = pixels(run(settings, Encoder(dawdle, dawdle), source))
    assert found == (wanted if pace == "lockstep" else {number: wanted[number] for number in found})
    assert max(found) == max(wanted)


@pytest.mark.parametrize("seed", range(2))
def test_it_makes_no_difference_in_what_order_frames_are_encoded(seed: int) -> None:
    chance, model, encoded = random.Random(seed), Encoder(), kept()
    builder, windows = WindowBuilder(frames=T, fps=10.0, stride=chance.randint(1, T)), 0
    for frame in ten_fps(50):
        for window in builder.push(frame, frame.stamp_ns):
            windows += 1
            wanted = kept().features(Encoder(), window, CONTEXT)
            assert same(encoded.features(model, window, CONTEXT), wanted)
        while chance.random() < 0.6 and encoded.ahead(model, builder.filling, CONTEXT):
            assert len(encoded) <= T
    assert windows >= 3
    assert sorted(set(model.encoded)) == sorted(model.encoded)  # each once


# When frames are encoded.


def test_when_a_window_is_complete_only_its_last_frame_is_left_to_encode() -> None:
    class Waiting(FakeSource):
        """Gives its last frame when all those before it are encoded."""

        def frames(self) -> Iterator[Frame]:
            for frame in super().frames():
                if frame.seq == T - 1:
                    until(lambda: len(model.encoded) == T - 1)
                    assert model.asked == []
                yield frame

    model = Encoder()
    assert run(config(), model, Waiting(T)).ids() == [0]
    assert model.encoded == list(range(T))


# What is forgotten.


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
