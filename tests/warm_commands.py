"""Command lines in forks of one process that has imported everything: each starts at once, and is limited and measured.

Run as a program it answers lines of JSON: {"argv": ["gcd-node", ...], "folder": where it runs} with an `Ended`.
"""

import json
import os
import resource
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from types import TracebackType
from typing import Self

LIMIT_S, LIMIT_MB = 30, 2000
"""Of processor time, so that a busy machine fails nothing; and resident."""
_PATIENCE_S = 300  # what waits for ever uses no processor
_STDERR = 2


@dataclass(frozen=True, kw_only=True, slots=True)
class Ended:
    """How a command ended. code: below 0 for a signal. cpu_s: processor time. peak_mb: resident, at most."""

    code: int
    output: str
    cpu_s: float
    peak_mb: float


class WarmCommands:
    """The process, while the block lasts."""

    def __enter__(self) -> Self:
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "COLUMNS": "300"}
        self._process = subprocess.Popen(
            [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )
        assert self._process.stdout is not None
        self._process.stdout.readline()
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        with self._process:
            assert self._process.stdin is not None
            self._process.stdin.close()

    def run(self, argv: Sequence[str], folder: Path) -> Ended:
        """Run one command line in a folder."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps({"argv": list(argv), "folder": str(folder)}) + "\n")
        self._process.stdin.flush()
        return Ended(**json.loads(self._process.stdout.readline()))


def _serve() -> None:
    from gcd_node.cli.main import main as node
    from gcd_train.cli.main import main as train

    _import_what_commands_import()
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(_STDERR, 1)
    answers.write("ready\n")
    answers.flush()
    for line in sys.stdin:
        asked = json.loads(line)
        main = node if asked["argv"][0] == "gcd-node" else train
        ended = _forked(main, asked["argv"], Path(asked["folder"]))
        answers.write(json.dumps(asdict(ended)) + "\n")
        answers.flush()


def _import_what_commands_import() -> None:
    from gcd_node.cli.main import COMMANDS, new_app
    from gcd_train.cli import main as train

    new_app(COMMANDS)
    train.new_app(train.COMMANDS)
    for name in ("check", "image_io", "demo", "viewer.server"):
        import_module(f"gcd_node.{name}")
    for name in ("evaluation.report", "look.gallery", "look.show", "training.run"):
        import_module(f"gcd_train.{name}")


def _forked(main: object, argv: list[str], folder: Path) -> Ended:
    output = folder / "output.txt"
    output.touch()
    pid = os.fork()
    if pid == 0:
        _child(main, argv, folder, output)
    peak_kb, status, cpu_s = 0, None, 0.0
    while status is None:
        peak_kb = max(peak_kb, _peak_kb(pid))
        if peak_kb > 2 * LIMIT_MB * 1000:  # before the machine is full
            os.kill(pid, signal.SIGKILL)
        done, code, used = os.wait4(pid, os.WNOHANG)
        if done:
            status, cpu_s = code, used.ru_utime + used.ru_stime
        else:
            time.sleep(0.02)
    return Ended(
        code=os.waitstatus_to_exitcode(status),
        output=output.read_text(errors="replace"),
        cpu_s=cpu_s,
        peak_mb=peak_kb / 1000,
    )


def _child(main: object, argv: list[str], folder: Path, output: Path) -> None:
    code = 1
    try:
        file = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(file, 1)
        os.dup2(file, _STDERR)
        os.chdir(folder)
        os.environ["RUNTIME_DIRECTORY"] = str(folder)
        resource.setrlimit(resource.RLIMIT_CPU, (2 * LIMIT_S, 2 * LIMIT_S))
        signal.alarm(_PATIENCE_S)
        sys.argv = argv
        assert callable(main)
        main()
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _peak_kb(pid: int) -> int:
    """VmHWM counts from the fork; `ru_maxrss` would begin with the parent's."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM")), 0)


if __name__ == "__main__":
    _serve()
