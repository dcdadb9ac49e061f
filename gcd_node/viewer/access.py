"""Who may load the page, open its feed, and command the node. Pure: headers in, a refusal or none out.

Loopback alone is no protection: every page of the web that is open in a browser of this machine can send requests
there. So the Host header must name this machine (a foreign name that was made to point here does not), and a feed is
opened only for the page that was served under that very Host (Origin). Whoever commands must know the token.
"""

import ipaddress
import re
import secrets
from dataclasses import dataclass, field

from gcd_node.errors import ConfigError
from gcd_node.security.keys import Role

_HOST = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:[0-9]{1,5})?")
_TUNNEL = "from elsewhere use a tunnel: ssh -L 8470:127.0.0.1:8470 ROBOT, then open http://127.0.0.1:8470 there"


@dataclass(frozen=True, kw_only=True, slots=True)
class Refusal:
    """A request that is turned down. status: of HTTP. reason: for people."""

    status: int
    reason: str


@dataclass(frozen=True, kw_only=True, slots=True)
class Access:
    """token: what makes an operator of a viewer; new with every start, and in no repr."""

    token: str = field(default_factory=lambda: secrets.token_urlsafe(24), repr=False)

    def role(self, given: str | None) -> Role:
        """Of who gives this token, or none. Takes as long for a wrong one as for the right one."""
        right = secrets.compare_digest((given or "").encode(errors="replace"), self.token.encode())
        return "operator" if right else "viewer"

    def refusal(self, hosts: list[str], origins: list[str], *, feed: bool) -> Refusal | None:
        """Why a request is turned down; None if it is not.

        Args:
            hosts, origins: all Host and Origin headers there are. feed: it asks for the feed, not for a file.
        """
        if len(hosts) != 1 or not _HOST.fullmatch(hosts[0]):
            return Refusal(status=403, reason=f"this page is for browsers of this machine alone; {_TUNNEL}")
        if not origins and not feed:
            return None
        if origins != [f"http://{hosts[0]}"]:
            return Refusal(status=403, reason="only the page served here may open its feed; load it from this address")
        return None


def security_headers(host: str) -> dict[str, str]:
    """What every answer tells the browser: nothing from elsewhere, nothing inline, no frame around it.

    host: the Host header, already looked at.
    """
    policy = (
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "img-src 'self' data:",
        f"connect-src 'self' ws://{host}",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
        "require-trusted-types-for 'script'",
    )
    return {
        "Content-Security-Policy": "; ".join(policy),
        "X-Content-Type-Options": "nosniff",
        "X-Frame-Options": "DENY",
        "Referrer-Policy": "no-referrer",
        "Cross-Origin-Opener-Policy": "same-origin",
        "Cross-Origin-Resource-Policy": "same-origin",
        "Cache-Control": "no-store",
    }


def viewer_address(address: str) -> tuple[str, int]:
    """Host, without brackets, and port of an address on this machine.

    Raises:
        ConfigError: it has no port, or other machines could reach it.
    """
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise ConfigError(f'[viewer] http must be "127.0.0.1:PORT", got {address!r}')
    host = "127.0.0.1" if host == "localhost" else host.strip("[]")
    if host not in ("127.0.0.1", "::1"):
        raise ConfigError(
            f'[viewer] http = "{address}" {_beyond(host)}, and whoever loads the page sees what the camera sees: '
            f'use "127.0.0.1:{port}"; {_TUNNEL}'
        )
    return host, int(port)


def _beyond(host: str) -> str:
    try:
        inside = ipaddress.ip_address(host).is_loopback
    except ValueError:
        inside = False
    return "is no address that browsers are let in under" if inside else "can be reached from other machines"
