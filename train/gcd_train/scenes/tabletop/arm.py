"""The arm, six hinges and a parallel gripper, and the physics: arm, table and things as one MuJoCo model, in metres."""

import math
from typing import Any

import numpy as np

from gcd_train.scenes.description import Colour, Doubles, Part, pick, rotations
from gcd_train.scenes.drop.world import load_mujoco
from gcd_train.scenes.tabletop.things import (
    FLOOR_M,
    TABLE_M,
    Placed,
    Setting,
    TableThing,
    TabletopClass,
    plain,
    random_clutter,
    random_table,
    random_thing,
)

BASE = (-0.36, 0.0, 0.0)
"""Where the arm is bolted to the table, metres from the middle of its surface."""
JOINTS = ("yaw", "shoulder", "elbow", "forearm_roll", "wrist_pitch", "tool_roll")
FINGERS = ("slide_left", "slide_right")
"""Names in the model; every joint and finger has the position actuator of its name."""
HOME = (0.0, 0.0, 1.6, 0.0, float(np.pi - 1.6), 0.0)
"""Angles of a pose above the table with the tool down, radians."""
OPEN_M = 0.052
"""How far a finger goes from the middle."""
REACH_M = (0.27, 0.55)
"""Nearest and farthest distance from the base at which the arm grasps from above."""
STEP_S = 1 / 480
FINGER_ROOM_M = 0.085
"""How far the open gripper reaches from the middle of what it takes."""
_WIDEST_AZIMUTH = 1.15
_GAP_M, _DROP_M, _TRIES = 0.015, 0.002, 400
_SPANS_M = ((-0.3, TABLE_M[0] - 0.1), (0.1 - TABLE_M[1], TABLE_M[1] - 0.1))
"""Where on the table things lie: along x and along y."""

_LIVERIES: tuple[tuple[Colour, Colour], ...] = (
    ((0.93, 0.93, 0.91), (0.16, 0.17, 0.19)),
    ((0.95, 0.47, 0.08), (0.13, 0.13, 0.14)),
    ((0.95, 0.80, 0.12), (0.18, 0.18, 0.20)),
    ((0.22, 0.42, 0.72), (0.86, 0.87, 0.88)),
    ((0.30, 0.31, 0.33), (0.75, 0.20, 0.14)),
    ((0.80, 0.83, 0.86), (0.12, 0.38, 0.52)),
)
"""Of shell and joints."""
_LINKS = ("base", "shoulder", "upper_arm", "forearm", "wrist_roll", "wrist")
_GRIPPER = ("palm", "left_finger", "right_finger")
"""Bodies of the model."""
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
_MOVED_ALIKE = '<joint joint1="slide_right" joint2="slide_left" polycoef="0 1 0 0 0" solref="0.005 1"/>'


def random_setting(random: np.random.Generator) -> Setting:
    """An arm, a table with clutter, and five to twelve loose things; the first four or so stand apart and within
    reach, so that they can be taken.
    """
    arm, table, clutter = random_arm(random), random_table(random), random_clutter(random)
    wanted = int(random.integers(5, 13))
    placed: list[Placed] = []
    for _ in range(_TRIES):
        if len(placed) == wanted:
            break
        first = len(placed) < 4
        thing = random_thing(random, 2 * OPEN_M - 0.022)
        x, y = reachable_spot(random) if first else tuple(random.uniform(*span) for span in _SPANS_M)
        radius = thing.radius_m + (FINGER_ROOM_M - 0.02 if first else _GAP_M)
        others = [
            (math.hypot(x - each.place[0], y - each.place[1]), each.thing.radius_m) for each in (*placed, *clutter)
        ]
        apart = math.hypot(x - BASE[0], y - BASE[1]) > 0.2 + radius
        if apart and all(away > radius + other for away, other in others):
            place = (x, y, thing.size[2] / 2 + _DROP_M)
            placed.append(Placed(thing=thing, place=place, yaw=random.uniform(-math.pi, math.pi)))
    return Setting(arm=arm, table=table, clutter=clutter, things=tuple(placed))


def reachable_spot(random: np.random.Generator) -> tuple[float, float]:
    """A point of the table, x and y in metres, that the arm can grasp at from above."""
    radius = random.uniform(REACH_M[0] + 0.02, REACH_M[1] - 0.02)
    azimuth = random.uniform(-_WIDEST_AZIMUTH, _WIDEST_AZIMUTH)
    return BASE[0] + radius * math.cos(azimuth), BASE[1] + radius * math.sin(azimuth)


def is_reachable(x: float, y: float) -> bool:
    """Whether the arm can grasp from above at a point of the table, metres."""
    return REACH_M[0] <= math.hypot(x - BASE[0], y - BASE[1]) <= REACH_M[1]


def random_arm(random: np.random.Generator) -> str:
    """An arm in one of several liveries and slightly varied in length and girth, as MJCF.

    Its body stands at the origin, x ahead; its site "tool" is the point between the fingertips, z out of the hand, y
    from finger to finger.
    """
    shell, joint = pick(random, _LIVERIES)
    upper, fore = random.uniform(0.33, 0.37), random.uniform(0.30, 0.34)
    r, (s, j) = 0.045 * random.uniform(0.9, 1.15), (f'rgba="{a} {b} {c} 1"' for a, b, c in (shell, joint))
    return f"""
<body name="base" gravcomp="1">
  <geom class="arm" type="cylinder" size="{2.1 * r} 0.018" pos="0 0 0.018" {j}/>
  <geom class="arm" type="cylinder" size="{1.6 * r} 0.05" pos="0 0 0.08" {s}/>
  <body name="shoulder" pos="0 0 0.13" gravcomp="1">
    <joint name="yaw" class="arm" axis="0 0 1" range="-3 3"/>
    <geom class="arm" type="cylinder" size="{1.5 * r} 0.045" pos="0 0 0.045" {s}/>
    <geom class="arm" type="cylinder" size="{1.25 * r} {1.75 * r}" pos="0 0 0.10" quat="0.7071 0.7071 0 0" {j}/>
    <body name="upper_arm" pos="0 0 0.10" gravcomp="1">
      <joint name="shoulder" class="arm" axis="0 1 0" range="-2 2.3"/>
      <geom class="arm" type="capsule" size="{r}" fromto="0 {1.1 * r} 0.02 0 {0.55 * r} {upper - 0.02}" {s}/>
      <geom class="arm" type="capsule" size="{0.8 * r}" fromto="0 {-0.9 * r} 0 0 {-0.45 * r} {upper}" {s}/>
      <geom class="arm" type="cylinder" size="{1.15 * r} {1.5 * r}" pos="0 0 {upper}" quat="0.7071 0.7071 0 0" {j}/>
      <body name="forearm" pos="0 0 {upper}" gravcomp="1">
        <joint name="elbow" class="arm" axis="0 1 0" range="-0.3 2.8"/>
        <geom class="arm" type="capsule" size="{0.85 * r}" fromto="0 0 0 0 0 {0.5 * fore}" {s}/>
        <geom class="arm" type="cylinder" size="{0.92 * r} 0.018" pos="0 0 {0.53 * fore}" {j}/>
        <body name="wrist_roll" pos="0 0 {0.55 * fore}" gravcomp="1">
          <joint name="forearm_roll" class="wrist" axis="0 0 1" range="-3 3"/>
          <geom class="arm" type="capsule" size="{0.72 * r}" fromto="0 0 0 0 0 {0.4 * fore}" {s}/>
          <geom class="arm" type="cylinder" size="{0.85 * r} {1.05 * r}" pos="0 0 {0.45 * fore}"
                quat="0.7071 0.7071 0 0" {j}/>
          <body name="wrist" pos="0 0 {0.45 * fore}" gravcomp="1">
            <joint name="wrist_pitch" class="wrist" axis="0 1 0" range="-2.6 2.6"/>
            <geom class="arm" type="capsule" size="{0.66 * r}" fromto="0 0 0 0 0 0.05" {s}/>
            <geom class="arm" type="cylinder" size="{0.75 * r} 0.012" pos="0 0 0.075" {j}/>
            <body name="palm" pos="0 0 0.087" gravcomp="1">
              <joint name="tool_roll" class="wrist" axis="0 0 1" range="-3.6 3.6"/>
              <site name="tool" pos="0 0 0.135"/>
              <geom class="arm" type="cylinder" size="0.030 0.010" pos="0 0 0.010" {s}/>
              <geom class="arm" type="box" size="0.024 0.068 0.018" pos="0 0 0.036" {j}/>
              <geom class="arm" type="box" size="0.018 0.064 0.004" pos="0 0 0.056" {s}/>
              {_finger("left", 1, s)}
              {_finger("right", -1, s)}
            </body>
          </body>
        </body>
      </body>
    </body>
  </body>
</body>"""


def _finger(side: str, sign: int, shell: str) -> str:
    """A finger that slides along y; at 0 its pad touches the middle."""
    rubber = 'rgba="0.09 0.09 0.10 1"'
    return f"""
<body name="{side}_finger" pos="0 0 0.060" gravcomp="1">
  <joint name="slide_{side}" class="finger" axis="0 {sign} 0"/>
  <geom class="arm" type="box" size="0.012 0.008 0.012" pos="0 {0.013 * sign} 0.012" {shell}/>
  <geom class="arm" type="box" size="0.011 0.005 0.035" pos="0 {0.014 * sign} 0.051" {shell}/>
  <geom class="pad" type="box" size="0.012 0.0045 0.019" pos="0 {0.0045 * sign} 0.071" {rubber}/>
</body>"""


def build_model(setting: Setting) -> Any:
    """All as one MjModel: body 1 is the first of the clutter, `thing_3` thing 3. Raises RenderError without MuJoCo."""
    floor = f'<geom class="still" type="plane" size="5 5 0.1" pos="0 0 {FLOOR_M}"/>'  # what falls off the table lands
    still = floor + "\n".join(_geom(part, "still") for part in setting.table)
    still += "\n".join(_body(placed, None) for placed in setting.clutter)
    loose = "\n".join(_body(placed, index) for index, placed in enumerate(setting.things))
    classes = ["arm"] * 3 + ["wrist"] * 3 + ["finger"] * 2
    actuators = "".join(
        f'<position name="{name}" joint="{name}" class="{kind}"/>'
        for name, kind in zip((*JOINTS, *FINGERS), classes, strict=True)
    )
    return load_mujoco().MjModel.from_xml_string(f"""<mujoco>{_OPTIONS}
<default>{_DEFAULTS}</default>
<worldbody>{still}<body name="mount" pos="{BASE[0]} {BASE[1]} {BASE[2]}">{setting.arm}</body>{loose}</worldbody>
<equality>{_MOVED_ALIKE}</equality>
<actuator>{actuators}</actuator>
</mujoco>""")


def arm_links(model: Any) -> list[tuple[TableThing, int, TabletopClass]]:
    """The arm's links, the gripper's last, each with its body's number and its class.

    Their names tell the class too, for layouts that keep no classes: robot_arm/upper_arm, gripper/palm.
    """
    found: list[tuple[TableThing, int, TabletopClass]] = []
    for name in (*_LINKS, *_GRIPPER):
        label = TabletopClass.GRIPPER if name in _GRIPPER else TabletopClass.ROBOT_ARM
        body = model.body(name).id
        parts = _parts_of_body(model, body, label)
        corners: list[Doubles] = []  # of the parts' own boxes, along the body's axes
        for part in parts:
            x, y, z = part.size
            own = np.array([x, y, z + x if part.shape == "capsule" else z])
            half = np.abs(rotations(np.asarray(part.turn))) @ (own / 2)
            corners += [np.asarray(part.centre) - half, np.asarray(part.centre) + half]
        low, high = np.min(corners, axis=0), np.max(corners, axis=0)
        link = TableThing(
            name=f"{label.name.lower()}/{name}",
            parts=parts,
            size=tuple((high - low).tolist()),
            middle=tuple(((low + high) / 2).tolist()),
            mass_kg=float(model.body_mass[body]),
            friction=0.8,
        )
        found.append((link, body, label))
    return found


def _parts_of_body(model: Any, body: int, label: TabletopClass) -> tuple[Part, ...]:
    """The geoms of one body of a compiled model, as they are seen."""
    kinds = load_mujoco().mjtGeom
    shapes = {kinds.mjGEOM_BOX: "box", kinds.mjGEOM_CYLINDER: "cylinder", kinds.mjGEOM_CAPSULE: "capsule"}
    first = model.body_geomadr[body]
    found: list[Part] = []
    for geom in range(first, first + model.body_geomnum[body]):
        shape = shapes[kinds(model.geom_type[geom])]
        x, y, z = (2 * model.geom_size[geom]).tolist()
        size = (x, y, z) if shape == "box" else (x, x, y)
        colour, place = tuple(model.geom_rgba[geom][:3].tolist()), tuple(model.geom_pos[geom].tolist())
        found.append(Part(shape, place, size, plain(colour, 0.25), label, tuple(model.geom_quat[geom].tolist())))
    return tuple(found)


def _body(placed: Placed, index: int | None) -> str:
    """A loose thing has a number, a free joint and mass; a still one has none of these."""
    thing = placed.thing
    x, y, z = placed.place
    pose = f'pos="{x} {y} {z}" quat="{np.cos(placed.yaw / 2)} 0 0 {np.sin(placed.yaw / 2)}"'
    if index is None:
        return f"<body {pose}>{''.join(_geom(part, 'still') for part in thing.parts)}</body>"
    touch = f'friction="{thing.friction} 0.01 {0.004 if thing.rolls else 0.0005}"' + ' condim="6"' * thing.rolls
    # Shares of the mass, not quite by volume: with better ones every scene would be another.
    weights = [float(np.prod(_half_sizes(part))) * (4.0 if part.shape == "sphere" else 1.0) for part in thing.parts]
    inside = "".join(
        _geom(part, "thing", f'mass="{thing.mass_kg * weight / sum(weights)}" {touch}')
        for part, weight in zip(thing.parts, weights, strict=True)
    )
    return f'<body name="thing_{index}" {pose}><freejoint/>{inside}</body>'


def _geom(part: Part, kind: str, more: str = "") -> str:
    rows = (_half_sizes(part), part.centre, part.turn)
    size, place, turn = (" ".join(f"{number:.6g}" for number in row) for row in rows)
    return f'<geom class="{kind}" type="{part.shape}" size="{size}" pos="{place}" quat="{turn}" {more}/>'


def _half_sizes(part: Part) -> tuple[float, ...]:
    """As MuJoCo wants them: of a box; the radius of a sphere; radius and half length of what is round."""
    x, y, z = (side / 2 for side in part.size)
    return {"box": (x, y, z), "sphere": (x,)}.get(part.shape, (x, z))
