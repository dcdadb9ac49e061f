"""The control client against a ROUTER that answers as a test wants it."""

import asyncio
import json
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zmq

from gcd_client.control import MAX_REQUEST, Code, ControlClient, ControlError, Reply, decode_reply

pytestmark = pytest.mark.timeout(30)
Answer = Callable[[dict[str, Any]], bytes | None]


def reply(request: dict[str, Any], **fields: Any) -> bytes:
    """What a node answers to a request."""
    told = {"id": request["id"], "ok": True, "code": "OK", "message": "", "state": "active", "proto": "gcd/1.0"}
    return json.dumps({**told, **fields}).encode()


class FakeNode:
    """Answers each request by `answer`; None: not at all."""

    def __init__(self, endpoint: str) -> None:
        self.endpoint, self.requests = endpoint, list[dict[str, Any]]()
        self.answer: Answer = reply
        self._context = zmq.Context()
        self._router, self._stop = self._context.socket(zmq.ROUTER), threading.Event()
        self._router.bind(endpoint)
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._context.destroy(linger=0)

    def _serve(self) -> None:
        while not self._stop.is_set():
            if self._router.poll(20):
                peer, part = self._router.recv_multipart()
                self.requests.append(json.loads(part))
                answer = self.answer(self.requests[-1])
                if answer is not None:
                    self._router.send_multipart((peer, answer))


@pytest.fixture
def node(tmp_path: Path) -> Iterator[FakeNode]:
    made = FakeNode(f"ipc://{tmp_path}/control")
    yield made
    made.close()


@pytest.fixture
def client(node: FakeNode) -> Iterator[ControlClient]:
    with ControlClient(node.endpoint, timeout_s=10.0, attempts=1) as made:
        yield made


def test_a_request_is_what_the_protocol_says(node: FakeNode, client: ControlClient) -> None:
    answer = client.request(
        "set_view", {"view": "top", "azimuth_deg": 30.0}, dry_run=True, if_view_rev=3, request_id="a"
    )
    assert answer == Reply(id="a", ok=True, code=Code.OK, message="", state="active")
    told = {"proto": "gcd/1.0", "id": "a", "verb": "set_view", "dry_run": True, "if_view_rev": 3}
    assert node.requests == [told | {"args": {"view": "top", "azimuth_deg": 30.0}}]


def test_call_gives_the_result_and_raises_a_refusal(node: FakeNode, client: ControlClient) -> None:
    node.answer = lambda request: reply(request, result={"view_rev": 2})
    assert client.call("views") == {"view_rev": 2}
    node.answer = lambda request: reply(request, ok=False, code="UNKNOWN_VIEW", message="known are top")
    assert client.request("set_view", {"view": "nose"}).code is Code.UNKNOWN_VIEW
    with pytest.raises(ControlError, match="set_view: UNKNOWN_VIEW: known are top") as caught:
        client.call("set_view", {"view": "nose"})
    assert (caught.value.code, caught.value.exit_code) == ("UNKNOWN_VIEW", 70)


def test_asyncio_asks_and_commands(node: FakeNode, client: ControlClient) -> None:
    async def ask() -> None:
        node.answer = lambda request: reply(request, result={"a": 1})
        assert (await client.request_async("state", request_id="x")).id == "x"
        assert await client.call_async("state") == {"a": 1}
        node.answer = lambda request: reply(request, ok=False, code="BUSY")
        with pytest.raises(ControlError, match="BUSY"):
            await client.call_async("activate")

    asyncio.run(asyncio.wait_for(ask(), 20))


def test_a_lost_reply_is_asked_for_again_under_the_same_id(node: FakeNode) -> None:
    node.answer = lambda request: None if len(node.requests) < 2 else reply(request)
    with ControlClient(node.endpoint, timeout_s=20.0, attempts=40) as client:
        assert client.request("hello").ok
    assert node.requests[0] == node.requests[1]


def test_replies_to_others_are_thrown_away(node: FakeNode) -> None:
    late = ControlClient(node.endpoint, timeout_s=0.3, attempts=1)
    node.answer = lambda request: reply(request, id="an older request")
    with late, pytest.raises(ControlError, match="did not answer"):
        late.call("hello")


def test_nobody_there_is_an_error_without_a_code(tmp_path: Path) -> None:
    with (
        ControlClient(f"ipc://{tmp_path}/nobody", timeout_s=0.1) as client,
        pytest.raises(ControlError, match="is the node running") as caught,
    ):
        client.call("hello")
    assert (caught.value.code, caught.value.exit_code) == (None, 69)


def test_f17_the_client_refuses_before_anything_is_sent(node: FakeNode, client: ControlClient) -> None:
    with pytest.raises(ControlError) as caught:
        client.call("remove_view", {"view": "x" * MAX_REQUEST})
    assert caught.value.code == "TOO_LARGE"
    assert client.request("hello").ok
    assert [request["verb"] for request in node.requests] == ["hello"]


def test_a_reply_may_have_more_keys_and_a_newer_minor() -> None:
    part = reply({"id": "x"}, proto="gcd/1.7", new=1)
    assert decode_reply(part).ok
    made = Reply(id="x", ok=True, code=Code.ACCEPTED, message="", state="active", result={"view_rev": 2})
    assert decode_reply(msgspec.json.encode(made)) == made


BAD_REPLIES = [b"", b"[]", b"{}", b"\xff", b"[" * 50_000, b'{"id": "\xff"}', reply({"id": "x"}, proto="gcd/2.0")]
BAD_REPLIES += [reply({"id": "x"}, code="NEW"), reply({"id": 1}), reply({"id": "x"}, result={"a": "@"})]
BAD_REPLIES[-1] = BAD_REPLIES[-1].replace(b'"@"', b"9" * 5000)


@pytest.mark.parametrize("part", BAD_REPLIES, ids=lambda part: part[:30])
def test_what_is_no_reply_is_a_control_error(node: FakeNode, client: ControlClient, part: bytes) -> None:
    node.answer = lambda _: part
    with pytest.raises(ControlError, match="no reply of a gcd node"):
        client.call("hello")
