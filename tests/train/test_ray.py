"""Items mapped on a Ray cluster: nothing is lost or done twice when a node dies."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from mapped_work import mark_and_square, square

from gcd_train import parallel
from gcd_train.errors import DataError, RunError
from gcd_train.parallel import map_items


class FakeRay:
    """As much of Ray as is used: tasks run when they are waited for; some are lost with their worker."""

    class exceptions:  # noqa: N801  Ray's own name
        class RayError(Exception):
            pass

    def __init__(self, lost: set[int]) -> None:
        self.lost, self.most_out, self.cancelled, self.stopped = lost, 0, 0, False
        self.resources = {"CPU": 2.0}
        self.out: list[tuple[Any, Any]] = []

    def is_initialized(self) -> bool:
        return False

    def init(self, **options: object) -> None:
        self.options = options

    def shutdown(self) -> None:
        self.stopped = True

    def cluster_resources(self) -> dict[str, float]:
        return self.resources

    def put(self, value: Any) -> Any:
        return value

    def remote(self, function: Any) -> Any:
        fake = self

        class Task:
            def options(self, **kept: object) -> "Task":
                fake.task_options = kept
                return self

            def remote(self, work: Any, item: Any) -> int:
                fake.out.append((function, (work, item)))
                fake.most_out = max(fake.most_out, len(fake.out))
                return len(fake.out) * 1000 + item

        return Task()

    def wait(self, references: list[int], num_returns: int, timeout: float) -> tuple[list[int], list[int]]:
        assert (num_returns, timeout > 0) == (1, True)
        return references[-1:], references[:-1]

    def get(self, reference: int) -> Any:
        function, arguments = self.out.pop()
        if arguments[1] in self.lost:
            raise self.exceptions.RayError("The node died.\nlong story")
        return function(*arguments)

    def cancel(self, reference: int) -> None:
        self.cancelled += 1


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakeRay:
    fake = FakeRay(lost={5})
    monkeypatch.setattr(parallel, "_import_ray", lambda: fake)
    return fake


class TestWithoutACluster:
    def test_each_item_has_one_outcome(self, fake: FakeRay) -> None:
        outcomes = {outcome.item: outcome for outcome in map_items(square, range(8), ray_address="auto", retries=3)}
        assert sorted(outcomes) == list(range(8))
        assert [outcomes[n].value for n in (0, 3, 6, 7)] == [0, 9, 36, 49]
        assert isinstance(outcomes[1].error, DataError)
        assert "lost again and again (The node died.)" in str(outcomes[5].error)
        assert (fake.most_out, fake.stopped) == (4, True)
        assert fake.task_options == {"num_cpus": 1, "num_gpus": 0.0, "max_retries": 3}

    @pytest.mark.parametrize(("there", "given", "out"), [(0.0, 0.0, 16), (1.0, 0.5, 4), (3.0, 0.5, 12)])
    def test_items_that_ask_for_gpus_are_given_them_where_there_are_any(
        self, fake: FakeRay, there: float, given: float, out: int
    ) -> None:
        fake.resources = {"CPU": 8.0} | ({"GPU": there} if there else {})
        assert len(list(map_items(square, range(40), ray_address="auto", gpus=0.5))) == 40
        assert fake.task_options == {"num_cpus": 1, "num_gpus": given, "max_retries": 2}
        assert fake.most_out == out

    def test_leaving_early_cancels_what_is_out(self, fake: FakeRay) -> None:
        outcomes: Any = map_items(square, range(100), ray_address="auto")
        next(outcomes)
        outcomes.close()
        assert (fake.cancelled, fake.stopped) == (3, True)

    def test_a_missing_extra_is_named(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "ray", None)
        with pytest.raises(RunError, match=r"gcd-node\[cluster\]"):
            next(map_items(square, range(2), ray_address="auto"))

    @pytest.mark.parametrize("port", [True, False])
    def test_a_cluster_that_does_not_answer_is_named(
        self, fake: FakeRay, monkeypatch: pytest.MonkeyPatch, port: bool
    ) -> None:
        def broken(**options: object) -> None:
            raise FakeRay.exceptions.RayError("timed out")

        monkeypatch.setattr(fake, "init", broken)
        with socket.socket() as nobody:
            nobody.bind(("127.0.0.1", 0))  # and does not listen
            address = f"127.0.0.1:{nobody.getsockname()[1]}" if port else "auto"
            with pytest.raises(RunError, match=rf"no Ray cluster answers at {address}"):
                next(map_items(square, range(2), ray_address=address))
        assert not fake.stopped


@pytest.mark.slow
@pytest.mark.timeout(400)  # Ray notices a lost node after its own patience; workers import everything anew
class TestTwoNodes:
    @pytest.fixture
    def cluster(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
        pytest.importorskip("ray", reason="needs the extra `cluster`")
        monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))  # of the workers, for the functions of the tests
        monkeypatch.chdir(tmp_path)
        from ray.cluster_utils import Cluster

        head = {"num_cpus": 1, "include_dashboard": False, "object_store_memory": 80 * 2**20}
        cluster = Cluster(initialize_head=True, head_node_args=head)
        try:
            yield cluster
        finally:
            cluster.shutdown()

    def test_killing_one_of_two_nodes_loses_and_doubles_nothing(self, cluster: Any, tmp_path: Path) -> None:
        marks = tmp_path / "marks"
        marks.mkdir()
        second = cluster.add_node(num_cpus=2, object_store_memory=80 * 2**20)
        cluster.wait_for_nodes()
        items = [(str(marks), number) for number in range(12)]
        seen, killed = [], False
        for outcome in map_items(mark_and_square, items, ray_address=cluster.address, retries=3):
            seen.append((outcome.item[1], outcome.value, outcome.error))
            if not killed and len(seen) == 3:
                killed = True
                _kill(second)
        assert sorted(seen) == [(n, n * n, None) for n in range(12)]
        done = Counter(path.name.split("-")[0] for path in marks.iterdir())
        assert set(done) == {str(number) for number in range(12)}
        assert done.total() <= 12 + 2, "only what the lost node was doing may have been done again"


def _kill(node: Any) -> None:
    """The raylet and its workers, as when a machine loses power."""
    (raylet,) = node.all_processes["raylet"]
    pid = raylet.process.pid
    children = subprocess.run(["ps", "-o", "pid=", "--ppid", str(pid)], capture_output=True, text=True, check=False)
    for victim in (pid, *map(int, children.stdout.split())):
        try:
            os.kill(victim, signal.SIGKILL)
        except ProcessLookupError:
            time.sleep(0)
