"""Models that work frame by frame: a view of every frame, and nothing remembered across a break of the source."""

from collections.abc import Iterator
from dataclasses import replace

from fakes import Box, FakeSource, FakeSynthesizer, fake_config, made_node, traits
from msgspec.structs import replace as struct_replace

from gcd_model import NonFiniteError, RenderOptions
from gcd_node.frame import Frame


class Streaming(FakeSynthesizer):
    """Notes after how many frames it was told to forget."""

    def __init__(self, act: object = None) -> None:
        super().__init__(replace(traits(), config=struct_replace(traits().config, frames=1), move_time=0), act)  # type: ignore[arg-type]
        self.resets: list[int] = []

    def streaming(self) -> "Streaming":
        return self

    def reset(self) -> None:
        self.resets.append(len(self.asked))


class Stepping(FakeSource):
    """Its clock jumps by an hour before frame 10."""

    def frames(self) -> Iterator[Frame]:
        for frame in super().frames():
            yield frame if frame.seq < 10 else replace(frame, stamp_ns=frame.stamp_ns + 3600 * 10**9)


def test_every_frame_gives_a_view_and_a_break_of_the_source_is_a_beginning() -> None:
    model, box = Streaming(), Box()
    made_node(fake_config(), model, Stepping(20), box).run()
    assert [message.header.src.seq for message in box.of("win")] == [(seq,) for seq in range(20)]
    assert [message.header.window_id for message in box.of("win")] == list(range(20))
    assert model.resets == [0, 10]


def test_a_frame_that_is_rendered_again_is_the_first_one_then() -> None:
    failing = iter([True])

    def act(options: RenderOptions) -> None:
        if len(model.asked) == 5 and next(failing, False):
            raise NonFiniteError("for once")

    model, box = Streaming(act), Box()
    made_node(fake_config(), model, FakeSource(8), box).run()
    assert [message.header.src.seq for message in box.of("win")] == [(seq,) for seq in range(8)]
    assert model.resets == [0, 5]
