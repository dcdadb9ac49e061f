"""The page's server beside a running node, and the commands that start it. No browser."""

import os
import re
import signal
import subprocess
import sys
import threading
import time
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from cameras import Bench, Camera, until
from fakes import fake_config
from media import environment
from msgspec.structs import replace
from rig import Rig
from viewer_clients import TOKEN, WAIT_S, answer, farewell, hear, open_feed, raw_feed, role, say, send_raw, viewer_of
from wire_messages import window

from gcd_node.auth import Role, new_key_pair, write_key_pair
from gcd_node.config import PublishConfig
from gcd_node.errors import ConfigError
from gcd_node.publisher import Publisher
from gcd_node.session import open_session
from gcd_node.viewer import feed as feed_module
from gcd_node.viewer import server as server_module

pytestmark = pytest.mark.timeout(90)
LOOPBACK = "tcp://127.0.0.1:0"


# Beside a node.


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


def test_a_page_that_never_reads_slows_neither_node_nor_others_and_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_module, "_PING_S", 0.5)
    monkeypatch.setattr(feed_module, "_STUCK_S", 1.0)
    noise = np.random.default_rng(0).integers(0, 256, (14, 256, 384, 3), np.uint8)
    endpoints = PublishConfig(data=f"ipc://{tmp_path}/data", status=f"ipc://{tmp_path}/status")
    with Publisher(endpoints) as publisher, viewer_of(tmp_path) as viewer, open_feed(viewer.url) as healthy:
        stuck = [raw_feed(viewer) for _ in range(3)]
        for each in stuck:
            send_raw(each, {"type": "watch", "view": "top"})
            for _ in range(40):  # it even says that it has seen everything
                send_raw(each, {"type": "got"})
        say(healthy, "watch", view="top")
        until(lambda: publisher.stats.subscribers == 6 and viewer.browsers == 4)
        for number in range(12):
            started_s = time.monotonic()
            publisher.send(window(number, images=noise))
            assert time.monotonic() - started_s < 10
            assert hear(healthy, "picture", lambda head, number=number: head["header"]["window_id"] >= number)
        until(lambda: viewer.browsers == 1)
        for each in stuck:
            each.close()


@pytest.mark.parametrize("page_role", ["viewer", "operator"])
def test_a_node_that_asks_for_keys_asks_its_own_page_too(
    page_role: Role, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
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

    def address() -> "re.Match[str] | None":
        told.append(capfd.readouterr().err)
        return re.search(r"page (http://127\.0\.0\.1:\d+/)#token=(\S{32})\n", "".join(told))

    with open_session(settings, viewer=True):
        until(lambda: address() is not None)
        found = address()
        assert found is not None
        with open_feed(found[1]) as feed:
            assert role(feed, token=found[2]) == ("operator", False)
            assert answer(feed, "views")["result"]["main"]["view_rev"] == 1
            assert answer(feed, "set_param", steps=3)["code"] == ("OK" if page_role == "operator" else "FORBIDDEN")


# As a process of its own.


def printed_page(process: "subprocess.Popen[str]") -> str:
    """The address that a viewer prints, its token included."""
    assert process.stderr is not None
    return process.stderr.readline().removeprefix("page ").strip()


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
        url = printed_page(process)
        with open_feed(url) as feed:
            assert role(feed, token=url.partition("#token=")[2]) == ("operator", False)
            process.terminate()
            assert farewell(feed) == 1001
        assert process.wait(WAIT_S) == 0


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
    with subprocess.Popen([sys.executable, "-c", code], env=environment(), text=True, **pipes) as process:
        url = printed_page(process)
        assert is_served(url)
        if end == "killed":
            process.kill()
        else:
            process.communicate("", timeout=WAIT_S)
            assert process.returncode == 0
        until(lambda: not is_served(url))


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
