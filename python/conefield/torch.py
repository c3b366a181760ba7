"""Projection and its adjoint for PyTorch's automatic differentiation. Importing it needs PyTorch; nothing else here does.

Tensors are taken to the CPU, where the work is done, and results go back to where the input was.
"""

from __future__ import annotations

import torch

from ._operator import Operator


class Projection(torch.autograd.Function):
    """``operator @ x`` with ``operator.T @ dy`` as its gradient: linear, so that it may be differentiated any number of times."""

    @staticmethod
    def forward(ctx, x: torch.Tensor, operator: Operator) -> torch.Tensor:
        ctx.operator = operator
        return torch.from_numpy(operator @ x.detach().cpu().numpy()).to(device=x.device, dtype=x.dtype)

    @staticmethod
    def backward(ctx, dy: torch.Tensor):
        return Projection.apply(dy, ctx.operator.T), None


def project(x: torch.Tensor, operator: Operator) -> torch.Tensor:
    """The projections of a volume, or with ``operator.T`` the back-projection of views; gradients go through."""
    return Projection.apply(x, operator)
