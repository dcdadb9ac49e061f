"""The same noise drawn in many ways, held against references and the truth."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest
import torch
from driving_plane import PlaneClips
from tiny_driving import smaller
from typer.testing import CliRunner

from gcd_model import RenderOptions, Sampler, load_synthesizer
from gcd_model.checkpoints import save_weights
from gcd_model.config import ModelConfig, SamplingConfig
from gcd_model.errors import OptionError
from gcd_model.networks import random_networks
from gcd_model.own_format import Card
from gcd_train.cli.main import app
from gcd_train.evaluation import PairedSet, SynthesizedViews
from gcd_train.sampler_bench import Grid, SamplerBench, bench_of, measure_ways, references_of, to_markdown, ways_of

FRAMES, HEIGHT, WIDTH = 4, 32, 48
GUIDED = SamplingConfig(steps=2, sigma_max=80.0, sigma_min=0.1, guidance=(1.0, 1.5), augmentation=0.0)


def tiny_config() -> ModelConfig:
    """A driving model that is guided."""
    return msgspec.structs.replace(smaller(FRAMES, HEIGHT, WIDTH), sampling=GUIDED)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Random; tests only read them."""
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    card = Card(name="tiny", config=tiny_config(), family="driving", move_time=FRAMES - 1)
    save_weights(random_networks(card.config, seed=0), path, card)
    return path


@pytest.fixture(scope="module")
def bench(weights: Path) -> SamplerBench:
    """Own way, both solvers in two steps and in one, guided and not; held against 3 steps and against 5."""
    clips = PairedSet(clips=PlaneClips.make(2), identity="plane")
    views = SynthesizedViews.of(load_synthesizer(weights, device="cpu"), clips, RenderOptions(seed=4))
    ways = ways_of(GUIDED, Grid(steps=(1, 2)))
    references = [Sampler(steps=steps, solver="euler", guidance=(1.0, 1.5)) for steps in (3, 5)]
    found = measure_ways(views, clips, ways, references)
    return bench_of(found, views, clips, data=["plane"], command="gcd-train bench sampler")


def test_the_grid_begins_with_the_checkpoints_own_way_and_repeats_none() -> None:
    ways = ways_of(GUIDED, Grid(steps=(1, 2), intervals=[(0.5, 5.0)]))
    assert ways[0] == Sampler(steps=2, solver="euler", guidance=(1.0, 1.5))
    assert len(set(ways)) == len(ways) == 9  # 1 step has no second order, no guidance no interval
    assert sum(way.guidance_interval is not None for way in ways) == 3
    assert all(way.solver == "euler" for way in ways if way.steps == 1)


def test_an_unguided_checkpoint_is_tried_without_guidance_alone() -> None:
    plain = msgspec.structs.replace(GUIDED, guidance=(1.0, 1.0))
    assert {way.guidance for way in ways_of(plain, Grid(steps=(1, 2)))} == {(1.0, 1.0)}


def test_references_have_the_checkpoints_own_guidance() -> None:
    euler, fine = references_of(GUIDED, 40)
    own = Sampler(steps=25, solver="euler", guidance=(1.0, 1.5))
    assert (euler, fine) == (own, replace(own, steps=40, solver="dpmpp_2m"))


def test_evaluations_count_both_branches(bench: SamplerBench) -> None:
    told = [(way.steps, way.solver, way.guidance[1], way.evaluations) for way in bench.ways]
    assert told == [
        (2, "euler", 1.5, 4),
        (1, "euler", 1.5, 2),
        (2, "dpmpp_2m", 1.5, 4),
        (1, "euler", 1.0, 1),
        (2, "euler", 1.0, 2),
        (2, "dpmpp_2m", 1.0, 2),
    ]


def test_its_own_way_is_level_with_itself(bench: SamplerBench) -> None:
    own, *others = bench.ways
    assert (own.ahead_db, own.ahead_error_db) == (0.0, 0.0)
    assert any(way.ahead_db != 0.0 for way in others)
    assert own.psnr_db is not None


def test_more_steps_come_nearer_to_both_references(bench: SamplerBench) -> None:
    by_steps = {way.steps: way.apart for way in bench.ways if way.solver == "euler" and way.guidance[1] == 1.5}
    for one, two in zip(by_steps[1], by_steps[2], strict=True):
        assert two.latents < one.latents
        assert two.psnr_db > one.psnr_db


def test_a_reference_is_not_apart_from_itself(weights: Path) -> None:
    clips = PairedSet(clips=PlaneClips.make(1), identity="plane")
    views = SynthesizedViews.of(load_synthesizer(weights, device="cpu"), clips)
    way = Sampler(steps=1, solver="euler", guidance=(1.0, 1.0))
    ((apart,),) = measure_ways(views, clips, [way], [way]).apart
    assert (apart.latents, apart.psnr_db) == (0.0, pytest.approx(100.0))


def test_a_report_survives_json_and_fills_a_table(bench: SamplerBench) -> None:
    assert msgspec.json.decode(msgspec.json.encode(bench), type=SamplerBench) == bench
    lines = to_markdown(bench).splitlines()
    assert len(lines) == 2 + len(bench.ways)
    assert {line.count("|") for line in lines} == {lines[0].count("|")}
    assert lines[2].startswith("| 2 | euler | 1 to 1.5 | 4 |")


@pytest.fixture
def run(weights: Path, tmp_path: Path) -> Callable[..., tuple[int, str]]:
    """`gcd-train bench sampler` on a clip: exit code and all it said."""
    folder = PlaneClips.make(1).write(tmp_path / "pairs")

    def called(*options: str) -> tuple[int, str]:
        line = ["bench", "sampler", "--weights", str(weights), "--data", str(folder), "--device", "cpu", *options]
        result = CliRunner().invoke(app, line, env={"COLUMNS": "200"})
        return result.exit_code, result.output

    return called


def test_the_command_writes_what_it_shows(
    run: Callable[..., tuple[int, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gcd_train.sampler_bench.measuring.PUBLISHED_STEPS", 3)
    json, markdown = tmp_path / "sampler.json", tmp_path / "sampler.md"
    few = ("--steps", "1", "--solver", "euler", "--guidance", "1:1", "--fine", "2")
    code, said = run(*few, "--json", str(json), "--markdown", str(markdown))
    assert code == 0, said
    bench = msgspec.json.decode(json.read_bytes(), type=SamplerBench)
    assert [(way.steps, way.guidance) for way in bench.ways] == [(2, (1.0, 1.5)), (1, (1.0, 1.0))]
    assert (bench.weights, bench.clips, bench.torch) == ("tiny", 1, str(torch.__version__))
    assert markdown.read_text() == to_markdown(bench)


def test_guidance_that_is_no_pair_is_refused(run: Callable[..., tuple[int, str]]) -> None:
    code, said = run("--guidance", "1.5")
    assert code != 0
    assert "--guidance is two numbers with a colon between, such as 1:1.5, got '1.5'" in " ".join(said.split())


def test_an_interval_that_is_none_is_refused_before_anything_is_drawn() -> None:
    with pytest.raises(OptionError, match=r"guidance_interval goes from .* up to another, got 5 to 0\.5"):
        ways_of(GUIDED, Grid(steps=(3,), intervals=[(5.0, 0.5)]))
