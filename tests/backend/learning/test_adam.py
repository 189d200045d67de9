"""Adam compared with its formula; modules that it must not load."""

import sys

import numpy as np
import torch

from touchdown.backend.learning.training import Adam, use_one_thread

RATE = 0.01


def by_formula(weight: np.ndarray, gradients: list[np.ndarray]) -> np.ndarray:
    """Algorithm 1 of arXiv 1412.6980 in float64, with its own constants."""
    mean, square = np.zeros_like(weight), np.zeros_like(weight)
    for t, gradient in enumerate(gradients, 1):
        mean = 0.9 * mean + 0.1 * gradient
        square = 0.999 * square + 0.001 * gradient**2
        step = (mean / (1 - 0.9**t)) / (np.sqrt(square / (1 - 0.999**t)) + 1e-8)
        weight = weight - RATE * step
    return weight


def test_steps_follow_the_formula_and_go_on_from_kept_moments() -> None:
    rng = np.random.default_rng(2)
    start, gradients = rng.normal(size=(3, 4)), [rng.normal(size=(3, 4)) for _ in range(6)]
    parameter = torch.nn.Parameter(torch.tensor(start, dtype=torch.float32))
    optimiser = Adam([parameter], RATE)
    for number, gradient in enumerate(gradients):
        if number == 3:
            again = Adam([parameter], RATE)
            again.take_up(optimiser.moments)
            optimiser = again
        parameter.grad = torch.tensor(gradient, dtype=torch.float32)
        optimiser.step()
        optimiser.zero_grad()
        assert parameter.grad is None
    reached = parameter.detach().numpy()
    np.testing.assert_allclose(reached, by_formula(start, gradients), rtol=0, atol=2e-6)


def test_a_training_does_not_load_the_compiler_of_torch() -> None:
    """Loading it takes as long as loading torch, at the start of every training."""
    use_one_thread()
    assert torch.are_deterministic_algorithms_enabled()
    assert not torch.is_deterministic_algorithms_warn_only_enabled()
    parameter = torch.nn.Parameter(torch.ones(2))
    optimiser = Adam([parameter], RATE)
    parameter.sum().backward()
    optimiser.step()
    assert "torch._dynamo" not in sys.modules
