"""What fewer steps, another solver and less guidance cost: the same noise of the same clips, drawn in many ways.

    python tools/bench_sampler.py --weights FILE --data runs/test --limit 8 --steps 4 10 25

Each way is held against 25 Euler steps and against many of second order (`--fine`): `latents from` is the norm of the
difference over that of the reference. Then against the truth, frames 2 to the last, with the lead over the weights' own
way (the first row) and its paired 95 % interval over scenes. `runs` counts evaluations of the network for one view.
"""

import argparse
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean

from gcd_model import RenderOptions, load_synthesizer
from gcd_model.diffusion import SOLVERS, Sampler, Schedule
from gcd_train.evaluation.measure import predicted_and_measured
from gcd_train.evaluation.metrics import psnr
from gcd_train.evaluation.opening import ClipOptions, open_clips
from gcd_train.evaluation.predictors import Prediction
from gcd_train.evaluation.statistics import ClipTable
from gcd_train.evaluation.synthesized import SynthesizedViews

UNGUIDED = (1.0, 1.0)
HEADS = ["steps", "solver", "guidance", "runs", "latents from Euler", "dB to Euler", "latents from fine", "dB to fine"]
HEADS += ["PSNR dB", "ahead", "gradient", "mIoU", "ahead"]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", required=True, help="package:NAME or a path")
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="folders of held-out pairs")
    parser.add_argument("--split", help="only scenes of a split, such as driving-test")
    parser.add_argument("--limit", type=int, help="only the first so many scenes")
    parser.add_argument("--steps", type=int, nargs="+", default=[1, 2, 4, 6, 8, 12, 16, 25])
    parser.add_argument("--solver", choices=SOLVERS, nargs="+", default=list(SOLVERS))
    parser.add_argument("--guidance", type=two, nargs="+", help="FIRST:LAST; by default the weights' own, and none")
    parser.add_argument("--interval", type=two, nargs="+", default=[], help="LOW:HIGH, noise levels of guidance")
    parser.add_argument("--fine", type=int, default=100, help="steps of second order that stand for any number of them")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--dtype")
    options = parser.parse_args()
    model = load_synthesizer(options.weights, device=options.device, dtype=options.dtype)
    clips = open_clips(ClipOptions(data=options.data, split=options.split, limit=options.limit), model.traits)[0]
    views = SynthesizedViews.of(lambda: model, clips, RenderOptions(seed=options.seed))
    own = Sampler.of(model.traits.config.sampling, RenderOptions())
    references = [replace(own, steps=25), replace(own, steps=options.fine, solver="dpmpp_2m")]
    ways = list(dict.fromkeys(map(plainest, [own, *grid(own, options)])))
    print(f"{model.traits.name}, {len(clips.keys)} clips, noise of seed {options.seed}\n")
    show(measure(views, clips, ways, references), model.traits.diffusion)


def two(text):
    first, last = map(float, text.split(":"))
    return first, last


def grid(own, options):
    return [
        Sampler(steps=steps, solver=solver, guidance=guidance, guidance_interval=interval)
        for guidance in options.guidance or dict.fromkeys((own.guidance, UNGUIDED))
        for interval in (None, *options.interval)
        for solver in options.solver
        for steps in options.steps
    ]


def plainest(way):
    """Without what changes nothing: one step has no second order, and no guidance no interval."""
    way = replace(way, solver="euler") if way.steps == 1 else way
    return replace(way, guidance_interval=None) if way.guidance == UNGUIDED else way


def options_of(way, seed=0):
    return RenderOptions(
        steps=way.steps, solver=way.solver, guidance=way.guidance, guidance_interval=way.guidance_interval, seed=seed
    )


@dataclass
class Fixed:
    """What was drawn already."""

    name: str
    prediction: Prediction
    privileged: bool = False

    def predict(self, clip):
        return self.prediction


def measure(views, clips, ways, references):
    """Of each way: its distances from both references, means over clips, and its figures against the truth."""
    apart, records = {way: [] for way in ways}, {way: [] for way in ways}
    for key in clips.keys:
        clip = clips.clip(key)
        draw = views.drawer(clip.seen)
        drawn = {way: draw(options_of(way, views.options.seed)) for way in dict.fromkeys([*references, *ways])}
        for way in ways:
            apart[way].append([number for each in references for number in distance(drawn[way], drawn[each])])
            shown = Fixed(name=str(way), prediction=views.shown(drawn[way]))
            records[way].append(predicted_and_measured(shown, clip, classes=clips.classes)[1])
    count = len(clips.classes)
    truth = {way: ClipTable.of(rows, count).scene_sums() for way, rows in records.items()}
    return {way: ([mean(column) for column in zip(*apart[way], strict=True)], truth[way]) for way in ways}


def distance(view, reference):
    latents = (view.latents - reference.latents).norm() / reference.latents.norm().clamp(min=1e-12)
    return float(latents), float(psnr(view.video, reference.video).mean())


def show(found, diffusion):
    print("| " + " | ".join(HEADS) + " |\n|" + " --- |" * len(HEADS))
    own = next(iter(found.values()))[1]
    for way, (apart, truth) in found.items():
        guidance = "no" if way.guidance == UNGUIDED else "{:g} to {:g}".format(*way.guidance)
        if way.guidance_interval is not None:
            guidance += ", noise {:g} to {:g}".format(*way.guidance_interval)
        ahead_db, ahead_miou = (truth.interval(name, own) for name in ("psnr_db", "miou_full"))
        row = [way.steps, way.solver, guidance, Schedule.of(diffusion, options_of(way)).evaluations]
        row += [f"{number:.{digits}f}" for number, digits in zip(apart, (4, 1, 4, 1), strict=True)]
        row += [f"{truth.value('psnr_db'):.2f}", f"{ahead_db.value:.2f} [{ahead_db.low:.2f}, {ahead_db.high:.2f}]"]
        row += [
            f"{truth.value('gradient_energy'):.2f}",
            f"{truth.value('miou_full'):.3f}",
            f"{ahead_miou.value:.3f} [{ahead_miou.low:.3f}, {ahead_miou.high:.3f}]",
        ]
        print("| " + " | ".join(map(str, row)) + " |")


if __name__ == "__main__":
    main()
