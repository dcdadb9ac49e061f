"""The page's server beside a running node, and the commands that start it. No browser."""

import os
import re
import signal
import subprocess
import sys
import threading
import time
import urllib.request
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cameras import Bench, Camera, until
from msgspec.structs import replace
from rig import Rig, rig_config
from viewer_clients import (
    TOKEN,
    WAIT_S,
    farewell,
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

from gcd_node.auth import Role, new_key_pair, write_key_pair
from gcd_node.config import PublishConfig, parse_config
from gcd_node.errors import ConfigError
from gcd_node.publisher import Publisher
from gcd_node.session import open_session
from gcd_node.viewer import server as server_module
from gcd_node.viewer.server import ViewerServer

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
            assert hear(late, "event", lambda told: told["fields"]["code"] == "VIEW_SET")["fields"]["view_rev"] == 2
            assert hear(late, "meta")["fields"]["views"] == ["main"]
            say(late, type="ask", id=1, verb="describe")
            assert hear(late, "reply")["result"]["limits"]["azimuth_deg"] == [-90.0, 90.0]


def test_a_page_that_never_reads_slows_neither_node_nor_others_and_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_module, "_PING_S", 0.5)
    monkeypatch.setattr(server_module, "_STUCK_S", 1.0)
    noise = np.random.default_rng(0).integers(0, 256, (14, 256, 384, 3), np.uint8)
    opened = partial(Publisher, PublishConfig(data=f"ipc://{tmp_path}/data", status=f"ipc://{tmp_path}/status"))
    with (
        opened() as publisher,
        ViewerServer("127.0.0.1:0", nobody(tmp_path)) as viewer,
        open_feed(viewer) as healthy,
    ):
        stuck = [raw_feed(viewer) for _ in range(3)]
        for each in stuck:
            send_raw(each, {"type": "watch", "view": "top"})
            for number in range(1, 40):  # it even says that it has seen everything
                send_raw(each, {"type": "got", "number": number})
        say(healthy, type="watch", view="top")
        until(lambda: publisher.stats.subscribers == 6 and len(viewer.browsers) == 4)
        for number in range(12):
            started_s = time.monotonic()
            publisher.send(window(number, images=noise))
            assert time.monotonic() - started_s < 10
            assert hear(healthy, "picture", lambda head, number=number: head["window_id"] >= number)
        until(lambda: len(viewer.browsers) == 1)
        for each in stuck:
            each.close()


@pytest.mark.parametrize("role", ["viewer", "operator"])
def test_a_node_that_asks_for_keys_asks_its_own_page_too(
    role: Role, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
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
    with open_session(settings, viewer=True):
        host, _, token = page_of(capfd).removeprefix("http://").partition("/#token=")
        with connect(f"ws://{host}/feed", origin=f"http://{host}", open_timeout=WAIT_S) as feed:  # type: ignore[arg-type]
            say(feed, type="hello", token=token)
            assert hear(feed, "role")["role"] == "operator"
            say(feed, type="ask", id=1, verb="views")
            assert hear(feed, "reply")["result"]["main"]["view_rev"] == 1
            say(feed, type="ask", id=2, verb="set_param", args={"steps": 3})
            assert hear(feed, "reply")["code"] == ("OK" if role == "operator" else "FORBIDDEN")


# As a process of its own.


def page_of(capfd: pytest.CaptureFixture[str]) -> str:
    """The address that a viewer prints."""
    told: list[str] = []

    def printed() -> bool:
        told.append(capfd.readouterr().err)
        return "page http" in "".join(told) and told[-1].endswith("\n")

    until(printed)
    found = re.search(r"page (http://127\.0\.0\.1:\d+/#token=\S{32})\n", "".join(told))
    assert found is not None, told
    return found[1]


def is_served(url: str) -> bool:
    try:
        urllib.request.urlopen(url.partition("#")[0], timeout=WAIT_S).close()
    except OSError:
        return False
    return True


def test_the_viewer_serves_without_torch_until_it_is_told_to_end(tmp_path: Path) -> None:
    code = "import sys; sys.modules['torch'] = None; from gcd_node.cli.main import main; main()"
    endpoints = [f"--{name}=ipc://{tmp_path}/{name}" for name in ("data", "status", "control")]
    command = [sys.executable, "-c", code, "viewer", "--http", "127.0.0.1:0", *endpoints]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        url = process.stderr.readline().removeprefix("page ").strip()
        host, _, token = url.removeprefix("http://").partition("/#token=")
        with connect(f"ws://{host}/feed", origin=f"http://{host}", open_timeout=WAIT_S) as feed:  # type: ignore[arg-type]
            say(feed, type="hello", token=token)
            assert hear(feed, "role")["role"] == "operator"
            process.terminate()
            assert farewell(feed)[0] == 1001
        assert process.wait(WAIT_S) == 0
        assert TOKEN not in process.stderr.read()


def test_a_launch_file_with_a_page_starts_a_viewer_that_ends_with_the_node(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    more = '[viewer]\nhttp = "127.0.0.1:0"\n[life]\nautostart = false'
    settings = rig_config(tmp_path, 'kind = "synthetic"', "[view.main]", more)
    with open_session(settings):
        assert not [thread.name for thread in threading.enumerate() if thread.name.startswith("viewer")]
    with open_session(settings, viewer=True):
        url = page_of(capfd)
        assert is_served(url)
        assert not [thread.name for thread in threading.enumerate() if thread.name.startswith("viewer")]
    assert not is_served(url)


def test_a_viewer_ends_with_a_node_that_is_killed(tmp_path: Path) -> None:
    code = (
        "import os, sys\nfrom pathlib import Path\nfrom rig import rig_config\n"
        "from gcd_node.session import open_session\n"
        f"more = '[viewer]\\nhttp = \"127.0.0.1:0\"\\n[life]\\nautostart = false'\n"
        f"settings = rig_config(Path({str(tmp_path)!r}), 'kind = \"synthetic\"', '[view.main]', more)\n"
        "with open_session(settings, viewer=True):\n    sys.stdin.read()\n"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join((str(Path(__file__).parent), *sys.path))}
    command = [sys.executable, "-c", code]
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, env=environment, **pipes) as process:
        assert process.stderr is not None
        url = process.stderr.readline().removeprefix("page ").strip()
        assert is_served(url)
        process.kill()
        until(lambda: not is_served(url))


def test_the_demo_opens_its_page_and_ends_with_ctrl_c(tmp_path: Path) -> None:
    opened = tmp_path / "opened"
    browser = tmp_path / "browser"
    browser.write_text(f"#!/bin/sh\necho $1 > {opened}\n")
    browser.chmod(0o700)
    command = [sys.executable, "-m", "gcd_node", "demo", "--open"]
    environment = os.environ | {"BROWSER": str(browser), "DISPLAY": ":0"}
    with subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        assert process.stderr is not None
        url = process.stderr.readline().removeprefix("page ").strip()
        host = url.removeprefix("http://").partition("/")[0]
        with connect(f"ws://{host}/feed", origin=f"http://{host}", open_timeout=WAIT_S, max_size=2**26) as feed:  # type: ignore[arg-type]
            assert hear(feed, "status", lambda told: told["fields"]["state"] == "active")["node_id"] == "demo"
            assert hear(feed, "picture")["kind"] == "src"
        until(opened.exists)
        assert opened.read_text().strip() == url
        os.killpg(process.pid, signal.SIGINT)
        out, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    assert "frames read" in out
