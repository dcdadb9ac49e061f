from itertools import product
from typing import get_args

import pytest

from gcd_node.lifecycle import PATHS, Lifecycle, State, Verb

VERBS: tuple[Verb, ...] = get_args(Verb)
WAYS: dict[State, tuple[Verb, ...]] = {
    State.UNCONFIGURED: (),
    State.INACTIVE: ("configure",),
    State.ACTIVE: ("configure", "activate"),
    State.FINALIZED: ("shutdown",),
}


def at(state: State) -> Lifecycle:
    life = Lifecycle()
    for verb in WAYS[state]:
        life.begin(verb)
        life.succeed()
    assert life.state is state
    return life


@pytest.mark.parametrize(("verb", "state"), list(product(VERBS, WAYS)))
def test_a_transition_leads_where_it_should_or_changes_nothing(verb: Verb, state: State) -> None:
    life = at(state)
    allowed, passing, goal = PATHS[verb]
    if state not in allowed:
        assert life.begin(verb)
        assert life.state is state
        return
    for end, leads_to in ((life.fail, state), (life.succeed, goal)):
        assert life.begin(verb) is None
        assert all(life.begin(each) for each in VERBS)  # one at a time
        assert life.state is passing
        end()
        assert life.state is leads_to


@pytest.mark.parametrize(("verb", "goal"), [("activate", State.UNCONFIGURED), ("shutdown", State.FINALIZED)])
def test_after_an_error_the_node_begins_anew_or_is_finished(verb: Verb, goal: State) -> None:
    life = at(State.INACTIVE)
    life.begin(verb)
    life.error()
    assert life.state is State.ERRORPROCESSING
    assert all(life.refusal(each) for each in VERBS)
    life.recover()
    assert life.state is goal
