"""A Franka Panda from an installed package, as an `Arm`: its files are read where they are, nothing is copied.

The package gymnasium-robotics carries the model in `envs/assets/kitchen_franka`, made by Vikash Kumar and under the
Apache License 2.0. Kinematics, masses and collision meshes are theirs; controllers and contacts are ours. Its meshes
collide as they are and are drawn as capsules (`panda_shells`).
"""

import importlib.metadata
import importlib.util
from pathlib import Path
from xml.etree import ElementTree

from gcd_train.errors import DataError, RenderError
from gcd_train.scenes.tabletop.arm import Arm
from gcd_train.scenes.tabletop.panda_shells import panda_shells

PACKAGE = "gymnasium-robotics"
_FOLDER = Path("envs/assets/kitchen_franka/franka_assets")
_JOINTS = tuple(f"robot:panda0_joint{number}" for number in range(1, 8))
_FINGERS = ("robot:panda0_finger_joint1", "robot:panda0_finger_joint2")
_HOME = (0.0, -0.6, 0.0, -2.5, 0.0, 0.33, 0.0)
_TIP_M = 0.243
"""From the last link to the point between the fingertips."""
_COLOURS = {"light": "0.93 0.93 0.92 1", "dark": "0.20 0.21 0.23 1"}
_DARK = ("panda0_link6", "panda0_leftfinger", "panda0_rightfinger")


def panda_arm() -> Arm:
    """The arm. Raises RenderError if the package is not installed, DataError if its files are not as expected."""
    folder = _asset_folder()
    try:
        body = ElementTree.parse(folder / "chain.xml").getroot().find("body")  # noqa: S314  an installed package's file
    except (OSError, ElementTree.ParseError) as error:
        raise DataError(f"{folder}/chain.xml cannot be read ({error}); install {PACKAGE} again") from error
    if body is None:
        raise DataError(f"{folder}/chain.xml holds no body; this needs {PACKAGE} 1.3 or 1.4")
    _adapt(body)
    return Arm(
        name="panda",
        licence=f"Apache-2.0 (Franka model by V. Kumar in {PACKAGE} {_version()})",
        body=ElementTree.tostring(body, encoding="unicode"),
        assets=_meshes(folder),
        actuators=_actuators(),
        equality=f'<joint joint1="{_FINGERS[1]}" joint2="{_FINGERS[0]}" polycoef="0 1 0 0 0" solref="0.005 1"/>',
        joints=_JOINTS,
        fingers=_FINGERS,
        home=_HOME,
        open_m=0.04,
        reach_m=(0.33, 0.60),
        links=_links(),
        gripper_links=2,
        shells=panda_shells(),
    )


def _asset_folder() -> Path:
    found = importlib.util.find_spec("gymnasium_robotics")
    if found is None or found.origin is None:
        raise RenderError(
            f"the arm 'panda' is read from the package {PACKAGE}, which is not installed: pip install {PACKAGE}; or "
            "use the arm 'primitive'"
        )
    return Path(found.origin).parent / _FOLDER


def _version() -> str:
    try:
        return importlib.metadata.version(PACKAGE)
    except importlib.metadata.PackageNotFoundError:
        return "of unknown version"


def _adapt(body: ElementTree.Element) -> None:
    """Give every body gravity compensation, every geom and joint our classes; take out what is only for looking at."""
    name = body.get("name", "")
    body.set("gravcomp", "1")
    body.attrib.pop("childclass", None)
    for geom in body.findall("geom"):
        if geom.get("class") == "panda_viz":
            body.remove(geom)
        else:
            _adapt_geom(geom, "dark" if name in _DARK else "light", is_finger=name.endswith("finger"))
    for joint in body.findall("joint"):
        joint.set(
            "class", {"panda_arm": "arm", "panda_forearm": "wrist", "panda_finger": "finger"}[joint.get("class", "")]
        )
        joint.set("axis", joint.get("axis", "0 0 1"))
    for site in body.findall("site"):
        body.remove(site)
        # as in the model, but between the fingertips, and turned so that its x axis points back to the base
        ElementTree.SubElement(body, "site", name="tool", pos=f"0 0 {_TIP_M}", euler="0 0 2.356194")
    for child in body.findall("body"):
        _adapt(child)


def _adapt_geom(geom: ElementTree.Element, colour: str, *, is_finger: bool) -> None:
    geom.set("class", "pad" if is_finger else "arm")
    geom.set("rgba", _COLOURS[colour])
    if not is_finger:
        geom.set("type", "mesh")


def _meshes(folder: Path) -> str:
    names = [*(f"link{number}" for number in range(8)), "hand"]
    return "".join(f'<mesh name="{name}_col" file="{folder}/meshes/collision/{name}.stl"/>' for name in names)


def _actuators() -> str:
    rows = [f'<position name="{name}" joint="{name}" class="arm"/>' for name in _JOINTS[:4]]
    rows += [f'<position name="{name}" joint="{name}" class="wrist"/>' for name in _JOINTS[4:]]
    rows += [f'<position name="{name}" joint="{name}" class="finger"/>' for name in _FINGERS]
    return "".join(rows)


def _links() -> dict[str, str]:
    links = {f"panda0_link{number}": f"link {number}" for number in range(7)}
    hand = {"panda0_link7": "link 7 and hand"}
    return {**links, **hand, "panda0_leftfinger": "left finger", "panda0_rightfinger": "right finger"}
