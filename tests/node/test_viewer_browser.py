"""The page in a real browser: a headless Chromium, one for the whole module, beside nodes over real sockets."""

import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
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
    pytest.mark.slow,
    pytest.mark.timeout(120),
    pytest.mark.skipif(not CHROMIUM.exists(), reason="needs the Debian package chromium"),
    pytest.mark.skipif(not DRIVER.exists(), reason="needs the Debian package chromium-driver"),
]
PROCESS = Path(__file__).with_name("node_process.py")


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
        self.get("[sessionStorage.clear(), localStorage.clear()]")

    def get(self, expression: str) -> Any:
        """Of JavaScript; $("id") is an element."""
        return self._driver.execute_script(f"const $ = (id) => document.getElementById(id); return {expression}")

    def text(self, name: str) -> str:
        return str(self.get(f"$('{name}').textContent"))

    @property
    def state(self) -> str:
        return str(self.get("document.body.dataset.state"))

    @property
    def revision(self) -> int:
        """Of the view on the screen; 0 before there is one."""
        return int(self.get("Number($('view').dataset.rev || 0)"))

    def slide(self, name: str, value: float) -> None:
        """Move a slider as a hand does."""
        self.get(f"$('{name}').value = {value}")
        self.get(f"['input', 'change'].map((kind) => $('{name}').dispatchEvent(new Event(kind, {{bubbles: true}})))")

    def complaints(self) -> list[str]:
        """What the browser holds for an error and is no broken connection: scripts that failed, what was refused."""
        logged = [each for each in self._driver.get_log("browser") if each["level"] == "SEVERE"]
        return [str(each["message"]) for each in logged if "WebSocket connection" not in each["message"]]

    wait = staticmethod(until)


@pytest.fixture(scope="module")
def node(tmp_path_factory: pytest.TempPathFactory) -> "Iterator[subprocess.Popen[str]]":
    """Steered by angles, in a process of its own; may still be starting."""
    command = [sys.executable, str(PROCESS), str(tmp_path_factory.mktemp("steered")), "steer"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        yield process
        process.kill()


@pytest.fixture(scope="module")
def browser(node: "subprocess.Popen[str]") -> Iterator[Page]:
    """Starts while the node does."""
    assert node.stdout is not None
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = str(CHROMIUM)
    for each in ("headless=new", "no-sandbox", "disable-gpu", "disable-dev-shm-usage", "window-size=1280,900"):
        options.add_argument(f"--{each}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    opened = webdriver.Chrome(options=options, service=Service(str(DRIVER)))
    opened.set_script_timeout(60)
    yield Page(opened)
    opened.quit()


@pytest.fixture
def page(browser: Page) -> Page:
    browser.complaints()
    return browser


@pytest.fixture(scope="module")
def operator_url(node: "subprocess.Popen[str]") -> Iterator[str]:
    """Of the node's page, which is served by another process."""
    assert node.stdout.readline() == "there\n", "the node did not start"
    folder = str(node.args[-2])  # type: ignore[index]
    endpoints = [f"--{name}=ipc://{folder}/{name}" for name in ("data", "status", "control")]
    command = [sys.executable, "-m", "gcd_node", "viewer", "--http", "127.0.0.1:0", *endpoints]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as viewer:
        yield viewer.stderr.readline().removeprefix("page ").strip()
        viewer.terminate()


@pytest.fixture
def url(operator_url: str) -> str:
    return operator_url.partition("#")[0]


def test_the_pictures_move_and_say_how_old_they_are(page: Page, url: str) -> None:
    page.open(url)
    page.wait(lambda: page.state == "live" and page.text("input-badge").startswith("input, "))
    assert page.text("view-badge").startswith("generated, ")
    assert page.text("view-badge").endswith(" s old")
    for name in ("input-picture", "view-picture"):
        pixels = f"$('{name}').toDataURL()"
        before = page.get(pixels)
        page.wait(lambda pixels=pixels, before=before: page.get(pixels) != before)
    assert page.text("node") == "gcd"
    page.wait(lambda: "age" in page.text("stage-table"))
    assert page.complaints() == []


def test_a_slider_needs_the_token_and_raises_the_revision_with_it(page: Page, url: str, operator_url: str) -> None:
    page.open(url)
    page.wait(lambda: page.revision > 0 and page.get("!$('azimuth_deg').disabled"))
    assert page.text("role") == "viewer"
    before = page.revision
    page.slide("azimuth_deg", 55)
    page.wait(lambda: page.text("answer").startswith("FORBIDDEN"))
    assert page.get("getComputedStyle($('answer')).display") != "none"
    page.wait(lambda: page.get("Number($('azimuth_deg').value)") == -30)  # as the node has it
    assert page.revision == before
    page.open(operator_url)
    page.wait(lambda: page.text("role") == "operator" and page.revision > 0)
    assert "token" not in page.get("location.href")  # it leaves the address at once
    assert page.get("['min', 'max'].map((each) => $('azimuth_deg')[each])") == ["-90", "90"]
    page.slide("azimuth_deg", 41)
    page.wait(lambda: page.revision == before + 1)
    page.wait(lambda: f"revision {before + 1} is on the screen" in page.text("answer"))
    page.wait(lambda: "VIEW_SET" in page.text("events"))
    page.slide("elevation_deg", 10)
    page.wait(lambda: page.revision == before + 2)
    page.forget(url)
    page.open(url)
    page.wait(lambda: page.get("document.querySelectorAll('#views input').length") == 2)  # another view is a click away
    page.get("document.querySelector('#views input[value=swing]').click()")
    page.wait(lambda: page.get("$('pose').elements.kind.value") == "orbit")
    page.wait(lambda: page.state == "live" and page.text("view-note").endswith("revision 1"))
    assert page.get("!$('orbit').hidden")
    page.forget(url)


def test_a_hung_node_is_shown_as_dead_until_it_goes_on(page: Page, url: str, node: "subprocess.Popen[str]") -> None:
    page.open(url)
    page.wait(lambda: page.state == "live")
    node.send_signal(signal.SIGSTOP)
    try:
        page.wait(lambda: page.state == "dead")
    finally:
        node.send_signal(signal.SIGCONT)
    page.wait(lambda: page.state == "live")
    node.kill()
    page.wait(lambda: page.state == "dead")
    page.wait(lambda: page.text("view-veil") == "DEAD")
    assert page.text("state") == "dead"
    assert "silent" in page.text("why")


def test_a_fixed_view_has_its_classes_and_says_why_it_cannot_be_steered(page: Page, tmp_path: Path) -> None:
    camera, model = Camera(fps=10.0), FakeSynthesizer(painting_traits())
    with Rig(tmp_path, Bench(camera), model, views="[view.main]", watched=False) as rig, viewer_of(tmp_path) as viewer:
        rig.await_state("active")
        page.open(viewer.operator_url)
        until(lambda: rig.publisher.stats.subscribers == 6)
        shots = threading.Thread(target=camera.run, args=(16,), daemon=True)
        shots.start()
        page.wait(lambda: page.get("!$('class-tool').hidden"))
        assert page.get("$('legend').hidden")
        page.slide("class-opacity", 60)
        names = page.get("[...document.querySelectorAll('#legend button')].map((each) => each.textContent)")
        assert names[:2] == ["sky", "road"]
        assert len(names) == 13
        picture = "$('class-picture')"
        pixels = f"{picture}.getContext('2d').getImageData(0, 0, {picture}.width, {picture}.height).data"
        page.wait(lambda: page.get(f"{pixels}.some((value, i) => i % 4 === 3 && value > 0)"))
        assert page.get(f"{picture}.style.opacity") == "0.6"
        page.wait(lambda: "takes no angles" in page.text("steer-why"))
        assert page.get("$('azimuth_deg').disabled")
        shots.join(60)
        page.wait(lambda: page.state == "stale" and page.text("view-veil") == "too old")  # the camera gives nothing
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
