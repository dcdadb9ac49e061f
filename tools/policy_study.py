"""Does a frozen policy survive a moved camera, if its picture is turned back? Success of grasps in closed loop.

    python tools/policy_study.py demonstrations --out DIR --count 1500
    python tools/policy_study.py train --out DIR --cpu-minutes 40
    python tools/policy_study.py evaluate --out DIR
    python tools/policy_study.py report --out DIR

The policy learns by behaviour cloning with injected noise (Laskey et al. 2017, DART) from the tabletop world's own
controller, sees one camera's picture, its own tool and a colour, and says five times a second where the tool shall go.
With `--highest 0.25` the things stand on a block, whose height each episode draws up to that, and nobody tells it.
Demonstrations and episodes that are there are kept, so each command goes on where it was stopped.
"""

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from policy_views import VIEWS, Correction, to_network
from policy_world import BLOCK_CORNERS, CAMERA, COLOURS, DECISIONS, HEIGHT, LENS, WIDTH, Action, Bench, Move
from scipy.stats import binomtest
from torch import Tensor, nn
from torch.nn import functional as F

from gcd_model.networks import LiveNetworks
from gcd_train.evaluation.galleries import Strip, write_video
from gcd_train.evaluation.statistics import scene_weights
from gcd_train.evaluation.tables import markdown_rows
from gcd_train.live.training import live_model
from gcd_train.parallel import one_thread_each
from gcd_train.pictures import new_figure, save
from gcd_train.scenes.renderer import Renderer

FIRST_EPISODE, EPISODES = 1_000_000, 100
_NOISE_M, _NOISY = 0.03, 0.5
_HELD_OUT, _BATCH, _RATE = 20, 32, 2e-3
_WEIGHTS, _GRIPS, _MIDDLE_M = torch.tensor([1.0, 1.0, 0.2, 0.1]), 4.0, 0.06
"""Weights of the losses, and of decisions to grip, which are few; height over the table of what pictures show."""
_MIDDLE, _SPREAD = torch.tensor([0.03, 0.0, 0.12]), 0.1


# --- demonstrations --------------------------------------------------------------------------------------------------


def demonstrate(seed: int, highest_m: float, renderer: Renderer, path: Path) -> bool:
    """One demonstration, written if it succeeds: T decisions, and what the controller would do for each of N things.

    pictures: uint8 [T, H, W, 3]. states: [T, 5]. actions: [T, N, 5], see `Action`; NaN for other things than the one in
    the hand. colours: [N]. raised_m: on what the things stand.
    """
    bench, random = Bench(seed, renderer, highest_m=highest_m), np.random.default_rng([seed, 0xDA])
    rows: list[tuple[np.ndarray, ...]] = []
    for _ in range(DECISIONS):
        picture, state = bench.look()[0], bench.robot.state
        actions = [bench.robot.expert(index) for index in range(len(bench.colours))]
        told = np.array([[*each.place, each.opening, each.closed] for each in actions])
        action = actions[bench.target]
        if action.closed:
            told[np.arange(len(told)) != bench.target] = np.nan
        rows.append((picture, state, told))
        if not action.closed and random.random() < _NOISY:
            action = Action(action.place + random.normal(size=3) * _NOISE_M, action.opening, action.closed)
        bench.robot.act(action)
        if bench.done:
            break
    bench.close()
    if bench.done:
        pictures, states, actions = (np.stack(each) for each in zip(*rows, strict=True))
        told = {"colours": bench.colours, "raised_m": bench.raised_m}
        np.savez(path, pictures=pictures, states=states, actions=actions, **told)
    return bench.done


def demonstrations(out: Path, count: int, highest_m: float) -> None:
    """So many seeds' demonstrations; those that failed leave no file."""
    folder, renderer = out / "demonstrations", Renderer(WIDTH, HEIGHT)
    folder.mkdir(parents=True, exist_ok=True)
    start, kept = time.process_time(), 0
    for seed in range(count):
        path = folder / f"{seed:06d}.npz"
        kept += path.exists() or demonstrate(seed, highest_m, renderer, path)
        if seed % 100 == 99:
            print(f"{kept} of {seed + 1} succeeded, {time.process_time() - start:.0f} CPU s", flush=True)


# --- the policy ------------------------------------------------------------------------------------------------------


class Policy(nn.Module):
    """Picture, own state and a colour in; where the tool shall go, how far to open, whether to grip out.

    Convolutions, then by the colour expected places of 24 keypoints (spatial softmax, Levine et al. 2016), and three
    linear layers. The first keypoint learns where the thing is, too, and two more where the block's front corners are.
    """

    def __init__(self) -> None:
        super().__init__()
        self.name = nn.Embedding(len(COLOURS), 24)
        self.eye = nn.Sequential(
            *(nn.Conv2d(3, 24, 6, 4, 1), nn.ReLU()),
            *(nn.Conv2d(24, 24, 3, 1, 1), nn.GroupNorm(4, 24), nn.ReLU()),
            *(nn.Conv2d(24, 24, 3, 1, 1), nn.GroupNorm(4, 24)),
        )
        self.modulation = nn.Linear(24, 48)
        self.points = nn.Conv2d(24, 24, 1)
        self.hand = nn.Sequential(
            *(nn.Linear(48 + 5 + 24, 256), nn.ReLU()), *(nn.Linear(256, 256), nn.ReLU()), nn.Linear(256, 5)
        )

    def forward(self, pictures: Tensor, states: Tensor, colours: Tensor) -> tuple[Tensor, Tensor]:
        """What to do for each of N colours, and where in the picture its thing is.

        Args:
            pictures: [B, 3, H, W] in [-1, 1]. states: [B, 5]. colours: int64 [B, N].
        Returns:
            [B, N, 5]: place about the middle of the table in decimetres, opening in decimetres, logit of gripping.
            [B, N, 3, H / 4, W / 4]: log shares of the first keypoints.
        """
        names = self.name(colours)
        scale, shift = self.modulation(names)[..., None, None].chunk(2, dim=2)
        maps = F.relu(self.eye(pictures)[:, None] * (1 + scale) + shift).flatten(0, 1)  # [B * N, 24, h, w]
        shares = self.points(maps).flatten(2).log_softmax(-1)
        grid = _cells(maps.shape[3], maps.shape[2]) / torch.tensor([maps.shape[3], maps.shape[2]]) * 2 - 1
        places = (shares.exp() @ grid.flatten(0, 1)).view(*colours.shape, -1)
        own = torch.cat([(states[:, :3] - _MIDDLE) / _SPREAD, states[:, 3:4] / _SPREAD, states[:, 4:]], dim=1)
        out = self.hand(torch.cat([places, own[:, None].expand(-1, colours.shape[1], -1), names], dim=2))
        return out, shares[:, :3].view(*colours.shape, 3, *maps.shape[2:])

    @torch.inference_mode()
    def act(self, picture: Tensor, state: np.ndarray, colour: int) -> Action:
        """picture: [3, H, W] in [-1, 1]."""
        out = self(picture[None], torch.from_numpy(state).float()[None], torch.tensor([[colour]]))[0][0, 0]
        return Action((out[:3] * _SPREAD + _MIDDLE).double().numpy(), float(out[3]) * _SPREAD, bool(out[4] > 0))


def _cells(width: int, height: int) -> Tensor:
    """Column and row of the middle of every cell: [h, w, 2]."""
    return torch.stack(torch.meshgrid(torch.arange(width) + 0.5, torch.arange(height) + 0.5, indexing="xy"), dim=2)


def losses(told: tuple[Tensor, Tensor], actions: Tensor, raised_m: Tensor) -> Tensor:
    """Mean errors [4]: of place and opening, decimetres; of the grip; of where things that stand, and the front corners
    of the block if there is one, are seen, both nats.

    An opening counts where nothing is gripped. actions: [B, N, 5], NaN where unknown. raised_m: [B].
    """
    known = actions.isfinite().all(-1)
    out, shares, actions = told[0][known], told[1][known], actions[known]
    place = (out[:, :3] - (actions[:, :3] - _MIDDLE) / _SPREAD).abs().mean()
    free = actions[:, 4] == 0
    opening = (out[free, 3] - actions[free, 3] / _SPREAD).abs().mean()
    raised_m = raised_m[:, None].expand(known.shape)[known][free]
    points = torch.cat([torch.zeros(len(raised_m), 3, 2), raised_m[:, None, None].expand(-1, 3, 1)], dim=2)
    points[:, 0, :2], points[:, 1:, :2] = actions[free, :2], torch.tensor(BLOCK_CORNERS)
    points[:, 0, 2] += _MIDDLE_M
    x, y, z = (F.pad(points, (0, 1), value=1.0) @ torch.from_numpy(np.linalg.inv(CAMERA)[:3]).float().T).unbind(2)
    pixels = torch.stack([LENS.fx * x / z + LENS.cx, LENS.fy * y / z + LENS.cy], dim=2)
    cells = _cells(shares.shape[3], shares.shape[2])
    away = (cells - pixels[:, :, None, None] * cells.shape[0] / HEIGHT).square().sum(-1)  # [K, 3, h, w]
    nats = -((-away).flatten(2).softmax(2) * shares[free].flatten(2)).sum(2)
    nats[:, 1:] *= (raised_m > 0)[:, None]
    seen = nats.sum(1).mean()
    grip = F.binary_cross_entropy_with_logits(out[:, 4], actions[:, 4], pos_weight=torch.tensor(_GRIPS))
    return torch.stack([place, opening, grip, seen])


def jittered(pictures: Tensor) -> Tensor:
    """Other exposures, white balances and noise: what a robot's camera does by itself."""
    count = len(pictures)
    gain = 1 + 0.15 * torch.randn(count, 1, 1, 1) + 0.05 * torch.randn(count, 3, 1, 1)
    lift, noise = 0.1 * torch.randn(count, 1, 1, 1), 0.06 * torch.rand(count, 1, 1, 1)
    return torch.empty_like(pictures).uniform_(-1, 1).mul_(noise).add_(lift).addcmul_(pictures, gain)


class Decisions:
    """All that was demonstrated, in memory."""

    def __init__(self, paths: list[Path]) -> None:
        read = [np.load(path) for path in paths]
        lengths = torch.tensor([len(each["states"]) for each in read])
        self.pictures, self.states, self.actions = (
            torch.from_numpy(np.concatenate([each[name] for each in read]))
            for name in ("pictures", "states", "actions")
        )
        self.colours, self.raised_m = (
            torch.from_numpy(np.stack([each[name] for each in read])).repeat_interleave(lengths, 0)
            for name in ("colours", "raised_m")
        )
        held_out = torch.arange(len(read)).repeat_interleave(lengths) % _HELD_OUT == 0
        self.learned, self.held_out = (each.nonzero()[:, 0] for each in (~held_out, held_out))

    def batch(self, rows: Tensor, *, mirrored: bool = False) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Pictures, states, colours, actions, heights. The camera looks along the table's x axis, so y mirrors."""
        pictures, states, actions = self.pictures[rows], self.states[rows].float(), self.actions[rows].float()
        if mirrored:
            pictures = pictures.flip(2)
            states[:, 1], actions[..., 1] = -states[:, 1], -actions[..., 1]
        return to_network(pictures), states, self.colours[rows], actions, self.raised_m[rows].float()


def train(out: Path, cpu_minutes: float) -> None:
    """Behaviour cloning for so many CPU minutes; the learning rate falls to nothing over them."""
    torch.manual_seed(0)
    data = Decisions(sorted((out / "demonstrations").glob("*.npz")))
    policy = Policy().to(memory_format=torch.channels_last)
    print(f"{len(data.pictures)} decisions, {sum(each.numel() for each in policy.parameters())} weights", flush=True)
    optimiser = torch.optim.AdamW(policy.parameters(), lr=_RATE, weight_decay=1e-3)
    start, step, share = time.process_time(), 0, 0.0
    while share < 1:
        for rows in data.learned[torch.randperm(len(data.learned))].split(_BATCH):
            share = (time.process_time() - start) / (60 * cpu_minutes)
            if share >= 1:
                break
            optimiser.param_groups[0]["lr"] = _RATE * min(1.0, (step + 1) / 100) * 0.5 * (1 + np.cos(np.pi * share))
            pictures, states, colours, *told = data.batch(rows, mirrored=step % 2 > 0)
            seen = jittered(pictures).contiguous(memory_format=torch.channels_last)
            loss = losses(policy(seen, states, colours), *told) @ _WEIGHTS
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            step += 1
        with torch.no_grad():
            batches = [data.batch(rows) for rows in data.held_out.split(256)]
            place, opening, grip, seen = torch.stack([losses(policy(*each[:3]), *each[3:]) for each in batches]).mean(0)
        print(
            f"{share:.0%}, {step} updates; held out: {100 * place:.1f} mm off along an axis, opening "
            f"{100 * opening:.1f} mm, grip {grip:.3f} nats, thing {seen:.2f} nats",
            flush=True,
        )
        torch.save(policy.state_dict(), out / "policy.pt")


# --- episodes --------------------------------------------------------------------------------------------------------

TRAINED, TOGETHER = Move(0.0, 0.0), Move(0.05, 10.0)
MOVES = (TOGETHER, *(Move(shift_m, 0) for shift_m in (0.03, 0.05, 0.1)), *(Move(0, deg) for deg in (5.0, 10.0, 15.0)))
"""What is measured, first things first."""


def _cells_of(move: Move, highest_m: float) -> list[tuple[Move, str]]:
    """The moved camera's views; one of them only with the first move, and where things are raised."""
    is_first = move is TOGETHER
    views = [view for view in VIEWS if (highest_m and is_first) or view != "homography-height"]
    return [(TRAINED, "none")] * is_first + [(move, view) for view in views]


@torch.inference_mode()
def episode(
    seed: int, move: Move, view: str, highest_m: float, policy: Policy, networks: LiveNetworks, renderer: Renderer
) -> tuple[dict[str, float], list[np.ndarray]]:
    """One attempt: what became of it, and what the policy saw, uint8 [H, W, 3] each.

    It ends when the thing is lifted, when the fingers closed on nothing, or after DECISIONS.
    """
    camera = move.camera(seed)
    bench = Bench(seed, renderer, camera, highest_m)
    correction = Correction(view, camera, networks, bench.raised_m)
    shown: list[np.ndarray] = []
    while len(shown) < DECISIONS and not bench.done and not bench.robot.empty_handed:
        seen = correction(*bench.look())
        shown.append(((seen + 1) * 127.5).round().byte().permute(1, 2, 0).numpy())
        bench.robot.act(policy.act(seen, bench.robot.state, bench.instruction))
    bench.close()
    found = {"lifted": bench.done, "decisions": len(shown), "raised_m": round(bench.raised_m, 3)}
    if correction.depth_errors:
        found["depth_error"] = round(float(np.mean(correction.depth_errors)), 4)
    return found, shown


def evaluate(out: Path, episodes: int, moves: int, highest_m: float) -> None:
    """All cells of so many moves on the same seeds, a line an episode; those that are there are kept."""
    path = out / "episodes.jsonl"
    done = {_key(row) for row in _rows(path)}
    policy, networks, renderer = *_loaded(out), Renderer(WIDTH, HEIGHT)
    for group in MOVES[:moves]:
        for seed in range(FIRST_EPISODE, FIRST_EPISODE + episodes):
            for move, view in _cells_of(group, highest_m):
                row: dict[str, float | str] = {"seed": seed, **move._asdict(), "view": view}
                if _key(row) in done:
                    continue
                row |= episode(seed, move, view, highest_m, policy, networks, renderer)[0]
                with path.open("a") as file:
                    file.write(json.dumps(row) + "\n")


def _loaded(out: Path) -> tuple[Policy, LiveNetworks]:
    policy = Policy()
    policy.load_state_dict(torch.load(out / "policy.pt", weights_only=True))
    return policy.eval(), live_model("package:live-small", device="cpu").networks


def _rows(path: Path) -> list[dict[str, float | str]]:
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def _key(row: dict[str, float | str]) -> tuple[float | str, ...]:
    return row["seed"], row["shift_m"], row["turn_deg"], row["view"]


# --- what came out ---------------------------------------------------------------------------------------------------

_SHOWN = {
    "trained camera": (TRAINED, "none"),
    "moved by 5 cm and 10 degrees": (TOGETHER, "none"),
    "homography": (TOGETHER, "homography"),
    "canonical view, learned depth": (TOGETHER, "canonical-learned"),
}
_COLUMNS = {TRAINED: "as trained", **{move: str(move) for move in MOVES}}
_HOLD, _FPS = 4, 5.0


def report(out: Path, films: Sequence[int], highest_m: float) -> None:
    """report.md and report.png of all episodes there are, and a film of each of some seeds."""
    cells: dict[tuple[Move, str], dict[int, bool]] = {}
    errors: list[float] = []
    for row in _rows(out / "episodes.jsonl"):
        cell = Move(float(row["shift_m"]), float(row["turn_deg"])), str(row["view"])
        cells.setdefault(cell, {})[int(row["seed"])] = bool(row["lifted"])
        errors += [float(row["depth_error"])] if "depth_error" in row else []
    moves = [move for move in _COLUMNS if any(cell[0] == move for cell in cells)]
    views = [view for view in VIEWS if any(cell[1] == view for cell in cells)]
    rows = [[view, *(_success(cells.get((move, view), {})) for move in moves)] for view in views]
    lines = markdown_rows(["success, % [95 %], of episodes", *(_COLUMNS[move] for move in moves)], rows)
    over = (f"{view} over homography, points" for view in ("learned", "exact"))
    header = ["recovered of what was lost, % [95 %]", "seeds", *views[1:], *over]
    lines += ["", *markdown_rows(header, _recoveries(cells, moves, views)), ""]
    if errors:
        low, middle, high = np.quantile(errors, [0.05, 0.5, 0.95])
        lines.append(
            f"Learned depth, median of a picture: off by {middle:.1%}; 90 % of episodes {low:.1%} to {high:.1%}."
        )
    (out / "report.md").write_text("\n".join(lines) + "\n")
    _draw(cells, moves, out / "report.png")
    for seed in films:
        _film(out, seed, highest_m)


def _success(lifted: dict[int, bool]) -> str:
    if not lifted:
        return "-"
    share, low, high = _interval(lifted)
    return f"{share:.0f} [{low:.0f}, {high:.0f}] of {len(lifted)}"


def _interval(lifted: dict[int, bool]) -> tuple[float, float, float]:
    """Share and its 95 % interval by Wilson, in %."""
    result = binomtest(sum(lifted.values()), len(lifted))
    bounds = result.proportion_ci(method="wilson")
    return 100 * result.statistic, 100 * bounds.low, 100 * bounds.high


def _recoveries(
    cells: dict[tuple[Move, str], dict[int, bool]], moves: Sequence[Move], views: Sequence[str]
) -> list[list[str]]:
    """Of each move: (view - none) / (trained - none) on the same seeds, which the bootstrap draws."""
    rows: list[list[str]] = []
    for move in moves[1:]:
        there = {view: cells[move, view] for view in views if (move, view) in cells}
        seeds = sorted(set(cells[TRAINED, "none"]).intersection(*there.values()))
        weights = np.concatenate([np.ones((1, len(seeds))), scene_weights(len(seeds))]) / len(seeds)
        share = {view: weights @ np.array([lifted[seed] for seed in seeds]) for view, lifted in there.items()}
        trained = weights @ np.array([cells[TRAINED, "none"][seed] for seed in seeds])
        lost = np.maximum(trained - share["none"], 1e-9)
        recovered = [_drawn((share[view] - share["none"]) / lost) if view in share else "-" for view in views[1:]]
        over = [_drawn(share[f"canonical-{depth}"] - share["homography"]) for depth in ("learned", "exact")]
        rows.append([_COLUMNS[move], str(len(seeds)), *recovered, *over])
    return rows


def _drawn(values: np.ndarray) -> str:
    """The first one and the interval of the others, in %."""
    low, high = 100 * np.quantile(values[1:], [0.025, 0.975])
    return f"{100 * values[0]:.0f} [{low:.0f}, {high:.0f}]"


def _draw(cells: dict[tuple[Move, str], dict[int, bool]], moves: Sequence[Move], path: Path) -> None:
    figure = new_figure(10, 4)
    axes = figure.add_subplot()
    for place, view in enumerate(VIEWS):
        shown = [(at, _interval(cells[move, view])) for at, move in enumerate(moves[1:]) if (move, view) in cells]
        if not shown:
            continue
        x, y = [at + 0.14 * (place - 2.5) for at, _ in shown], [each[0] for _, each in shown]
        errors = np.abs([[each[1] - each[0], each[2] - each[0]] for _, each in shown]).T
        axes.bar(x, y, 0.13, yerr=errors, label=view, capsize=2, color=f"C{place}")
    share, low, high = _interval(cells[TRAINED, "none"])
    axes.axhspan(low, high, color="0.9", zorder=0)
    axes.axhline(share, color="0.4", label="trained camera")
    axes.set_xticks(range(len(moves) - 1), [_COLUMNS[move] for move in moves[1:]])
    axes.set_ylabel("things lifted, %")
    axes.set_ylim(0, 100)
    axes.legend(loc="upper center", ncols=7, bbox_to_anchor=(0.5, 1.12), fontsize="small", frameon=False)
    save(figure, path)


def _film(out: Path, seed: int, highest_m: float) -> None:
    """film-SEED.mp4: what the policy sees in some cells, framed green once the thing is lifted and red if it is not."""
    policy, networks, renderer = *_loaded(out), Renderer(WIDTH, HEIGHT)
    strips: list[Strip] = []
    for name, (move, view) in _SHOWN.items():
        found, frames = episode(seed, move, view, highest_m, policy, networks, renderer)
        end = frames[-1].copy()
        cv2.rectangle(end, (0, 0), (WIDTH - 1, HEIGHT - 1), (0, 160, 60) if found["lifted"] else (200, 30, 30), 5)
        frames += [end] * (DECISIONS + _HOLD - len(frames))
        large = [cv2.resize(each, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC) for each in frames]
        strips.append(Strip(name=name, frames=dict(enumerate(large))))
    write_video(strips, _FPS, out / f"film-{seed}.mp4")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=["demonstrations", "train", "evaluate", "report"])
    parser.add_argument("--out", type=Path, required=True, help="folder of the whole study")
    parser.add_argument("--count", type=int, default=1500, help="demonstrations")
    parser.add_argument("--highest", type=float, default=0.0, help="metres: the things stand on a block up to so high")
    parser.add_argument("--episodes", type=int, default=100, help="of each cell")
    parser.add_argument("--moves", type=int, default=len(MOVES), help="so many of them; 1: only moved and turned")
    parser.add_argument("--film", type=int, nargs="*", default=[], help="seeds of which a report makes a film")
    parser.add_argument("--cpu-minutes", type=float, default=40.0, help="of training")
    options = parser.parse_args()
    one_thread_each()
    torch.set_num_threads(1)
    if options.command == "demonstrations":
        demonstrations(options.out, options.count, options.highest)
    elif options.command == "train":
        train(options.out, options.cpu_minutes)
    elif options.command == "evaluate":
        evaluate(options.out, options.episodes, options.moves, options.highest)
    else:
        report(options.out, options.film, options.highest)


if __name__ == "__main__":
    main()
