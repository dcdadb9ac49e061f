"""The verbs of the control socket: what each takes, and who may say it (wire protocol, section 5)."""

import functools
import types
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeAlias

import msgspec
from msgspec import Meta

from gcd_client.protocol import LARGEST_INTEGER
from gcd_node.auth import Role
from gcd_node.config import Matrix, Pose, ViewConfig, pose_matrix

ViewName: TypeAlias = Annotated[str, Meta(pattern=r"^[a-z0-9_]{1,16}$(?!\n)")]


class SetView(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Replace a view as a whole: as in a launch file, what is left out has its default, whatever it was before.

    view: its id. kind, azimuth_deg, elevation_deg, radius, position_m, look_at_m, rate_deg_s, amplitude_deg: as in
        [view.*].
    source_from_view: 16 numbers, row-major 4x4, rigid, instead of the three differences; `T_src_dst` on the wire.
    """

    view: ViewName
    kind: Literal["fixed", "orbit"] = "fixed"
    azimuth_deg: float | None = None
    elevation_deg: float | None = None
    radius: float | None = None
    position_m: tuple[float, float, float] | None = None
    look_at_m: tuple[float, float, float] | None = None
    source_from_view: Matrix | None = msgspec.field(default=None, name="T_src_dst")
    rate_deg_s: float | None = None
    amplitude_deg: Annotated[float, Meta(gt=0)] | None = None

    def __post_init__(self) -> None:
        if self.source_from_view is not None:
            pose_matrix(self.source_from_view)
            if (self.azimuth_deg, self.elevation_deg, self.radius, self.position_m) != (None,) * 4:
                raise ValueError("a goal is T_src_dst, or azimuth_deg, elevation_deg and radius: state one of the two")
        self.to_config()

    def to_config(self) -> ViewConfig:
        """The view as a launch file states it.

        Raises:
            ValueError: an orbit without rate or amplitude, or another view with them.
        """
        return ViewConfig(
            kind=self.kind if self.source_from_view is None else "pose",
            azimuth_deg=self.azimuth_deg or 0.0,
            elevation_deg=self.elevation_deg or 0.0,
            radius=self.radius or 0.0,
            position_m=self.position_m,
            look_at_m=self.look_at_m,
            pose=self.source_from_view,
            rate_deg_s=self.rate_deg_s,
            amplitude_deg=self.amplitude_deg,
        )


class SetPose(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Put a view at a rigid pose.

    pose: as in [view.*] of kind "pose": x, y, z and a quaternion x, y, z, w, or 16 numbers, row-major 4x4, in the
        source camera's axes.
    """

    view: ViewName
    pose: Pose

    def __post_init__(self) -> None:
        pose_matrix(self.pose)

    def to_config(self) -> ViewConfig:
        """The view as a launch file states it."""
        return ViewConfig(kind="pose", pose=self.pose)


class RemoveView(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Stop publishing a view."""

    view: ViewName


class SetParam(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Change how views are drawn and sent; what is left out stays.

    steps, guidance, seed, samples: as in [model]. jpeg_quality: as in [publish]. publish: its `encoding`.
    """

    steps: Annotated[int, Meta(ge=1, le=1000)] | None = None
    guidance: tuple[Annotated[float, Meta(ge=0, le=100)], Annotated[float, Meta(ge=0, le=100)]] | None = None
    seed: Annotated[int, Meta(ge=0, le=LARGEST_INTEGER)] | None = None
    samples: Annotated[int, Meta(ge=1, le=64)] | None = None
    jpeg_quality: Annotated[int, Meta(ge=50, le=100)] | None = None
    publish: Literal["rgb8", "jpeg"] | None = None

    def __post_init__(self) -> None:
        if all(getattr(self, name) is None for name in self.__struct_fields__):
            raise ValueError(f"nothing to change; name one of {', '.join(self.__struct_fields__)}")


@dataclass(frozen=True, kw_only=True, slots=True)
class Verb:
    """What a verb takes, who may say it, and whether `if_view_rev` goes with it."""

    arguments: type[msgspec.Struct]
    role: Role
    names_view: bool = False


def _plain(name: str, role: Role, about: str) -> Verb:
    """A verb without arguments."""
    kind = msgspec.defstruct(name, [], frozen=True, forbid_unknown_fields=True, namespace={"__doc__": about})
    return Verb(arguments=kind, role=role)


VERBS: Mapping[str, Verb] = types.MappingProxyType(
    {
        "hello": _plain("Hello", "viewer", "Who answers: node, boot, version, and the role of who asks."),
        "describe": _plain(
            "Describe", "viewer", "Verbs and their arguments, the views this checkpoint allows, limits."
        ),
        "state": _plain("State", "viewer", "State of the node, of its source and of its model."),
        "stats": _plain("Stats", "viewer", "The status message, now."),
        "time": _plain("Time", "viewer", "The node's clock when the request came and when the reply left."),
        "views": _plain("Views", "viewer", "Every view with its pose and revision."),
        "get_config": _plain("GetConfig", "viewer", "The configuration in force, without passwords."),
        "get_calib": _plain("GetCalib", "viewer", "Intrinsics of the source and of the views."),
        "configure": _plain("Configure", "operator", "Check the configuration and load the model."),
        "activate": _plain("Activate", "operator", "Open the source and publish views."),
        "deactivate": _plain("Deactivate", "operator", "Close the source, keep the model."),
        "cleanup": _plain("Cleanup", "operator", "Let go of the model."),
        "shutdown": _plain("Shutdown", "operator", "End the process in order."),
        "set_view": Verb(arguments=SetView, role="operator", names_view=True),
        "set_pose": Verb(arguments=SetPose, role="operator", names_view=True),
        "remove_view": Verb(arguments=RemoveView, role="operator", names_view=True),
        "set_param": Verb(arguments=SetParam, role="operator"),
        "record_start": _plain("RecordStart", "operator", "Begin to record."),
        "record_stop": _plain("RecordStop", "operator", "Finish the recording."),
    }
)
"""Every verb. A viewer's verbs change nothing; an operator may say all of them."""


@functools.cache
def schemas() -> Mapping[str, object]:
    """Role and JSON schema of every verb's arguments, for `describe`; null is left out, as no argument may be that."""
    return {
        name: {
            "role": verb.role,
            "args": _without_null(msgspec.json.schema(verb.arguments)),
            "if_view_rev": verb.names_view,
        }
        for name, verb in VERBS.items()
    }


def _without_null(schema: dict[str, Any]) -> dict[str, Any]:
    """What may be left out is an optional argument of msgspec, which counts null among its values."""
    for definition in schema.get("$defs", {}).values():
        for name, told in definition.get("properties", {}).items():
            kinds = [kind for kind in told.get("anyOf", ()) if kind != {"type": "null"}]
            if len(kinds) == 1:
                definition["properties"][name] = kinds[0]
    return schema
