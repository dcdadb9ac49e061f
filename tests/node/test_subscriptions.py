"""How many read what, counted from what ZeroMQ says of subscriptions."""

from collections import Counter

from hypothesis import given
from hypothesis import strategies as st

from gcd_node.envelope import topic_key
from gcd_node.publishing.subscriptions import Readers, Subscriptions

TOPICS = [b"", b"src/", topic_key("src/frm"), b"view/", topic_key("view/a/win")]


@given(st.lists(st.tuples(st.booleans(), st.sampled_from(TOPICS))))
def test_readers_are_counted_as_if_all_were_looked_at_each_time(events: list[tuple[bool, bytes]]) -> None:
    counted, there = Subscriptions(), Counter[bytes]()
    for comes, topic in events:
        counted.hear(bytes([comes]) + topic)
        there[topic] = max(0, there[topic] + (1 if comes else -1))
    previews = {topic: count for topic, count in there.items() if topic_key("src/frm").startswith(topic)}
    every = sum(previews.values())
    assert counted.now == Readers(total=there.total(), previews=every, previews_alone=every - previews.get(b"", 0))
