"""Does a frozen policy survive a moved camera, if its picture is turned back? Success of grasps in closed loop.

    python tools/policy_study.py demonstrations --out DIR --count 1500
    python tools/policy_study.py train --out DIR --cpu-minutes 40
    python tools/policy_study.py evaluate --out DIR
    python tools/policy_study.py report --out DIR

The policy learns by behaviour cloning with injected noise (Laskey et al. 2017, DART) from the tabletop world's own
controller, sees one camera's picture, its own tool and a colour, and says five times a second where the tool shall go.
Demonstrations and episodes that are there are kept, so each command goes on where it was stopped.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
import torch
from policy_views import VIEWS, Correction, to_network
from policy_world import COLOURS, DECISIONS, HEIGHT, WIDTH, Action, Bench, Move
from torch import Tensor, nn
from torch.nn import functional as F

from gcd_model.networks import LiveNetworks
from gcd_train.live.training import live_model
from gcd_train.parallel import one_thread_each
from gcd_train.scenes.renderer import Renderer

FIRST_EPISODE, EPISODES = 1_000_000, 100
_NOISE_M, _NOISY = 0.03, 0.5
_HELD_OUT, _BATCH, _RATE = 20, 64, 1e-3
_MIDDLE, _SPREAD = torch.tensor([0.03, 0.0, 0.12]), 0.1


# --- demonstrations --------------------------------------------------------------------------------------------------


def demonstrate(seed: int, renderer: Renderer, path: Path) -> bool:
    """One demonstration, written if it succeeds: T decisions, and what the controller would do for each of N things.

    pictures: uint8 [T, H, W, 3]. states: [T, 5]. actions: [T, N, 5], see `Action`; NaN for other things than the one in
    the hand. colours: [N].
    """
    bench, random = Bench(seed, renderer), np.random.default_rng([seed, 0xDA])
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
        np.savez(path, pictures=pictures, states=states, actions=actions, colours=bench.colours)
    return bench.done


def demonstrations(out: Path, count: int) -> None:
    """So many seeds' demonstrations; those that failed leave no file."""
    folder, renderer = out / "demonstrations", Renderer(WIDTH, HEIGHT)
    folder.mkdir(parents=True, exist_ok=True)
    start, kept = time.process_time(), 0
    for seed in range(count):
        path = folder / f"{seed:06d}.npz"
        kept += path.exists() or demonstrate(seed, renderer, path)
        if seed % 100 == 99:
            print(f"{kept} of {seed + 1} succeeded, {time.process_time() - start:.0f} CPU s", flush=True)


# --- the policy ------------------------------------------------------------------------------------------------------


class Policy(nn.Module):
    """Picture, own state and a colour in; where the tool shall go, how far to open, whether to grip out.

    Convolutions modulated by the colour, expected places of 32 keypoints (spatial softmax, Levine et al. 2016), three
    linear layers.
    """

    def __init__(self) -> None:
        super().__init__()
        self.name = nn.Embedding(len(COLOURS), 32)
        self.eye = nn.Sequential(
            *(nn.Conv2d(3, 16, 5, 2, 2), nn.ReLU()),
            *(nn.Conv2d(16, 32, 3, 2, 1), nn.GroupNorm(4, 32), nn.ReLU()),
            *(nn.Conv2d(32, 32, 3, 1, 1), nn.GroupNorm(4, 32)),
        )
        self.modulation = nn.Linear(32, 64)
        self.points = nn.Sequential(nn.ReLU(), nn.Conv2d(32, 32, 3, 1, 1), nn.ReLU(), nn.Conv2d(32, 32, 1))
        self.sharpness = nn.Parameter(torch.zeros(32, 1))
        self.hand = nn.Sequential(
            nn.Linear(64 + 5 + 32, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU(), nn.Linear(256, 5)
        )

    def forward(self, picture: Tensor, state: Tensor, colour: Tensor) -> Tensor:
        """picture: [B, 3, H, W] in [-1, 1]; state: [B, 5]; colour: int64 [B] → [B, 5]: place about the middle of the
        table in decimetres, opening in decimetres, logit of gripping."""
        name = self.name(colour)
        scale, shift = self.modulation(name)[..., None, None].chunk(2, dim=1)
        maps = self.points(self.eye(picture) * (1 + scale) + shift)  # [B, 32, H / 4, W / 4]
        share = (maps.flatten(2) * self.sharpness.exp()).softmax(-1)
        x, y = torch.linspace(-1, 1, maps.shape[3]), torch.linspace(-1, 1, maps.shape[2])
        grid = torch.stack(torch.meshgrid(x, y, indexing="xy")).flatten(1)  # [2, H / 4 * W / 4]
        places = (share @ grid.T).flatten(1)
        own = torch.cat([(state[:, :3] - _MIDDLE) / _SPREAD, state[:, 3:4] / _SPREAD, state[:, 4:]], dim=1)
        return self.hand(torch.cat([places, own, name], dim=1))

    @torch.inference_mode()
    def act(self, picture: Tensor, state: np.ndarray, colour: int) -> Action:
        """picture: [3, H, W] in [-1, 1]."""
        out = self(picture[None], torch.from_numpy(state).float()[None], torch.tensor([colour]))[0]
        return Action((out[:3] * _SPREAD + _MIDDLE).double().numpy(), float(out[3]) * _SPREAD, bool(out[4] > 0))


def losses(out: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean errors of place and, where nothing is gripped, of opening, decimetres; and of the grip, nats."""
    place = (out[:, :3] - (action[:, :3] - _MIDDLE) / _SPREAD).abs().mean()
    free = 1 - action[:, 4]
    opening = ((out[:, 3] - action[:, 3] / _SPREAD).abs() * free).sum() / free.sum().clamp(min=1)
    return place, opening, F.binary_cross_entropy_with_logits(out[:, 4], action[:, 4])


def jittered(pictures: Tensor) -> Tensor:
    """Other exposures, white balances and noise: what a robot's camera does by itself."""
    count = len(pictures)
    gain = 1 + 0.15 * torch.randn(count, 1, 1, 1) + 0.05 * torch.randn(count, 3, 1, 1)
    lift, noise = 0.1 * torch.randn(count, 1, 1, 1), 0.06 * torch.rand(count, 1, 1, 1)
    return torch.empty_like(pictures).uniform_(-1, 1).mul_(noise).add_(lift).addcmul_(pictures, gain)


class Decisions:
    """All that was demonstrated, in memory: every picture with each thing that could be taken, and its mirror image."""

    def __init__(self, paths: list[Path]) -> None:
        read = [np.load(path) for path in paths]
        lengths = torch.tensor([len(each["states"]) for each in read])
        self.pictures, self.states, self.actions = (
            torch.from_numpy(np.concatenate([each[name] for each in read]))
            for name in ("pictures", "states", "actions")
        )
        colours = torch.from_numpy(np.stack([each["colours"] for each in read])).repeat_interleave(lengths, 0)
        demonstration = torch.arange(len(read)).repeat_interleave(lengths)
        known = self.actions.isfinite().all(2)
        self.pairs = known.nonzero()  # decision and thing, [P, 2]
        self.colours = colours
        self.held_out = demonstration[self.pairs[:, 0]] % _HELD_OUT == 0

    def batch(self, pairs: Tensor, *, mirrored: bool = False) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Pictures, states, colours and actions. The camera looks along the table's x axis, so y mirrors."""
        row, thing = pairs.T
        pictures, states, actions = self.pictures[row], self.states[row].float(), self.actions[row, thing].float()
        if mirrored:
            pictures = pictures.flip(2)
            states[:, 1], actions[:, 1] = -states[:, 1], -actions[:, 1]
        return to_network(pictures), states, self.colours[row, thing], actions


def train(out: Path, cpu_minutes: float) -> None:
    """Behaviour cloning for so many CPU minutes; the learning rate falls to nothing over them."""
    torch.manual_seed(0)
    data = Decisions(sorted((out / "demonstrations").glob("*.npz")))
    learned, held_out = data.pairs[~data.held_out], data.pairs[data.held_out]
    policy = Policy().to(memory_format=torch.channels_last)
    weights = sum(each.numel() for each in policy.parameters())
    print(f"{len(data.pictures)} decisions, {len(data.pairs)} with things, {weights} weights", flush=True)
    optimiser = torch.optim.AdamW(policy.parameters(), lr=_RATE, weight_decay=1e-3)
    start, step, share = time.process_time(), 0, 0.0
    while share < 1:
        for pairs in learned[torch.randperm(len(learned))].split(_BATCH):
            share = (time.process_time() - start) / (60 * cpu_minutes)
            if share >= 1:
                break
            optimiser.param_groups[0]["lr"] = _RATE * min(1.0, (step + 1) / 100) * 0.5 * (1 + np.cos(np.pi * share))
            pictures, states, colours, actions = data.batch(pairs, mirrored=step % 2 > 0)
            seen = jittered(pictures).contiguous(memory_format=torch.channels_last)
            place, opening, grip = losses(policy(seen, states, colours), actions)
            optimiser.zero_grad()
            (place + opening + 0.2 * grip).backward()
            optimiser.step()
            step += 1
            if step % 200 == 0 or share >= 1:
                print(f"{share:.0%}, {step} updates: {place:.4f} {opening:.4f} {grip:.4f}", flush=True)
        with torch.no_grad():
            batches = [data.batch(pairs) for pairs in held_out.split(256)]
            told = [losses(policy(*batch[:3]), batch[3]) for batch in batches]
        place, opening, grip = (float(torch.stack(each).mean()) for each in zip(*told, strict=True))
        print(
            f"{share:.0%}, {step} updates: held-out error along an axis {100 * place:.1f} mm, of an opening "
            f"{100 * opening:.1f} mm, of the grip {grip:.3f} nats", flush=True
        )  # fmt: skip
        torch.save(policy.state_dict(), out / "policy.pt")


# --- episodes --------------------------------------------------------------------------------------------------------

TRAINED, TOGETHER = Move(0.0, 0.0), Move(0.05, 10.0)
SINGLE = (Move(0.03, 0), Move(0.05, 0), Move(0.1, 0), Move(0, 5.0), Move(0, 10.0), Move(0, 15.0))
CELLS = (
    [(TRAINED, "none"), *((TOGETHER, view) for view in VIEWS)],
    [(move, view) for move in SINGLE for view in VIEWS if view != "splat-exact"],
)
"""What is measured, first things first."""


@torch.inference_mode()
def episode(
    seed: int, move: Move, view: str, policy: Policy, networks: LiveNetworks, renderer: Renderer
) -> tuple[dict[str, float], list[np.ndarray]]:
    """One attempt: what became of it, and what the policy saw, uint8 [H, W, 3] each.

    It ends when the thing is lifted, when the fingers closed on nothing, or after DECISIONS.
    """
    camera = move.camera(seed)
    bench, correction = Bench(seed, renderer, camera), Correction(view, camera, networks)
    shown: list[np.ndarray] = []
    while len(shown) < DECISIONS and not bench.done and not bench.robot.empty_handed:
        seen = correction(*bench.look())
        shown.append(((seen + 1) * 127.5).round().byte().permute(1, 2, 0).numpy())
        bench.robot.act(policy.act(seen, bench.robot.state, bench.instruction))
    bench.close()
    found = {"lifted": bench.done, "decisions": len(shown)}
    if correction.depth_errors:
        found["depth_error"] = round(float(np.mean(correction.depth_errors)), 4)
    return found, shown


def evaluate(out: Path, episodes: int) -> None:
    """All cells on the same seeds, a line an episode; those that are there are kept."""
    path = out / "episodes.jsonl"
    done = {_key(row) for row in _rows(path)}
    policy, networks, renderer = *_loaded(out), Renderer(WIDTH, HEIGHT)
    for group in CELLS:
        for seed in range(FIRST_EPISODE, FIRST_EPISODE + episodes):
            for move, view in group:
                row: dict[str, float | str] = {"seed": seed, **move._asdict(), "view": view}
                if _key(row) in done:
                    continue
                row |= episode(seed, move, view, policy, networks, renderer)[0]
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=["demonstrations", "train", "evaluate", "report"])
    parser.add_argument("--out", type=Path, required=True, help="folder of the whole study")
    parser.add_argument("--count", type=int, default=1500, help="demonstrations")
    parser.add_argument("--episodes", type=int, default=100, help="of each cell")
    parser.add_argument("--cpu-minutes", type=float, default=40.0, help="of training")
    options = parser.parse_args()
    one_thread_each()
    torch.set_num_threads(1)
    if options.command == "demonstrations":
        demonstrations(options.out, options.count)
    elif options.command == "train":
        train(options.out, options.cpu_minutes)
    elif options.command == "evaluate":
        evaluate(options.out, options.episodes)


if __name__ == "__main__":
    main()
