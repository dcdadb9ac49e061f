"""The pages tell the truth: links lead somewhere, launch files load, commands exist, every key of a launch file is
told, what is marked `run` runs."""

import ast
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, get_args

import msgspec
import pytest
from cameras import ramp
from robot_logs import at, camera_info, compressed, write_bag
from rosbags.rosbag2 import StoragePlugin
from typer.main import get_command

from gcd_client.control import Code, decode_reply
from gcd_node.cli.main import COMMANDS, new_app
from gcd_node.config import NodeConfig, parse_config
from gcd_node.errors import ConfigError
from gcd_node.health import Health
from gcd_node.sources import SourceConfig, SourcePose
from gcd_node.verbs import VERBS, RequestError, parse_command
from gcd_node.view_config import ViewConfig
from gcd_train.cli.main import app as train_app

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / f"{name}.md" for name in ("README", "CONTRIBUTING", "launch/README", "tools/README", "client/README")]
PAGES += sorted((ROOT / "docs").glob("*.md"))
LINKED = [*PAGES, *sorted((ROOT / "docs" / "log").glob("*.md")), *sorted((ROOT / "model").rglob("weights/*.md"))]
"""The log keeps commands that are gone; its links are checked."""
SHELL = ("", "sh", "bash", "console")
WHOLE = ("source.kind=synthetic", "model.weights=random:driving", "view.topdown.kind=fixed")
"""What a launch file cannot do without, as changes."""
SMALLER = {
    "--scenes 20 --compact": "--scenes 1 --compact --frames 14 --width 96 --height 64",
    "--clips 100": "--clips 3",
    "--clips 40": "--clips 2",
}
"""What a page's commands make, and what is made here instead."""


class Block(NamedTuple):
    """A fenced block. language, mark: the words behind the fence, such as `toml launch`."""

    place: str
    language: str
    mark: str
    text: str


def blocks_of(page: Path) -> Iterator[Block]:
    text = page.read_text()
    for found in re.finditer(r"^```([^\n`]*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
        language, _, mark = found[1].strip().partition(" ")
        line = text.count("\n", 0, found.start()) + 1
        yield Block(f"{page.relative_to(ROOT).as_posix()}:{line}", language, mark, found[2])


def without_blocks(page: Path) -> str:
    return re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)


BLOCKS = [block for page in PAGES for block in blocks_of(page)]


def marked(language: str, mark: str | None = None) -> pytest.MarkDecorator:
    chosen = [each for each in BLOCKS if each.language == language and mark in (None, each.mark)]
    return pytest.mark.parametrize("block", chosen, ids=lambda block: block.place)


# Links and names.


def dead_links(page: Path) -> Iterator[str]:
    for link in re.findall(r"\]\(([^)\s]+)\)", without_blocks(page)):
        if not re.match(r"[a-z]+:", link):
            file, _, anchor = link.partition("#")
            target = (page.parent / file).resolve() if file else page
            if not target.exists() or (anchor and anchor not in headings(target)):
                yield f"{page.name}: {link}"


@cache
def headings(page: Path) -> set[str]:
    """Anchors as GitHub makes them."""
    found = re.findall(r"^#+ (.+)$", without_blocks(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-") for title in found}


def test_every_link_leads_somewhere_and_the_index_names_every_page() -> None:
    assert [dead for page in LINKED for dead in dead_links(page)] == []
    index = (ROOT / "docs" / "README.md").read_text()
    assert [page.name for page in (ROOT / "docs").glob("*.md") if f"({page.name})" not in index + "(README.md)"] == []


def test_every_page_that_a_message_a_docstring_or_a_comment_names_is_there() -> None:
    suffixes = {".py", ".toml", ".sh", ".cpp", ".yaml", ".service", ".xml"}
    folders = ("gcd_node", "client", "model", "train", "launch", "tools", "tests")
    files = [path for folder in folders for path in (ROOT / folder).rglob("*") if path.suffix in suffixes]
    named = {found: path for path in files for found in re.findall(r"docs/[\w/-]+\.md", path.read_text())}
    assert "docs/node.md" in named
    assert {page: path for page, path in named.items() if not (ROOT / page).exists()} == {}


def test_every_key_of_a_launch_file_is_in_its_table() -> None:
    sections = [field.type for field in msgspec.structs.fields(NodeConfig) if isinstance(field.type, type)]
    structs = [each for each in sections if issubclass(each, msgspec.Struct)]
    structs += [NodeConfig, *get_args(SourceConfig), SourcePose, ViewConfig]
    page = (ROOT / "docs" / "launch-file.md").read_text()
    keys = {field.name for struct in structs for field in msgspec.structs.fields(struct)}
    assert len(keys) > 80
    assert sorted(key for key in keys if not re.search(rf"[`.\[]{key}[`.\]]", page)) == []


# Commands.


@cache
def programs() -> dict[str, Any]:
    return {"gcd-node": get_command(new_app(COMMANDS)), "gcd-train": get_command(train_app)}


def said_commands(text: str) -> Iterator[list[str]]:
    """Calls of our programs in a shell block, each as its words; comments, pipes and prompts are taken off."""
    for line in text.replace("\\\n", " ").splitlines():
        for call in re.split(r"\s(?:\\?\||&&|;|>|&)(?:\s|$)", re.sub(r"(?:^|\s)#.*", "", line).strip(" $")):
            words = shlex.split(call)
            while words and "=" in words[0]:
                words = words[1:]
            if words and Path(words[0]).name in programs():
                yield [Path(words[0]).name, *words[1:]]


def commands_of(page: Path) -> Iterator[list[str]]:
    """Of its shell blocks, and between backticks in running text."""
    for block in blocks_of(page):
        if block.language in SHELL:
            yield from said_commands(block.text)
    for quoted in re.findall(r"`((?:gcd-node|gcd-train)(?: [^`]*)?)`", without_blocks(page)):
        yield from said_commands(quoted.replace("...", " "))


def mistake(words: list[str]) -> str | None:
    """What a call names that the program does not know."""
    command, rest = programs()[words[0]], words[1:]
    while True:
        try:
            given, rest, _ = command.make_parser(command.context_class(command)).parse_args(rest)
        except Exception as error:  # an unknown option, or one without its value
            return None if type(error).__name__ == "BadOptionUsage" else str(error)
        if not hasattr(command, "commands") or not rest:
            break
        if rest[0] not in command.commands:
            return rest[0]
        command, rest = command.commands[rest[0]], rest[1:]
    verb = given.get("verb") or ""
    if command.name == "ctl" and verb.islower() and verb not in VERBS:
        return verb
    changes = given.get("changes") if words[0] == "gcd-node" else None
    return next((change for change in changes or () if not is_known(change)), None)


def is_known(change: str) -> bool:
    """Whether some launch file has the key of a change."""
    section, _, key = change.partition("=")[0].partition(".")
    if section == "source":
        keys = {field.name for kind in get_args(SourceConfig) for field in msgspec.structs.fields(kind)}
        return key.partition(".")[0] in keys | {"kind"}
    try:
        parse_config(b"", "here", [*WHOLE, change])
    except ConfigError as error:
        return "unknown key" not in str(error)
    return True


def test_every_command_and_option_exists() -> None:
    wrong = [(page.name, words, found) for page in PAGES for words in commands_of(page) if (found := mistake(words))]
    assert wrong == []
    for line in ("gcd-node fly", "gcd-node run a --set model.stepz=1", "gcd-node view --none", "gcd-node ctl fly"):
        assert mistake(line.split())


# Blocks.


@marked("toml")
def test_a_toml_block_loads(block: Block) -> None:
    """A launch file, or a part of one (what it lacks is filled in). Mark it `toml launch` if it is whole, `toml other`
    if it is no launch file."""
    table = tomllib.loads(block.text)
    stated = {"source.kind": table.get("source", {}).keys() & {"kind", "path"}, "model.weights": table.get("model")}
    stated["view.topdown.kind"] = table.get("view")
    lacking = [change for change in WHOLE if not stated[change.partition("=")[0]]]
    if block.mark != "other":
        parse_config(block.text.encode(), block.place, () if block.mark == "launch" else lacking)


@marked("python")
def test_a_python_block_is_python_and_runs_if_it_is_so_marked(
    block: Block, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = compile(block.text, block.place, "exec", flags=ast.PyCF_ALLOW_TOP_LEVEL_AWAIT)
    if block.mark == "run":
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))  # no node of this machine hears of it
        exec(code, {})


@pytest.mark.slow
@pytest.mark.timeout(900)
@marked("sh", "run")
def test_a_shell_block_marked_run_runs(block: Block, tmp_path: Path) -> None:
    """With `gcd-node` and `gcd-train` of this checkout, and with the programs that were installed beside Python."""
    (tmp_path / "bin").mkdir()
    for name in ("gcd-node", "gcd-train"):
        program = tmp_path / "bin" / name
        program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m {name.replace("-", "_")} "$@"\n')
        program.chmod(0o755)
    roots = [tmp_path / "bin", *(ROOT / each for each in ("model", "client", "train")), ROOT]
    programs = [roots[0], Path(sys.executable).parent, os.environ["PATH"]]
    paths = {"PATH": os.pathsep.join(map(str, programs)), "PYTHONPATH": os.pathsep.join(map(str, roots))}
    (tmp_path / "launch").symlink_to(ROOT / "launch")
    for name in ("drive.mp4", "my.mp4"):
        shutil.copy(ROOT / "gcd_node" / "assets" / "drive.mp4", tmp_path / name)
    if "source.path=drive " in block.text:
        said = [("/front/camera_info", camera_info(432, 288, d=()))]
        said += [
            ("/front/image/compressed", compressed(*each))
            for each in zip(ramp(6, 432, 288), map(at, range(6)), strict=True)
        ]
        write_bag(tmp_path / "drive", said, StoragePlugin.MCAP)
    text = block.text
    for much, little in SMALLER.items():
        text = text.replace(much, little)
    done = subprocess.run(
        ["bash", "-e", "-c", text], cwd=tmp_path, env=os.environ | paths, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr


# docs/protocol.md against the code: a client is to be written from that page alone.


PAGE = (ROOT / "docs" / "protocol.md").read_text()


def section(title: str) -> str:
    """Below a heading, to the next one of its rank."""
    mark = title.split()[0]
    body = PAGE.split(f"\n{title}", 1)[1]
    return re.split(rf"\n{mark} ", body, maxsplit=1)[0]


def examples() -> list[bytes]:
    (block,) = re.findall(r"```json\n(.*?)```", section("## 5 Control"), re.DOTALL)
    return [line.encode() for line in block.splitlines()]


def test_the_requests_and_replies_shown_are_such_as_they_are_written() -> None:
    lines = examples()
    assert len(lines) == 4
    for request, reply in zip(lines[0::2], lines[1::2], strict=True):
        if b'"steps":2000' in request:  # the page shows one refusal
            with pytest.raises(RequestError):
                parse_command(request)
        else:
            command = parse_command(request)
            assert command.if_view_rev == (1 if command.verb == "set_view" else None)
        assert msgspec.json.encode(decode_reply(reply)) == reply


def test_every_verb_is_there_with_its_role_and_arguments_and_every_code() -> None:
    page, told = section("## 5 Control"), dict[str, str]()
    for line in page.splitlines():
        cells = [cell.strip() for cell in line.split("|")]
        if len(cells) > 3 and cells[2] in ("viewer", "operator"):
            verbs = re.findall(r"`([^`]+)`", cells[1])
            told |= dict.fromkeys(verbs, cells[2])
            arguments = {argument for name in verbs for argument in VERBS[name].arguments.__struct_encode_fields__}
            assert [argument for argument in arguments if f"`{argument}`" not in line] == []
    assert told == {name: verb.role for name, verb in VERBS.items()}
    rows = [line.split("|")[1] for line in page.splitlines() if line.startswith("| `")]
    assert set(Code) <= {word for row in rows for word in re.findall(r"`([^`]+)`", row)}


def test_every_key_of_a_status_is_there() -> None:
    health = Health()
    health.gpu_mem_mb = 1.0
    health.stage("render", 0.1)
    for i in range(3):
        health.frame(i * 100_000_000, i * 100_000_000)
    page = section("### 4.7 Notes on the status socket")
    for key, value in health.report().items():
        assert f"`{key}`" in page, key
        for inner in value if isinstance(value, dict) and key in ("source", "window", "model", "publish") else ():
            assert f"`{inner}`" in page, (key, inner)


def test_every_row_of_the_failure_table_and_every_event_that_is_named_in_the_code_is_explained() -> None:
    page = (ROOT / "docs" / "node.md").read_text()
    assert re.findall(r"^\| (F\d+) \|", page, re.MULTILINE) == [f"F{number}" for number in range(1, 26)]
    calls = re.compile(
        r'(?:\.event|on_event|self\._tell|self\._say|_after_change|_report)\(\s*(?:self\._on_event, )?"([A-Z_]{4,})"'
    )
    told = {code for path in (ROOT / "gcd_node").rglob("*.py") for code in calls.findall(path.read_text())}
    assert {
        "STATE",
        "VIEW_SET",
        "AUTH_DENIED",
        "ALLOW_CHANGED",
        "GPU_OOM",
        "TOO_LARGE",
    } <= told  # the search finds them
    assert [code for code in sorted(told) if f"`{code}`" not in page] == []
