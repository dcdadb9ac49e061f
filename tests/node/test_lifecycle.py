from itertools import product
from typing import get_args

import pytest

from gcd_node.lifecycle import PATHS, Lifecycle, State, Verb

VERBS: tuple[Verb, ...] = get_args(Verb)
SETTLED = [state for state in State if state.settled]


@pytest.mark.parametrize(("verb", "state"), list(product(VERBS, SETTLED)))
def test_a_transition_begins_where_it_may_and_alone_or_changes_nothing(verb: Verb, state: State) -> None:
    life = Lifecycle()
    assert life.state is State.UNCONFIGURED
    life.state = state
    allowed, passing, goal = PATHS[verb]
    assert goal in SETTLED
    if state not in allowed:
        assert life.begin(verb)
        assert life.state is state
        return
    assert life.begin(verb) is None
    assert all(life.begin(each) for each in VERBS)
    assert life.state is passing
    assert passing not in SETTLED
