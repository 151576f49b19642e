"""The mean of a compiled predictor as an operation of torch."""

from typing import Any

import torch
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput


class MeanWithGradient(torch.autograd.Function):
    """The mean of a compiled predictor, whose backward pass takes the Jacobians of its linearisation."""

    @staticmethod
    @override
    def forward(ctx: Any, predictor: Any, *states: Tensor) -> Tensor:
        ctx.predictor = predictor
        ctx.save_for_backward(*states)
        return predictor.run("mean", states)[0]

    @staticmethod
    @override
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():  # create_graph=True: the gradients would pass for constants
            raise InvalidInput(
                "a compiled predictor has first derivatives only; for second ones make it with compile=False."
            )
        (_, nv, nu), space = ctx.predictor.sizes, ctx.predictor.space
        jacobian = ctx.predictor.run("linearize", ctx.saved_tensors)[1].view(-1, nv, 2 * nv + nu)
        in_q, in_v, in_u = (grad_outputs[0][:, None] @ jacobian)[:, 0].split([nv, nv, nu], dim=-1)
        return None, in_q if space.is_vector_space else space.cotangent(ctx.saved_tensors[0], in_q), in_v, in_u
