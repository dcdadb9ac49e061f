"""The arm: six hinges and a parallel gripper, made of boxes, cylinders and capsules, as MuJoCo wants it."""

from dataclasses import dataclass

import numpy as np

from gcd_train.scenes.description import Colour


@dataclass(frozen=True, kw_only=True, slots=True)
class Arm:
    """An arm as pieces of MJCF, and what the controller must know of it.

    body, equality, actuators: the XML inside the elements of those names; the body stands at the origin, x ahead,
    metres, and its site "tool" is the point between the fingertips, z out of the hand, y from finger to finger.
    joints, fingers: names, as in the model; every joint has the position actuator of its name. home: [J] radians, a
    pose above the table with the tool down. open_m: how far a finger goes from the middle. reach_m: nearest and
    farthest distance from the base at which it grasps from above. links: body name -> spoken name, gripper last; the
    last `gripper_links` of them are the gripper.
    """

    body: str
    actuators: str
    equality: str
    joints: tuple[str, ...]
    fingers: tuple[str, str]
    home: tuple[float, ...]
    open_m: float
    reach_m: tuple[float, float]
    links: dict[str, str]
    gripper_links: int


@dataclass(frozen=True, kw_only=True, slots=True)
class _Style:
    shell: Colour
    joint: Colour
    upper: float
    fore: float
    thick: float


_STYLES: tuple[tuple[Colour, Colour], ...] = (
    ((0.93, 0.93, 0.91), (0.16, 0.17, 0.19)),
    ((0.95, 0.47, 0.08), (0.13, 0.13, 0.14)),
    ((0.95, 0.80, 0.12), (0.18, 0.18, 0.20)),
    ((0.22, 0.42, 0.72), (0.86, 0.87, 0.88)),
    ((0.30, 0.31, 0.33), (0.75, 0.20, 0.14)),
    ((0.80, 0.83, 0.86), (0.12, 0.38, 0.52)),
)
OPEN_M = 0.052
_LINKS = {
    "base": "base",
    "turret": "shoulder",
    "upper": "upper arm",
    "fore": "forearm",
    "roll": "wrist roll",
    "wrist": "wrist",
    "palm": "palm",
    "finger_left": "left finger",
    "finger_right": "right finger",
}
_JOINTS = ("yaw", "shoulder", "elbow", "forearm_roll", "wrist_pitch", "tool_roll")


def random_arm(random: np.random.Generator) -> Arm:
    """An arm in one of several liveries and slightly varied in length and girth."""
    shell, joint = _STYLES[int(random.integers(len(_STYLES)))]
    style = _Style(
        shell=shell,
        joint=joint,
        upper=float(random.uniform(0.33, 0.37)),
        fore=float(random.uniform(0.30, 0.34)),
        thick=float(random.uniform(0.9, 1.15)),
    )
    return Arm(
        body=_body(style),
        actuators=_actuators(),
        equality='<joint joint1="slide_right" joint2="slide_left" polycoef="0 1 0 0 0" solref="0.005 1"/>',
        joints=_JOINTS,
        fingers=("slide_left", "slide_right"),
        home=(0.0, 0.0, 1.6, 0.0, float(np.pi - 1.6), 0.0),
        open_m=OPEN_M,
        reach_m=(0.27, 0.55),
        links=_LINKS,
        gripper_links=3,
    )


def _rgba(colour: Colour) -> str:
    return f'rgba="{colour[0]} {colour[1]} {colour[2]} 1"'


def _body(style: _Style) -> str:
    """Nested bodies from the base to the fingers; the tool points along +z of the palm."""
    r, s, j = 0.045 * style.thick, _rgba(style.shell), _rgba(style.joint)
    up, fore = style.upper, style.fore
    return f"""
<body name="base" gravcomp="1">
  <geom class="arm" type="cylinder" size="{2.1 * r} 0.018" pos="0 0 0.018" {j}/>
  <geom class="arm" type="cylinder" size="{1.6 * r} 0.05" pos="0 0 0.08" {s}/>
  <body name="turret" pos="0 0 0.13" gravcomp="1">
    <joint name="yaw" class="arm" axis="0 0 1" range="-3 3"/>
    <geom class="arm" type="cylinder" size="{1.5 * r} 0.045" pos="0 0 0.045" {s}/>
    <geom class="arm" type="cylinder" size="{1.25 * r} {1.75 * r}" pos="0 0 0.10" quat="0.7071 0.7071 0 0" {j}/>
    <body name="upper" pos="0 0 0.10" gravcomp="1">
      <joint name="shoulder" class="arm" axis="0 1 0" range="-2 2.3"/>
      <geom class="arm" type="capsule" size="{r}" fromto="0 {1.1 * r} 0.02 0 {0.55 * r} {up - 0.02}" {s}/>
      <geom class="arm" type="capsule" size="{0.8 * r}" fromto="0 {-0.9 * r} 0 0 {-0.45 * r} {up}" {s}/>
      <geom class="arm" type="cylinder" size="{1.15 * r} {1.5 * r}" pos="0 0 {up}" quat="0.7071 0.7071 0 0" {j}/>
      <body name="fore" pos="0 0 {up}" gravcomp="1">
        <joint name="elbow" class="arm" axis="0 1 0" range="-0.3 2.8"/>
        <geom class="arm" type="capsule" size="{0.85 * r}" fromto="0 0 0 0 0 {0.5 * fore}" {s}/>
        <geom class="arm" type="cylinder" size="{0.92 * r} 0.018" pos="0 0 {0.53 * fore}" {j}/>
        <body name="roll" pos="0 0 {0.55 * fore}" gravcomp="1">
          <joint name="forearm_roll" class="wrist" axis="0 0 1" range="-3 3"/>
          <geom class="arm" type="capsule" size="{0.72 * r}" fromto="0 0 0 0 0 {0.4 * fore}" {s}/>
          <geom class="arm" type="cylinder" size="{0.85 * r} {1.05 * r}" pos="0 0 {0.45 * fore}"
                quat="0.7071 0.7071 0 0" {j}/>
          <body name="wrist" pos="0 0 {0.45 * fore}" gravcomp="1">
            <joint name="wrist_pitch" class="wrist" axis="0 1 0" range="-2.6 2.6"/>
            <geom class="arm" type="capsule" size="{0.66 * r}" fromto="0 0 0 0 0 0.05" {s}/>
            <geom class="arm" type="cylinder" size="{0.75 * r} 0.012" pos="0 0 0.075" {j}/>
            {_palm(s, j)}
          </body>
        </body>
      </body>
    </body>
  </body>
</body>"""


def _palm(shell: str, joint: str) -> str:
    """Palm, two fingers with rubber pads, and the point between the tips."""
    return f"""
<body name="palm" pos="0 0 0.087" gravcomp="1">
  <joint name="tool_roll" class="wrist" axis="0 0 1" range="-3.6 3.6"/>
  <site name="tool" pos="0 0 0.135"/>
  <geom class="arm" type="cylinder" size="0.030 0.010" pos="0 0 0.010" {shell}/>
  <geom class="arm" type="box" size="0.024 0.068 0.018" pos="0 0 0.036" {joint}/>
  <geom class="arm" type="box" size="0.018 0.064 0.004" pos="0 0 0.056" {shell}/>
  {_finger("left", 1, shell)}
  {_finger("right", -1, shell)}
</body>"""


def _finger(side: str, sign: int, shell: str) -> str:
    """A finger that slides along y; at 0 its pad touches the middle."""
    rubber = 'rgba="0.09 0.09 0.10 1"'
    return f"""
<body name="finger_{side}" pos="0 0 0.060" gravcomp="1">
  <joint name="slide_{side}" class="finger" axis="0 {sign} 0"/>
  <geom class="arm" type="box" size="0.012 0.008 0.012" pos="0 {0.013 * sign} 0.012" {shell}/>
  <geom class="arm" type="box" size="0.011 0.005 0.035" pos="0 {0.014 * sign} 0.051" {shell}/>
  <geom class="pad" type="box" size="0.012 0.0045 0.019" pos="0 {0.0045 * sign} 0.071" {rubber}/>
</body>"""


def _actuators() -> str:
    rows = [f'<position name="{name}" joint="{name}" class="arm"/>' for name in _JOINTS[:3]]
    rows += [f'<position name="{name}" joint="{name}" class="wrist"/>' for name in _JOINTS[3:]]
    rows += [f'<position name="{name}" joint="{name}" class="finger"/>' for name in ("slide_left", "slide_right")]
    return "\n".join(rows)
