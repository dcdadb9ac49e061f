"""The page's server beside a running node, and the commands that start it. No browser."""

import os
import queue
import re
import signal
import threading
import time
import webbrowser
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cameras import Bench, Camera, until
from fakes import FakeSynthesizer, warping_traits
from msgspec.structs import replace
from rich.console import Console
from rig import Rig
from viewer_clients import (
    TOKEN,
    WAIT_S,
    hear,
    nobody,
    open_feed,
    raw_feed,
    say,
    send_raw,
    viewer_of,
)
from websockets.sync.client import connect
from wire_messages import window

from gcd_node.cli import node as cli_node
from gcd_node.cli import viewer as cli_viewer
from gcd_node.cli.main import run_app
from gcd_node.config import parse_config
from gcd_node.errors import ConfigError
from gcd_node.publisher import Publisher, PublisherOptions
from gcd_node.security.gate import new_key_pair
from gcd_node.security.keys import Role, write_key_pair
from gcd_node.session import open_session
from gcd_node.viewer import server as server_module
from gcd_node.viewer.server import ViewerOptions, ViewerServer

pytestmark = pytest.mark.timeout(90)


# Beside a node.


def test_pictures_come_only_while_somebody_looks(tmp_path: Path) -> None:
    camera = Camera()
    with Rig(tmp_path, Bench(camera), watched=False) as rig, viewer_of(rig) as viewer:
        rig.await_state("active")
        assert rig.publisher.stats.subscribers == 0
        with open_feed(viewer) as feed:
            say(feed, type="watch", view="main")
            until(lambda: rig.publisher.stats.subscribers == 6)  # src/frm, win, std, cls, vis, depth
            threading.Thread(target=camera.run, args=(60,), daemon=True).start()
            seen = hear(feed, "picture", lambda head: head["kind"] == "src")
            assert (seen["synthetic"], seen["frames"]) == (False, 1)
            view = hear(feed, "picture", lambda head: head["kind"] == "win")
            assert (view["synthetic"], view["view"], view["rev"], view["frames"]) == (True, "main", 1, 14)
            assert hear(feed, "status")["fields"]["state"] == "active"
            assert hear(feed, "beat")["silent_ms"] < 30_000
        until(lambda: rig.publisher.stats.subscribers == 0)
        assert viewer.feeds == 0


def test_an_operator_steers_the_node_and_a_late_page_knows_what_happened(tmp_path: Path) -> None:
    camera = Camera()
    with Rig(tmp_path, Bench(camera), watched=False) as rig, viewer_of(rig) as viewer:
        rig.await_state("active")
        with open_feed(viewer) as feed:
            say(feed, type="hello", token=TOKEN)
            say(feed, type="ask", id=5, verb="set_view", args={"view": "main", "azimuth_deg": 20.0})
            reply = hear(feed, "reply")
            assert (reply["id"], reply["ok"], reply["result"]["view_rev"]) == (5, True, 2)
            say(feed, type="ask", id=6, verb="set_view", args={"view": "main", "azimuth_deg": 1000.0})
            reply = hear(feed, "reply")
            assert reply["code"] == "OUT_OF_RANGE"
            assert reply["result"]["allowed"]["azimuth_deg"] == [-90.0, 90.0]
        rig.await_event("VIEW_SET")
        with open_feed(viewer) as late:
            assert hear(late, "history")["samples"]
            assert hear(late, "event", lambda told: told["fields"]["code"] == "VIEW_SET")["fields"]["view_rev"] == 2
            assert hear(late, "meta")["fields"]["views"] == ["main"]
            say(late, type="ask", id=1, verb="describe")
            assert hear(late, "reply")["result"]["limits"]["azimuth_deg"] == [-90.0, 90.0]


def test_a_page_that_never_reads_slows_neither_node_nor_others_and_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_module, "_PING_S", 0.5)
    monkeypatch.setattr(server_module, "_STUCK_S", 1)
    noise = np.random.default_rng(0).integers(0, 256, (14, 256, 384, 3), np.uint8)
    options = PublisherOptions(data=f"ipc://{tmp_path}/data", status=f"ipc://{tmp_path}/status")
    with (
        Publisher(options) as publisher,
        ViewerServer(ViewerOptions(http="127.0.0.1:0", node=nobody(tmp_path))) as viewer,
        open_feed(viewer) as healthy,
    ):
        stuck = [raw_feed(viewer) for _ in range(3)]
        for each in stuck:
            send_raw(each, {"type": "watch", "view": "top"})
            for number in range(1, 40):  # it even says that it has seen everything
                send_raw(each, {"type": "got", "number": number})
        say(healthy, type="watch", view="top")
        until(lambda: publisher.stats.subscribers == 6 and viewer.browsers == 4)
        for number in range(12):
            started_s = time.monotonic()
            publisher.send(window(number, images=noise))
            assert time.monotonic() - started_s < 10
            assert hear(healthy, "picture", lambda head, number=number: head["window_id"] >= number)
        until(lambda: viewer.browsers == 1)
        for each in stuck:
            each.close()


def test_a_class_map_reaches_the_page_of_a_model_that_draws_one(tmp_path: Path) -> None:
    camera = Camera(fps=10.0)
    model = FakeSynthesizer(warping_traits())
    with Rig(tmp_path, Bench(camera), model, views="[view.main]", watched=False) as rig, viewer_of(rig) as viewer:
        rig.await_state("active")
        with open_feed(viewer) as feed:
            say(feed, type="watch", view="main")
            until(lambda: rig.publisher.stats.subscribers == 6)
            threading.Thread(target=camera.run, args=(40,), kwargs={"pause_s": 0.02}, daemon=True).start()
            drawn = hear(feed, "picture", lambda head: head["kind"] == "cls")
            assert len(drawn["classes"]) == 13
            say(feed, type="ask", id=1, verb="describe")
            assert hear(feed, "reply")["result"]["camera"] == "none"


@pytest.mark.parametrize("role", ["viewer", "operator"])
def test_a_node_that_asks_for_keys_asks_its_own_page_too(role: Role, tmp_path: Path) -> None:
    node_keys, page_keys = new_key_pair(), new_key_pair()
    write_key_pair(tmp_path / "node", node_keys)
    write_key_pair(tmp_path / "page", page_keys)
    (tmp_path / "allow.toml").write_text(f'[client.page]\nkey = "{page_keys.public}"\nrole = "{role}"\n')
    settings = parse_config(
        f"""
        [source]
        kind = "synthetic"
        [model]
        weights = "random:kubric90"
        [view.main]
        [life]
        autostart = false
        [publish]
        data = "tcp://127.0.0.1:0"
        status = "ipc://{tmp_path}/status"
        [control]
        endpoint = "tcp://127.0.0.1:0"
        [security]
        keys = "{tmp_path}/node"
        allow = "{tmp_path}/allow.toml"
        [viewer]
        http = "127.0.0.1:0"
        """.encode(),
        "test",
    )
    with pytest.raises(ConfigError, match=r"\[viewer\] keys"), open_session(settings):
        pass
    settings = replace(settings, viewer=replace(settings.viewer, keys=str(tmp_path / "page")))
    urls: list[str] = []
    with open_session(settings, on_viewer=urls.append):
        host, _, token = urls[0].removeprefix("http://").partition("/#token=")
        with connect(f"ws://{host}/feed", origin=f"http://{host}", open_timeout=WAIT_S) as feed:  # type: ignore[arg-type]
            say(feed, type="hello", token=token)
            assert hear(feed, "role")["role"] == "operator"
            say(feed, type="ask", id=1, verb="views")
            assert hear(feed, "reply")["result"]["main"]["view_rev"] == 1
            say(feed, type="ask", id=2, verb="set_param", args={"steps": 3})
            assert hear(feed, "reply")["code"] == ("OK" if role == "operator" else "FORBIDDEN")


# As commands.


def run_command(arguments: list[str], look: Callable[[str], None], monkeypatch: pytest.MonkeyPatch) -> None:
    """Run `gcd-node ...` here, look at the page it opens from another thread, and end it as Ctrl-C does."""
    urls: queue.Queue[str] = queue.Queue()
    failures: list[BaseException] = []
    tell = cli_viewer.tell_page

    def told(console: Console, url: str) -> None:
        tell(console, url)
        urls.put(url)

    for module in (cli_node, cli_viewer):
        monkeypatch.setattr(module, "tell_page", told)

    def visit() -> None:
        try:
            look(urls.get(timeout=WAIT_S))
        except BaseException as error:  # told to the test
            failures.append(error)
        os.kill(os.getpid(), signal.SIGINT)

    visitor = threading.Thread(target=visit, daemon=True)
    visitor.start()
    code = run_app(arguments)
    visitor.join(WAIT_S)
    assert (code, failures) == (0, [])


def test_the_page_can_be_served_from_a_process_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def look(url: str) -> None:
        host, _, token = url.removeprefix("http://").partition("/#token=")
        with connect(f"ws://{host}/feed", origin=f"http://{host}", open_timeout=WAIT_S) as feed:  # type: ignore[arg-type]
            say(feed, type="hello", token=token)
            assert hear(feed, "role")["role"] == "operator"

    endpoints = [f"--{name}=ipc://{tmp_path}/{name}" for name in ("data", "status", "control")]
    run_command(["viewer", "--http", "127.0.0.1:0", *endpoints], look, monkeypatch)
    assert re.fullmatch(r"page http://127\.0\.0\.1:\d+/#token=\S{32}\n", capsys.readouterr().err)


def test_the_demo_opens_its_page_and_ends_with_ctrl_c(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    opened: list[str] = []
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(webbrowser, "open", opened.append)

    def look(url: str) -> None:
        host = url.removeprefix("http://").partition("/")[0]
        with connect(f"ws://{host}/feed", origin=f"http://{host}", open_timeout=WAIT_S, max_size=2**26) as feed:  # type: ignore[arg-type]
            assert hear(feed, "status", lambda told: told["fields"]["state"] == "active")["node_id"] == "demo"
            assert hear(feed, "picture")["kind"] == "src"
        assert opened == [url]

    run_command(["demo", "--open"], look, monkeypatch)
    assert "frames read" in capsys.readouterr().out
