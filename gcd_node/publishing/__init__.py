"""From rendered views to the publisher: order, rhythm, and what a publisher is told."""
