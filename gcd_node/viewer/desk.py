"""Carries a browser's commands to the node's control socket, if the browser may."""

from typing import Any, Final

from gcd_node.control.client import ControlClient
from gcd_node.control.message import Code
from gcd_node.errors import AuthError, ControlError
from gcd_node.security.keys import Role
from gcd_node.viewer.hub import NodeEndpoints
from gcd_node.viewer.messages import Ask, Note, note

_LOOKING: Final = frozenset({"describe", "views"})
_STEERING: Final = frozenset({"set_view", "set_param", "get_config"})
_TIMEOUT_S = 2.0


class Desk:
    """One browser's; belongs to the thread that reads from it. Only what the page has a use for is passed on."""

    def __init__(self, node: NodeEndpoints) -> None:
        self._node = node
        self._client: ControlClient | None = None

    def carry_out(self, ask: Ask, role: Role) -> Note:
        """The reply, a refusal too."""
        try:
            self._check(ask.verb, role)
            reply = self._reached().request(ask.verb, ask.args)
        except (ControlError, AuthError) as error:
            code = error.code if isinstance(error, ControlError) else Code.FORBIDDEN
            self._drop(error)
            return _reply(ask, ok=False, code=code or "NO_ANSWER", message=str(error), result=None)
        return _reply(ask, ok=reply.ok, code=reply.code, message=reply.message, result=reply.result)

    def close(self) -> None:
        """Let go of the control socket."""
        if self._client is not None:
            self._client.close()
            self._client = None

    def _check(self, verb: str, role: Role) -> None:
        """Raises ControlError."""
        if verb in _STEERING and role != "operator":
            raise ControlError(
                "you are looking, not steering: open the address that the node printed, with its #token=...",
                Code.FORBIDDEN,
            )
        if verb not in _LOOKING | _STEERING:
            known = ", ".join(sorted(_LOOKING | _STEERING))
            raise ControlError(f"a page asks for {known}, not for {verb!r}; use `gcd-node ctl`", Code.FORBIDDEN)

    def _reached(self) -> ControlClient:
        endpoint = self._node.control
        if endpoint is None:
            raise ControlError("this node takes no commands: it has no [control] endpoint", Code.FORBIDDEN)
        if self._client is None:
            keys = self._node.keys_for(endpoint)
            self._client = ControlClient(endpoint, keys=keys, timeout_s=_TIMEOUT_S, attempts=1)
        return self._client

    def _drop(self, error: Exception) -> None:
        """After a refusal of the handshake a client is of no more use."""
        if isinstance(error, AuthError):
            self.close()


def _reply(ask: Ask, *, ok: bool, code: str, message: str, result: dict[str, Any] | None) -> Note:
    return note("reply", {"id": ask.id, "verb": ask.verb, "ok": ok, "code": code, "message": message, "result": result})
