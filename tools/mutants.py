"""How many small mistakes the tests notice: random mutants of the code, each run against the tests that reach its line.

    pytest -n 2 --dist loadfile --cov=gcd_model --cov=gcd_client --cov=gcd_node --cov=gcd_train --cov-context=test
    python tools/mutants.py .coverage --count 200 --out mutants.jsonl

A mutant negates a condition, moves a whole number or a comparison by one, or drops a line. It is killed if one of those
tests fails. The same line again goes on where it stopped. Needs coverage and pytest-cov. Files are changed in place and
put back: give it a checkout of its own.
"""

import argparse
import ast
import contextlib
import json
import random
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import coverage

SCOPE = (
    "model/gcd_model",
    "client/gcd_client",
    "gcd_node/window.py",
    "gcd_node/publisher.py",
    "train/gcd_train/data",
    "train/gcd_train/training/losses.py",
)
_MOST_TESTS, _TIMEOUT_S = 25, 300
_NEXT = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt}


@dataclass(frozen=True)
class Mutant:
    """path, line: where. kind: what was done. seed: which of the tests that reach the line are run."""

    path: str
    line: int
    column: int
    kind: str
    seed: int


def places(tree: ast.Module) -> Iterator[tuple[str, ast.AST]]:
    """Every change that can be made in a function, and the node it is made to."""
    functions = (each for each in ast.walk(tree) if isinstance(each, ast.FunctionDef | ast.AsyncFunctionDef))
    for node in dict.fromkeys(node for each in functions for line in each.body for node in ast.walk(line)):
        if isinstance(node, ast.If | ast.While | ast.IfExp):
            yield "negated", node
        elif (isinstance(node, ast.Compare) and type(node.ops[0]) in _NEXT) or (
            isinstance(node, ast.Constant) and type(node.value) is int
        ):
            yield "off by one", node
        elif isinstance(node, ast.Assign | ast.AugAssign) or (
            isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
        ):
            yield "dropped", node


def mutated(tree: ast.Module, mutant: Mutant) -> str:
    """The file with one change."""
    for kind, node in places(tree):
        if (kind, getattr(node, "lineno", 0), getattr(node, "col_offset", 0)) != (
            mutant.kind,
            mutant.line,
            mutant.column,
        ):
            continue
        if isinstance(node, ast.If | ast.While | ast.IfExp):
            node.test = ast.UnaryOp(ast.Not(), node.test)
        elif isinstance(node, ast.Compare):
            node.ops[0] = _NEXT[type(node.ops[0])]()
        elif isinstance(node, ast.Constant):
            node.value += 1
        else:
            _drop(tree, node)
        return ast.unparse(ast.fix_missing_locations(tree))
    raise LookupError(f"{mutant} is not there any more")


def _drop(tree: ast.Module, dropped: ast.AST) -> None:
    for parent in ast.walk(tree):
        for field in ("body", "orelse", "finalbody"):
            lines = getattr(parent, field, None)
            if isinstance(lines, list) and dropped in lines:
                lines[lines.index(dropped)] = ast.Pass()


def sampled(root: Path, count: int, seed: int) -> list[Mutant]:
    """Mutants drawn from all there could be in the scope; each kind gets a third."""
    paths = [file for each in SCOPE for file in sorted((root / each).rglob("*.py") or [root / each])]
    paths += [root / each for each in SCOPE if each.endswith(".py")]
    found: dict[str, list[tuple[str, int, int]]] = {"negated": [], "off by one": [], "dropped": []}
    for path in sorted(set(paths)):
        for kind, node in places(ast.parse(path.read_text())):
            found[kind].append((str(path.relative_to(root)), node.lineno, node.col_offset))  # type: ignore[attr-defined]
    draw, mutants = random.Random(seed), list[Mutant]()
    for k in range(count):
        kind = sorted(found)[k % 3]
        mutants.append(Mutant(*draw.choice(found[kind]), kind, draw.randrange(2**32)))
    return mutants


def tests_of(data: coverage.CoverageData, root: Path, mutant: Mutant) -> list[str]:
    """Some of the tests that reach the line."""
    reached = data.contexts_by_lineno(str(root / mutant.path)).get(mutant.line, [])
    names = sorted({each.partition("|")[0] for each in reached if "::" in each})
    random.Random(mutant.seed).shuffle(names)
    return names[:_MOST_TESTS]


def killed(root: Path, mutant: Mutant, tests: list[str]) -> bool:
    """Whether one of the tests fails, or does not end."""
    path = root / mutant.path
    text = path.read_text()
    command = [sys.executable, "-m", "pytest", "-x", "-q", "--timeout=120", "-p", "no:randomly", "-m", "", *tests]
    try:
        path.write_text(mutated(ast.parse(text), mutant))
        done = subprocess.run(command, cwd=root, capture_output=True, timeout=_TIMEOUT_S, check=False)
        return done.returncode != 0
    except subprocess.TimeoutExpired:
        return True
    finally:
        path.write_text(text)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("coverage", type=Path, help="the file that coverage wrote, with contexts")
    parser.add_argument(
        "--root", type=Path, default=Path.cwd(), help="the checkout that is changed; by default this one"
    )
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True, help="a line of JSON for each mutant")
    options = parser.parse_args()
    root = options.root.resolve()
    data = coverage.CoverageData(str(options.coverage))
    data.read()
    done = dict[str, bool]()
    with contextlib.suppress(FileNotFoundError):
        done = {json.dumps(row["mutant"]): row["killed"] for row in map(json.loads, options.out.open())}
    with options.out.open("a") as out:
        for mutant in sampled(root, options.count, options.seed):
            if (name := json.dumps(asdict(mutant))) in done:
                continue
            tests = tests_of(data, root, mutant)
            done[name] = bool(tests) and killed(root, mutant, tests)
            out.write(json.dumps({"mutant": asdict(mutant), "tests": len(tests), "killed": done[name]}) + "\n")
            out.flush()
    print(f"{sum(done.values())} of {len(done)} mutants killed")


if __name__ == "__main__":
    main()
