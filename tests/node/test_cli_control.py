"""`gcd-node ctl` and `gcd-node keys` as a user types them."""

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest
from fakes import FakeNode

from gcd_client.endpoints import fingerprint, read_key_pair
from gcd_node.auth import load_server_security
from gcd_node.cli.main import run_app
from gcd_node.config import SecurityConfig

pytestmark = pytest.mark.timeout(90)

LOOPBACK = "tcp://127.0.0.1:0"


@pytest.fixture
def node() -> FakeNode:
    return FakeNode()


@pytest.fixture
def ctl(tmp_path: Path, node: FakeNode) -> Iterator[Callable[..., int]]:
    """Runs `gcd-node ctl` on a node; gives its exit code."""
    with node.serve(f"ipc://{tmp_path}/c") as server:
        yield lambda *words: run_app(["ctl", *words, "--endpoint", server.endpoint, "--timeout", "20"])


def test_ctl_sends_what_the_verb_wants_and_shows_the_result_as_json(
    ctl: Callable[..., int], node: FakeNode, capsys: pytest.CaptureFixture[str]
) -> None:
    assert ctl("set_view", "view=top", "azimuth_deg=30") == 0
    assert capsys.readouterr().out.startswith("OK (the node is active)\n")
    assert ctl("hello") == 0
    headline, _, result = capsys.readouterr().out.partition("\n")
    assert (headline, json.loads(result)) == ("OK (the node is active)", {"role": "operator"})
    assert ctl("remove_view", "view=1") == 0
    assert msgspec.to_builtins(node.heard[-1].args) == {"view": "1"}  # a name is text


def test_ctl_says_what_was_refused_and_what_is_allowed(
    ctl: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    assert ctl("set_view", "view=top", "azimuth_deg=120") == 70
    said = capsys.readouterr().err
    assert said.startswith("error: set_view: OUT_OF_RANGE")
    assert "[-90,90]" in said


@pytest.mark.parametrize("settings", [["view"], ["=top"], ["view=a", "view=b"]])
def test_ctl_wants_key_value_once(settings: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert run_app(["ctl", "remove_view", *settings]) == 64
    assert "KEY=VALUE" in capsys.readouterr().err


def test_keys_made_on_the_command_line_open_the_door(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], node: FakeNode
) -> None:
    for name in ("node", "desk"):
        assert run_app(["keys", "new", str(tmp_path / name)]) == 0
    shown, pair = capsys.readouterr().out, read_key_pair(tmp_path / "desk")
    assert pair.secret not in shown
    assert run_app(["keys", "show", str(tmp_path / "desk")]) == 0
    assert capsys.readouterr().out in shown
    assert fingerprint(pair.public) in shown
    stanza = shown[shown.rindex("[client.NAME]") :].replace("NAME", "desk")
    (tmp_path / "allow.toml").write_text(stanza)
    security = load_server_security(SecurityConfig(keys=str(tmp_path / "node"), allow=str(tmp_path / "allow.toml")))
    with node.serve(LOOPBACK, security=security) as server:
        line = ["ctl", "hello", "--json", "--endpoint", server.endpoint, "--timeout", "20"]
        line += ["--keys", str(tmp_path / "desk"), "--node-key", str(tmp_path / "node" / "public.key")]
        assert run_app(line) == 0
        assert json.loads(capsys.readouterr().out)["result"] == {"role": "viewer"}
        assert run_app([*line[:1], "activate", *line[3:]]) == 70
        assert "FORBIDDEN" in capsys.readouterr().err


def test_half_of_the_key_options_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_app(["ctl", "hello", "--keys", str(tmp_path)]) == 64
    assert "--node-key" in capsys.readouterr().err


def test_who_talks_to_a_running_node_does_not_wait_for_torch(tmp_path: Path) -> None:
    code = (
        "import sys; from gcd_node.cli.main import run_app; "
        f"ends = run_app(['-v', 'ctl', 'state', '--endpoint', 'ipc://{tmp_path}/none', '--timeout', '0.1']); "
        f"ends += run_app(['status', 'ipc://{tmp_path}/none', '--once', '--timeout', '0.1']); "
        f"ends += run_app(['view', 'ipc://{tmp_path}/none', '--timeout', '0.1']); "
        "ends += sum(run_app([name, '--help']) for name in ('run', 'check', 'demo', 'bench')); "
        "print(ends, sorted({'torch', 'cv2', 'kornia'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout.splitlines()[-1] == "207 []", done.stderr
