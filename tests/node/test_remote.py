"""A model that computes elsewhere: the same views, by a deadline, or none; what a node does meanwhile."""

import asyncio
import shutil
import socket
import ssl
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from http.server import BaseHTTPRequestHandler
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from cameras import Bench, Camera, until
from fakes import TINY, FakeSource, FakeSynthesizer, fake_config, live_traits, painting_traits, run, traits
from msgspec.structs import replace as struct_replace
from mutations import BYTE_PIECES, TEXT_PIECES, Mutator
from remote_service import Act, ServiceStandIn, WholeLevels, respond
from rig import Rig

from gcd_client.protocol import MAX_HEADER, MAX_PAYLOAD, PREFIX, pack, unpack
from gcd_model import (
    Augmentation,
    Cancelled,
    Clip,
    RenderOptions,
    SphericalDelta,
    Traits,
    Trajectory,
    View,
    ViewSynthesizer,
)
from gcd_model.networks import random_networks
from gcd_model.synthesizer import Synthesizer
from gcd_model.weights.card import FAMILIES
from gcd_node import fleet
from gcd_node.config import ModelSection, parse_config
from gcd_node.errors import ConfigError, RemoteError
from gcd_node.fleet import RefusedError, Replica, ServiceConfig, load_service
from gcd_node.model import ModelSlot
from gcd_node.remote import RemoteSynthesizer, Service, open_remote
from gcd_node.remote_messages import model_digest
from gcd_node.session import load_model
from gcd_node.stream_context import config_digest

DEADLINE_S = 0.4
SLACK_S = 1.0  # what a machine that does other things may add


def remote(
    service: ServiceStandIn, *, fallback: ViewSynthesizer | None = None, deadline_s: float = DEADLINE_S
) -> RemoteSynthesizer:
    section = ModelSection(weights=service.address, engine="remote", deadline_s=deadline_s)
    made = open_remote(section)
    made.fallback = fallback
    return made


def rendered(model: ViewSynthesizer, level: int = 90, options: RenderOptions | None = None) -> list[View]:
    """Views of a clip with noise, encoded a frame at a time as a node does it."""
    config = model.traits.config
    video = torch.rand(config.frames, 3, config.height, config.width, generator=torch.Generator().manual_seed(level))
    levels = (video * 255).round() / 127.5 - 1
    first, *others = (
        model.encode(Clip(video=frame[None], fps=12.0), Augmentation(strength=0.02, seed=seed))
        for seed, frame in enumerate(levels)
    )
    return model.render(first.followed_by(*others), paths(model.traits), options or RenderOptions(seed=5))


def paths(made: Traits) -> list[Trajectory]:
    if made.config.camera == "none":
        return [made.plan_view()]
    free = torch.eye(4, dtype=torch.float64).repeat(made.config.frames, 1, 1)
    delta = SphericalDelta(azimuth_deg=20.0)
    return [made.plan_view(delta), made.plan_poses(free) if made.takes_any_pose else made.plan_view()]


def posed_traits() -> Traits:
    """Of a model that takes any pose: some of its paths have no angles."""
    made = traits("kubric90")
    return replace(made, config=struct_replace(made.config, camera="relative_pose"), family=FAMILIES["manipulation"])


@pytest.mark.parametrize(
    "made",
    [traits("kubric90"), traits("driving"), painting_traits(), posed_traits()],
    ids=["steered", "fixed", "semantic", "posed"],
)
def test_views_from_elsewhere_are_those_of_the_same_model_here(made: Traits) -> None:
    options = RenderOptions(seed=5, samples=2)
    with ServiceStandIn(model := WholeLevels(made)) as service:
        there = rendered(remote(service), options=options)
    here = rendered(model, options=options)
    assert len(there) == len(here)
    for far, near in zip(there, here, strict=True):
        assert torch.equal(far.samples, near.samples)
        assert (far.classes is None) == (near.classes is None)
        assert far.classes is None or torch.equal(far.classes, near.classes)
        assert torch.equal(far.trajectory.source_from_target, near.trajectory.source_from_target)


def test_a_real_network_draws_the_same_noise_there() -> None:
    made = replace(traits("driving"), config=struct_replace(TINY, height=32, width=64))
    model = Synthesizer(random_networks(made.config, seed=0), made)
    options = RenderOptions(seed=7, steps=1, whole_levels=True)
    with ServiceStandIn(model) as service:
        far = open_remote(ModelSection(weights=service.address, engine="remote", deadline_s=30.0))
        there = rendered(far, options=options)
    assert far.traits.to_metadata() == made.to_metadata()
    assert all(torch.equal(a.samples, b.samples) for a, b in zip(there, rendered(model, options=options), strict=True))


# What may come back instead.


def never(_: BaseHTTPRequestHandler, __: Callable[[], bytes]) -> None:
    time.sleep(2 * DEADLINE_S)


def drop_by_drop(request: BaseHTTPRequestHandler, _: Callable[[], bytes]) -> None:
    for _ in range(20):
        request.wfile.write(b"H")
        time.sleep(DEADLINE_S / 5)


def cut_short(request: BaseHTTPRequestHandler, reply: Callable[[], bytes]) -> None:
    content = reply()
    request.send_response(200)
    request.send_header("content-length", str(len(content)))
    request.end_headers()
    request.wfile.write(content[: len(content) // 2])


def changed(edit: Callable[[bytes], bytes], status: int = 200) -> Act:
    return lambda request, reply: respond(request, edit(reply()), status)


FAULTS: dict[str, Act] = {
    "never": never,
    "drop_by_drop": drop_by_drop,
    "cut_short": cut_short,
    "hangs_up": lambda request, _: request.connection.close(),
    "no_http": lambda request, _: request.wfile.write(b"\x00\x01garbage\r\n\r\n"),
    "503": changed(lambda _: b"no replica", 503),
    "nothing": changed(lambda _: b""),
    "garbage": changed(lambda reply: bytes(len(reply))),
    "a_byte_damaged": changed(lambda reply: reply[:-5] + bytes([reply[-5] ^ 1]) + reply[-4:]),
    "too_long": changed(lambda reply: reply + bytes(PREFIX.size + MAX_HEADER)),
}


@pytest.mark.parametrize("fault", FAULTS.values(), ids=FAULTS)
def test_a_reply_that_is_late_or_wrong_gives_no_view_and_the_next_window_is_rendered(fault: Act) -> None:
    with ServiceStandIn(WholeLevels(traits())) as service:
        far = remote(service, deadline_s=SLACK_S)
        service.act = fault
        started_s = time.monotonic()
        with pytest.raises(RemoteError):
            rendered(far)
        assert time.monotonic() - started_s < 2 * SLACK_S
        service.act = None
        assert len(rendered(far)) == 2


def test_views_of_another_stream_or_window_are_refused() -> None:
    kept: list[bytes] = []

    def keep(request: BaseHTTPRequestHandler, reply: Callable[[], bytes]) -> None:
        kept.append(reply())
        respond(request, kept[-1])

    with ServiceStandIn(WholeLevels(traits())) as service:
        far, other = remote(service), remote(service)
        service.act = keep
        rendered(far)
        service.act = lambda request, _: respond(request, kept[0])
        for each in (far, other):
            with pytest.raises(RemoteError, match="due"):
                rendered(each)


@pytest.mark.parametrize(
    "change",
    [{"sha256_12": "1" * 12}, {"precision": "bfloat16"}, {"family": FAMILIES["kubric180"]}],
    ids=["weights", "precision", "family"],
)
def test_a_service_that_serves_another_model_now_is_refused_until_the_node_is_configured_anew(
    change: dict[str, object],
) -> None:
    with ServiceStandIn(model := WholeLevels(traits("kubric90"))) as service:
        far = remote(service)
        model.traits = replace(model.traits, **change)
        with pytest.raises(RemoteError, match="configure anew"):
            rendered(far)
        assert rendered(remote(service))


def test_nobody_there_is_told_at_once_and_a_name_that_does_not_resolve_by_the_deadline() -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    for address in (f"http://127.0.0.1:{port}", "http://gcd.invalid:8000"):
        far = RemoteSynthesizer(Service(address=address), traits(), "0" * 12, deadline_s=DEADLINE_S)
        started_s = time.monotonic()
        with pytest.raises(RemoteError):
            rendered(far)
        assert time.monotonic() - started_s < DEADLINE_S + SLACK_S


def test_over_https_a_service_must_be_who_it_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if shutil.which("openssl") is None:
        pytest.skip("needs openssl: apt install openssl")
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    subject = ["-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost"]
    command = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", *subject]
    subprocess.run([*command, "-keyout", key, "-out", certificate], check=True, capture_output=True)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)
    with ServiceStandIn(WholeLevels(traits()), tls=context) as service:
        with pytest.raises(RemoteError, match="CERTIFICATE"):
            remote(service)
        monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
        far = remote(service)
        assert rendered(far)
        ended = threading.Event()

        def wait_for_the_end(request: BaseHTTPRequestHandler, _: object) -> None:
            with suppress(OSError):
                assert request.connection.recv(1) == b""
            ended.set()

        service.act = wait_for_the_end
        with pytest.raises(RemoteError, match="did not answer"):
            rendered(far)
        assert ended.wait(5)  # given up: the service knows, and nobody reads on
        until(lambda: not any(each.name == "exchange" for each in threading.enumerate()))


def test_a_cancelled_window_is_not_waited_for() -> None:
    with ServiceStandIn(WholeLevels(traits())) as service:
        far = open_remote(ModelSection(weights=service.address, engine="remote", deadline_s=30.0))
        service.act = never
        cancel = threading.Event()
        threading.Timer(0.1, cancel.set).start()
        with pytest.raises(Cancelled):
            rendered(far, options=RenderOptions(cancel=cancel))


def test_with_a_fallback_a_late_service_is_asked_now_and_then_but_not_waited_for() -> None:
    with ServiceStandIn(WholeLevels(traits())) as service:
        far = remote(service, fallback=FakeSynthesizer(traits()))
        service.act = never
        with pytest.raises(RemoteError):
            rendered(far)
        started_s = time.monotonic()
        for _ in range(5):
            with pytest.raises(RemoteError):
                rendered(far)
        assert time.monotonic() - started_s < DEADLINE_S
        assert service.asked == 2  # the first, and one that asks whether it is back
        service.act = None

        def is_back() -> bool:
            try:
                return len(rendered(far)) == 2
            except RemoteError:
                return False

        until(is_back)


# A whole node.


@contextmanager
def filmed(folder: Path, load: Callable[[ModelSection], ViewSynthesizer], more: str = "") -> Iterator[Rig]:
    """A node with a camera that films."""
    camera, done = Camera(), threading.Event()

    def film() -> None:
        for i in count():
            camera.shoot(np.full((64, 96, 3), 20 + i % 200, np.uint8))
            if done.wait(1 / 60):
                return

    with Rig(folder, Bench(camera), load, config='kind = "v4l2"', more=more) as rig:
        rig.await_state("active")
        filming = threading.Thread(target=film, daemon=True)
        filming.start()
        try:
            yield rig
        finally:
            done.set()
            filming.join()


@pytest.mark.parametrize("falls_back", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["drop", "live"])
def test_a_node_says_when_its_service_is_late_and_back_and_labels_who_drew(tmp_path: Path, falls_back: bool) -> None:
    fallback = FakeSynthesizer(replace(live_traits(), name="stand-in")) if falls_back else None
    with (
        ServiceStandIn(WholeLevels(traits())) as service,
        filmed(tmp_path, lambda _: remote(service, fallback=fallback)) as rig,
    ):
        rig.await_views(1)
        service.act = never
        rig.await_event("REMOTE_LATE")
        rig.await_status(lambda status: "REMOTE_LATE" in status["reasons"])
        seen = len(rig.of())
        if falls_back:
            rig.await_views(seen + 2)
        service.act = None
        rig.await_event("REMOTE_BACK")
        rig.await_views(len(rig.of()) + 1)
        rig.await_status(lambda status: "REMOTE_LATE" not in status["reasons"])
    names = [view.header.model.name for view in rig.of()]
    assert set(names) == ({"fake", "stand-in"} if falls_back else {"fake"})
    assert {names[0], names[-1]} == {"fake"}
    ids = [view.header.window_id for view in rig.of()]
    assert ids == sorted(set(ids))
    digests = {view.header.model.name: view.header.cfg_digest for view in rig.of()}
    assert len(set(digests.values())) == len(digests)


@pytest.mark.parametrize(
    ("fallback", "name"),
    [("random:live", "random-live"), pytest.param("package:live-small", "live-small", marks=pytest.mark.slow)],
)
def test_the_live_model_draws_what_a_dead_service_does_not_with_its_own_maps_and_name(fallback: str, name: str) -> None:
    """The service dies after its first window; the model that the launch file names draws the second."""
    with ServiceStandIn(WholeLevels(traits())) as service:

        def answer_once(request: BaseHTTPRequestHandler, reply: Callable[[], bytes]) -> None:
            respond(request, reply())
            service.act = FAULTS["hangs_up"]

        service.act = answer_once
        section = ModelSection(weights=service.address, engine="remote", fallback=fallback, device="cpu")
        box = run(fake_config(), open_remote(section), FakeSource(28))
    drawn = [(message.topic.rpartition("/")[2], message.header.model.name) for message in box.views]
    by_live = {(kind, name): 1 for kind in ("win", "cls", "vis", "depth", "std")}
    assert Counter(drawn) == by_live | {("win", "fake"): 1, ("frm", "fake"): 14, ("frm", name): 14}
    assert {each.topic for each in box.ends} == {message.topic for message in box.views}


def test_a_node_that_starts_before_its_service_waits_for_it(tmp_path: Path) -> None:
    with ServiceStandIn(WholeLevels(traits())) as service:
        tries = count()

        def load(_: ModelSection) -> ViewSynthesizer:
            if next(tries) == 0:
                raise RemoteError("nobody there yet")
            return remote(service)

        with filmed(tmp_path, load) as rig:
            assert rig.await_event("NOT_READY")["verb"] == "configure"
            rig.await_views(1)


# The service.


async def asked(replica: Replica, *bodies: bytes, pause_s: float = 0.0) -> list[bytes | BaseException]:
    tasks = []
    for body in bodies:
        tasks.append(asyncio.create_task(replica.answer(body)))
        await asyncio.sleep(pause_s)
    return await asyncio.gather(*tasks, return_exceptions=True)


def windows(model: ViewSynthesizer, streams: int, each: int, deadline_s: float = 20.0) -> list[bytes]:
    """Bodies of requests: of every stream so many windows, one after the other."""
    bodies: list[bytes] = []

    class Kept:
        address = ""

        def exchange(self, _: float, __: int, body: bytes, ___: str) -> None:
            bodies.append(body)
            raise RemoteError("kept")

    for _ in range(streams):
        far = RemoteSynthesizer(Kept(), model.traits, model_digest(model.traits), deadline_s=deadline_s)
        for _ in range(each):
            with pytest.raises(RemoteError):
                rendered(far)
    return bodies


def test_of_a_stream_the_newest_window_wins_and_streams_do_not_disturb_each_other() -> None:
    released = threading.Event()
    model = WholeLevels(traits(), lambda _: released.wait(10) and None)
    busy, old, newer, other = *windows(model, 1, 1), *windows(model, 1, 2), *windows(model, 1, 1)
    replica = Replica({"model": {"weights": "fake"}}, lambda _: released.set() or model)
    released.clear()
    threading.Timer(0.3, released.set).start()
    first, dropped, second, third = asyncio.run(asked(replica, busy, old, newer, other, pause_s=0.02))
    assert isinstance(dropped, RefusedError)
    assert dropped.status == 409
    assert all(isinstance(each, bytes) for each in (first, second, third))
    assert replica._newest == {}


@pytest.mark.slow
def test_more_streams_than_a_replica_can_serve_do_not_keep_it_from_serving_any() -> None:
    """Who comes first would be served first, and too late: every rendering would be begun and none finished in time."""
    model = WholeLevels(traits())
    replica = Replica({"model": {"weights": "fake"}}, lambda _: model)
    bodies = [body for each in range(2) for body in windows(model, 16, 1, deadline_s=0.5)]
    model._act = lambda _: time.sleep(0.2)
    started_s = time.monotonic()
    answers = asyncio.run(asked(replica, *bodies, pause_s=0.08))
    could = (time.monotonic() - started_s) / 0.3  # not all of the time is the network's
    assert sum(isinstance(each, bytes) for each in answers) > could / 2
    assert {each.status for each in answers if isinstance(each, RefusedError)} <= {503, 504}


def test_a_window_that_is_not_rendered_by_its_deadline_is_given_up_and_the_device_is_free_again() -> None:
    def hang(options: RenderOptions) -> None:
        if options.cancel is not None and options.cancel.wait(5):
            raise Cancelled("between two steps")

    model = WholeLevels(traits())
    replica = Replica({"model": {"weights": "fake"}}, lambda _: model)
    model._act = hang
    started_s = time.monotonic()
    (late,) = asyncio.run(asked(replica, *windows(model, 1, 1, deadline_s=0.2)))
    assert isinstance(late, RefusedError)
    assert late.status == 504
    assert time.monotonic() - started_s < SLACK_S
    model._act = None
    (fine,) = asyncio.run(asked(Replica({"model": {"weights": "fake"}}, lambda _: model), *windows(model, 1, 1)))
    assert isinstance(fine, bytes)


def test_whatever_is_sent_to_a_service_becomes_views_or_a_refusal() -> None:
    model = WholeLevels(traits())
    replica = Replica({"model": {"weights": "fake"}}, lambda _: model)
    key, _, sequence, text, payload = unpack(whole := windows(model, 1, 1)[0], MAX_PAYLOAD)
    texts = Mutator(3, [bytes(text)], TEXT_PIECES)
    bodies = [pack(key, 0, sequence, texts.next(), payload, checksum=False) for _ in range(300)]
    start = Mutator(4, [whole[: PREFIX.size]], BYTE_PIECES)
    bodies += [start.next() + whole[PREFIX.size :] for _ in range(20)] + [whole[:-1], b"", payload]
    answers = [each for body in bodies for each in asyncio.run(asked(replica, body))]
    assert all(isinstance(each, bytes | RefusedError) for each in answers)
    statuses = Counter(each.status for each in answers if isinstance(each, RefusedError))
    assert statuses[400] > len(bodies) / 2
    assert set(statuses) <= {400, 422, 504}


def test_a_service_with_a_token_answers_those_who_know_it(tmp_path: Path) -> None:
    (tmp_path / "token").write_text("seven-of-nine\n")
    (tmp_path / "wrong").write_text("seven")
    with ServiceStandIn(WholeLevels(traits()), token=str(tmp_path / "token")) as service:

        def section(name: str | None) -> ModelSection:
            token = None if name is None else str(tmp_path / name)
            return ModelSection(weights=service.address, engine="remote", token=token)

        assert rendered(open_remote(section("token")))
        for name in ("wrong", None):
            with pytest.raises(RemoteError, match="401"):
                open_remote(section(name))
        with pytest.raises(ConfigError):
            open_remote(section("missing"))


def test_no_byte_of_a_body_is_read_for_a_stranger(tmp_path: Path) -> None:
    """Who has no token may send slowly, or much."""
    pytest.importorskip("starlette", reason="needs the extra cluster")
    (tmp_path / "token").write_text("seven-of-nine")
    config = {"model": {"weights": "fake"}, "serve": {"token": str(tmp_path / "token")}}
    replica = Replica(config, lambda _: WholeLevels(traits()))
    request = SimpleNamespace(
        method="POST", headers={"authorization": "Bearer seven"}, stream=lambda: pytest.fail("read")
    )
    assert asyncio.run(replica(cast("Any", request))).status_code == 401


def test_a_replica_whose_device_is_stuck_or_lost_is_not_healthy(monkeypatch: pytest.MonkeyPatch) -> None:
    replica = Replica({"model": {"weights": "fake"}}, lambda _: WholeLevels(traits()))
    replica.check_health()
    (body,) = windows(model := replica._synthesizer, 1, 1)
    stuck = threading.Event()
    model._act = lambda _: stuck.wait(10) and None

    async def look() -> None:
        work = asyncio.create_task(replica.answer(body))
        await asyncio.sleep(0.1)
        replica.check_health()
        monkeypatch.setattr(fleet, "_STUCK_S", 0.01)
        with pytest.raises(RuntimeError, match="in work"):
            replica.check_health()
        stuck.set()
        await work
        replica.check_health()

    asyncio.run(look())

    def query() -> None:
        raise RuntimeError("CUDA error: unspecified launch failure")

    monkeypatch.setattr(torch.cuda, "current_stream", lambda: SimpleNamespace(query=query))
    model.traits = replace(model.traits, device="cuda:0")
    with pytest.raises(RuntimeError, match="launch failure"):
        replica.check_health()


@pytest.mark.parametrize(
    "text",
    [
        '[model]\nweights = "random:kubric90"\n[serve]\nhttp = "0.0.0.0:8000"',
        '[model]\nweights = "random:kubric90"\n[serve]\nhttp = "127.0.0.1"',
        '[model]\nweights = "random:kubric90"\n[serve]\ncertificate = "a.pem"',
        '[model]\nweights = "http://127.0.0.1:8000"\nengine = "remote"',
        '[model]\nweights = "random:kubric90"\n[serve]\nport = 8000',
        "[serve]",
    ],
    ids=["open_without_token", "no_port", "half_of_tls", "of_a_service", "unknown_key", "no_model"],
)
def test_a_service_refuses_settings_it_cannot_have(tmp_path: Path, text: str) -> None:
    (tmp_path / "serve.toml").write_text(text)
    with pytest.raises(ConfigError):
        load_service(tmp_path / "serve.toml")


@pytest.mark.parametrize("address", ["127.0.0.1:1", "ray://head", "head"])
def test_a_cluster_that_is_named_and_not_there_is_refused_at_once(
    address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RAY_ADDRESS", address)
    with (
        pytest.raises(ConfigError, match="RAY_ADDRESS"),
        fleet.deployed(ServiceConfig(model=ModelSection(weights="x"))),
    ):
        pass


def test_the_live_model_is_not_served() -> None:
    with pytest.raises(ConfigError, match="own machine"):
        Replica({"model": {"weights": "random:live", "device": "cpu"}})


# The node's settings.


LAUNCH = '[source]\npath = "package:drive.mp4"\n[view.main]\n[model]\n'


@pytest.mark.parametrize(
    "model",
    [
        'weights = "a.ckpt"\nengine = "remote"',
        'weights = "http://127.0.0.1:8000"',
        'weights = "http://x"\nengine = "cuda"',
    ],
)
def test_an_address_goes_with_the_engine_remote(model: str) -> None:
    with pytest.raises(ConfigError, match="remote"):
        parse_config(LAUNCH + model, "test")


@pytest.mark.parametrize(
    "keys",
    [
        {"family": "kubric90"},
        {"fallback": "random:kubric90"},
        {"fallback": "no-such-file"},
        {"weights": "http://user:password@127.0.0.1:1"},
        {"weights": "http://127.0.0.1:99999"},
    ],
    ids=str,
)
def test_a_node_refuses_settings_that_its_service_cannot_have(keys: dict[str, str]) -> None:
    with ServiceStandIn(WholeLevels(traits())) as service:
        section = ModelSection(**{"weights": service.address, "engine": "remote", **keys})
        with pytest.raises(Exception, match=r"fallback|leave them out|password|ort|no-such-file") as caught:
            load_model(section)
    assert type(caught.value).__name__ in ("ConfigError", "CheckpointError")


def test_nothing_takes_the_place_of_a_view_that_stands_nobody_knows_where() -> None:
    made = replace(traits("driving"), family=None)
    with ServiceStandIn(WholeLevels(made)) as service, pytest.raises(ConfigError, match="fallback"):
        open_remote(ModelSection(weights=service.address, engine="remote", fallback="random:live", motion_bucket=127.0))


def test_where_a_model_computes_and_what_stands_in_for_it_changes_no_digest() -> None:
    texts = (
        'weights = "http://a:1"\nengine = "remote"',
        'weights = "https://b:2"\nengine = "remote"\nfallback = "package:live-small"\ntoken = "t"\ndeadline_s = 1.0',
    )
    one, other = (config_digest(parse_config(LAUNCH + text, "test"), traits()) for text in texts)
    assert one == other


def test_a_node_that_waits_for_its_service_never_counts_as_hung() -> None:
    text = LAUNCH + 'weights = "http://a:1"\nengine = "remote"\ndeadline_s = 5.0\n[life]\nhang_s = '
    with pytest.raises(ConfigError, match=r"deadline_s 5 has to be less than .* hang_s 5"):
        parse_config(text + "5.0", "test")
    assert parse_config(text + "5.1", "test").model.deadline_s == 5.0


def test_a_fallback_is_warmed_up_and_the_service_is_not() -> None:
    with ServiceStandIn(WholeLevels(traits())) as service:
        fallback = FakeSynthesizer(traits())
        slot = ModelSlot(ModelSection(weights="fake"), lambda _: remote(service, fallback=fallback))
        assert slot.local is fallback
        assert not slot.can_halve
