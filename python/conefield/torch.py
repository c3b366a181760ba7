"""Projection and its adjoint for PyTorch's automatic differentiation. Only this module needs PyTorch.

Tensors are copied to the CPU for the work, and results to the device of the input.
"""

from __future__ import annotations

import torch

from ._operator import Operator


class Projection(torch.autograd.Function):
    """``operator @ x`` with ``operator.T @ dy`` as its gradient. It is linear, so it can be differentiated any number of times."""

    @staticmethod
    def forward(ctx, x: torch.Tensor, operator: Operator) -> torch.Tensor:
        ctx.operator = operator
        return torch.from_numpy(operator @ x.detach().cpu().numpy()).to(device=x.device, dtype=x.dtype)

    @staticmethod
    def backward(ctx, dy: torch.Tensor):
        return Projection.apply(dy, ctx.operator.T), None


def project(x: torch.Tensor, operator: Operator) -> torch.Tensor:
    """Projections of a volume, or with ``operator.T`` the back-projection of views. Differentiable."""
    return Projection.apply(x, operator)
