"""Two runs compared: what counts as the same, how far apart they are, and what is said and shown of it."""

import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from fakes import FakeSource, painting_traits
from runs import FRAMES, LevelModel, copied, made_run, nan_model

from gcd_model import View
from gcd_node.cli.main import run_app
from gcd_node.errors import UsageError
from gcd_node.frame import Frame
from gcd_node.replay.compare import Tolerance, compare, report_text
from gcd_node.replay.run import MANIFEST, RunFolder, encode_manifest, keep_pixels, open_run, pixel_digest

pytestmark = pytest.mark.timeout(60)
EXACT, LOOSE = Tolerance(), Tolerance(min_psnr_db=1.0)


@pytest.fixture(scope="module")
def golden(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return made_run(tmp_path_factory.mktemp("golden") / "run")


def lowered(folder: Path, lower: Mapping[tuple[int, int], int]) -> RunFolder:
    return made_run(folder, LevelModel(lower=lower))


def classed(folder: Path, columns: Mapping[int, int]) -> RunFolder:
    return made_run(folder, LevelModel(painting_traits(), classes=columns), FakeSource(42, fps=10.0))


def restated(run: RunFolder, folder: Path, **changes: object) -> RunFolder:
    """A copy of a run whose manifest says something else."""
    copied(run, folder)
    (folder / MANIFEST).write_bytes(encode_manifest(msgspec.structs.replace(run.manifest, **changes)))
    return open_run(folder)


# How far apart.


def test_a_run_is_identical_to_its_repetition(golden: RunFolder, tmp_path: Path) -> None:
    comparison = compare(golden, made_run(tmp_path / "run"))
    assert (comparison.facts, comparison.differences) == ({}, ())
    assert report_text(comparison, EXACT) == "identical: all 3 views"


def test_one_bad_frame_is_not_hidden_by_thirteen_good_ones(golden: RunFolder, tmp_path: Path) -> None:
    other = lowered(tmp_path / "run", {(1, 4): 5, (1, 9): 10})
    (view,) = compare(golden, other).differences
    assert (view.window_id, view.worst_frame, view.facts) == (1, 9, ())
    frame_db = 20 * math.log10(255 / 10)
    assert view.worst_psnr_db == pytest.approx(frame_db)
    assert view.within(Tolerance(min_psnr_db=frame_db - 0.01))
    assert not view.within(Tolerance(min_psnr_db=frame_db + 0.01))
    assert compare(other, golden).differences == (view,)


def test_class_pixels_have_a_bound_of_their_own(tmp_path: Path) -> None:
    for bounds in ({"min_psnr_db": 0.0}, {"min_psnr_db": math.nan}, {"max_class_share": 1.5}):
        with pytest.raises(UsageError):
            Tolerance(**bounds)
    (view,) = compare(classed(tmp_path / "a", {}), classed(tmp_path / "b", {1: 48})).differences
    share = 48 / 96 / FRAMES  # half of the columns, in one frame
    assert view.shares == {"class map": pytest.approx(share)}
    assert view.worst_psnr_db == math.inf
    assert not view.within(LOOSE)
    assert not view.within(Tolerance(max_class_share=0.9 * share))
    assert view.within(Tolerance(max_class_share=1.1 * share))


class MovedMaps(LevelModel):
    """Its inverse depth is so many times the usual one, and `columns` of its visibility are painted instead."""

    def __init__(self, factor: float, columns: int) -> None:
        super().__init__(holds=("visibility", "inverse_depth"))
        self._factor, self._columns = factor, columns

    def render(self, *asked: Any) -> list[View]:
        views = super().render(*asked)
        for view in views:
            assert view.visibility is not None
            assert view.inverse_depth is not None
            view.inverse_depth.mul_(self._factor)
            view.visibility[..., : self._columns] = 0
        return views


def test_depth_and_visibility_count_like_class_pixels(tmp_path: Path) -> None:
    usual = made_run(tmp_path / "usual", MovedMaps(1.0, 0))
    near = compare(usual, made_run(tmp_path / "near", MovedMaps(1.005, 0))).differences[0]
    assert near.within(Tolerance(max_class_share=0.001))
    far = compare(usual, made_run(tmp_path / "far", MovedMaps(1.05, 24))).differences[0]
    assert far.shares["depth"] == pytest.approx(6 / 7, abs=0.01)  # the others have none
    assert far.shares["visibility"] == pytest.approx(24 / 96 * 2 / 3, abs=0.01)
    assert not far.within(Tolerance(max_class_share=0.8))
    assert "of the depth" in str(far)
    assert compare(usual, made_run(tmp_path / "plain")).differences[0].facts == ("visibility", "depth")


# What always fails.


def test_a_window_that_only_one_run_has_fails_and_shifts_none_of_the_others(golden: RunFolder, tmp_path: Path) -> None:
    longer = made_run(tmp_path / "longer", source=FakeSource(4 * FRAMES))
    for a, b, only in ((golden, longer, "only in B"), (longer, golden, "only in A")):
        (missing,) = compare(a, b).failures(LOOSE)
        assert (missing.window_id, missing.view_id, missing.facts) == (3, "main", (only,))
    holed = compare(golden, made_run(tmp_path / "holed", nan_model({1})))
    assert [(view.window_id, view.facts) for view in holed.differences] == [(1, ("only in A",))]
    assert set(holed.facts) == {"total windows", "total nan_windows", "trouble MODEL_NAN in window 1"}


def test_other_moments_flags_and_sizes_fail_even_if_the_pixels_agree(golden: RunFolder, tmp_path: Path) -> None:
    first, *others = golden.manifest.windows
    black = np.zeros((FRAMES, 16, 24, 3), np.uint8)
    changes = {"stamps_ns": tuple(range(9, FRAMES + 9)), "seqs": tuple(range(1, FRAMES + 1)), "epoch": 4}
    for field, value in (changes | {"ood": ("fps",), "views": {"main": {"win": pixel_digest(black)}}}).items():
        changed = msgspec.structs.replace(first, **{field: value})
        other = restated(golden, tmp_path / field, windows=(changed, *others))
        if field == "views":
            keep_pixels(other.path, "main", 0, "win", black)
        (view,) = compare(golden, other).failures(LOOSE)
        assert view.facts == ("size" if field == "views" else field,)


# What is said.


def test_what_the_runs_were_made_from_is_named_first(golden: RunFolder, tmp_path: Path) -> None:
    other = made_run(tmp_path / "run", changes=["model.steps=3", "source.resize=area", "life.nice=3"])
    made_from = other.manifest.made_from | {"weights sha256_12": "f" * 12, "version torch": "\x1b]0;mine\x07"}
    comparison = compare(golden, restated(other, tmp_path / "restated", made_from=made_from))
    assert [(name, *values) for name, values in comparison.facts.items()] == [
        ("config source.resize", "released", "area"),
        ("config model.steps", "1", "3"),
        ("weights sha256_12", "0" * 12, "f" * 12),
        ("version torch", golden.manifest.made_from["version torch"], "\\x1b]0;mine\\x07"),  # commands no terminal
    ]
    text = report_text(comparison, EXACT)
    assert text.index("model.steps: 1, 3") < text.index("first divergence: window 0, view main")


class Brighter(FakeSource):
    def frames(self) -> Iterator[Frame]:
        for frame in super().frames():
            yield Frame(image=frame.image + 1, stamp_ns=frame.stamp_ns, seq=frame.seq)


def test_the_first_divergence_says_whether_input_and_seed_were_the_same(golden: RunFolder, tmp_path: Path) -> None:
    def told(run: RunFolder) -> str:
        return report_text(compare(golden, run), LOOSE).splitlines()[-1]

    same = told(lowered(tmp_path / "same", {(2, 0): 1}))
    assert same.startswith("first divergence: window 2, view main: ")
    assert same.endswith("the model was given the same pictures")
    assert "other pictures already" in told(made_run(tmp_path / "input", source=Brighter(42)))
    seed = made_run(tmp_path / "seed", LevelModel(lower={(0, 0): 1}), changes=["model.cond_aug=0.01"])
    assert "same pictures and another seed" in told(seed)


def test_exit_codes_verdict_and_json_tell_same_near_different_damaged_and_missing(
    golden: RunFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = lowered(tmp_path / "run", {(1, 4): 5})
    damaged = copied(golden, tmp_path / "damaged")
    (damaged / MANIFEST).write_text("{")
    a, b = str(golden.path), str(other.path)
    assert run_app(["diff", a, a]) == 0
    assert run_app(["diff", a, str(damaged)]) == 65
    assert run_app(["diff", str(tmp_path / "nowhere"), b]) == 66
    capsys.readouterr()
    assert run_app(["diff", a, b]) == 1
    assert capsys.readouterr().out.startswith("DIFFERENT: 1 of 3")
    assert run_app(["diff", a, b, "--min-psnr", "30"]) == 0
    assert capsys.readouterr().out.startswith("near enough: 2 of 3")
    assert run_app(["diff", a, b, "--json"]) == 1
    plain = json.loads(capsys.readouterr().out)
    assert (plain["a"], plain["b"], plain["views"]) == (a, b, 3)
    (view,) = plain["differences"]
    assert (view["window_id"], view["view_id"], view["worst_frame"]) == (1, "main", 4)
