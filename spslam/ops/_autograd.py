"""What the gradients of all ops share."""

import torch


def forbid_second_derivatives(op: str) -> None:
    """Makes differentiating `<op>_backward` an error: without this its result would silently count as a constant."""

    def backward(ctx, *grads):
        raise NotImplementedError(f"{op}: second derivatives are not supported")

    torch.library.register_autograd(f"spslam::{op}_backward", backward)
