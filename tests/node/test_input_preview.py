"""The preview of the input on src/frm: who gets it, what it says, and that nobody else pays for it."""

import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from cameras import Bench, Camera, until
from fakes import Box, FakeSource, traits
from rig import Rig, rig_config
from wire_messages import window

from gcd_client.images import images
from gcd_client.protocol import PREVIEW_TOPIC, ViewMessage, topic_key
from gcd_client.subscriber import ReceivedView, ViewSubscriber
from gcd_model import ViewSynthesizer
from gcd_node.config import PublishConfig
from gcd_node.frame import Frame, FrameSource
from gcd_node.messages import PREVIEW_WIDTH, PublisherStats, preview_message
from gcd_node.publisher import Publisher
from gcd_node.stream_context import StreamContext, prepare_stream
from gcd_node.views import InputPreview

pytestmark = pytest.mark.timeout(90)
REALTIME = 'kind = "synthetic"\npace = "realtime"'
PREVIEW_KEY, VIEW_KEY = topic_key(PREVIEW_TOPIC), topic_key("view/main/win")


class Watched(Box):
    """An outbox with so many subscribers of the preview."""

    previews = 0

    @property
    def stats(self) -> PublisherStats:
        return PublisherStats(subscribers=self.previews, previews=self.previews)


def run_of(folder: Path, source: FrameSource, model: ViewSynthesizer | None = None, **settings: float) -> StreamContext:
    more = "".join(f"\n{name} = {value}" for name, value in settings.items())
    config = rig_config(folder, REALTIME + more, "[view.main]", "")
    return prepare_stream(config, traits() if model is None else model.traits, source.info)


def frame_of(width: int, height: int, *, seq: int = 7) -> Frame:
    image = np.full((height, width, 3), (200, 100, 50), np.uint8)
    return Frame(image=image, stamp_ns=5_000_000_000, seq=seq)


def preview(folder: Path, width: int, height: int, **settings: float) -> ViewMessage:
    source = FakeSource(1, size=(width, height))
    return preview_message(run_of(folder, source, **settings), frame_of(width, height), time.monotonic_ns(), 3)


def next_preview(views: ViewSubscriber) -> ReceivedView:
    received = views.receive(60_000)
    assert received is not None
    return received


# Laws.


@pytest.mark.parametrize(("width", "height"), [(96, 64), (640, 480), (641, 480), (1920, 1080), (3000, 100)])
def test_a_preview_is_the_whole_picture_and_never_wider_than_said(tmp_path: Path, width: int, height: int) -> None:
    message = preview(tmp_path, width, height)
    _, shown_height, shown_width, _ = message.header.shape
    assert shown_width == min(width, PREVIEW_WIDTH)
    assert shown_height == pytest.approx(shown_width * height / width, abs=0.51)
    assert message.header.src.resize == ("none" if width <= PREVIEW_WIDTH else "area")
    assert np.abs(images(message)[0].astype(int) - (200, 100, 50)).max() <= 4  # JPEG


# What it says.


def test_a_preview_says_that_it_is_no_generated_view_and_what_frame_it_is(tmp_path: Path) -> None:
    header = preview(tmp_path, 96, 64).header
    assert (header.view_id, header.synthetic, header.encoding, header.window_id) == ("src", False, "jpeg", -1)
    assert header.t_capture_ns == (5_000_000_000,)  # of a recording, its own clock
    assert (header.src.seq, header.src.epoch, header.model.name) == ((7,), 3, "none")
    assert 0 <= header.age_ms < 30_000
    assert header.pose is not None
    assert header.pose[0].az_deg == 0.0


def test_the_camera_matrix_is_that_of_the_smaller_picture(tmp_path: Path) -> None:
    camera = preview(tmp_path, 1280, 720, hfov_deg=90.0).header.intrinsics
    assert camera is not None
    assert camera[0] == pytest.approx(320.0)  # half of 640 over tan 45 degrees
    assert (camera[2], camera[5]) == (319.5, 179.5)
    assert preview(tmp_path, 1280, 720).header.intrinsics is None


# When it is made.


def test_nothing_is_made_while_nobody_looks_and_at_most_five_a_second_then(tmp_path: Path) -> None:
    box, now = Watched(), [0.0]
    shown = InputPreview(box, lambda: run_of(tmp_path, FakeSource(1)), lambda: now[0])
    for seq in range(48):
        now[0] = seq / 24
        shown.offer(frame_of(96, 64, seq=seq), time.monotonic_ns(), 3)
    assert box.views == []
    box.previews = 1
    for seq in range(48, 48 + 240):  # 10 s
        now[0] = seq / 24
        shown.offer(frame_of(96, 64, seq=seq), time.monotonic_ns(), 3)
    shown.announce_end(delay_ms=None)
    seqs = [message.header.src.seq[0] for message in box.views]
    assert 0 < len(seqs) <= 50
    assert seqs == sorted(set(seqs))
    assert min(seqs) >= 48
    assert [message.topic for message in box.ends] == [PREVIEW_TOPIC]


def test_a_subscriber_sees_the_input_and_is_told_of_its_end(tmp_path: Path) -> None:
    camera = Camera()
    with Rig(tmp_path, Bench(camera), config='kind = "v4l2"\nhfov_deg = 60.0', watched=False) as rig:
        with ViewSubscriber(f"ipc://{tmp_path}/data", "src", "frm") as views:
            rig.await_state("active")
            until(lambda: rig.publisher.stats.previews == 1)
            camera.run(30)
            first = next_preview(views)
            assert first.images.shape == (1, 64, 96, 3)
            assert not first.header.synthetic
            assert first.header.intrinsics is not None
            assert len(set(first.images[0].reshape(-1, 3)[:, 0])) == 1
            level = 20 + first.header.src.seq[0]
            assert abs(int(first.images[0, 0, 0, 0]) - level) <= 3
            assert 0 <= first.age_ms < 60_000
            rig.ask("deactivate")
            until(lambda: views.receive(100) is None and views.ended)
        rig.await_state("inactive")


def test_a_reader_of_previews_that_hangs_does_not_hold_up_a_lockstep_run(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (480, 640, 3), np.uint8)
    frame = Frame(image=noise, stamp_ns=0, seq=0)
    picture = preview_message(run_of(tmp_path, FakeSource(1, size=(640, 480))), frame, time.monotonic_ns(), 0)
    opened = partial(
        Publisher,
        PublishConfig(data=f"ipc://{tmp_path}/data", status=f"ipc://{tmp_path}/status", min_subscribers=1),
        lockstep=True,
    )
    with (
        opened() as publisher,
        ViewSubscriber(publisher.endpoint, "src", "frm", conflate=False),
        ViewSubscriber(publisher.endpoint, "top", conflate=False) as views,
    ):
        until(lambda: publisher.stats.subscribers == 2)
        fill(publisher, picture)
        for number in range(20):
            publisher.send(window(number))
        assert [next_preview(views).header.window_id for _ in range(20)] == list(range(20))
        publisher.stop_waiting()


def fill(publisher: Publisher, picture: ViewMessage) -> None:
    """Send until nothing leaves any more: every buffer on the way is full."""
    refused = 0
    while refused < 5:
        before, until_s = publisher.stats.sent, time.monotonic() + 0.1
        publisher.preview(lambda: picture)
        while publisher.stats.sent == before and time.monotonic() < until_s:
            time.sleep(0.001)
        refused += publisher.stats.sent == before
