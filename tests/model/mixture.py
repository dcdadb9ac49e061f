"""A denoiser that is known exactly: of data that are a mixture of Gaussians."""

from small_models import draw
from torch import Tensor

from gcd_model.clip import SolverName
from gcd_model.config import SamplingConfig
from gcd_model.diffusion import edm_sigmas, sample, solver_steps

PUBLISHED = SamplingConfig()
CENTRES = draw(24, 32, seed=2).double()
SPREAD = 0.3
NOISE = draw(64, 32, seed=3).double()


def denoised(x: Tensor, sigma: float, centres: Tensor = CENTRES) -> Tensor:
    """The mean of what x could be without its noise. x: [N, D]. centres: [K, D], each with the deviation SPREAD."""
    variance = SPREAD**2 + sigma**2
    nearness = -((x[:, None] - centres) ** 2).sum(dim=2) / (2 * variance)
    mean = nearness.softmax(dim=1) @ centres
    return mean + SPREAD**2 / variance * (x - mean)


def followed(solver: SolverName, steps: int, sampling: SamplingConfig = PUBLISHED) -> Tensor:
    """Where the noise ends up: [64, 32]."""
    sigmas = edm_sigmas(sampling, steps)
    start = NOISE * (sigmas[0].item() ** 2 + 1) ** 0.5
    return sample(lambda x, i: denoised(x, sigmas[i].item()), start, solver_steps(solver, sigmas))


def apart(made: Tensor, reference: Tensor) -> Tensor:
    """Norm of the difference over the norm, of each sample: [N]."""
    return (made - reference).norm(dim=1) / reference.norm(dim=1)
