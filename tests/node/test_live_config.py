import pytest

from gcd_node.config import NodeConfig, ViewConfig, parse_config
from gcd_node.views import LiveConfig


def config() -> NodeConfig:
    return parse_config(b'[source]\nkind = "synthetic"\n[model]\nweights = "w"\n[view.a]\n[view.b]\n', "test")


def test_a_view_that_comes_back_goes_on_counting() -> None:
    live = LiveConfig(config())
    live.set_view("a", ViewConfig())
    live.remove_view("a")
    assert list(live.settings().revisions) == ["b"]
    assert live.known_views == ("a", "b")
    assert live.revision("a") == 2
    assert live.set_view("a", ViewConfig()) == 3
    with pytest.raises(KeyError):
        live.remove_view("c")


def test_the_end_of_a_removed_view_is_announced_once_unless_it_came_back() -> None:
    live = LiveConfig(config())
    live.remove_view("a")
    assert live.take_removed() == [("a", 1)]
    assert live.take_removed() == []
    live.set_view("a", ViewConfig())
    live.remove_view("a")
    live.set_view("a", ViewConfig())
    assert live.take_removed() == []
