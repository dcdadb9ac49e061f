"""One measurement with everything a reader needs to make it again: a JSON file under docs/performance/."""

import datetime
import os
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

import msgspec

from gcd_model import ModelBench
from gcd_node.errors import OutputError, SourceError
from gcd_node.load.machine import Machine, this_machine
from gcd_node.load.stream_report import StreamBench

Report: TypeAlias = ModelBench | StreamBench


class BenchRecord(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """command: that gave the figures. date: YYYY-MM-DD. load_before: load average of the last minute before it began,
    that is, how much else there was to do."""

    command: str
    date: str
    machine: Machine
    load_before: float
    report: Report


class Measurement:
    """Takes note of the machine before a measurement and makes a record of what comes out."""

    def __init__(self, command: Sequence[str]) -> None:
        """command: its words."""
        self._command = shlex.join(command)
        self._load_before = os.getloadavg()[0]

    def record(self, report: Report) -> BenchRecord:
        """The measurement is over."""
        return BenchRecord(
            command=self._command,
            date=datetime.datetime.now(tz=datetime.UTC).date().isoformat(),
            machine=this_machine(),
            load_before=self._load_before,
            report=report,
        )


def write_record(path: Path, record: BenchRecord) -> None:
    """As indented JSON. Raises OutputError if it cannot be written."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(msgspec.json.format(msgspec.json.encode(record), indent=1) + b"\n")
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}; give another path with --json") from error


def read_record(path: Path) -> BenchRecord:
    """The inverse. Raises SourceError if it is missing or no record."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=BenchRecord)
    except OSError as error:
        raise SourceError(f"cannot read {path}: {error.strerror}; give what --json has written") from error
    except msgspec.DecodeError as error:
        raise SourceError(f"{path} is no record of gcd-node bench: {error}; measure again with --json") from error
