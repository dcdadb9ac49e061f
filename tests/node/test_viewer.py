"""The page's server as pages, foreign pages and HTTP clients meet it, without a browser; and what it is made of."""

import re
import time
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from fakes import Box, FakeSource, FakeSynthesizer, made_node, traits
from hypothesis import given, settings
from hypothesis import strategies as st
from viewer_clients import (
    TOKEN,
    get,
    host_of,
    lonely_viewer,
    nobody,
    received,
    taken_apart,
)
from wire_messages import class_map, depth, visibility, window

from gcd_client.images import colours, decode_jpegs, images
from gcd_client.protocol import MessageError
from gcd_node.config import parse_config
from gcd_node.errors import ConfigError, EndpointError
from gcd_node.viewer.feed import MOST_UNSEEN, MOST_WAITING, Mailbox, parse_request, picture
from gcd_node.viewer.server import ViewerServer, load_page, security_headers

pytestmark = pytest.mark.timeout(90)


@pytest.fixture
def viewer(tmp_path: Path) -> Iterator[ViewerServer]:
    with lonely_viewer(tmp_path) as opened:
        yield opened


# Laws.


@settings(deadline=None, max_examples=50)
@given(st.text(max_size=80) | st.binary(max_size=80))
def test_what_is_no_request_of_the_page_is_refused(text: str | bytes) -> None:
    with pytest.raises(MessageError):
        parse_request(text)


def test_a_mailbox_gives_the_newest_of_each_slot_in_the_order_of_the_slots() -> None:
    box = Mailbox()
    for slot, text in (("a", "old"), ("b", "1"), ("a", "new")):
        box.put(slot, text)
    assert [box.take(0.0) for _ in range(3)] == ["new", "1", None]


def test_a_browser_has_no_more_pictures_on_the_way_than_it_may() -> None:
    box, shown = Mailbox(), picture(received(window()))

    def taken() -> int:
        for each in range(10):
            box.put_picture(shown)
            if box.take(0.0) is None:
                return each
        return 10

    assert taken() == MOST_UNSEEN
    box.put("status", "text")
    assert box.take(0.0) == "text"  # texts do not wait for pictures
    box.shown(2)
    assert taken() == 2
    box.shown(10**9)  # more than it was sent
    assert taken() == MOST_UNSEEN


def test_a_mailbox_nobody_empties_does_not_grow() -> None:
    box = Mailbox()
    for number in range(10 * MOST_WAITING):
        box.put(f"event/{number}", str(number))
    kept = [box.take(0.0) for _ in range(MOST_WAITING + 1)]
    assert kept == [*(str(number) for number in range(9 * MOST_WAITING, 10 * MOST_WAITING)), None]


@pytest.mark.parametrize("encoding", ["rgb8", "jpeg"])
def test_a_view_is_sent_as_pictures_that_are_what_it_was(encoding: str) -> None:
    box = Box()
    config = parse_config(
        f'[source]\nkind = "synthetic"\npace = "lockstep"\n[model]\nweights = "fake"\n[view.main]\n'
        f'[publish]\nencoding = "{encoding}"'.encode(),
        "test",
    )
    made_node(config, FakeSynthesizer(traits()), FakeSource(14), box).run()
    message = box.of("win")[0]
    sent = picture(received(message, age_ms=message.header.age_ms + 50))
    head, payload = taken_apart(sent.part(7, sent.born_s + 1.0))
    assert (head["kind"], head["view"], head["number"], head["frames"]) == ("win", "main", 7, 14)
    assert head["age_ms"] == pytest.approx(message.header.age_ms + 1050, abs=1)
    assert head["left_ms"] == pytest.approx(message.header.valid_for_ms - 1050, abs=1)
    shown = decode_jpegs(payload, tuple(head["offsets"]), message.header.shape)
    assert np.abs(shown.astype(int) - images(message).astype(int)).mean() < 3


def test_maps_are_sent_without_loss_and_depth_as_grey_levels() -> None:
    for message, kind, levels in (
        (class_map(3), "cls", bytes(class_map(3).payload)),
        (visibility(3), "vis", bytes(visibility(3).payload)),
        (depth(3), "depth", colours(depth(3))[..., 0].tobytes()),
    ):
        head, payload = taken_apart(picture(received(message)).part(1, time.monotonic()))
        assert (head["kind"], zlib.decompress(payload)) == (kind, levels)
        assert [each["name"] for each in head["classes"] or ()] == [each.name for each in message.header.classes or ()]


# The page over HTTP.


def test_every_file_of_the_page_is_served_with_headers_that_let_nothing_else_in(viewer: ViewerServer) -> None:
    for path, file in load_page().items():
        status, headers, body = get(viewer, path)
        assert (status, body, headers["Content-Type"]) == (200, *file)
        assert headers["X-Content-Type-Options"] == "nosniff"
        policy = headers["Content-Security-Policy"]
        assert policy.startswith("default-src 'none'")
        assert "unsafe" not in policy
        assert f"connect-src 'self' ws://{host_of(viewer)};" in policy
        assert set(security_headers("x")) <= set(headers)


def test_the_page_needs_nothing_from_elsewhere_and_nothing_inline() -> None:
    page = {path: body.decode() for path, (body, _) in load_page().items()}
    assert {"/", "/viewer.css", "/main.js"} <= set(page)
    elsewhere = re.compile(r"(?<!xmlns=')(?:https?:)?//(?!www\.w3\.org/2000/svg)[a-z0-9]", re.IGNORECASE)
    for path, text in page.items():
        code = re.sub(r"^\s*//.*$|\s//\s.*$", "", text, flags=re.MULTILINE) if path.endswith(".js") else text
        found = [line for line in code.splitlines() if elsewhere.search(line) and "location.host" not in line]
        assert found == [], path
        assert "innerHTML" not in code
        assert "eval(" not in code
    assert not re.search(r"<script(?![^>]*\bsrc=)|<style|\sstyle=|\son[a-z]+=", page["/"])


def test_the_page_does_not_hold_the_token(viewer: ViewerServer) -> None:
    assert viewer.operator_url == f"{viewer.url}#token={TOKEN}"
    for path in load_page():
        _, headers, body = get(viewer, path)
        assert TOKEN not in body.decode() + str(headers)


@pytest.mark.parametrize(
    "hosts", [["evil.example"], ["127.0.0.1.evil.example:80"], [""], [], ["127.0.0.1", "evil.example"], ["0.0.0.0"]]
)
def test_a_foreign_name_made_to_point_here_gets_nothing(viewer: ViewerServer, hosts: list[str]) -> None:
    status, _, body = get(viewer, "/", hosts=hosts)
    assert status in (400, 403)
    assert b"<html" not in body
    assert get(viewer, "/", hosts=["localhost:9000"])[0] == 200  # a tunnel may end at another port


@pytest.mark.parametrize(
    "path", ["/../config.py", "/..%2fconfig.py", "/page/main.js", "//etc/passwd", "/feed/", "/x" * 40]
)
def test_there_are_no_other_files(viewer: ViewerServer, path: str) -> None:
    assert get(viewer, path)[0] == 404


@pytest.mark.parametrize("method", ["POST", "HEAD"])
def test_only_get_is_answered(viewer: ViewerServer, method: str) -> None:
    assert get(viewer, "/", method=method)[0] == 405


def test_a_page_of_another_site_is_not_told_what_is_here(viewer: ViewerServer) -> None:
    assert get(viewer, "/", Origin="https://evil.example")[0] == 403


@pytest.mark.parametrize("address", ["0.0.0.0:8470", "[::]:8470", "robot:8470", "", "127.0.0.1:", "127.0.0.1:70000"])
def test_others_than_ports_of_this_machine_are_refused(address: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError):
        ViewerServer(address, nobody(tmp_path))


def test_a_port_in_use_is_refused(viewer: ViewerServer, tmp_path: Path) -> None:
    with pytest.raises(EndpointError):
        ViewerServer(host_of(viewer), nobody(tmp_path))
