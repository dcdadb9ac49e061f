"""docs/protocol.md against the code: a client is to be written from that page alone."""

import re
from pathlib import Path

import msgspec
import pytest

from gcd_client.control import Code, decode_reply
from gcd_node.health import Health
from gcd_node.verbs import VERBS, RequestError, parse_command

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "protocol.md").read_text()


def section(title: str) -> str:
    """Below a heading, to the next one of its rank."""
    mark = title.split()[0]
    body = PAGE.split(f"\n{title}", 1)[1]
    return re.split(rf"\n{mark} ", body, maxsplit=1)[0]


def first_cells(text: str) -> list[str]:
    """The first column of all tables, code words alone."""
    rows = [line for line in text.splitlines() if line.startswith("| `")]
    return [word for row in rows for word in re.findall(r"`([^`]+)`", row.split("|")[1])]


def examples() -> list[bytes]:
    (block,) = re.findall(r"```json\n(.*?)```", section("## 5 Control"), re.DOTALL)
    return [line.encode() for line in block.splitlines()]


@pytest.mark.parametrize("request_line", examples()[0::2])
def test_the_requests_shown_are_requests(request_line: bytes) -> None:
    if b'"steps":2000' in request_line:  # the page shows one refusal
        with pytest.raises(RequestError):
            parse_command(request_line)
    else:
        command = parse_command(request_line)
        assert command.if_view_rev == (1 if command.verb == "set_view" else None)


@pytest.mark.parametrize("reply_line", examples()[1::2])
def test_the_replies_shown_are_replies_as_they_are_written(reply_line: bytes) -> None:
    assert msgspec.json.encode(decode_reply(reply_line)) == reply_line


def test_every_verb_is_there_with_its_role() -> None:
    told: dict[str, str] = {}
    for line in section("## 5 Control").splitlines():
        cells = [cell.strip() for cell in line.split("|")]
        if len(cells) > 3 and cells[2] in ("viewer", "operator"):
            told |= dict.fromkeys(re.findall(r"`([^`]+)`", cells[1]), cells[2])
    assert told == {name: verb.role for name, verb in VERBS.items()}


def test_every_argument_of_a_verb_is_there() -> None:
    page = section("## 5 Control")
    for name, verb in VERBS.items():
        row = next(line for line in page.splitlines() if re.match(rf"\|.*`{name}`.*\| (viewer|operator) \|", line))
        for argument in verb.arguments.__struct_encode_fields__:
            assert f"`{argument}`" in row, (name, argument)


def test_every_code_is_there() -> None:
    told = first_cells(section("## 5 Control"))
    assert set(Code) <= set(told)


def test_every_row_of_the_failure_table_is_there_once() -> None:
    page = (ROOT / "docs" / "node.md").read_text()
    rows = re.findall(r"^\| (F\d+) \|", page, re.MULTILINE)
    assert rows == [f"F{number}" for number in range(1, 26)]


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


def test_every_event_that_is_named_in_the_code_is_explained() -> None:
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
    page = (ROOT / "docs" / "node.md").read_text()
    assert [code for code in sorted(told) if f"`{code}`" not in page] == []
