"""What ships in launch/: every launch file is a good one, the unit and the container files say what the node does."""

import os
import re
import shutil
import signal
import socket
import stat
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
import yaml
from cameras import write_video
from fakes import write_tiny
from msgspec.structs import replace
from rig import launch_file

from gcd_node.check import check_launch
from gcd_node.cli.main import COMMANDS, run_app
from gcd_node.config import NodeConfig, PublishConfig, load_config, parse_config
from gcd_node.errors import ConfigError, SourceError, TooShortError, UsageError
from gcd_node.fleet import load_service, service_config
from gcd_node.publisher import Publisher
from gcd_node.sources import RecordedSource, SyntheticSource

Capture = pytest.CaptureFixture[str]
ROOT = Path(__file__).parents[2]
LAUNCH = ROOT / "launch"
TOMLS = sorted(path for path in LAUNCH.glob("*.toml") if path.name != "serve.toml")
UNIT = LAUNCH / "systemd" / "gcd-node@.service"
INSTALLED = "/opt/gcd-node/bin/gcd-node"
PATIENCE_S = 60


def rehearsed(config: NodeConfig, folder: Path) -> NodeConfig:
    """As it is, but with frames of our own instead of a camera or a log, endpoints here, and random weights."""
    stated = [name for name in RecordedSource.__struct_fields__ if hasattr(config.source, name)]
    common = {name: getattr(config.source, name) for name in stated}
    here = {name: f"ipc://{folder}/{name}" for name in ("data", "status", "control")}
    random = f"random:{config.model.family or 'live'}"
    reference = folder / "training.png"
    cv2.imwrite(str(reference), np.random.default_rng(0).integers(0, 256, (224, 224, 3), np.uint8))
    views = {name: replace(each, reference=each.reference and str(reference)) for name, each in config.view.items()}
    return replace(
        config,
        source=SyntheticSource(**common | {"loop": False}, frames=1),
        view=views,
        model=replace(config.model, weights=random, family=None, device="cpu"),
        publish=replace(config.publish, data=here["data"], status=here["status"]),
        control=replace(config.control, endpoint=here["control"]),
    )


@pytest.mark.parametrize("path", TOMLS, ids=lambda path: path.name)
def test_a_launch_file_passes_every_check_that_needs_no_hardware(path: Path, tmp_path: Path) -> None:
    config = rehearsed(load_config(path), tmp_path)
    findings = {each.topic: each for each in check_launch(config, 2**36)}
    assert list(findings) == ["endpoints", "source", "weights", "views"]
    errors = {topic: str(each.error) for topic, each in findings.items() if each.error is not None}
    assert errors == {}
    assert findings["weights"].verdict == "warning"


def unit() -> dict[str, list[str]]:
    """Its assignments, by key; of one that is made again all values."""
    found: dict[str, list[str]] = {}
    for line in UNIT.read_text().splitlines():
        if line and line[0] not in "#;[":
            key, _, value = line.partition("=")
            found.setdefault(key, []).append(value)
    return found


def systemd(tool: str, *arguments: str) -> "subprocess.CompletedProcess[str]":
    if shutil.which(f"systemd-{tool}") is None:
        pytest.skip(f"needs systemd-{tool}: apt install systemd")
    command = [f"systemd-{tool}", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)


def verified(folder: Path, text: str) -> str:
    path = folder / UNIT.name
    path.write_text(text.replace(INSTALLED, sys.executable))  # which is there: else that is all it says
    done = systemd("analyze", "verify", "--man=no", str(path))
    return done.stdout + done.stderr


@pytest.mark.slow
def test_systemd_finds_nothing_wrong_with_the_unit(tmp_path: Path) -> None:
    text = UNIT.read_text()
    assert INSTALLED in text
    assert verified(tmp_path, text) == ""
    assert "RestartSecs" in verified(tmp_path, text.replace("RestartSec=", "RestartSecs="))
    shutil.copytree(LAUNCH / "systemd", tmp_path / "etc" / "sysusers.d")
    done = systemd("sysusers", f"--root={tmp_path}")
    assert done.returncode == 0, done.stderr
    assert all("gcd:" in (tmp_path / "etc" / name).read_text() for name in ("passwd", "group"))


def test_the_unit_is_confined_and_a_restart_is_for_what_a_restart_can_mend() -> None:
    done = systemd("analyze", "security", "--offline=true", "--threshold=25", str(UNIT))
    assert done.returncode == 0, done.stdout
    said = unit()
    assert said["DeviceAllow"] == ["char-usb_device rw", "char-video4linux rw"]
    assert "PrivateDevices" not in said  # it would hide the cameras
    wanted = ["Type=notify", "Restart=on-failure", "StartLimitBurst=5", "User=gcd", "DevicePolicy=closed"]
    assert [line for line in wanted if line not in UNIT.read_text().splitlines()] == []
    (codes,) = said["RestartPreventExitStatus"]
    hopeless = {each.exit_code for each in (UsageError, TooShortError, SourceError, ConfigError)}
    assert set(map(int, codes.split())) == hopeless == {64, 65, 66, 78}


@pytest.mark.slow
def test_the_node_does_under_the_units_settings_what_the_unit_says(tmp_path: Path) -> None:
    runtime, said = tmp_path / "run", unit()
    runtime.mkdir()
    runtime.chmod(int(said["RuntimeDirectoryMode"][0], 8))
    launch = tmp_path / "waiting.toml"
    launch.write_text(
        '[source]\nkind = "synthetic"\n[model]\nweights = "random:driving"\n[view.a]\n[life]\nautostart = false\n'
    )
    arguments = said["ExecStart"][0].replace("/etc/gcd/%i.toml", str(launch)).split()[1:]
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(PATIENCE_S)
        environment = os.environ | {
            "NOTIFY_SOCKET": str(tmp_path / "notify"),
            "WATCHDOG_USEC": str(int(said["WatchdogSec"][0]) * 1_000_000),
            "RUNTIME_DIRECTORY": str(runtime),
        }
        command = [sys.executable, "-m", "gcd_node", *arguments]
        with subprocess.Popen(
            command, env=environment, umask=int(said["UMask"][0], 8), stdout=subprocess.PIPE, text=True
        ) as node:
            heard = [manager.recv(4096).decode() for _ in range(2)]
            assert {line.split("=")[0] for line in heard} == {"READY", "WATCHDOG"}
            for name in ("data", "status", "control"):  # the group may connect, others may not
                assert stat.S_IMODE((runtime / name).stat().st_mode) == 0o770
            node.send_signal(signal.SIGTERM)
            assert manager.recv(4096).decode().startswith("STOPPING=1")
            assert node.wait(PATIENCE_S) == 0
    assert (runtime.exists(), list(runtime.iterdir())) == (True, [])


def test_the_container_copies_what_is_there_runs_as_nobody_special_and_calls_commands_that_exist() -> None:
    text = re.sub(r"^#.*\n", "", (LAUNCH / "docker" / "Dockerfile").read_text(), flags=re.MULTILINE)
    ignore = (LAUNCH / "docker" / "Dockerfile.dockerignore").read_text().splitlines()

    def all_of(name: str) -> list[str]:
        return re.findall(rf"^{name} (.*)", text.replace("\\\n", " "), re.MULTILINE)

    copied = {source for rest in all_of("COPY") for source in rest.split()[:-1]}
    assert ignore[1] == "*"
    assert copied == {line[1:] for line in ignore if line.startswith("!")}  # not left out of the build
    assert [source for source in copied if not (ROOT / source).exists()] == []
    (health,), (start,) = all_of("HEALTHCHECK"), all_of("CMD")
    assert health.endswith('["gcd-node", "status", "--once"]')
    command, config = msgspec.json.decode(start, type=list[str])
    assert command in COMMANDS
    assert f"launch/{Path(config).name}" in " ".join(all_of("COPY"))
    assert (all_of("USER"), all_of("STOPSIGNAL")) == (["10001:10001"], ["SIGTERM"])


def test_a_fleets_files_are_what_serve_and_the_service_take() -> None:
    assert load_service(LAUNCH / "serve.toml").serve.token is None
    spec = yaml.safe_load((LAUNCH / "kubernetes" / "rayservice.yaml").read_text())["spec"]
    config, cluster = yaml.safe_load(spec["serveConfigV2"]), spec["rayClusterConfig"]
    pytest.importorskip("ray.serve.schema").ServeDeploySchema.model_validate(config)
    (application,) = config["applications"]
    module, _, name = application["import_path"].partition(":")
    assert callable(getattr(import_module(module), name))
    settings, options = service_config(application["args"]), config["http_options"]
    assert settings.serve.http == f"{options['host']}:{options['port']}"
    (workers,) = cluster["workerGroupSpecs"]
    pods = [group["template"]["spec"] for group in (cluster["headGroupSpec"], workers)]
    containers = [each for pod in pods for each in pod["containers"]]
    assert settings.serve.replicas == workers["replicas"] * int(containers[1]["resources"]["limits"]["nvidia.com/gpu"])
    assert {each["image"] for each in containers} == {"REGISTRY/gcd-node:cuda"}
    for pod, container in zip(pods, containers, strict=True):  # every machine has the token and the weights
        mounts = {each["mountPath"]: each["name"] for each in container["volumeMounts"]}
        assert set(mounts.values()) == {each["name"] for each in pod["volumes"]}
        assert settings.serve.token in mounts
        assert str(Path(settings.model.weights).parent) in mounts
    assert f"ray=={cluster['rayVersion']}" in (ROOT / "constraints.txt").read_text().splitlines()


# `gcd-node check`, and launch files with changes, as text again.


@pytest.fixture
def launch(tmp_path: Path) -> Path:
    """Of a video that is smaller than any model takes unless it may be enlarged."""
    write_video(tmp_path / "v.mkv", [np.full((128, 192, 3), 5 * i, np.uint8) for i in range(16)], 10.0)
    return launch_file(tmp_path, f'path = "{tmp_path}/v.mkv"\nallow_upscale = true')


def found(launch: Path, *changes: str, memory: int | None = None) -> dict[str, tuple[str, str]]:
    return {each.topic: (each.verdict, each.detail) for each in check_launch(load_config(launch, changes), memory)}


def test_a_good_launch_file_is_looked_at_from_end_to_end(launch: Path) -> None:
    findings = found(launch)
    assert list(findings) == ["endpoints", "source", "weights", "views"]
    assert [verdict for verdict, _ in findings.values()] == ["ok", "ok", "warning", "ok"]  # random weights are noise
    assert "192 x 128 at 10 FPS" in findings["source"][1]
    assert "14 frames at 10 FPS" in findings["views"][1]
    assert not (launch.parent / "data").exists()  # nothing stays bound


def test_what_fails_is_the_exit_code(launch: Path, capsys: Capture) -> None:
    for change, topic, code in (
        ("source.path=/no/such.mp4", "source", 66),
        ('source={kind = "v4l2", device = "/dev/video-none"}', "source", 69),
        ("model.weights=/no/such.ckpt", "weights", 65),
        ("model.weights=package:unheard", "weights", 65),
        ("view.main.azimuth_deg=5", "views", 64),
        ("publish.data=tcp://0.0.0.0:5580", "endpoints", 78),
        ("publish.data=tcp://127.0.0.1:99999", "endpoints", 78),
        ("model.device=cuda:99", "weights", 78),
    ):
        assert found(launch, change)[topic][0] == "failed"
        assert run_app(["check", str(launch), "--set", change]) == code
        assert capsys.readouterr().err.strip().splitlines()[-1].startswith("error: ")


def test_one_failure_does_not_hide_the_next_and_weights_must_fit_into_memory(launch: Path, tmp_path: Path) -> None:
    endpoints = PublishConfig(data=f"ipc://{launch.parent}/data", status=f"ipc://{launch.parent}/status")
    with Publisher(endpoints, linger_ms=0):
        findings = found(launch, "source.path=/no/such.mp4", "model.weights=/no/such.ckpt")
    assert [findings[topic][0] for topic in ("endpoints", "source", "weights")] == ["failed"] * 3
    assert "in use" in findings["endpoints"][1]
    tiny = f"model.weights={write_tiny(tmp_path)}"
    assert [found(launch, tiny, memory=memory)["weights"][0] for memory in (10_000, 2**40)] == ["failed", "ok"]


def test_what_was_not_looked_at_and_what_is_assumed_is_said(launch: Path, tmp_path: Path) -> None:
    assert found(launch, "source.path=/no/such.mp4")["views"] == (
        "warning",
        "not looked at: that takes the source and the weights",
    )
    checkpoint = write_tiny(tmp_path)  # it is only read, not loaded
    assert found(launch, f"model.weights={checkpoint}", "model.engine=cuda")["weights"][0] == "failed"
    live = "model.weights=package:live-small"
    assert "85 degrees wide: state hfov_deg" in found(launch, live)["views"][1]
    assert found(launch, live, "source.hfov_deg=85")["views"][0] == "ok"


def test_where_recordings_would_go_is_looked_at(launch: Path, tmp_path: Path) -> None:
    folder = tmp_path / "new" / "recordings"
    (tmp_path / "file").write_text("")
    for where, keep_free_mb, verdict in (
        (folder, 0, "ok"),
        (folder, 1e12, "warning"),
        (tmp_path / "file/x", 0, "failed"),
    ):
        changes = (f"record.folder={where}", f"record.keep_free_mb={keep_free_mb}")
        assert found(launch, *changes)["record"][0] == verdict
    assert list(folder.iterdir()) == []


# The configuration as text.


def test_what_is_printed_is_the_same_launch_file_again(launch: Path, capsys: Capture) -> None:
    assert run_app(["run", str(launch), "--set", "model.steps=7", "--print-config"]) == 0
    again = parse_config(capsys.readouterr().out.encode(), "printed")
    assert again == load_config(launch, ["model.steps=7"])
    assert again.model.steps == 7
