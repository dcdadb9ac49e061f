"""The page in a real browser: a headless Chromium, one for the whole module, beside nodes over real sockets."""

import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from cameras import Bench, Camera, until
from fakes import FakeSynthesizer, painting_traits
from rig import Rig
from viewer_clients import viewer_of
from wire_messages import origin

from gcd_node.config import PublishConfig
from gcd_node.publisher import Publisher

CHROMIUM, DRIVER = Path("/usr/bin/chromium"), Path("/usr/bin/chromedriver")
webdriver = pytest.importorskip("selenium.webdriver", reason="needs the Python package selenium, of the extra `dev`")
pytestmark = [
    pytest.mark.timeout(120),
    pytest.mark.skipif(not CHROMIUM.exists(), reason="needs the Debian package chromium"),
    pytest.mark.skipif(not DRIVER.exists(), reason="needs the Debian package chromium-driver"),
]
PROCESS = Path(__file__).with_name("viewer_process.py")
LOOK_MS = 100  # of the page: TICK_MS in main.js
DESKTOP, PHONE = (1280, 900), (360, 740)


class Page:
    """What a test does with a page, and what it reads off it."""

    def __init__(self, driver: Any) -> None:
        self._driver = driver

    def open(self, url: str) -> None:
        self._driver.get("about:blank")  # another fragment alone would not load the page anew
        self._driver.get(url)

    def forget(self, url: str) -> None:
        """What this address has left in the browser, the token first of all."""
        self._driver.get(url)
        self.run("sessionStorage.clear(); localStorage.clear()")

    def run(self, script: str, *arguments: object) -> Any:
        return self._driver.execute_script(script, *arguments)

    def size(self, size: tuple[int, int]) -> None:
        metrics = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": size[0] < 600}
        self._driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)

    def text(self, name: str) -> str:
        return str(self.run("return document.getElementById(arguments[0]).textContent", name))

    @property
    def state(self) -> str:
        return str(self.run("return document.body.dataset.state"))

    def looks(self) -> list[object]:
        """Whether by its rule the node was dead when the page looked before it turned to its state, and when it did,
        by its own clock; and the longest silence that is not death, ms."""
        script = """
            const done = arguments[0];
            import("/link.js").then(({Link, BEAT_LOST_MS, NODE_SILENT_MS}) => {
                const dead = (silence) => Link.prototype.life.call({heard: 0, reason: ""}, silence)[0] === "dead";
                done([...JSON.parse(document.body.dataset.silence).map(dead), Math.max(BEAT_LOST_MS, NODE_SILENT_MS)]);
            });"""
        return list(self._driver.execute_async_script(script))

    @property
    def revision(self) -> int:
        """Of the view on the screen; 0 before there is one."""
        return int(self.run("return Number(document.getElementById('view').dataset.rev || 0)"))

    def picture(self, name: str) -> str:
        """The pixels of a canvas, as text."""
        return str(self.run("return document.getElementById(arguments[0]).toDataURL()", name))

    def painted(self, name: str) -> int:
        """Pixels of a canvas that are not transparent."""
        script = """
            const canvas = document.getElementById(arguments[0]);
            const {data} = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
            return data.filter((value, i) => i % 4 === 3 && value > 0).length"""
        return int(self.run(script, name))

    def slide(self, name: str, value: float) -> None:
        """Move a slider as a hand does."""
        script = """
            const slider = document.getElementById(arguments[0]);
            slider.value = arguments[1];
            for (const kind of ["input", "change"]) slider.dispatchEvent(new Event(kind, {bubbles: true}));"""
        self.run(script, name, value)

    def complaints(self) -> list[str]:
        """What the browser holds for an error and is no broken connection: scripts that failed, what was refused."""
        logged = [each for each in self._driver.get_log("browser") if each["level"] == "SEVERE"]
        return [str(each["message"]) for each in logged if "WebSocket connection" not in each["message"]]

    def wait(self, holds: Callable[[], bool]) -> None:
        until(holds, 60.0)


@pytest.fixture(scope="module")
def driver(starting: "subprocess.Popen[str]") -> Iterator[Any]:
    """Starts while the node does."""
    assert starting.stdout is not None
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = str(CHROMIUM)
    for each in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"):
        options.add_argument(each)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    opened = webdriver.Chrome(options=options, service=Service(str(DRIVER)))
    opened.set_script_timeout(60)
    yield opened
    opened.quit()


@pytest.fixture
def page(driver: Any) -> Page:
    shown = Page(driver)
    shown.size(DESKTOP)
    shown.complaints()
    return shown


@pytest.fixture(scope="module")
def starting(tmp_path_factory: pytest.TempPathFactory) -> "Iterator[subprocess.Popen[str]]":
    command = [sys.executable, str(PROCESS), str(tmp_path_factory.mktemp("steered"))]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    yield process
    process.kill()
    process.wait()


@pytest.fixture(scope="module")
def operator_url(starting: "subprocess.Popen[str]") -> Iterator[str]:
    """Of the page of a node that is steered by angles; both in processes of their own."""
    assert starting.stdout is not None
    assert starting.stdout.readline() == "there\n", "the node did not start"
    folder = str(starting.args[-1])  # type: ignore[index]
    endpoints = [f"--{name}=ipc://{folder}/{name}" for name in ("data", "status", "control")]
    command = [sys.executable, "-m", "gcd_node", "viewer", "--http", "127.0.0.1:0", *endpoints]
    viewer = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert viewer.stderr is not None
    yield viewer.stderr.readline().removeprefix("page ").strip()
    viewer.terminate()
    viewer.communicate()


@pytest.fixture
def url(operator_url: str) -> str:
    return operator_url.partition("#")[0]


def test_the_pictures_move_and_say_how_old_they_are(page: Page, url: str) -> None:
    page.open(url)
    page.wait(lambda: page.state == "live" and page.text("input-badge").startswith("input, "))
    assert page.text("view-badge").startswith("generated, ")
    assert page.text("view-badge").endswith(" s old")
    for name in ("input-picture", "view-picture"):
        before = page.picture(name)
        page.wait(lambda name=name, before=before: page.picture(name) != before)
    assert page.text("node") == "gcd"
    page.wait(lambda: "age" in page.text("stage-table"))
    assert page.complaints() == []


def test_without_the_token_a_slider_is_refused_and_the_page_says_so(page: Page, url: str) -> None:
    page.open(url)
    page.wait(lambda: page.revision > 0 and page.run("return !document.getElementById('azimuth_deg').disabled"))
    assert page.text("role") == "viewer"
    before = page.revision
    page.slide("azimuth_deg", 55)
    page.wait(lambda: page.text("answer").startswith("FORBIDDEN"))
    assert page.run("return getComputedStyle(document.getElementById('answer')).display") != "none"
    page.wait(
        lambda: page.run("return Number(document.getElementById('azimuth_deg').value)") == -30
    )  # as the node has it
    assert page.revision == before


def test_with_the_token_a_slider_raises_the_revision_of_the_view(page: Page, operator_url: str) -> None:
    page.open(operator_url)
    page.wait(lambda: page.text("role") == "operator" and page.revision > 0)
    assert "token" not in page.run("return location.href")  # it leaves the address at once
    assert page.run("return ['min', 'max'].map((each) => document.getElementById('azimuth_deg')[each])") == [
        "-90",
        "90",
    ]
    before = page.revision
    page.slide("azimuth_deg", 41)
    page.wait(lambda: page.revision == before + 1)
    page.wait(lambda: f"revision {before + 1} is on the screen" in page.text("answer"))
    page.wait(lambda: "VIEW_SET" in page.text("events"))
    page.slide("elevation_deg", 10)
    page.wait(lambda: page.revision == before + 2)
    page.forget(operator_url.partition("#")[0])


def test_another_view_is_a_click_away(page: Page, url: str) -> None:
    page.open(url)
    page.wait(lambda: page.run("return document.querySelectorAll('#views input').length") == 2)
    page.run("document.querySelector('#views input[value=swing]').click()")
    page.wait(lambda: page.run("return document.getElementById('pose').elements.kind.value") == "orbit")
    page.wait(lambda: page.state == "live" and page.text("view-note").endswith("revision 1"))
    assert page.run("return !document.getElementById('orbit').hidden")
    page.forget(url)


@pytest.mark.parametrize("size", [PHONE, (320, 600), DESKTOP])
def test_nothing_scrolls_sideways(page: Page, url: str, size: tuple[int, int]) -> None:
    page.size(size)
    page.open(url)
    page.wait(lambda: page.state == "live" and page.text("answer") == "" and "age" in page.text("stage-table"))
    content, room, window = page.run(
        "const root = document.documentElement; return [root.scrollWidth, root.clientWidth, window.innerWidth]"
    )
    assert content <= room
    assert window == size[0]
    columns = page.run("return getComputedStyle(document.querySelector('.pictures')).gridTemplateColumns").split()
    assert len(columns) == (1 if size[0] < 600 else 2)
    assert page.complaints() == []


def _require_prompt_death(page: Page) -> None:
    """It was shown at the first look after it was so, and looks follow each other as fast as the machine lets them;
    the silence that means it leaves one look of 2 s."""
    *dead, longest_ms = page.looks()
    assert dead == [False, True]
    assert longest_ms + LOOK_MS <= 2000


def test_a_hung_node_is_shown_as_dead_and_as_alive_once_it_goes_on_and_a_killed_one_as_dead(
    page: Page, url: str, starting: "subprocess.Popen[str]"
) -> None:
    page.open(url)
    page.wait(lambda: page.state == "live")
    starting.send_signal(signal.SIGSTOP)
    try:
        page.wait(lambda: page.state == "dead")
        _require_prompt_death(page)
    finally:
        starting.send_signal(signal.SIGCONT)
    page.wait(lambda: page.state == "live")
    starting.kill()
    page.wait(lambda: page.state == "dead")
    _require_prompt_death(page)
    page.wait(lambda: page.text("view-veil") == "DEAD")
    assert page.text("state") == "dead"
    assert "silent" in page.text("why")


def test_a_fixed_view_has_its_classes_and_says_why_it_cannot_be_steered(page: Page, tmp_path: Path) -> None:
    camera = Camera(fps=10.0)
    model = FakeSynthesizer(painting_traits())
    with (
        Rig(tmp_path, Bench(camera), model, views="[view.main]", watched=False) as rig,
        viewer_of(tmp_path) as viewer,
    ):
        rig.await_state("active")
        page.open(viewer.operator_url)
        until(lambda: rig.publisher.stats.subscribers == 6)
        shots = threading.Thread(target=camera.run, args=(16,), daemon=True)
        shots.start()
        page.wait(lambda: page.run("return !document.getElementById('class-tool').hidden"))
        assert page.run("return document.getElementById('legend').hidden")
        page.slide("class-opacity", 60)
        names = page.run("return [...document.querySelectorAll('#legend button')].map((each) => each.textContent)")
        assert names[:2] == ["sky", "road"]
        assert len(names) == 13
        page.wait(lambda: page.painted("class-picture") > 0)
        assert page.run("return document.getElementById('class-picture').style.opacity") == "0.6"
        page.wait(lambda: "takes no angles" in page.text("steer-why"))
        assert page.run("return document.getElementById('azimuth_deg').disabled")
        shots.join(60)
        page.wait(lambda: page.state == "stale")  # the camera gives nothing any more
        page.wait(lambda: page.text("view-veil") == "too old")
        assert page.text("view-badge").startswith("generated, ")
        assert page.complaints() == []
        page.forget(viewer.url)


def test_who_comes_to_a_node_that_is_not_there_is_told_so(page: Page, tmp_path: Path) -> None:
    with viewer_of(tmp_path) as viewer:
        page.open(viewer.url)
        page.wait(lambda: "has not spoken" in page.text("why"))
        assert page.state == "connecting"
        assert page.text("view-badge") == "no view yet"
        assert page.text("input-badge") == "no input yet"
        with Publisher(PublishConfig(data=f"ipc://{tmp_path}/data", status=f"ipc://{tmp_path}/status")) as publisher:

            def speak() -> bool:
                publisher.note("status", origin(), {"state": "active", "level": 0})
                return page.state == "stale"

            page.wait(speak)  # it lives, and no view comes
            page.wait(lambda: page.state == "dead")  # it lives no more, though its socket is there
        assert "silent" in page.text("why")
