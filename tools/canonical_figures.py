"""How well a canonical view's pose is found, and a camera that was moved is noticed, on held-out tabletop scenes.

    python tools/canonical_figures.py pose OUT --depth exact     # learned, stereo: the pose against a reference picture
    python tools/canonical_figures.py moves OUT --depth learned   # moves of 1 cm or 1 degree: noticed within 2 s?
    python tools/canonical_figures.py alarms OUT --depth exact --seconds 270     # of each scene: alarms, nothing moved
    python tools/canonical_figures.py report OUT

Every scene leaves a file in OUT; what is there is not done again. The node's own code decides: `DriftDetector.check` on
a frame every 0.42 s, `align` on five frames as `gcd-node calibrate-view` takes them. Exact depth, as a perfect camera
would measure it, comes without the network's mask of what moves. All pictures have noise of two grey levels; that
of `pose`'s reference camera is of another moment, gamma, exposure and white balance. `moves` and `alarms` compare with
what the camera saw first: their reference is a clean picture from there, which the stated pose fits.
"""

import argparse
import json
import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from gcd_model import AlignmentError, Clip, Intrinsics, SeenFrame, align, features, landmarks_of, load_synthesizer
from gcd_model.geometry import sphere_poses
from gcd_model.live.eyes import FrameGeometry
from gcd_node.canonical import Reference
from gcd_node.config import parse_config
from gcd_node.drift import DriftDetector
from gcd_node.frame import LensModel
from gcd_node.health import Health
from gcd_node.sources.stereo import StereoDepth
from gcd_node.status import Announcer
from gcd_node.views import LiveConfig
from gcd_train.data.splits import public_split
from gcd_train.files import write_whole
from gcd_train.scenes.description import Scene, rotations
from gcd_train.scenes.renderer import Renderer, Rendering
from gcd_train.scenes.tabletop.scene import UNITS_A_METRE, tabletop_scene
from gcd_train.scenes.triangles import freeze

Depth = Literal["exact", "learned", "stereo"]
Array = NDArray[Any]
MODEL, CAMERA, REFERENCE = (192, 128), (640, 427), (224, 224)
"""Sizes: of what the model sees, of a camera's picture as calibrate-view takes it, and of a policy's picture."""
HFOV_DEG, REFERENCE_DEG, STEREO_DEG, BASELINE_M = 60.0, 55.0, 66.0, 0.075
CHECK_FRAMES, BEFORE, AFTER = 10, 4, 4
"""24 Hz frames from check to check, checks before a move, and those that surely come within 2 s after it."""
MOVES = ((1.0, 1.0), (3.0, 3.0), (5.0, 5.0), (10.0, 10.0))
"""Of the pose's reference camera from the source, centimetres and degrees, in drawn directions; twice each."""
LAUNCH = """[source]\nkind = "synthetic"\n[model]\nweights = "package:live-small"\n[view.v]\nkind = "canonical"
reference = "-"\nhfov_deg = 60.0\npose = [0, 0, 0, 0, 0, 0, 1]\n"""


def moved(pose: Array, random: np.random.Generator, cm: float, deg: float) -> Array:
    """world_from_camera after a step and a turn of these sizes in drawn directions; scene units."""
    step, axis = (each / np.linalg.norm(each) for each in random.normal(size=(2, 3)))
    half = math.radians(deg) / 2
    pose = pose.copy()
    pose[:3, 3] += cm / 100 * UNITS_A_METRE * step
    pose[:3, :3] = pose[:3, :3] @ rotations(np.array([math.cos(half), *(math.sin(half) * axis)]))
    return pose


def place(random: np.random.Generator) -> Array:
    """world_from_camera of a camera that looks at the table from 1.1 to 1.5 m away."""
    where = [random.uniform(0, 360), random.uniform(15, 50), random.uniform(11, 15)]
    return sphere_poses(torch.tensor([where], dtype=torch.float64)).numpy()[0]


def looks_otherwise(picture: Array, random: np.random.Generator) -> Array:
    """The same in another light: u8 [H, W, 3]."""
    gamma, gain = math.exp(random.normal() * 0.15), np.exp(random.normal() * 0.1 + random.normal(size=3) * 0.04)
    return noisy((picture / 255.0) ** gamma * gain * 255, random)


def noisy(picture: Array, random: np.random.Generator) -> Array:
    return (picture + random.normal(size=picture.shape) * 2).clip(0, 255).round().astype(np.uint8)


@cache
def renderer(size: tuple[int, int]) -> Renderer:
    return Renderer(*size, oversample=2)


def film(scene: Scene, steps: list[int], poses: Array, size: tuple[int, int], hfov_deg: float) -> Rendering:
    """What a camera sees at these time steps; poses: [T, 4, 4]."""
    cut = replace(freeze(scene), poses=scene.poses[steps], focus=scene.focus[steps])
    return renderer(size).render(cut, {"camera": poses}, {"camera": hfov_deg})["camera"]


class Camera:
    """A camera with depth of a kind. lens: of what the model sees."""

    def __init__(self, depth: Depth, random: np.random.Generator) -> None:
        self.depth, self._random, self.lens = depth, random, Intrinsics.from_hfov(HFOV_DEG, *MODEL)
        if depth == "stereo":
            plain = Intrinsics.from_hfov(STEREO_DEG, *CAMERA)
            lens = LensModel(
                width=CAMERA[0], height=CAMERA[1], fx=plain.fx, fy=plain.fy, cx=plain.cx - 0.5, cy=plain.cy - 0.5
            )
            right_from_left = np.eye(4)
            right_from_left[0, 3] = -BASELINE_M
            self._stereo = StereoDepth((lens, lens), right_from_left, size=MODEL)
            self.lens = self._stereo.lens
        if depth != "exact":
            self._model = network()
            self._model.reset()

    def see(self, scene: Scene, steps: list[int], poses: Array, *, fine: bool) -> Iterator[tuple[SeenFrame, Any, Any]]:
        """Frames, and each as fine as calibrate-view takes it, with its lens; None where nobody asks."""
        size = CAMERA if fine or self.depth == "stereo" else MODEL
        angle = STEREO_DEG if self.depth == "stereo" else HFOV_DEG
        left, shift = film(scene, steps, poses, size, angle), np.eye(4)
        shift[0, 3] = BASELINE_M * UNITS_A_METRE
        right = film(scene, steps, poses @ shift, size, angle) if self.depth == "stereo" else None
        small = left if size == MODEL else film(scene, steps, poses, MODEL, HFOV_DEG)
        for t in range(len(steps)):
            picture, metres = noisy(small.rgb[t], self._random), small.depth[t] / UNITS_A_METRE
            if right is not None:
                picture, metres = self._stereo(noisy(left.rgb[t], self._random), noisy(right.rgb[t], self._random))
            frame = self._seen(picture, metres.astype(np.float32))
            own = noisy(left.rgb[t], self._random), Intrinsics.from_hfov(angle, *size)
            yield frame, *(own if fine else (None, None))

    def _seen(self, picture: Array, metres: Array) -> SeenFrame:
        video = torch.from_numpy(picture).permute(2, 0, 1).float() / 127.5 - 1
        if self.depth == "exact":
            labels, static = torch.zeros(metres.shape, dtype=torch.uint8), torch.ones(metres.shape, dtype=torch.bool)
            shown = FrameGeometry(metres=torch.from_numpy(metres), labels=labels, static=static, ood=0.0)
            return SeenFrame(
                picture=video, geometry=shown, lens=self.lens, floor=None, world_from_source=torch.eye(4), begins=True,
                lost=None,
            )  # fmt: skip
        stated = torch.from_numpy(metres)[None] if self.depth == "stereo" else None
        clip = Clip(video=video[None], fps=10.0, lens=self.lens, depth=stated)
        return self._model.see(self._model.encode(clip))[0]


@cache
def network() -> Any:
    torch.set_num_threads(1)
    return load_synthesizer("package:live-small", device="cpu").streaming()


def pose_figures(seed: int, depth: Depth) -> dict[str, Any]:
    """Of a scene: errors of the pose of a reference camera after each of MOVES, in mm and degrees, and the doubt."""
    scene, random, rows = tabletop_scene(seed, 60), np.random.default_rng([seed, 1]), []
    source, camera = place(random), Camera(depth, random)
    frames = camera.see(scene, [35, 40, 45, 50, 55], np.tile(source, (5, 1, 1)), fine=True)
    known, lens = [landmarks_of(*each) for each in frames], Intrinsics.from_hfov(REFERENCE_DEG, *REFERENCE)
    for cm, deg in MOVES * 2:
        goal = moved(source, random, cm, deg)
        picture = looks_otherwise(film(scene, [0], goal[None], REFERENCE, REFERENCE_DEG).rgb[0], random)
        truth = np.linalg.inv(source) @ goal
        truth[:3, 3] /= UNITS_A_METRE
        row: dict[str, Any] = {"cm": cm, "deg": deg}
        try:
            off = align(known, [features(picture, lens)]).moved_from(torch.from_numpy(truth))
            row |= {"mm": 10 * off.centimetres, "off_deg": off.degrees, "px": off.pixels}
            row |= {"doubt_mm": 10 * off.doubt_centimetres, "doubt_deg": off.doubt_degrees}
        except AlignmentError as error:
            row["refused"] = str(error)
        rows.append(row)
    return {"rows": rows}


class Watch:
    """A drift detector without a node, shown frames one by one."""

    def __init__(self, picture: Array, lens: Intrinsics) -> None:
        announcer = Announcer("figures", "", SimpleNamespace(note=lambda *_: None), Health())  # type: ignore[arg-type]
        reference = Reference(features=(features(picture, lens),), view=lens)
        self._detector = DriftDetector(
            LiveConfig(parse_config(LAUNCH, "figures")), announcer, {"v": reference}, lambda: None
        )

    def says_moved(self, frame: SeenFrame) -> bool:
        self._detector.check(frame)
        return bool(self._detector.moved)


def move_figures(seed: int, depth: Depth) -> dict[str, Any]:
    """Of a scene: which check after a move of 1 cm or of 1 degree notices it, from 1; None: none within 2 s."""
    frames = CHECK_FRAMES * (BEFORE + AFTER)
    scene, random, rows = tabletop_scene(seed, frames), np.random.default_rng([seed, 2]), []
    for cm, deg in ((1.0, 0.0), (1.0, 0.0), (0.0, 1.0), (0.0, 1.0)):
        source, camera = place(random), Camera(depth, random)
        poses = np.stack([source] * BEFORE + [moved(source, random, cm, deg)] * AFTER)
        seen = [frame for frame, _, _ in camera.see(scene, list(range(0, frames, CHECK_FRAMES)), poses, fine=False)]
        watch = Watch(film(scene, [0], source[None], MODEL, HFOV_DEG).rgb[0], Intrinsics.from_hfov(HFOV_DEG, *MODEL))
        said = [watch.says_moved(frame) for frame in seen]
        noticed = said[BEFORE:].index(True) + 1 if True in said[BEFORE:] else None
        rows.append({"cm": cm, "deg": deg, "check": noticed, "early": any(said[:BEFORE])})
    return {"rows": rows}


def alarm_figures(seed: int, depth: Depth, seconds: float) -> dict[str, Any]:
    """Of a scene whose arm works while the camera stands: checks, and how often it was said to have moved."""
    count = round(seconds * 24 / CHECK_FRAMES)
    scene, random = tabletop_scene(seed, count * CHECK_FRAMES), np.random.default_rng([seed, 3])
    source, camera = place(random), Camera(depth, random)
    watch = Watch(film(scene, [0], source[None], MODEL, HFOV_DEG).rgb[0], Intrinsics.from_hfov(HFOV_DEG, *MODEL))
    said: list[bool] = [False]
    for first in range(0, count, 50):
        steps = [CHECK_FRAMES * each for each in range(first, min(first + 50, count))]
        frames = camera.see(scene, steps, np.tile(source, (len(steps), 1, 1)), fine=False)
        said += [watch.says_moved(frame) for frame, _, _ in frames]
    alarms = sum(now and not before for before, now in pairwise(said))
    return {"checks": count, "hours": count * CHECK_FRAMES / 24 / 3600, "alarms": alarms, "checks_moved": sum(said)}


def report(out: Path) -> None:
    """Print what OUT holds."""
    for folder in sorted(each for each in out.iterdir() if each.is_dir()):
        found = [json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))]
        rows = [row for each in found for row in each.get("rows", [])]
        print(f"{folder.name}: {len(found)} scenes")
        if folder.name.startswith("alarms"):
            hours, alarms = (sum(each[name] for each in found) for name in ("hours", "alarms"))
            print(f"  {hours:.2f} hours, {alarms} alarms, {sum(each['checks_moved'] for each in found)} checks")
        for cm, deg in sorted({(row["cm"], row["deg"]) for row in rows}):
            some = [row for row in rows if (row["cm"], row["deg"]) == (cm, deg)]
            if folder.name.startswith("moves"):
                noticed, early = (sum(bool(row[name]) for row in some) for name in ("check", "early"))
                low, high = wilson(noticed, len(some))
                words = f"{noticed} of {len(some)} noticed [{low:.3f}, {high:.3f}], {early} early"
                print(f"  {cm:g} cm, {deg:g} deg: {words}")
                continue
            known = [row for row in some if "mm" in row]
            good = sum(row["mm"] <= 5 and row["off_deg"] <= 0.5 for row in known)
            quantiles = [np.quantile([row[name] for row in known], (0.5, 0.9, 1)) for name in ("mm", "off_deg", "px")]
            within = [
                np.mean([row[a] <= 2 * row[b] for row in known])
                for a, b in (("mm", "doubt_mm"), ("off_deg", "doubt_deg"))
            ]
            low, high = wilson(good, len(some))
            print(
                f"  {cm:g} cm, {deg:g} deg: {good} of {len(some)} within 5 mm and 0.5 deg [{low:.2f}, {high:.2f}], "
                f"{len(some) - len(known)} refused; median, 90 %, most: "
                + "; ".join(" ".join(f"{each:.2f}" for each in some) for some in quantiles)
                + f" (mm; deg; px); within two doubts {within[0]:.2f}, {within[1]:.2f}"
            )  # fmt: skip


def wilson(hits: int, of: int) -> tuple[float, float]:
    """The 95 % interval of a share. Source: Wilson 1927."""
    z, share = 1.96, hits / of
    middle, half = share + z * z / (2 * of), z * math.sqrt(share * (1 - share) / of + z * z / (4 * of * of))
    return (middle - half) / (1 + z * z / of), (middle + half) / (1 + z * z / of)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("pose", "moves", "alarms", "report"))
    parser.add_argument("out", type=Path)
    parser.add_argument("--depth", choices=("exact", "learned", "stereo"), default="exact")
    parser.add_argument("--scenes", type=int, default=40)
    parser.add_argument("--seconds", type=float, default=90.0)
    options = parser.parse_args()
    if options.what == "report":
        report(options.out)
        return
    folder = options.out / f"{options.what}-{options.depth}"
    folder.mkdir(parents=True, exist_ok=True)
    seeds = [seed for run in public_split("tabletop-test").runs for seed in run][: options.scenes]
    for seed in seeds:
        path = folder / f"{seed}.json"
        if path.exists():
            continue
        if options.what == "alarms":
            made = alarm_figures(seed, options.depth, options.seconds)
        else:
            made = (pose_figures if options.what == "pose" else move_figures)(seed, options.depth)
        write_whole(path, json.dumps(made).encode())
        print(seed, json.dumps(made)[:300], flush=True)


if __name__ == "__main__":
    main()
