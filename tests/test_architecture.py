"""The tree's rules: who may import whom, how large things may grow. Plain `ast`, no import of the packages."""

import ast
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from statistics import median

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = {
    "gcd_client": ROOT / "client" / "gcd_client",
    "gcd_model": ROOT / "model" / "gcd_model",
    "gcd_node": ROOT / "gcd_node",
    "gcd_train": ROOT / "train" / "gcd_train",
}
SOCKET_FILES = {"publisher.py", "control.py", "auth.py", "sources/push.py"}
OPENING_CALLS = {"open", "safe_open", "save_file", "read_text", "read_bytes", "write_text", "write_bytes"}
OPENING_LIBRARIES = {"torch", "np", "numpy", "json", "pickle", "safetensors"}  # their load and save open files
MAY_OPEN_FILES = {"small_files.py", "read.py", "load.py", "save.py", "onnx_export.py"}
MOST = [
    ("client/gcd_client", 9, 1_819),
    ("model/gcd_model", 44, 10_125),
    ("tests/model", 29, 6_437),
    ("gcd_node", 68, 15_444),
    ("tests/node", 43, 12_350),
    ("train/gcd_train", 116, 27_271),
    ("tests/train", 72, 14_902),
]
"""Files and lines of what is being made smaller: put the new numbers here when they have fallen. They rise for what is
new alone: lately canonical views, grids, a fleet behind Ray Serve, and novel views in LeRobot sets and ROS 2 bags."""
MOST_DOCS, MOST_README = (14, 1_900), 90


def files(package: str) -> list[Path]:
    found = sorted(PACKAGES[package].rglob("*.py"))
    assert found, f"{package} has no files: the test looks in the wrong place"
    return found


@pytest.fixture(autouse=True, scope="module")
def forgotten() -> Iterator[None]:
    """A million syntax nodes would slow down every search for garbage in the tests that follow."""
    yield
    nodes.cache_clear()
    parsed.cache_clear()


@cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    """All of a file's, in no particular order; parsed once."""
    return tuple(ast.walk(parsed(path)))


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def imports(path: Path, *, top_level_only: bool = False) -> Iterator[str]:
    """Dotted names a file imports; `from a import b` gives `a` and `a.b`."""
    for node in parsed(path).body if top_level_only else nodes(path):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute here"
            yield node.module or ""
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def offenders(paths: list[Path], *roots: str, top_level_only: bool = False) -> list[str]:
    return [
        f"{path.relative_to(ROOT)}: {name}"
        for path in paths
        for name in imports(path, top_level_only=top_level_only)
        if any(name == root or name.startswith(root + ".") for root in roots)
    ]


def functions(path: Path) -> Iterator[tuple[str, int]]:
    for node in nodes(path):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node.name, (node.end_lineno or node.lineno) - node.lineno + 1


def test_the_model_knows_neither_node_nor_training() -> None:
    assert offenders(files("gcd_model"), "gcd_node", "gcd_train") == []


def test_the_model_imports_without_cameras_sockets_and_onnx() -> None:
    assert offenders(files("gcd_model"), "zmq", "depthai", "cv2", "onnxruntime", top_level_only=True) == []


def test_only_checkpoints_small_files_and_exporters_open_files_in_the_model() -> None:
    found = [
        (path.name, ast.unparse(node))
        for path in files("gcd_model")
        if path.name not in MAY_OPEN_FILES
        for node in nodes(path)
        if isinstance(node, ast.Call) and _opens_a_file(node.func)
    ]
    assert found == []


def _opens_a_file(function: ast.expr) -> bool:
    if isinstance(function, ast.Name):
        return function.id in OPENING_CALLS
    if not isinstance(function, ast.Attribute):
        return False
    library = function.value.id if isinstance(function.value, ast.Name) else ""
    return function.attr in OPENING_CALLS or (function.attr in {"load", "save"} and library in OPENING_LIBRARIES)


def test_geometry_stands_on_errors_alone() -> None:
    paths = sorted((PACKAGES["gcd_model"] / "geometry").glob("*.py"))
    assert paths
    names = [name for path in paths for name in imports(path) if name.startswith("gcd_model")]
    assert [name for name in names if not name.startswith(("gcd_model.errors", "gcd_model.geometry"))] == []


def test_the_node_enters_the_model_by_its_door() -> None:
    inside = {path.stem for path in files("gcd_model")} | {"geometry"}
    reached = [name for path in files("gcd_node") for name in imports(path) if name.startswith("gcd_model.")]
    assert [name for name in reached if name.count(".") > 1 or name.split(".")[1] in inside - {"__init__"}] == []


def test_node_and_training_never_meet() -> None:
    assert offenders(files("gcd_node"), "gcd_train") == []
    assert offenders(files("gcd_train"), "gcd_node") == []


def test_only_the_socket_files_know_zeromq() -> None:
    inside = PACKAGES["gcd_node"]
    outside = [path for path in files("gcd_node") if path.relative_to(inside).as_posix() not in SOCKET_FILES]
    assert offenders(outside, "zmq") == []


def test_only_the_oak_source_knows_depthai_and_only_lazily() -> None:
    assert offenders([path for path in files("gcd_node") if path.name != "oak.py"], "depthai") == []
    assert offenders(files("gcd_node"), "depthai", top_level_only=True) == []


def test_the_client_stands_alone_on_every_system() -> None:
    known = {"gcd_client", "numpy", "zmq", "msgspec", "cv2", *sys.stdlib_module_names}
    alone = [path for path in files("gcd_client") if path.name != "lerobot.py"]  # nothing but its users imports that
    found = {name.split(".")[0] for path in alone for name in imports(path)}
    assert found - known == set()
    assert found & {"fcntl", "termios", "ctypes", "pwd", "grp", "resource"} == set()
    assert offenders(files("gcd_client"), "cv2", "asyncio", "zmq.asyncio", top_level_only=True) == []


def test_nothing_imports_launch_tools_or_tests() -> None:
    everything = [path for package in PACKAGES for path in files(package)]
    scripts = [path.stem for path in (ROOT / "tools").glob("*.py")]
    assert scripts
    assert offenders(everything, "launch", "tests", "tools", "client", "model", "train", *scripts) == []
    assert offenders(sorted((ROOT / "tests").rglob("*.py")), "tools", *scripts) == []


@pytest.mark.parametrize(("folder", "most_files", "most_lines"), MOST)
def test_what_is_to_shrink_does_not_grow(folder: str, most_files: int, most_lines: int) -> None:
    paths = list((ROOT / folder).rglob("*.py"))
    lines = sum(len(path.read_text().splitlines()) for path in paths)
    assert (len(paths) <= most_files, lines <= most_lines) == (True, True), f"{len(paths)} files, {lines} lines"


def test_the_documentation_is_read_in_half_an_hour() -> None:
    pages = [len(path.read_text().splitlines()) for path in (ROOT / "docs").glob("*.md")]
    assert len(pages) <= MOST_DOCS[0]
    assert sum(pages) <= MOST_DOCS[1]
    assert len((ROOT / "README.md").read_text().splitlines()) <= MOST_README


def test_functions_fit_a_screen() -> None:
    for package in PACKAGES:
        sizes = [size for path in files(package) for _, size in functions(path)]
        assert median(sizes) <= 12, package
        assert sorted(sizes)[int(0.9 * len(sizes))] <= 35, package
    longest = [(path.name, name, size) for p in PACKAGES for path in files(p) for name, size in functions(path)]
    assert [row for row in longest if row[2] > 60] == []


def test_files_stay_readable() -> None:
    long = [(path.name, len(path.read_text().splitlines())) for p in PACKAGES for path in files(p)]
    assert [row for row in long if row[1] > 400] == []


def test_packages_are_at_most_two_deep() -> None:
    depths = [len(path.relative_to(root).parts) for root in PACKAGES.values() for path in root.rglob("*.py")]
    assert max(depths) <= 3  # package / subpackage / file
