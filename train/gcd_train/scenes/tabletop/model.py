"""The physics model: arm, table and things as one MuJoCo model, in metres, the arm's base at `BASE`."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gcd_train.errors import RenderError
from gcd_train.scenes.tabletop.arm import Arm
from gcd_train.scenes.tabletop.furniture import FLOOR_M
from gcd_train.scenes.tabletop.things import Placed, Solid

BASE = (-0.36, 0.0, 0.0)
"""Where the arm is bolted to the table, metres from the middle of its surface."""
STEP_S = 1 / 480

_OPTIONS = f"""
<option timestep="{STEP_S}" cone="elliptic" impratio="10" integrator="implicitfast" noslip_iterations="2"/>
<compiler angle="radian" autolimits="true"/>
<size memory="32M"/>"""
_DEFAULTS = """
<geom solref="0.006 1" solimp="0.95 0.99 0.001"/>
<default class="arm">
  <joint type="hinge" armature="0.1" damping="1"/>
  <geom contype="2" conaffinity="1" friction="0.8 0.01 0.001"/>
  <position kp="4000" dampratio="1" forcerange="-400 400"/>
</default>
<default class="wrist">
  <joint type="hinge" armature="0.03" damping="0.5"/>
  <position kp="800" dampratio="1" forcerange="-80 80"/>
</default>
<default class="finger">
  <joint type="slide" range="0 0.052" armature="0.1" damping="5"/>
  <position kp="1500" kv="30" forcerange="-22 22"/>
</default>
<default class="pad">
  <geom contype="2" conaffinity="1" condim="4" friction="1.2 0.02 0.001" mass="0.02"/>
</default>
<default class="thing"><geom contype="1" conaffinity="3" condim="4"/></default>
<default class="still"><geom contype="1" conaffinity="3" condim="3" friction="0.6 0.01 0.001"/></default>"""


def load_mujoco() -> Any:
    """The simulator, imported when it is needed. Raises RenderError if it is not installed."""
    try:
        import mujoco  # an optional dependency: only generating needs it
    except ImportError as error:
        raise RenderError("the tabletop world needs the extra `scenes`: pip install 'gcd-node[scenes]'") from error
    return mujoco


@dataclass(frozen=True, kw_only=True, slots=True)
class Model:
    """A compiled model and the numbers of what is in it.

    joints, fingers: [J], [2] addresses in qpos; rates: of `joints` in qvel. controls, grips: their actuators.
    things: body ids; free: address in qpos of each thing's free joint. links: body ids, as `Arm.links`. site: the tool.
    """

    mujoco: Any
    model: Any
    arm: Arm
    joints: NDArray[np.int64]
    rates: NDArray[np.int64]
    fingers: NDArray[np.int64]
    controls: NDArray[np.int64]
    grips: NDArray[np.int64]
    things: tuple[int, ...]
    links: tuple[int, ...]
    site: int


def build_model(arm: Arm, table: tuple[Solid, ...], clutter: list[Placed], things: list[Placed]) -> Model:
    """Compile everything. Raises RenderError without MuJoCo."""
    mujoco = load_mujoco()
    model = mujoco.MjModel.from_xml_string(_xml(arm, table, clutter, things))

    def ids(kind: Any, names: tuple[str, ...]) -> NDArray[np.int64]:
        return np.array([mujoco.mj_name2id(model, kind, name) for name in names])

    joints = ids(mujoco.mjtObj.mjOBJ_JOINT, arm.joints)
    fingers = ids(mujoco.mjtObj.mjOBJ_JOINT, arm.fingers)
    return Model(
        mujoco=mujoco,
        model=model,
        arm=arm,
        joints=model.jnt_qposadr[joints].astype(np.int64),
        rates=model.jnt_dofadr[joints].astype(np.int64),
        fingers=model.jnt_qposadr[fingers].astype(np.int64),
        controls=ids(mujoco.mjtObj.mjOBJ_ACTUATOR, arm.joints),
        grips=ids(mujoco.mjtObj.mjOBJ_ACTUATOR, arm.fingers),
        things=tuple(ids(mujoco.mjtObj.mjOBJ_BODY, tuple(f"thing_{i}" for i in range(len(things)))).tolist()),
        links=tuple(ids(mujoco.mjtObj.mjOBJ_BODY, tuple(arm.links)).tolist()),
        site=int(ids(mujoco.mjtObj.mjOBJ_SITE, ("tool",))[0]),
    )


def _xml(arm: Arm, table: tuple[Solid, ...], clutter: list[Placed], things: list[Placed]) -> str:
    floor = f'<geom class="still" type="plane" size="5 5 0.1" pos="0 0 {FLOOR_M}"/>'  # what falls off the table lands
    still = floor + "\n".join(_geom(solid, "still") for solid in table)
    still += "\n".join(_body(placed, None) for placed in clutter)
    loose = "\n".join(_body(placed, index) for index, placed in enumerate(things))
    base = f'<body name="mount" pos="{BASE[0]} {BASE[1]} {BASE[2]}">{arm.body}</body>'
    return f"""<mujoco>{_OPTIONS}
<default>{_DEFAULTS}</default>
<worldbody>{still}{base}{loose}</worldbody>
<equality>{arm.equality}</equality>
<actuator>{arm.actuators}</actuator>
</mujoco>"""


def _body(placed: Placed, index: int | None) -> str:
    """A loose thing has a number, a free joint and mass; a still one has none of these."""
    thing = placed.thing
    turn = f"{np.cos(placed.yaw / 2)} 0 0 {np.sin(placed.yaw / 2)}"
    x, y, z = placed.place
    if index is None:
        inside = "".join(_geom(solid, "still") for solid in thing.solids)
        return f'<body pos="{x} {y} {z}" quat="{turn}">{inside}</body>'
    friction = f'friction="{thing.friction} 0.01 {0.004 if thing.rolls else 0.0005}"'
    rolling = f'condim="6" {friction}' if thing.rolls else friction
    volumes = [float(np.prod(solid.size)) * (4.0 if len(solid.size) == 1 else 1.0) for solid in thing.solids]
    inside = "".join(
        _geom(solid, "thing", f'mass="{thing.mass_kg * volume / sum(volumes)}" {rolling}')
        for solid, volume in zip(thing.solids, volumes, strict=True)
    )
    return f'<body name="thing_{index}" pos="{x} {y} {z}" quat="{turn}"><freejoint/>{inside}</body>'


def _geom(solid: Solid, kind: str, more: str = "") -> str:
    size, place, turn = (" ".join(f"{number:.6g}" for number in row) for row in (solid.size, solid.centre, solid.turn))
    return f'<geom class="{kind}" type="{solid.kind}" size="{size}" pos="{place}" quat="{turn}" {more}/>'
