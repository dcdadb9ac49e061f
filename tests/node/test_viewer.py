"""The page's server without a browser and without a node: what it serves and to whom, what a feed gives, and what
hostile clients can do with both."""

import asyncio
import contextlib
import logging
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any, cast
from unittest.mock import create_autospec

import numpy as np
import pytest
from cameras import Bench, Camera, environment, until
from fakes import fake_config
from msgspec.structs import replace
from rig import Rig
from viewer_clients import (
    TOKEN,
    WAIT_S,
    answer,
    deaf,
    endpoints_in,
    farewell,
    get,
    hear,
    host_of,
    open_feed,
    role,
    say,
    taken_apart,
    viewer_of,
)
from websockets.exceptions import ConnectionClosed, InvalidStatus
from wire_messages import class_map, depth, jpeg_window, pixels, received, visibility, window

from gcd_client.images import colours, decode_jpegs, images
from gcd_node.auth import Role, new_key_pair, write_key_pair
from gcd_node.config import PublishConfig
from gcd_node.errors import ConfigError, EndpointError
from gcd_node.publisher import Publisher
from gcd_node.session import open_session
from gcd_node.viewer import feed as feed_module
from gcd_node.viewer.feed import MOST_UNSEEN, MOST_WAITING, Browser, NodeLink, picture
from gcd_node.viewer.server import HEADERS, MOST_BROWSERS, ViewerServer, load_page


@pytest.fixture
def viewer(tmp_path: Path) -> Iterator[ViewerServer]:
    with viewer_of(tmp_path) as opened:
        yield opened


def silent_browser() -> Browser:
    return Browser(cast("Any", None), cast("Any", None), TOKEN)


def test_of_what_waits_a_browser_gets_the_newest_in_the_order_of_the_slots_and_never_too_much() -> None:
    browser = silent_browser()
    for slot, text in (("a", "old"), ("b", "1"), ("a", "new")):
        browser.put(slot, text)
    assert [browser.next_message() for _ in range(3)] == ["new", "1", None]
    for number in range(10 * MOST_WAITING):
        browser.put(f"event/{number}", str(number))
    kept = [browser.next_message() for _ in range(MOST_WAITING + 1)]
    assert kept == [*(str(number) for number in range(9 * MOST_WAITING, 10 * MOST_WAITING)), None]


def test_a_browser_has_no_more_pictures_on_the_way_than_it_may() -> None:
    browser, shown = silent_browser(), picture(received(window()))

    def taken() -> int:
        for each in range(10):
            browser.put("picture", shown)
            if browser.next_message() is None:
                return each
        return 10

    assert taken() == MOST_UNSEEN
    browser.put("picture", shown)
    time.sleep(0.05)
    browser.put("status", "text")
    assert browser.next_message() == "text"  # texts do not wait for pictures
    browser.shown()
    late = browser.next_message()
    assert taken_apart(late)[0]["waited_ms"] >= 50
    browser.shown()
    browser.shown()
    assert taken() == 2
    for _ in range(1000):  # more than it was sent
        browser.shown()
    assert taken() == MOST_UNSEEN


def test_a_view_is_sent_as_pictures_that_are_what_it_was() -> None:
    for message in (window(images=pixels(0, 14, 64, 96)), jpeg_window()):
        sent = picture(received(message, age_ms=message.header.age_ms + 50))
        head, payload = taken_apart(bytes(4) + sent)
        assert (head["kind"], head["header"]["view_id"]) == ("win", "top")
        assert head["age_ms"] == message.header.age_ms + 50
        assert head["left_ms"] == message.header.valid_for_ms - 50
        shown = decode_jpegs(payload, tuple(head["offsets"]), message.header.shape)
        if message.header.encoding == "jpeg":
            assert payload == message.payload
        assert shown.shape == images(message).shape
        assert np.abs(shown.mean(axis=(1, 2)) - images(message).mean(axis=(1, 2))).max() < 3
    for message, kind, levels in (
        (class_map(3), "cls", bytes(class_map(3).payload)),
        (visibility(3), "vis", bytes(visibility(3).payload)),
        (depth(3), "depth", colours(depth(3))[..., 0].tobytes()),
    ):
        head, payload = taken_apart(bytes(4) + picture(received(message)))
        assert (head["kind"], zlib.decompress(payload)) == (kind, levels)  # without loss; depth as grey levels
        classes = head["header"].get("classes", ())
        assert [each["name"] for each in classes] == [each.name for each in message.header.classes or ()]


def test_every_file_is_served_with_headers_that_let_nothing_in_and_no_token(viewer: ViewerServer) -> None:
    assert viewer.operator_url == f"{viewer.url}#token={TOKEN}"
    for path, (content, kind) in load_page().items():
        status, headers, body = get(viewer, path)
        assert (status, body, headers["Content-Type"]) == (200, content, f"{kind}; charset=utf-8")
        assert HEADERS.items() <= dict(headers).items()
        assert TOKEN not in body.decode() + str(headers)
    assert HEADERS["Content-Security-Policy"].startswith("default-src 'none'")
    assert "unsafe" not in HEADERS["Content-Security-Policy"]


def test_a_page_shows_within_two_seconds_that_its_node_is_dead() -> None:
    link, main = (load_page()[name][0].decode() for name in ("/link.js", "/main.js"))
    silences = re.findall(r"(?:BEAT_LOST|NODE_SILENT)_MS = (\d+)", link)
    (look_ms,) = re.findall(r"TICK_MS = (\d+)", main)
    assert max(map(int, silences)) + int(look_ms) <= 2000


def test_a_foreign_name_made_to_point_here_gets_nothing(viewer: ViewerServer) -> None:
    for hosts in (["evil.example"], ["127.0.0.1.evil.example:80"], [""], [], ["127.0.0.1", "evil"], ["0.0.0.0"]):
        status, _, body = get(viewer, "/", hosts=hosts)
        assert (status in (400, 403), b"<html" in body) == (True, False), hosts
    assert get(viewer, "/", hosts=["localhost:9000"])[0] == 200  # a tunnel may end at another port
    for path in ("/../config.py", "/..%2fconfig.py", "/page/main.js", "//etc/passwd", "/feed/", "/x" * 40):
        assert get(viewer, path)[0] == 404, path
    for method in ("POST", "HEAD"):
        assert get(viewer, "/", method=method)[0] == 405
    assert get(viewer, "/", Origin="https://evil.example")[0] == 403
    for origin in ("http://evil.example", "null", "http://127.0.0.1:1", "https://{host}", "http://localhost", ""):
        with pytest.raises(InvalidStatus) as refused:
            open_feed(viewer.url, origin.format(host=host_of(viewer)))
        assert refused.value.response.status_code == 403, origin


def test_others_than_free_ports_of_this_machine_are_refused(viewer: ViewerServer, tmp_path: Path) -> None:
    for address in ("0.0.0.0:8470", "[::]:8470", "robot:8470", "", "127.0.0.1:", "127.0.0.1:70000", host_of(viewer)):
        with pytest.raises(EndpointError if address == host_of(viewer) else ConfigError):
            ViewerServer(address, endpoints_in(tmp_path))


def test_who_comes_is_a_viewer_until_the_token_is_shown_which_is_in_no_log_and_asks_for_what_a_page_may(
    viewer: ViewerServer, caplog: pytest.LogCaptureFixture
) -> None:
    for name in (None, "gcd_node", "websockets", "websockets.server"):
        caplog.set_level(logging.DEBUG, logger=name)
    never = ("shutdown", "remove_view", "record_start", "nonsense")
    with open_feed(viewer.url) as feed:
        for said, given, verbs in (
            ({}, ("viewer", False), ("set_view", "set_param", "get_config", *never)),
            ({"token": TOKEN + "x"}, ("viewer", True), never),
            ({"token": TOKEN}, ("operator", False), never),
        ):
            assert role(feed, **said) == given
            for verb in verbs:  # refused without asking the node
                assert answer(feed, verb, view="main")["code"] == "FORBIDDEN"
    told = [record.getMessage() for record in caplog.records if record.name != "websockets.client"]  # our own end
    assert not [line for line in told if TOKEN in line]


def test_a_ninth_page_is_asked_to_wait(viewer: ViewerServer) -> None:
    with contextlib.ExitStack() as stack:
        for _ in range(MOST_BROWSERS):
            stack.enter_context(open_feed(viewer.url))
        until(lambda: viewer.browsers == MOST_BROWSERS)
        with open_feed(viewer.url) as ninth:
            assert farewell(ninth) == 1013
        assert get(viewer, "/")[0] == 200
    until(lambda: viewer.browsers == 0)
    with open_feed(viewer.url) as feed:
        assert hear(feed, "beat")


def test_who_sends_what_no_page_sends_or_too_much_is_sent_away_and_others_do_not_notice(viewer: ViewerServer) -> None:
    wrong = ("{}", "[" * 4000, '{"type":"watch","view":"../x"}', '{"type":"got","more":2}', b"\0\1")
    with open_feed(viewer.url) as other:
        for sent, code in (("x" * 5000, 1009), *((each, 1008) for each in wrong)):
            with open_feed(viewer.url) as feed:
                feed.send(sent)
                assert farewell(feed) == code
        with open_feed(viewer.url) as feed:
            with contextlib.suppress(ConnectionClosed):
                for _ in range(100_000):
                    say(feed, "got")
            assert farewell(feed) == 1008
        assert role(other, token=TOKEN) == ("operator", False)


def test_a_page_that_takes_seconds_for_a_message_may_say_as_much_as_any_other() -> None:
    class Slow:
        code: int | None = None

        async def send(self, _: str) -> None:
            await asyncio.sleep(60)

        async def close(self, code: int, _: str) -> None:
            self.code = code

        async def __aiter__(self) -> AsyncIterator[str]:
            for _ in range(2):
                for _ in range(80):
                    yield '{"type":"got"}'
                await asyncio.sleep(0.6)

    slow = Slow()
    asyncio.run(Browser(cast("Any", slow), create_autospec(NodeLink), TOKEN).serve())
    assert slow.code is None


@pytest.mark.slow
def test_the_end_waits_for_nobody(tmp_path: Path) -> None:
    with viewer_of(tmp_path, control=False) as viewer, open_feed(viewer.url) as feed:  # a node without a control socket
        assert hear(feed, "welcome")["commands"] is False
        role(feed, token=TOKEN)
        assert "[control]" in answer(feed, "describe")["message"]
    with contextlib.ExitStack() as stack:
        with viewer_of(tmp_path) as viewer:
            host, port = host_of(viewer).split(":")
            stack.enter_context(socket.create_connection((host, int(port)), WAIT_S))
            *_, feed = (
                stack.enter_context(open_feed(viewer.url, **each)) for each in (*(deaf(viewer) for _ in range(3)), {})
            )
            hear(feed, "beat")
            began_s = time.monotonic()
        assert time.monotonic() - began_s < 20
        assert farewell(feed) == 1001


# The page's server beside a running node, and the commands that start it. No browser.


LOOPBACK = "tcp://127.0.0.1:0"


def test_pictures_come_only_while_somebody_looks_and_an_operator_steers_the_node(tmp_path: Path) -> None:
    camera = Camera()
    with Rig(tmp_path, Bench(camera), watched=False) as rig, viewer_of(tmp_path) as viewer:
        rig.await_state("active")
        assert rig.publisher.stats.subscribers == 0
        with open_feed(viewer.url) as feed:
            say(feed, "watch", view="main")
            until(lambda: rig.publisher.stats.subscribers == 6)  # src/frm, win, std, cls, vis, depth
            threading.Thread(target=camera.run, args=(60,), daemon=True).start()
            header = hear(feed, "picture", lambda head: head["kind"] == "src")["header"]
            assert (header["synthetic"], header["shape"][0]) == (False, 1)
            header = hear(feed, "picture", lambda head: head["kind"] == "win")["header"]
            assert (header["view_id"], header["view_rev"], header["shape"][0]) == ("main", 1, 14)
            assert header["synthetic"]
            assert hear(feed, "status")["fields"]["state"] == "active"
            assert hear(feed, "beat")["silent_ms"] < 30_000
        until(lambda: rig.publisher.stats.subscribers == 0)
        with open_feed(viewer.url) as feed:
            assert role(feed, token=TOKEN) == ("operator", False)
            reply = answer(feed, "set_view", view="main", azimuth_deg=20.0)
            assert (reply["ok"], reply["result"]["view_rev"]) == (True, 2)
            assert answer(feed, "set_view", view="main", azimuth_deg=1000.0)["code"] == "OUT_OF_RANGE"
        rig.await_event("VIEW_SET")
        with open_feed(viewer.url) as late:  # which knows what happened
            assert hear(late, "event", lambda told: told["fields"]["code"] == "VIEW_SET")["fields"]["view_rev"] == 2
            assert hear(late, "meta")["fields"]["views"] == ["main"]
            assert answer(late, "describe")["result"]["limits"]["azimuth_deg"] == [-90.0, 90.0]


def test_a_page_that_never_reads_slows_nobody_and_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(feed_module, "_STUCK_S", 1.0)
    noise = np.random.default_rng(0).integers(0, 256, (14, 256, 384, 3), np.uint8)
    endpoints = PublishConfig(data=f"ipc://{tmp_path}/data", status=f"ipc://{tmp_path}/status")
    with Publisher(endpoints) as publisher, viewer_of(tmp_path) as viewer, contextlib.ExitStack() as stack:
        healthy, *stuck = (
            stack.enter_context(open_feed(viewer.url, **each)) for each in ({}, *(deaf(viewer) for _ in range(3)))
        )
        for each in (healthy, *stuck):
            say(each, "watch", view="top")
            for _ in range(40 * (each is not healthy)):  # it even says that it has seen everything
                say(each, "got")
        until(lambda: publisher.stats.subscribers == 6 and viewer.browsers == 4)
        for number in range(12):
            started_s = time.monotonic()
            publisher.send(window(number, images=noise))
            assert time.monotonic() - started_s < 10
            assert hear(healthy, "picture", lambda head, number=number: head["header"]["window_id"] >= number)
        until(lambda: viewer.browsers == 1)


@pytest.mark.parametrize("page_role", ["viewer", "operator"])
def test_a_node_with_keys_asks_its_page_too(page_role: Role, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    node_keys, page_keys = new_key_pair(), new_key_pair()
    write_key_pair(tmp_path / "node", node_keys)
    write_key_pair(tmp_path / "page", page_keys)
    (tmp_path / "allow.toml").write_text(f'[client.page]\nkey = "{page_keys.public}"\nrole = "{page_role}"\n')
    endpoints = {"publish.data": LOOPBACK, "publish.status": f"ipc://{tmp_path}/status", "control.endpoint": LOOPBACK}
    files = {"security.keys": tmp_path / "node", "security.allow": tmp_path / "allow.toml"}
    changes = {**endpoints, **files, "viewer.http": "127.0.0.1:0", "life.autostart": "false"}
    changes["model.weights"] = "random:kubric90"
    settings = fake_config(*(f"{key}={value}" for key, value in changes.items()))
    with pytest.raises(ConfigError, match=r"\[viewer\] keys"), open_session(settings):
        pass
    settings = replace(settings, viewer=replace(settings.viewer, keys=str(tmp_path / "page")))
    told: list[str] = []
    with open_session(settings, viewer=True):
        until(lambda: told.append(capfd.readouterr().err) or "#token" in "".join(told))
        url, _, token = "".join(told).partition("page ")[2].strip().partition("#token=")
        with open_feed(url) as feed:
            assert role(feed, token=token) == ("operator", False)
            assert answer(feed, "views")["result"]["main"]["view_rev"] == 1
            assert answer(feed, "set_param", steps=3)["code"] == ("OK" if page_role == "operator" else "FORBIDDEN")


def printed_page(process: "subprocess.Popen[str]") -> str:
    """The address that a viewer prints, its token included."""
    return process.stderr.readline().removeprefix("page ").strip()


@pytest.mark.slow
def test_the_viewer_serves_without_torch_until_it_is_told_to_end(tmp_path: Path) -> None:
    code = "import sys; sys.modules['torch'] = None; from gcd_node.cli.main import main; main()"
    endpoints = [f"--{name}=ipc://{tmp_path}/{name}" for name in ("data", "status", "control")]
    command = [sys.executable, "-c", code, "viewer", "--http", "127.0.0.1:0", *endpoints]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        url = printed_page(process)
        with open_feed(url) as feed:
            assert role(feed, token=url.partition("#token=")[2]) == ("operator", False)
            process.terminate()
            assert farewell(feed) == 1001
        assert process.wait(WAIT_S) == 0


@pytest.mark.slow
@pytest.mark.parametrize("end", ["in order", "killed"])
def test_a_launch_file_with_a_page_starts_a_viewer_that_ends_with_the_node(end: str, tmp_path: Path) -> None:
    code = f"""
import sys, threading
from pathlib import Path
from rig import rig_config
from gcd_node.session import open_session
more = '[viewer]\\nhttp = "127.0.0.1:0"\\n[life]\\nautostart = false'
settings = rig_config(Path({str(tmp_path)!r}), 'kind = "synthetic"', '[view.main]', more)
with open_session(settings, viewer=True):
    assert not [each for each in threading.enumerate() if each.name.startswith('viewer')]
    sys.stdin.read()
"""
    pipes = {"stdin": subprocess.PIPE, "stderr": subprocess.PIPE}
    started = subprocess.Popen([sys.executable, "-c", code], env=environment(), text=True, **pipes)
    with started as process, open_feed(printed_page(process)) as feed:
        if end == "killed":
            process.kill()
        else:
            process.communicate("", timeout=WAIT_S)
            assert process.returncode == 0
        assert farewell(feed)


@pytest.mark.slow
def test_the_demo_opens_its_page_and_ends_with_ctrl_c(tmp_path: Path) -> None:
    opened, browser = tmp_path / "opened", tmp_path / "browser"
    browser.write_text(f"#!/bin/sh\necho $1 > {opened}\n")
    browser.chmod(0o700)
    command = [sys.executable, "-m", "gcd_node", "demo", "--open"]
    screen = os.environ | {"BROWSER": str(browser), "DISPLAY": ":0"}
    with subprocess.Popen(
        command, env=screen, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        url = printed_page(process)
        with open_feed(url) as feed:
            assert hear(feed, "status", lambda told: told["fields"]["state"] == "active")["node_id"] == "demo"
            assert hear(feed, "picture")["kind"] == "src"
        until(opened.exists)
        assert opened.read_text().strip() == url
        os.killpg(process.pid, signal.SIGINT)
        out, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    assert "frames read" in out
