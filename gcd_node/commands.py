"""What the node answers to each verb of the control socket (wire protocol, section 5). Never waits for the model."""

from collections.abc import Callable
from importlib.metadata import distributions

import msgspec
import torch
from msgspec.structs import replace

from gcd_client.control import Code
from gcd_client.protocol import PROTO
from gcd_model import ModelError, SphericalDelta, Traits, ViewFixedError, ViewRangeError, nearest_delta
from gcd_node.auth import Role
from gcd_node.config import without_secrets
from gcd_node.health import Level
from gcd_node.lifecycle import Transitions, Verb
from gcd_node.preprocess import stated_sphere
from gcd_node.recorder import Recorder
from gcd_node.status import Announcer, calibration
from gcd_node.stream_context import config_digest
from gcd_node.verbs import AlignView, Command, Outcome, RemoveView, RequestError, SetParam, SetPose, SetView, schemas
from gcd_node.view_config import ViewConfig, pose_matrix
from gcd_node.views import LiveConfig, VirtualView

_TOLERATED_DEG = 2.0


class NodeCommands:
    """Answers for one node; called from the control thread alone."""

    def __init__(
        self,
        live: LiveConfig,
        announcer: Announcer,
        transitions: Transitions,
        recorder: Recorder,
        request_transition: Callable[[Verb, bool], Outcome],
    ) -> None:
        """request_transition: begins one; its second argument is dry_run."""
        self._live, self._health, self._announcer = live, announcer.health, announcer
        self._transitions, self._recorder, self._request = transitions, recorder, request_transition
        self._queries: dict[str, Callable[[], dict[str, object]]] = {
            "describe": self._describe,
            "state": self._state,
            "stats": self._health.status,
            "views": self._views,
            "get_config": self._config,
            "get_calib": self._calibration,
        }

    def handle(self, command: Command, role: Role) -> Outcome:
        """Carry it out, or begin to; see CommandHandler. Raises RequestError."""
        verb, args = command.verb, command.args
        if verb == "hello":
            return Outcome(result=self._hello(role))
        if verb in self._queries:
            return Outcome(result=self._queries[verb]())
        match verb:
            case "configure" | "activate" | "deactivate" | "cleanup" | "shutdown":
                return self._request(verb, command.dry_run)
            case "record_start" | "record_stop":
                return self._record(begin=verb == "record_start", dry_run=command.dry_run)
            case _ if isinstance(args, SetView | SetPose):
                return self._set_view(args, command)
            case _ if isinstance(args, AlignView):
                return self._align_view(args, command)
            case _ if isinstance(args, RemoveView):
                return self._remove_view(args, command)
            case _ if isinstance(args, SetParam):
                return self._set_param(args, dry_run=command.dry_run)
            case _:
                raise RequestError(f"this node does not know {verb}", Code.UNKNOWN_VERB)

    # Queries.

    def _hello(self, role: Role) -> dict[str, object]:
        release = next((each.version for each in distributions(name="gcd-node")), "unknown")  # of a checkout alone
        node_id, boot_id = self._announcer.node_id, self._announcer.boot_id
        return {"node_id": node_id, "boot_id": boot_id, "proto": PROTO, "version": release, "role": role}

    def _describe(self) -> dict[str, object]:
        result: dict[str, object] = {"verbs": schemas(), "views": list(self._live.known_views)}
        traits = self._transitions.traits
        if traits is not None:
            family, sphere = traits.family, stated_sphere(self._live.config.source.pose)
            limits = None if family is None or family.limits is None else family.limits.allowed(sphere)
            result |= {
                "model": {"name": traits.name, "family": None if family is None else family.name},
                "camera": traits.config.camera,
                "fps": list(traits.rates),
                "frames": traits.config.frames,
                "limits": None if limits is None else _intervals(limits),
            }
        return result

    def _state(self) -> dict[str, object]:
        status = self._health.status()
        states = {name: status[name]["state"] for name in ("source", "model")}
        return {key: status[key] for key in ("state", "level", "reasons")} | states

    def _views(self) -> dict[str, object]:
        settings = self._live.settings()
        views = settings.config.view
        return {view_id: {**views[view_id].plain, "view_rev": rev} for view_id, rev in settings.revisions.items()}

    def _config(self) -> dict[str, object]:
        config, traits = self._live.config, self._transitions.traits
        digest = None if traits is None else config_digest(config, traits)
        return {"config": without_secrets(config), "cfg_digest": digest}

    def _calibration(self) -> dict[str, object]:
        stream, info = self._transitions.stream, self._transitions.source_info
        source = {} if info is None else {"source": msgspec.to_builtins(info)}
        return source if stream is None else source | calibration(stream.context)

    # Changes.

    def _set_view(self, args: SetView | SetPose, command: Command) -> Outcome:
        live, traits = self._live, self._transitions.traits
        if traits is None:
            raise RequestError("the model says which views there can be: configure first", Code.NOT_READY)
        if args.view not in live.known_views:
            raise _unknown(args.view, live.known_views)
        self._require_revision(args.view, command.if_view_rev)
        if args.view in live.canonical:
            message = (
                f"{args.view} is canonical: align_view lets it follow its camera; another pose is the launch file's"
            )
            raise RequestError(message, Code.BAD_ARG)
        view = args.to_config()
        result: dict[str, object] = {"view": args.view}
        if view.pose is not None:
            result["rotation_error_deg"] = 0.0
            if not traits.takes_any_pose:
                delta, rotation_error_deg = self._fitted(pose_matrix(view.pose), traits)
                result["rotation_error_deg"] = round(rotation_error_deg, 4)
                view = ViewConfig(
                    azimuth_deg=delta.azimuth_deg,
                    elevation_deg=delta.elevation_deg,
                    radius=delta.radius_m,
                )
        self._check_view(args.view, view, traits)
        result["goal"] = view.plain
        if command.dry_run:
            return Outcome(message="it would be set", result=result)
        result["view_rev"] = live.set_view(args.view, view)
        self._after_change("VIEW_SET", result)
        return Outcome(result=result)

    def _align_view(self, args: AlignView, command: Command) -> Outcome:
        view, stream = self._live.config.view.get(args.view), self._transitions.stream
        if view is None or view.kind != "canonical":
            raise _unknown(args.view, tuple(k for k, v in self._live.config.view.items() if v.kind == "canonical"))
        self._require_revision(args.view, command.if_view_rev)
        if stream is None or stream.drift is None or stream.drift.is_over:
            message = "the camera is looked at while the node is active, in realtime: activate first"
            raise RequestError(message, Code.NOT_READY)
        if command.dry_run:
            return Outcome(message="it would be asked for")
        stream.drift.request(args.view)
        return Outcome(code=Code.ACCEPTED, message="an event tells when it has")

    def _remove_view(self, args: RemoveView, command: Command) -> Outcome:
        views = self._live.settings().revisions
        if args.view not in views:
            raise _unknown(args.view, tuple(views))
        self._require_revision(args.view, command.if_view_rev)
        if len(views) == 1:
            raise RequestError(f"{args.view} is the last view; deactivate the node instead", Code.BAD_ARG)
        result: dict[str, object] = {"view": args.view, "view_rev": views[args.view]}
        if not command.dry_run:
            self._live.remove_view(args.view)
            self._after_change("VIEW_REMOVED", result)
        return Outcome(result=result)

    def _set_param(self, args: SetParam, *, dry_run: bool) -> Outcome:
        stated: dict[str, object] = msgspec.to_builtins(args)
        if "publish" in stated:
            stated["encoding"] = stated.pop("publish")
        sending = {name: value for name, value in stated.items() if name in ("encoding", "jpeg_quality")}
        drawing = {name: value for name, value in stated.items() if name not in sending}
        config = self._live.config
        model, publish = replace(config.model, **drawing), replace(config.publish, **sending)
        if not dry_run:
            self._live.change(model, publish)
            self._after_change("PARAM_SET", stated)
        return Outcome(result=stated)

    def _record(self, *, begin: bool, dry_run: bool) -> Outcome:
        """Begin to record, or to end that; an event tells how it went."""
        if begin and not self._recorder.available:
            message = "there is nowhere to record to: state folder in [record] of the launch file"
            return Outcome(code=Code.NOT_READY, message=message)
        if self._recorder.busy == begin:
            message = "a recording is under way: stop it first" if begin else "nothing is being recorded"
            return Outcome(code=Code.WRONG_STATE, message=message)
        if dry_run:
            return Outcome(message="it would be done")
        _ = self._recorder.start() if begin else self._recorder.stop()
        return Outcome(code=Code.ACCEPTED, message="an event tells when it has")

    def _after_change(self, code: str, fields: dict[str, object]) -> None:
        stream = self._transitions.stream
        if stream is not None:
            stream.notice_change()
        self._announcer.event(code, Level.OK, fields)

    # Checks.

    def _require_revision(self, view_id: str, revision: int | None) -> None:
        now = self._live.revision(view_id)
        if revision is not None and revision != now:
            message = f"{view_id} is at revision {now}, not {revision}: another client has changed it"
            raise RequestError(message, Code.WRONG_STATE, result={"view_rev": now})

    def _fitted(self, numbers: tuple[float, ...], traits: Traits) -> tuple[SphericalDelta, float]:
        """The differences that a rigid goal pose comes to, and the degrees they miss it by. Raises RequestError."""
        if traits.config.camera == "none":
            raise RequestError(f"{traits.name} has one fixed view and takes no poses", Code.VIEW_FIXED)
        pose = torch.tensor(numbers, dtype=torch.float64).reshape(4, 4)
        try:
            delta, by_deg = nearest_delta(pose, stated_sphere(self._live.config.source.pose) or Traits.ASSUMED_SOURCE)
        except ModelError as error:
            raise RequestError(f"the pose: {error}", Code.BAD_ARG) from error
        if by_deg > _TOLERATED_DEG:
            raise RequestError(
                f"a view looks at the centre of the scene: the nearest one is turned by {by_deg:.1f} "
                f"degrees from the pose, allowed are {_TOLERATED_DEG:g}; aim it there, or give angles and radius",
                Code.OUT_OF_RANGE,
                result={"allowed": {"rotation_error_deg": [0.0, _TOLERATED_DEG]}},
            )
        return delta, by_deg

    def _check_view(self, view_id: str, view: ViewConfig, traits: Traits) -> None:
        """Raises RequestError if the checkpoint cannot give it."""
        config, stream = self._live.config, self._transitions.stream
        mount = None if stream is None else stream.context.mount
        try:
            VirtualView(view_id, replace(config, view={**config.view, view_id: view}), traits, mount)
        except ViewFixedError as error:
            raise RequestError(str(error), Code.VIEW_FIXED) from error
        except ViewRangeError as error:
            raise RequestError(str(error), Code.OUT_OF_RANGE, result={"allowed": _intervals(error.allowed)}) from error
        except ModelError as error:
            raise RequestError(str(error), Code.BAD_ARG) from error


def _unknown(view_id: str, known: tuple[str, ...]) -> RequestError:
    message = f"there is no view {view_id}; there are {', '.join(known)}"
    return RequestError(message, Code.UNKNOWN_VIEW, result={"views": list(known)})


def _intervals(allowed: dict[str, tuple[float, float]]) -> dict[str, object]:
    """By the names a command uses."""
    return {name.removesuffix("_m"): list(interval) for name, interval in allowed.items()}
