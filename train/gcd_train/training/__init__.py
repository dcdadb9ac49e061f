"""Training: the stages of a recipe, in one process or in several, each resumable to the update."""
