"""Several views of one input while commands change them: on every topic, down to its end-of-stream."""

import threading
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import zmq
from cameras import until
from fakes import LOCKSTEP, FakeSynthesizer, Steady, painting_traits, traits
from rig import Rig

from gcd_client.control import Code
from gcd_client.protocol import EndMessage, StatusMessage, ViewMessage, decode
from gcd_model import RenderOptions

TWO_VIEWS = '[view.top]\n[view.swing]\nkind = "orbit"\nrate_deg_s = 24.0\namplitude_deg = 60.0'


@dataclass
class Tape:
    """Every message of the data socket, in its order."""

    said: list[ViewMessage | EndMessage] = field(default_factory=list[ViewMessage | EndMessage])

    def views(self, topic: str) -> list[ViewMessage]:
        return [each for each in list(self.said) if isinstance(each, ViewMessage) and each.topic == topic]

    def ends(self, topic: str) -> list[EndMessage]:
        return [each for each in list(self.said) if isinstance(each, EndMessage) and each.topic == topic]

    def await_more(self, topic: str, count: int = 2) -> None:
        wanted = len(self.views(topic)) + count
        until(lambda: len(self.views(topic)) >= wanted)

    def after_its_end(self, topic: str) -> list[ViewMessage | EndMessage]:
        of_topic = [each for each in list(self.said) if each.topic == topic]
        first = next(index for index, each in enumerate(of_topic) if isinstance(each, EndMessage))
        return of_topic[first + 1 :]


@contextmanager
def taped(folder: Path) -> Generator[Tape]:
    """Listens from before the node's start to after its end."""
    tape, done, there = Tape(), threading.Event(), threading.Event()

    def hear() -> None:
        with zmq.Context() as context, context.socket(zmq.SUB) as socket:
            socket.set(zmq.SUBSCRIBE, b"view/")
            socket.set(zmq.LINGER, 0)
            socket.connect(f"ipc://{folder}/data")
            there.set()
            while not done.is_set() or socket.poll(200):
                if socket.poll(50):
                    message = decode(socket.recv())
                    assert not isinstance(message, StatusMessage)
                    if not (isinstance(message, EndMessage) and message in tape.said[-20:]):  # ends are repeated
                        tape.said.append(message)

    thread = threading.Thread(target=hear, daemon=True)
    thread.start()
    assert there.wait(20)
    try:
        yield tape
    finally:
        done.set()
        thread.join(20)


def heard_by_the_tape(rig: Rig) -> None:
    until(lambda: rig.publisher.stats.subscribers >= 2)


def test_a_topic_that_a_command_opens_and_closes_begins_and_ends_with_it(tmp_path: Path) -> None:
    with taped(tmp_path) as tape, Rig(tmp_path, lambda _: Steady(), config=LOCKSTEP, views=TWO_VIEWS) as rig:
        heard_by_the_tape(rig)
        tape.await_more("view/top/win")
        assert rig.ask("set_param", samples=2).code is Code.OK
        tape.await_more("view/top/std")
        assert rig.ask("set_param", samples=1).code is Code.OK
        until(lambda: tape.ends("view/top/std") != [] and tape.ends("view/swing/std") != [])
        assert tape.ends("view/top/win") == []
        tape.await_more("view/top/win", 4)
        assert tape.after_its_end("view/top/std") == []
        assert rig.ask("set_param", samples=2).code is Code.OK
        until(lambda: len(tape.after_its_end("view/top/std")) >= 2)  # the sequence goes on where it was
    sequences = [each.sequence for each in tape.said if each.topic == "view/top/std"]
    assert sequences == list(range(len(sequences)))
    assert [len(tape.ends(f"view/{name}/std")) for name in ("top", "swing")] == [2, 2]
    assert [len(tape.ends(f"view/{name}/win")) for name in ("top", "swing")] == [1, 1]


def test_a_removed_view_ends_on_every_topic_it_ever_had(tmp_path: Path) -> None:
    model = FakeSynthesizer(painting_traits())
    views = "[view.top]\n[view.second]"
    with taped(tmp_path) as tape, Rig(tmp_path, lambda _: Steady(), model, config=LOCKSTEP, views=views) as rig:
        heard_by_the_tape(rig)
        rig.ask("set_param", samples=2)
        tape.await_more("view/second/std")
        tape.await_more("view/second/cls")
        assert rig.ask("remove_view", view="second").code is Code.OK
        topics = [f"view/second/{kind}" for kind in ("win", "std", "cls")]
        until(lambda: all(tape.ends(topic) for topic in topics))
        tape.await_more("view/top/cls")
        assert rig.ask("set_view", view="second").code is Code.OK
        tape.await_more("view/second/cls")
    revisions = [each.header.view_rev for each in tape.said if each.topic == "view/second/cls"]
    assert revisions == sorted(revisions)
    assert set(revisions) == {1, 2}
    assert all(len(tape.ends(topic)) == 2 for topic in topics)


WILD: list[dict[str, object]] = [
    {"azimuth_deg": 1e308},
    {"radius": 1e308},
    {"radius": -1e308},
    {"kind": "orbit", "rate_deg_s": 1e308, "amplitude_deg": 60.0},
    {"kind": "orbit", "rate_deg_s": 1.0, "amplitude_deg": 1e308},
    {"kind": "orbit", "rate_deg_s": 1.0, "amplitude_deg": 1e-308},
    {"T_src_dst": [1e308] * 16},
    {"T_src_dst": [1, 0, 0, 1e308, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]},
]


def test_no_number_in_a_view_can_end_the_stream(tmp_path: Path) -> None:
    with Rig(tmp_path, lambda _: Steady(), config=LOCKSTEP) as rig:
        rig.await_views(1)
        for wanted in WILD:
            reply = rig.ask("set_view", wanted, view="main")
            assert reply.code in (Code.OK, Code.OUT_OF_RANGE, Code.BAD_ARG)
            rig.await_views(len(rig.of()) + 3)
        assert rig.events("MODEL_FAILED") == []


def test_a_view_removed_in_the_last_window_still_ends(tmp_path: Path) -> None:
    begun = threading.Event()

    def slow(options: RenderOptions) -> None:
        begun.set()
        assert options.cancel is not None
        until(options.cancel.is_set)

    model = FakeSynthesizer(traits(), slow)
    with taped(tmp_path) as tape, Rig(tmp_path, lambda _: Steady(), model, config=LOCKSTEP, views=TWO_VIEWS) as rig:
        heard_by_the_tape(rig)
        assert begun.wait(30)
        assert rig.ask("remove_view", view="swing").code is Code.OK
        assert rig.ask("deactivate").code is Code.ACCEPTED
        rig.await_state("inactive")
        until(lambda: tape.ends("view/swing/win") != [] and tape.ends("view/top/win") != [])
    assert all(isinstance(each, EndMessage) for each in tape.said)  # what was in work when it was told to stop is lost
