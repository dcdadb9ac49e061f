"""The configuration in force: the launch file, and what commands have changed since."""

import threading
from collections.abc import Mapping
from dataclasses import dataclass

from msgspec.structs import replace

from gcd_node.config import ModelSection, NodeConfig, PublishConfig, ViewConfig


@dataclass(frozen=True, kw_only=True, slots=True)
class Settings:
    """The configuration at one moment. revisions: of every view in it; each change of a view raises its own."""

    config: NodeConfig
    revisions: Mapping[str, int]


class LiveConfig:
    """Holds the configuration between the control thread that changes it and the model thread that follows it.

    Nothing is checked here. A view that was removed may come back, and its revision goes on from where it was:
    receivers drop older ones.
    """

    def __init__(self, config: NodeConfig) -> None:
        self._lock = threading.Lock()
        self._config = config
        self._revisions = dict.fromkeys(config.view, 1)
        self._removed: list[tuple[str, int]] = []

    @property
    def config(self) -> NodeConfig:
        """In force now."""
        with self._lock:
            return self._config

    @property
    def known_views(self) -> tuple[str, ...]:
        """Every view there is or has been."""
        with self._lock:
            return tuple(self._revisions)

    def settings(self) -> Settings:
        """In force now, with the revisions of its views."""
        with self._lock:
            return Settings(
                config=self._config, revisions={view_id: self._revisions[view_id] for view_id in self._config.view}
            )

    def revision(self, view_id: str) -> int:
        """Of a view there is or has been; 0 for others."""
        with self._lock:
            return self._revisions.get(view_id, 0)

    def set_view(self, view_id: str, view: ViewConfig) -> int:
        """Replace or add a view; gives its new revision."""
        with self._lock:
            self._revisions[view_id] = self._revisions.get(view_id, 0) + 1
            self._config = replace(self._config, view={**self._config.view, view_id: view})
            self._removed = [each for each in self._removed if each[0] != view_id]
            return self._revisions[view_id]

    def remove_view(self, view_id: str) -> None:
        """Take a view out. Raises KeyError if it is not in."""
        with self._lock:
            left = dict(self._config.view)
            del left[view_id]
            self._config = replace(self._config, view=left)
            self._removed.append((view_id, self._revisions[view_id]))

    def change(self, model: ModelSection, publish: PublishConfig) -> None:
        """Replace how views are drawn and how they are sent."""
        with self._lock:
            self._config = replace(self._config, model=model, publish=publish)

    def take_removed(self) -> list[tuple[str, int]]:
        """Views removed since the last call, with their last revision: their end is yet to be announced."""
        with self._lock:
            removed, self._removed = self._removed, []
            return removed
