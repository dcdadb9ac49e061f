"""What a model costs, stage by stage, beside other implementations: times, memory, arithmetic, as Markdown tables.

    python tools/bench_model.py --weights random:kubric90 --peer diffusers --memory --json kubric90.json
    python tools/bench_model.py --show docs/performance/*.json

With a peer the same weights, latents, steps and guidance go through its modules, in turns with ours in one process. The
clip is then a still picture and camera control is left out: diffusers has one image token a clip and no camera.
"""

import argparse
import datetime
import json
import os
import platform
import shlex
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import msgspec
import psutil
import torch
from model_stages import (
    STAGES,
    Implementation,
    MemoryFigures,
    ModelBench,
    bench_model,
    load_measured,
    save_random,
)

from gcd_model import ModelError, OptionError

ENGINES = {
    "torch": "ours",
    "cuda": "ours on cuda",
    "cuda-tuned": "ours on cuda, tuned",
    "cuda-float8": "ours on cuda, float8",
    "cuda-float32-decoder": "ours on cuda, float32 decoder",
    "compiled": "ours, compiled alone",
    "graphs": "ours, graphs alone",
}
_MEMORY_OF = "--memory-of"
_POLL_S = 0.02
_GIGABYTE = 1e9


def main() -> None:
    parser = _parser()
    options = parser.parse_args()
    if options.weights is None and not options.show:
        parser.error("give --weights, or --show")
    try:
        if options.show:
            for path in options.show:
                print(markdown(json.loads(path.read_text())))
        elif options.memory_of is not None:
            print(msgspec.json.encode(own_memory(options, options.memory_of)).decode())
        else:
            print(markdown(measured(options)))
    except ModelError as error:
        sys.exit(f"error: {error}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", help="a checkpoint, package:NAME, random:FAMILY, or random:full (6 GB and more)")
    parser.add_argument("--peer", choices=["diffusers"], help="also the same networks in its modules")
    parser.add_argument("--compiled", action="store_true", help="the peer behind torch.compile, too")
    parser.add_argument("--engine", action="append", choices=list(ENGINES), help="again for more; the first is 'ours'")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--dtype", choices=["float32", "bfloat16", "float16"])
    parser.add_argument("--height", type=int)
    parser.add_argument("--width", type=int)
    parser.add_argument("--steps", type=int)
    parser.add_argument("--guidance", type=float, nargs=2, metavar=("FIRST", "LAST"))
    parser.add_argument("--repeats", type=int, default=3, help="measured windows of each")
    parser.add_argument("--warm", type=int, default=1, help="windows of each before those")
    parser.add_argument("--stages", default=",".join(STAGES), help="others are not computed")
    parser.add_argument("--memory", action="store_true", help="also the memory of each, in a process of its own")
    parser.add_argument("--threads", type=int)
    parser.add_argument("--json", type=Path, help="file for the figures and what they were measured on")
    parser.add_argument("--show", type=Path, nargs="+", help="files that --json wrote, as tables; measures nothing")
    parser.add_argument(_MEMORY_OF, metavar="IMPLEMENTATION", help=argparse.SUPPRESS)
    return parser


def measured(options: argparse.Namespace) -> dict:
    """The figures with everything a reader needs to make them again."""
    load_before = os.getloadavg()[0]
    record = {"command": shlex.join(["python", "tools/bench_model.py", *_without_json(sys.argv[1:])])}
    report = _bench(options)
    record |= {
        "date": datetime.datetime.now(tz=datetime.UTC).date().isoformat(),
        "machine": this_machine(),
        "load_before": load_before,
        "report": msgspec.to_builtins(report),
    }
    if options.json is not None:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(record, indent=1) + "\n")
    return record


def _without_json(words: list[str]) -> list[str]:
    """Where the figures go says nothing about them."""
    at = next((i for i, word in enumerate(words) if word == "--json"), len(words))
    return words[:at] + words[at + 2 :]


def _bench(options: argparse.Namespace) -> ModelBench:
    """Memory comes first, so that a measurement that fills the machine fails at once."""
    names, stages = _implementations(options), _stages(options)
    if not names or not stages or options.repeats < 1:
        raise OptionError("a bench takes at least one window, one stage and one implementation")
    memories = _memories(options, names) if options.memory else {}
    synthesizer = _load(options, stages=stages)
    shape = _shape(options)
    counts = {"repeats": options.repeats, "warm": options.warm}
    report = bench_model(
        synthesizer, names, stages, **counts, **shape, on_part=lambda part: print(part, file=sys.stderr)
    )
    rows = tuple(msgspec.structs.replace(row, memory=memories.get(row.name)) for row in report.implementations)
    return msgspec.structs.replace(report, implementations=rows)


def _implementations(options: argparse.Namespace) -> list[str]:
    names = [ENGINES[name] for name in options.engine or ["torch"]]
    if options.peer is not None:
        names += ["diffusers", "diffusers compiled"] if options.compiled else ["diffusers"]
    return names


def _stages(options: argparse.Namespace) -> list[str]:
    return [stage for stage in STAGES if stage in options.stages.split(",")]


def _shape(options: argparse.Namespace) -> dict:
    guidance = None if options.guidance is None else tuple(options.guidance)
    return {"height": options.height, "width": options.width, "steps": options.steps, "guidance": guidance}


def _load(options: argparse.Namespace, **more: object) -> object:
    if options.threads is not None:
        torch.set_num_threads(options.threads)
    return load_measured(options.weights, device=options.device, dtype=options.dtype, **more)


def _memories(options: argparse.Namespace, names: list[str]) -> dict[str, MemoryFigures]:
    """By implementation, each in a fresh process: a peak does not come down."""
    with tempfile.TemporaryDirectory(prefix="gcd-bench-") as folder:
        words = _without_json(sys.argv[1:])
        if options.weights.startswith("random:"):
            weights = Path(folder) / "random.safetensors"
            save_random(options.weights, weights, _stages(options))
            words += ["--weights", str(weights)]
        found = {}
        for name in names:
            command = [sys.executable, __file__, *words, _MEMORY_OF, name]
            done = subprocess.run(command, stdout=subprocess.PIPE, check=True)
            found[name] = msgspec.json.decode(done.stdout.splitlines()[-1], type=MemoryFigures)
        return found


def own_memory(options: argparse.Namespace, name: str) -> MemoryFigures:
    """The most this process holds while it does one window of an implementation."""
    once = {"repeats": 1, "warm": 0, "count": False, "bare": options.peer is not None}
    done, peak = threading.Event(), {"resident": 0, "private": 0}

    def watch() -> None:
        process = psutil.Process()
        while not done.wait(_POLL_S):
            now = process.memory_info()
            peak["resident"] = max(peak["resident"], now.rss)
            peak["private"] = max(peak["private"], now.rss - now.shared)

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        synthesizer = _load(options)
        bench_model(synthesizer, [name], _stages(options), **once, **_shape(options))
    finally:
        done.set()
        watcher.join()
    on_gpu = synthesizer.traits.device.startswith("cuda")
    return MemoryFigures(
        resident_gb=peak["resident"] / _GIGABYTE,
        private_gb=peak["private"] / _GIGABYTE,
        device_gb=torch.cuda.max_memory_reserved() / _GIGABYTE if on_gpu else None,
    )


def this_machine() -> dict:
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {
        "cpu": names[0] if names else platform.machine(),
        "cores": len(os.sched_getaffinity(0)),
        "memory_gb": psutil.virtual_memory().total / _GIGABYTE,
        "device": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "torch": str(torch.__version__),
        "python": platform.python_version(),
    }


def markdown(record: dict) -> str:
    """One measurement: its command, its machine, its tables."""
    machine, report = record["machine"], msgspec.convert(record["report"], ModelBench)
    place = (
        f"{record['date']}, {machine['cpu']}, {machine['cores']} cores, {machine['memory_gb']:.0f} GB, "
        f"{machine['device'] or 'no GPU'}, torch {machine['torch']}, Python {machine['python']}; "
        f"load before: {record['load_before']:.1f}."
    )
    guided = "no guidance" if report.guidance == (1.0, 1.0) else "guidance {:g} to {:g}".format(*report.guidance)
    head = (
        f"**{report.model}, {report.parameters:.1f} M parameters: {report.frames} x {report.height} x {report.width}, "
        f"{report.steps} steps, {guided}, {report.precision} on {report.device}, {report.threads} threads**"
    )
    parts = [f"```sh\n{record['command']}\n```", place, head, _stage_table(report.implementations)]
    memories = [(row.name, row.memory) for row in report.implementations if row.memory is not None]
    if memories:
        rows = [(name, _figure(m.resident_gb), _figure(m.private_gb), _figure(m.device_gb)) for name, m in memories]
        parts += ["**Most memory of a fresh process that does one such window, GB; mapped files count as resident**"]
        parts += [_table(("", "resident", "private", "on the GPU"), rows)]
    if report.differences:
        rows = [
            (each.name, _figure(each.latents), _figure(each.pictures), _figure(each.psnr_db))
            for each in report.differences
        ]
        parts += ["**Largest difference of a window from the first row's, of its largest value; PSNR of its pictures**"]
        parts += [_table(("", "latents", "pictures", "dB"), rows)]
    return "\n\n".join(parts) + "\n"


def _stage_table(implementations: tuple[Implementation, ...]) -> str:
    rows = []
    for first in implementations[0].stages:
        for row in implementations:
            for each in row.stages:
                if each.stage == first.stage:
                    times = (
                        [each.median_s / first.median_s, each.cpu_s / first.cpu_s] if each is not first else [None] * 2
                    )
                    figures = [each.median_s, each.p95_s, each.cpu_s, each.tflop, *times]
                    rows.append((each.stage, row.name, str(each.runs), *map(_figure, figures)))
    columns = ("stage", "", "runs", "median s", "p95 s", "CPU s", "TFLOP", "times ours", "in CPU time")
    return _table(columns, rows, names=2)


def _table(columns: tuple[str, ...], rows: list[tuple[str, ...]], names: int = 1) -> str:
    ruler = ("---",) * names + ("---:",) * (len(columns) - names)
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (columns, ruler, *rows))


def _figure(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"


if __name__ == "__main__":
    main()
