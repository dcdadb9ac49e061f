"""What data costs on this machine: making scenes, reading them, drawing targets from their points, bytes per sample.

    python tools/bench_data.py                  # half an hour and 3 GB of disk
    python tools/bench_data.py --frames 6       # shorter scenes: minutes

CPU seconds of one thread: what else the machine does hardly shows in them. Prints one Markdown row a figure.
"""

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from statistics import median

import numpy as np
import psutil
import torch

from gcd_train.data.kubric4d import Kubric4D
from gcd_train.data.parallel_domain4d import ParallelDomain4D
from gcd_train.data.paths import DRIVING, MAX90
from gcd_train.data.pictures import ViewPairs
from gcd_train.data.visibility import published_tensor
from gcd_train.parallel import one_thread_each
from gcd_train.scenes.scene_writer import write_scene
from gcd_train.scenes.worlds import SCENE_WORLDS, SceneFormat

PROCESS = psutil.Process()
FIRST_SEED = 3_000_000  # in no data set
CLIP_FRAMES, TARGETS, TIME_STEPS = 14, 7, 6
WORLDS = {"drop": (Kubric4D, MAX90), "driving": (ParallelDomain4D, DRIVING)}
EDITIONS = {"compact": {"compact": True, "oversample": 1}, "published": {"compact": False, "oversample": 2}}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--world", choices=WORLDS, nargs="+", default=list(WORLDS))
    parser.add_argument("--scenes", type=int, default=1, help="of each world and edition")
    parser.add_argument("--samples", type=int, default=2, help="training samples read whole")
    parser.add_argument("--frames", type=int, help="time steps of a scene; in shorter ones no training sample is read")
    parser.add_argument("--folder", help="where to make the scenes; removed afterwards")
    options = parser.parse_args()
    one_thread_each()
    torch.set_num_threads(1)
    print("| what | unit | median (lowest to highest) | count |\n| --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory(prefix="gcd-bench-", dir=options.folder) as place:
        for name in options.world:
            world = SCENE_WORLDS[name]
            warm = replace(published_form(world, **EDITIONS["compact"]), frames=1)
            write_scene(Path(place) / "unmeasured", world, warm, FIRST_SEED)
            for edition in EDITIONS:
                measure(Path(place) / f"{name}-{edition}", name, edition, options)


def published_form(world, **edition):
    """As the world's published data set."""
    return SceneFormat(width=world.width, height=world.height, frames=world.frames, **edition)


def measure(place, name, edition, options):
    """All figures of a world in one edition."""
    world, (open_set, sampling) = SCENE_WORLDS[name], WORLDS[name]
    form = published_form(world, **EDITIONS[edition])
    form = replace(form, frames=options.frames or world.frames)
    made = [write_scene(place, world, form, FIRST_SEED + number) for number in range(options.scenes)]
    what = f"{name}, {edition}"
    show(f"{what}: a scene of {form.frames} frames", "CPU s", [each.cpu_s for each in made])
    show(f"{what}: a scene of {form.frames} frames", "MB", [each.size / 1e6 for each in made])
    data = open_set(place)
    scene = data.scenes[0]
    views = data.views(scene, 0)  # metadata is read once a scene
    steps = range(0, form.frames, max(1, form.frames // TIME_STEPS))
    show(f"{what}: reading a time step", "CPU s", [cpu_s(data.views, scene, step) for step in steps])
    if edition == "compact":
        draw = sampling.draw(np.random.default_rng(0), world.frames, world.fps)
        lens, poses = data.lens(scene), draw.world_from_target[:: CLIP_FRAMES // TARGETS]
        published_tensor(views, poses[0], lens, (384, 256))
        drawn = [cpu_s(published_tensor, views, pose, lens, (384, 256)) for pose in poses]
        show(f"{name}: drawing a 384x256 target from {len(views)} views", "CPU s", drawn)
    if form.frames == world.frames:
        pairs, read = ViewPairs(data, sampling), []
        for number in range(options.samples):
            before = PROCESS.io_counters().read_chars, time.process_time()
            pairs.sample(number)
            read.append(((PROCESS.io_counters().read_chars - before[0]) / 1e6, time.process_time() - before[1]))
        show(f"{what}: a training sample, read", "MB", [each for each, _ in read])
        show(f"{what}: a training sample, read and drawn", "CPU s", [each for _, each in read])


def cpu_s(work, *args):
    started = time.process_time()
    work(*args)
    return time.process_time() - started


def show(what, unit, values):
    print(f"| {what} | {unit} | {median(values):.3g} ({min(values):.3g} to {max(values):.3g}) | {len(values)} |")


if __name__ == "__main__":
    main()
