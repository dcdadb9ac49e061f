"""Runs that are kept: records, resuming, failures, processes, frames that are read back."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import msgspec
import pytest
from driving_plane import PlaneClips
from made_records import note, record
from typer.testing import CliRunner

from gcd_model.errors import ViewRangeError
from gcd_train.cli.main import app
from gcd_train.data.pairs import PairedClips
from gcd_train.errors import DataError, RunError
from gcd_train.evaluation.baselines import CopySource
from gcd_train.evaluation.clips import HeldOutClip, PairedSet, chosen, identity_of
from gcd_train.evaluation.galleries import KeptViews, has_views, write_views
from gcd_train.evaluation.measure import GIVE_UP_AFTER, Account, ClipWork, assign_gpus, measure_all
from gcd_train.evaluation.predictors import Prediction, Predictor, SourceClip, to_pictures
from gcd_train.evaluation.store import Run, RunKeeper, folder_name
from gcd_train.pictures import png


@dataclass
class Counting:
    """Copies, counts how often, and refuses some clips."""

    name: str = "counting"
    refused: Sequence[str] = ()
    error: Callable[[str], Exception] = DataError
    privileged: bool = False
    met: list[str] = field(default_factory=list)

    def predict(self, clip: SourceClip) -> Prediction:
        self.met.append(clip.key)
        if clip.key in self.refused:
            raise self.error("no frames here")
        return Prediction(video=to_pictures(clip.source))


@dataclass(frozen=True, kw_only=True)
class Damaged(PairedSet):
    """Pairs of which those of these numbers cannot be read."""

    numbers_damaged: Sequence[int]

    def clip(self, key: str, /) -> HeldOutClip:
        if self.numbers[key] in self.numbers_damaged:
            raise DataError(f"shard of {key} is damaged")
        return super().clip(key)


def pairs(count: int = 3, *, damaged: Sequence[int] = ()) -> PairedSet:
    whole = PairedSet.of(PlaneClips.make(count), "plane")
    return Damaged(**{each.name: getattr(whole, each.name) for each in fields(whole)}, numbers_damaged=damaged)


def finished(folder: Path, clips: PairedSet, *methods: Predictor, views: KeptViews = "none") -> Account:
    """The account at the end of a run."""
    work = ClipWork(folder=folder, clips=clips, methods={each.name: each for each in methods}, views=views)
    *_, last = measure_all(work)
    return last


def records_in(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder / "records")) for path in folder.glob("records/*/*.json"))


# --- keeping -------------------------------------------------------------------------------------------------------


def test_a_run_is_read_back_as_it_was_kept(tmp_path: Path) -> None:
    keeper = RunKeeper(tmp_path)
    told = note(methods={"b (2 steps)": {"weights": "12"}, "a": {"baseline": "a"}})
    kept = [record("b (2 steps)", "k.1"), record("b (2 steps)", "k.0"), record("a", "k.0")]
    keeper.begin(told)
    for each in kept:
        keeper.keep(each)
    assert Run.read(tmp_path) == Run(folder=tmp_path, note=told, records=(kept[1], kept[0], kept[2]))


def test_names_become_file_names_and_two_methods_never_share_a_folder(tmp_path: Path) -> None:
    assert folder_name("scn02900.sample_00") == "scn02900.sample_00"
    assert folder_name("plain-small (4 steps)") == "plain-small_4_steps"
    assert folder_name("../..") not in ("..", ".", "")
    with pytest.raises(RunError, match="would share the folder"):
        RunKeeper(tmp_path).begin(note(methods={"a b": {}, "a/b": {}}))


def test_what_never_measured_anything_binds_nobody(tmp_path: Path) -> None:
    keeper = RunKeeper(tmp_path)
    keeper.begin(note(methods={"a": {}}, data_identity="a mistake", command="first"))
    begun = keeper.begin(note(methods={"b": {"digest": "1"}}, command="second"))
    assert (begun.command, list(begun.methods)) == ("second", ["b"])
    keeper.keep(record("b", "k"))
    keeper.begin(note(methods={"none": {"digest": "of nothing"}, "typo": {}}))
    joined = keeper.begin(note(methods={"none": {"digest": "2"}}, command="third"))
    assert (joined.command, joined.methods) == ("second", {"b": {"digest": "1"}, "none": {"digest": "2"}})
    with pytest.raises(RunError, match="digest of b was 1, is 3"):
        keeper.begin(note(methods={"b": {"digest": "3"}}))


def test_of_two_lines_the_second_is_refused_while_the_first_measures(tmp_path: Path) -> None:
    first, second = RunKeeper(tmp_path), RunKeeper(tmp_path)
    with first.in_use(note(methods={"a": {}})):
        with pytest.raises(RunError, match="another run is at work in"):
            second.in_use(note(methods={"b": {}})).__enter__()
        first.keep(record("a", "k"))
    with second.in_use(note(methods={"b": {}})):
        assert list(Run.read(tmp_path).note.methods) == ["a", "b"]


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ({"data_identity": "another"}, "data_identity was 0123456789ab, is another"),
        ({"classes": ("road", "car")}, "classes was , is road, car"),
        ({"methods": {"a": {"steps": "4"}}}, "steps of a was 1, is 4"),
        ({"methods": {"a": {"steps": "1", "lpips": "vgg"}}}, "lpips of a was not told, is vgg"),
    ],
)
def test_another_evaluation_is_refused_with_what_differs(tmp_path: Path, other: dict[str, object], said: str) -> None:
    first = note(methods={"a": {"steps": "1"}})
    RunKeeper(tmp_path).begin(first)
    RunKeeper(tmp_path).keep(record("a", "k"))
    with pytest.raises(RunError, match=said):
        RunKeeper(tmp_path).begin(msgspec.structs.replace(first, **other))
    assert Run.read(tmp_path).note == first


def test_a_damaged_record_is_named_and_no_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"holds no run\.json"):
        Run.read(tmp_path)
    keeper = RunKeeper(tmp_path)
    keeper.begin(note(methods={"a": {}}))
    keeper.keep(record("a", "k"))
    (tmp_path / "records" / "a" / "k.json").write_bytes(b'{"method": "a"')
    with pytest.raises(RunError, match=r"k\.json cannot be used"):
        Run.read(tmp_path)


# --- measuring -----------------------------------------------------------------------------------------------------


def test_what_has_a_record_is_not_done_again(tmp_path: Path) -> None:
    method, other = Counting(), Counting("other")
    assert finished(tmp_path, pairs(2), method).lines()[0] == "clips: 2 measured, 0 there already; 0 failures"
    (tmp_path / "records" / "counting" / "plane-00000000.json").unlink()
    account = finished(tmp_path, pairs(3), method)
    assert (account.there, account.measured, account.done) == (1, 2, 3)
    assert method.met == ["plane-00000000", "plane-00000001", "plane-00000000", "plane-00000002"]
    finished(tmp_path, pairs(3), method, other)
    assert (len(method.met), other.met) == (4, [f"plane-0000000{n}" for n in range(3)])


def test_a_clip_that_cannot_be_read_is_named_and_the_others_are_measured(tmp_path: Path) -> None:
    account = finished(tmp_path, pairs(3, damaged=[1]), Counting())
    assert account.failures == {"plane-00000001": "shard of plane-00000001 is damaged"}
    assert records_in(tmp_path) == ["counting/plane-00000000.json", "counting/plane-00000002.json"]
    assert account.lines()[1] == "  plane-00000001: shard of plane-00000001 is damaged"


def test_a_method_that_fails_takes_nothing_from_the_others(tmp_path: Path) -> None:
    account = finished(tmp_path, pairs(2), Counting(refused=["plane-00000000"]), CopySource())
    assert account.failures == {"plane-00000000, counting": "no frames here"}
    others = ["copy_source/plane-00000000.json", "copy_source/plane-00000001.json", "counting/plane-00000001.json"]
    assert records_in(tmp_path) == others


def test_a_run_in_which_nothing_goes_right_gives_up(tmp_path: Path) -> None:
    account = finished(tmp_path, pairs(7, damaged=range(7)), Counting())
    assert (account.measured, account.done, account.gave_up) == (0, GIVE_UP_AFTER, True)
    assert account.lines()[0] == f"clips: 0 measured, 0 there already; {GIVE_UP_AFTER} failures"
    assert "gave up" in account.lines()[-1]


def test_views_that_a_model_does_not_take_end_no_run(tmp_path: Path) -> None:
    clips = pairs(GIVE_UP_AFTER + 2)
    refused = Counting(refused=clips.keys[:-1], error=lambda why: ViewRangeError(why, {}))
    account = finished(tmp_path, clips, refused)
    assert (account.measured, len(account.failures), account.gave_up) == (1, GIVE_UP_AFTER + 1, False)


def test_a_folder_that_cannot_be_written_ends_the_run(tmp_path: Path) -> None:
    (tmp_path / "records").write_text("a file where a folder should be")
    with pytest.raises(RunError, match="cannot write"):
        finished(tmp_path, pairs(2), Counting())


def written(folder: Path, count: int, first_seed: int = 0) -> PairedClips:
    return PairedClips.open(PlaneClips.make(count).write(folder, first_seed))


def test_workers_take_gpus_in_turn_unless_one_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    each = [{"CUDA_VISIBLE_DEVICES": "0"}, {"CUDA_VISIBLE_DEVICES": "1"}, {"CUDA_VISIBLE_DEVICES": "2"}]
    assert list(assign_gpus("auto", 3)) == list(assign_gpus("cuda", 3)) == each
    assert assign_gpus("cpu", 3) == assign_gpus("cuda:1", 3) == assign_gpus("auto", 1) == assign_gpus("auto", 0) == ()
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "5, GPU-3a")
    assert [seat["CUDA_VISIBLE_DEVICES"] for seat in assign_gpus("auto", 2)] == ["5", "GPU-3a"]


@pytest.mark.slow
@pytest.mark.timeout(300)  # each process imports torch
def test_processes_find_what_one_finds(tmp_path: Path) -> None:
    clips = PairedSet.of(written(tmp_path / "data", 4))
    for workers in (1, 2):
        work = ClipWork(folder=tmp_path / str(workers), clips=clips, methods={"copy_source": CopySource()})
        *_, account = measure_all(work, workers=workers)
        assert (account.measured, account.failures) == (4, {})
    for path in records_in(tmp_path / "1"):
        one, two = (
            msgspec.json.decode((tmp_path / each / "records" / path).read_bytes()) | {"seconds": 0} for each in "12"
        )
        assert one == two


# --- frames --------------------------------------------------------------------------------------------------------


def pictures_in(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted((folder / "views").rglob("*.png"))}


def test_a_clip_without_the_frames_that_are_to_be_kept_is_measured_again(tmp_path: Path) -> None:
    finished(tmp_path / "whole", pairs(2), CopySource(), views="all")
    wanted: tuple[tuple[KeptViews, int], ...] = (("none", 2), ("last", 2), ("few", 2), ("all", 0), ("last", 0))
    for views, count in wanted:
        account = finished(tmp_path / "run", pairs(2), CopySource(), views=views)
        assert (account.measured, account.there) == (count, 2 - count)
    assert pictures_in(tmp_path / "run") == pictures_in(tmp_path / "whole")
    next((tmp_path / "run" / "views").rglob("sample_0/0001.png")).unlink()
    account = finished(tmp_path / "run", pairs(2), CopySource(), views="all")
    assert (account.measured, pictures_in(tmp_path / "run")) == (1, pictures_in(tmp_path / "whole"))


def test_kept_views_are_those_of_the_last_prediction_alone(tmp_path: Path) -> None:
    clip = pairs(1).clip("plane-00000000")
    (draw,) = CopySource().predict(clip.seen).draws
    for draws in ((draw, draw), (draw,)):
        write_views(tmp_path, clip, replace(draws[0], more=draws[1:]), "last", ())
        assert has_views(tmp_path, "last", len(clip.target))
        assert len(list(tmp_path.glob("sample_*"))) == len(draws)


# --- the command ---------------------------------------------------------------------------------------------------


def test_the_identity_follows_the_pictures_and_not_the_place(tmp_path: Path) -> None:
    clips = written(tmp_path / "a", 2)
    assert identity_of(clips) == identity_of(written(tmp_path / "b", 2))
    assert identity_of(clips) != identity_of(chosen(clips, limit=1))
    assert identity_of(clips) != identity_of(written(tmp_path / "c", 2, first_seed=1))


def evaluated(folder: Path, *options: str) -> tuple[int, str]:
    every = ["evaluate", "--data", str(folder / "data"), "--out", str(folder / "run"), *options]
    result = CliRunner().invoke(app, every, env={"COLUMNS": "200"})
    return result.exit_code, result.output


def test_the_command_measures_and_goes_on(tmp_path: Path) -> None:
    PlaneClips.make(2).write(tmp_path / "data", first_seed=1_000_000)
    code, said = evaluated(tmp_path, "--methods", "copy_source", "--split", "driving-test", "--views", "all")
    assert code == 0, said
    assert "IoU of each class" in said
    assert "has 2 of its 40 scenes" in said
    for file in ("run.json", "report.md", "tables/figures.csv", "gallery/sheet.png"):
        assert (tmp_path / "run" / file).is_file()
    run = Run.read(tmp_path / "run")
    told, records = run.note, run.records
    assert (told.protocol, told.kind, told.frames) == ("pairs", "driving", 4)
    assert [each.key for each in records] == ["driving-01000000", "driving-01000001"]
    frames = tmp_path / "run" / "views" / "copy_source"
    code, said = evaluated(tmp_path, "--no-baselines", "--predictions", f"saved={frames}", "--split", "driving-test")
    assert code == 0, said
    run = Run.read(tmp_path / "run")
    told, records = run.note, run.records
    assert list(told.methods) == ["copy_source", "saved"]
    scores = {each.method: each.regions["all"].psnr_db for each in records if each.key == "driving-01000001"}
    assert scores["saved"] == scores["copy_source"]


def test_a_line_that_measured_nothing_is_told_and_can_be_corrected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    PlaneClips.make(1).write(tmp_path / "data")
    code, said = evaluated(tmp_path, "--methods", "copy_source", "--views", "all")
    assert code == 0, said
    (tmp_path / "logs").mkdir()
    frames = tmp_path / "run" / "views" / "copy_source"
    wrong = ("--predictions", f"none={tmp_path / 'logs'}", "--predictions", f"saved={frames}")
    assert evaluated(tmp_path, "--no-baselines", *wrong)[0] != 0
    assert "Failed: none." in (tmp_path / "run" / "report.md").read_text()
    monkeypatch.chdir(frames.parent)
    for folder in (str(frames), "./copy_source"):
        code, said = evaluated(tmp_path, "--no-baselines", "--predictions", f"none={folder}")
        assert code == 0, said
    assert list(Run.read(tmp_path / "run").note.methods) == ["copy_source", "saved", "none"]


def test_frames_of_a_method_that_was_given_more_are_starred(tmp_path: Path) -> None:
    PlaneClips.make(1).write(tmp_path / "data")
    clip = PairedSet.of(PairedClips.open([tmp_path / "data"]))
    (key,) = clip.keys
    for name in ("a", "b"):
        RunKeeper(tmp_path).views(name, key).mkdir(parents=True)
        for number, frame in enumerate(clip.clip(key).target):
            (RunKeeper(tmp_path).views(name, key) / f"{number:04d}.png").write_bytes(png(frame))
    frames = [word for name in "ab" for word in ("--predictions", f"{name}={tmp_path / 'views' / name}")]
    code, said = evaluated(tmp_path, "--no-baselines", *frames, "--privileged", "b")
    assert code == 0, said
    assert ("| a |" in said, "| b * |" in said) == (True, True), said
    assert {each.method: each.privileged for each in Run.read(tmp_path / "run").records} == {"a": False, "b": True}
    code, said = evaluated(tmp_path, "--no-baselines", *frames)
    assert (code != 0, "privileged of b was yes, is not told" in said) == (True, True), said


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        (["--methods", "copy_sauce"], 78, "did you mean copy_source"),
        (["--methods", "copy_source", "--controls", "list.json"], 78, "these are pairs"),
        (["--methods", "copy_source", "--split", "driving-tset"], 78, "did you mean driving-test"),
        (["--methods", "copy_source", "--split", "drop-test"], 66, "the world drop, but these pairs are of driving"),
        (["--methods", "copy_source", "--split", "driving-test"], 66, "is of the split"),
        (["--no-baselines"], 78, "there is nothing to measure"),
        (["--no-baselines", "--methods", "copy_source"], 78, "leave one of the two out"),
        (["--methods", "copy_source", "--svd", "random:svd"], 78, "--svd is for vanilla_svd"),
        (["--methods", "copy_source", "--zeronvs-scale", "5"], 78, "--zeronvs-scale is for zeronvs"),
        (["--methods", "zeronvs", "--zeronvs", "zeronvs.ckpt"], 78, "zeronvs wants its weights"),
        (["--methods", "zeronvs", "--zeronvs", "no.ckpt", "--zeronvs-scale", "5"], 78, "no.ckpt"),
        (["--methods", "vanilla_svd", "--svd", "random:driving"], 78, "random:driving is of the family driving"),
        (["--methods", "copy_source", "--weights", "random:driving", "--weights", "b"], 78, "got random:driving and b"),
        (["--methods", "copy_source,hexplane_2"], 78, "hexplane_2 wants 2 cameras, and these clips have the source"),
        (["--no-baselines", "--predictions", "frames"], 78, "NAME=FOLDER"),
        (["--methods", "copy_source", "--privileged", "mine"], 78, "got 'mine'; there are none"),
    ],
)
def test_the_command_says_what_is_wrong(tmp_path: Path, options: list[str], code: int, words: str) -> None:
    PlaneClips.make(1).write(tmp_path / "data")
    found, said = evaluated(tmp_path, *options)
    assert (found, words in said) == (code, True), said
    assert "Traceback" not in said
    assert not (tmp_path / "run" / "run.json").exists()
