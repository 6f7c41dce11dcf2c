"""Vectors of any space, scaled to length one without a number lost on the way."""

from __future__ import annotations

import torch
from torch import Tensor


def unit_vectors(vectors: Tensor) -> Tensor:
    """Vectors scaled to length one; 0 stays 0 and passes no gradient.

    vectors: [..., D], any length that its dtype can hold. Returns the same shape.
    """
    # Scaled by the largest component first, so that squares neither vanish nor overflow; the result
    # does not depend on that scale, so it may be a constant for the gradient.
    largest = vectors.detach().abs().amax(dim=-1, keepdim=True)
    is_zero = largest == 0.0
    # The branch that `where` drops must not divide by zero either: its NaN gradient would stay.
    scaled = torch.where(is_zero, 1.0, vectors / torch.where(is_zero, 1.0, largest))
    return torch.where(is_zero, 0.0, scaled / scaled.square().sum(dim=-1, keepdim=True).sqrt())
