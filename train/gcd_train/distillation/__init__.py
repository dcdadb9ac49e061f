"""A student of few steps without guidance, from a model that takes many: `gcd-train distill`."""
