"""What the node answers to each verb of the control socket (wire protocol, section 5). Never waits for the model."""

from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from typing import TypeAlias

import msgspec
import torch
from msgspec.structs import replace

from gcd_client.control import Code
from gcd_client.protocol import PROTO
from gcd_model import (
    ASSUMED_SOURCE,
    DeltaFit,
    ModelError,
    Spherical,
    Traits,
    ViewFixedError,
    ViewRangeError,
    nearest_delta,
)
from gcd_node.auth import Role
from gcd_node.config import NodeConfig, ViewConfig, pose_matrix
from gcd_node.config_digest import config_digest
from gcd_node.config_text import without_secrets
from gcd_node.control.message import Command, Outcome, RequestError
from gcd_node.control.verbs import RemoveView, SetParam, SetPose, SetView, schemas
from gcd_node.health import Health, Level
from gcd_node.lifecycle import Verb
from gcd_node.preprocess import stated_sphere
from gcd_node.recorder import Recorder
from gcd_node.status import Announcer, calibration
from gcd_node.transitions import Transitions
from gcd_node.views import VirtualView

_TOLERATED_DEG = 2.0

Ask: TypeAlias = Callable[[Verb, bool], Outcome]
"""Begins a transition of the node's life; the second argument is dry_run."""


class NodeCommands:
    """Answers for one node; called from the control thread alone."""

    def __init__(
        self, transitions: Transitions, announcer: Announcer, health: Health, ask: Ask, recorder: Recorder
    ) -> None:
        self._machinery, self._announcer, self._health, self._ask = transitions, announcer, health, ask
        self._recorder = recorder
        self._told: dict[str, Callable[[], dict[str, object]]] = {
            "describe": self._describe,
            "state": self._state,
            "stats": self._stats,
            "views": self._views,
            "get_config": self._config,
            "get_calib": self._calibration,
        }

    def handle(self, command: Command, role: Role) -> Outcome:
        """Carry it out, or begin to; see Commands. Raises RequestError."""
        if command.verb == "hello":
            return Outcome(result=self._hello(role))
        if command.verb in self._told:
            return Outcome(result=self._told[command.verb]())
        match command.verb:
            case "configure" | "activate" | "deactivate" | "cleanup" | "shutdown":
                return self._ask(command.verb, command.dry_run)
            case "record_start" | "record_stop":
                return self._record(begin=command.verb == "record_start", dry_run=command.dry_run)
            case _:
                return self._change(command)

    def _change(self, command: Command) -> Outcome:
        match command.args:
            case SetView() | SetPose() as wanted:
                return self._set_view(wanted, command)
            case RemoveView() as wanted:
                return self._remove_view(wanted, command)
            case SetParam() as wanted:
                return self._set_param(wanted, dry_run=command.dry_run)
            case _:
                raise RequestError(f"this node does not know {command.verb}", Code.UNKNOWN_VERB)

    # Telling.

    def _hello(self, role: Role) -> dict[str, object]:
        announcer = self._announcer
        return {
            "node_id": announcer.node_id,
            "boot_id": announcer.boot_id,
            "proto": PROTO,
            "version": _version(),
            "role": role,
        }

    def _describe(self) -> dict[str, object]:
        told: dict[str, object] = {"verbs": schemas(), "views": list(self._machinery.live.known_views)}
        traits = self._machinery.traits
        if traits is not None:
            limits = None if traits.family is None else traits.family.limits
            told |= {
                "model": {"name": traits.name, "family": None if traits.family is None else traits.family.name},
                "camera": traits.config.camera,
                "fps": list(traits.rates),
                "frames": traits.config.frames,
                "limits": None if limits is None else _intervals(limits.allowed(self._sphere())),
            }
        return told

    def _state(self) -> dict[str, object]:
        status = self._health.snapshot().status
        states = {name: status[name]["state"] for name in ("source", "model")}
        return {key: status[key] for key in ("state", "level", "reasons")} | states

    def _stats(self) -> dict[str, object]:
        return self._health.snapshot().status

    def _views(self) -> dict[str, object]:
        settings = self._machinery.live.settings()
        return {
            view_id: {**settings.config.view[view_id].plain, "view_rev": rev}
            for view_id, rev in settings.revisions.items()
        }

    def _config(self) -> dict[str, object]:
        config, traits = self._machinery.live.config, self._machinery.traits
        digest = None if traits is None else config_digest(config, traits)
        return {"config": without_secrets(config), "cfg_digest": digest}

    def _calibration(self) -> dict[str, object]:
        stream, info = self._machinery.stream, self._machinery.source_info
        told: dict[str, object] = {}
        if info is not None:
            told["source"] = msgspec.to_builtins(info)
        if stream is not None:
            told |= calibration(stream.run)
        return told

    # Changing.

    def _set_view(self, wanted: SetView | SetPose, command: Command) -> Outcome:
        live, traits = self._machinery.live, self._loaded()
        if wanted.view not in live.known_views:
            raise _unknown(wanted.view, live.known_views)
        self._require_revision(wanted.view, command.if_view_rev)
        view, error_deg = wanted.to_config(), 0.0
        posed = view.pose is not None
        if view.pose is not None and not traits.takes_any_pose:
            fit = self._fitted(pose_matrix(view.pose), traits)
            delta, error_deg = fit.delta, fit.rotation_error_deg
            view = ViewConfig(azimuth_deg=delta.azimuth_deg, elevation_deg=delta.elevation_deg, radius=delta.radius_m)
        self._check_view(wanted.view, view, traits)
        told: dict[str, object] = {"view": wanted.view, "goal": view.plain}
        if posed:
            told["rotation_error_deg"] = round(error_deg, 4)
        if command.dry_run:
            return Outcome(message="it would be set", result=told)
        told["view_rev"] = live.set_view(wanted.view, view)
        self._after_change("VIEW_SET", told)
        return Outcome(result=told)

    def _remove_view(self, wanted: RemoveView, command: Command) -> Outcome:
        live = self._machinery.live
        views = live.settings().revisions
        if wanted.view not in views:
            raise _unknown(wanted.view, tuple(views))
        self._require_revision(wanted.view, command.if_view_rev)
        if len(views) == 1:
            raise RequestError(f"{wanted.view} is the last view; deactivate the node instead", Code.BAD_ARG)
        told: dict[str, object] = {"view": wanted.view, "view_rev": views[wanted.view]}
        if not command.dry_run:
            live.remove_view(wanted.view)
            self._after_change("VIEW_REMOVED", told)
        return Outcome(result=told)

    def _set_param(self, wanted: SetParam, *, dry_run: bool) -> Outcome:
        config = self._machinery.live.config
        drawing = {
            name: value
            for name in ("steps", "guidance", "seed", "samples")
            if (value := getattr(wanted, name)) is not None
        }
        sending: dict[str, object] = {}
        if wanted.jpeg_quality is not None:
            sending["jpeg_quality"] = wanted.jpeg_quality
        if wanted.publish is not None:
            sending["encoding"] = wanted.publish
        model, publish = replace(config.model, **drawing), replace(config.publish, **sending)
        told: dict[str, object] = {**drawing, **sending}
        if not dry_run:
            self._machinery.live.change(model, publish)
            self._after_change("PARAM_SET", told)
        return Outcome(result=told)

    def _record(self, *, begin: bool, dry_run: bool) -> Outcome:
        """Begin to record, or to end that; an event tells how it went."""
        recorder = self._recorder
        if begin and not recorder.available:
            message = "there is nowhere to record to: state folder in [record] of the launch file"
            return Outcome(code=Code.NOT_READY, message=message)
        if recorder.busy == begin:
            message = "a recording is under way: stop it first" if begin else "nothing is being recorded"
            return Outcome(code=Code.WRONG_STATE, message=message)
        if dry_run:
            return Outcome(message="it would be done")
        done = recorder.start() if begin else recorder.stop()
        if not done:  # somebody, or the disk, was faster
            return Outcome(code=Code.WRONG_STATE, message="the recording has just begun or ended; look at its state")
        return Outcome(code=Code.ACCEPTED, message="an event tells when it has")

    def _after_change(self, code: str, told: dict[str, object]) -> None:
        stream = self._machinery.stream
        if stream is not None:
            stream.notice_change()
        self._announcer.event(code, Level.OK, told)

    def _loaded(self) -> Traits:
        traits = self._machinery.traits
        if traits is None:
            raise RequestError("which views there can be, only a loaded model knows: configure first", Code.NOT_READY)
        return traits

    def _require_revision(self, view_id: str, revision: int | None) -> None:
        now = self._machinery.live.revision(view_id)
        if revision is not None and revision != now:
            raise RequestError(
                f"{view_id} is at revision {now}, not {revision}: somebody else has changed it",
                Code.WRONG_STATE,
                result={"view_rev": now},
            )

    def _sphere(self) -> Spherical | None:
        return stated_sphere(self._machinery.live.config.source.pose)

    def _fitted(self, numbers: tuple[float, ...], traits: Traits) -> DeltaFit:
        """The differences that a rigid goal pose comes to. Raises RequestError."""
        if traits.config.camera == "none":
            raise RequestError(f"{traits.name} has one fixed view and takes no poses", Code.VIEW_FIXED)
        pose = torch.tensor(numbers, dtype=torch.float64).reshape(4, 4)
        try:
            fit = nearest_delta(pose, self._sphere() or ASSUMED_SOURCE)
        except ModelError as error:
            raise RequestError(f"the pose: {error}", Code.BAD_ARG) from error
        if fit.rotation_error_deg > _TOLERATED_DEG:
            raise RequestError(
                f"a view looks at the centre of the scene: the nearest one is turned by {fit.rotation_error_deg:.1f} "
                f"degrees from the pose, allowed are {_TOLERATED_DEG:g}; aim it there, or give angles and radius",
                Code.OUT_OF_RANGE,
                result={"allowed": {"rotation_error_deg": [0.0, _TOLERATED_DEG]}},
            )
        return fit

    def _check_view(self, view_id: str, view: ViewConfig, traits: Traits) -> None:
        """Raises RequestError if the checkpoint cannot give it."""
        config: NodeConfig = self._machinery.live.config
        stream = self._machinery.stream
        mount = None if stream is None else stream.run.mount
        try:
            VirtualView(view_id, replace(config, view={**config.view, view_id: view}), traits, mount)
        except ViewFixedError as error:
            raise RequestError(str(error), Code.VIEW_FIXED) from error
        except ViewRangeError as error:
            raise RequestError(str(error), Code.OUT_OF_RANGE, result={"allowed": _intervals(error.allowed)}) from error
        except ModelError as error:
            raise RequestError(str(error), Code.BAD_ARG) from error


def _unknown(view_id: str, known: tuple[str, ...]) -> RequestError:
    return RequestError(
        f"there is no view {view_id}; there are {', '.join(known)}", Code.UNKNOWN_VIEW, result={"views": list(known)}
    )


def _intervals(allowed: dict[str, tuple[float, float]]) -> dict[str, object]:
    """By the names a command uses."""
    return {name.removesuffix("_m"): list(interval) for name, interval in allowed.items()}


def _version() -> str:
    try:
        return version("gcd-node")
    except PackageNotFoundError:
        return "unknown"
