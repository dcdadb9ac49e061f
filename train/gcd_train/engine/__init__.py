"""What a training run stands on: processes, sharing of weights, memory savers, optimisers, states on disk."""
