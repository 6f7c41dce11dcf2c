"""Samples as volumes: the Gaussian that stands for a piece of the cone behind a pixel.

Symbols: R rays, S intervals per ray; `t` distance along a unit ray d (scene units); an interval's
middle mu and half width h; r the radius of the pixel's cone at distance 1, so r t at distance t;
Sigma a covariance (scene units squared). A frustum is the part of the cone inside an interval.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Gaussians:
    """Normal distributions in space.

    mean: [..., 3]. covariance: [..., 3, 3], symmetric; units of the mean, squared.
    """

    mean: Tensor
    covariance: Tensor


def cone_radius(pixel_area: Tensor) -> Tensor:
    """Radius at distance 1 of the cone with a pixel's solid angle; same shape.

    pixel_area: [...], steradian, > 0. r = sqrt(area / pi): the disc that covers as much as the
    pixel, for pixels far smaller than a radian.
    """
    return (pixel_area / math.pi).sqrt()


def frustum_gaussians(
    origins: Tensor, directions: Tensor, t_edges: Tensor, radius: Tensor
) -> Gaussians:
    """Mean and covariance of points spread evenly over each frustum.

    origins: [R, 3], scene units. directions: [R, 3], unit vectors.
    t_edges: [R, S + 1], >= 0 and increasing, scene units. radius: [R], of the cone at distance 1.
    Returns mean [R, S, 3] and covariance [R, S, 3, 3]. A frustum of no length is a disc, a cone of
    no radius a line; both at once are the point itself.
    Source: Mip-NeRF, arXiv:2103.13415, eqs. 7 and 8 (their stable form in mu and h).
    """
    start, end = t_edges[..., :-1], t_edges[..., 1:]
    mu, h = 0.5 * (start + end), 0.5 * (end - start)
    h2, mu2 = h * h, mu * mu
    # q = h^2 / (3 mu^2 + h^2) in [0, 1]; the guard is for an interval of no length at t = 0.
    q = h2 / (3.0 * mu2 + h2).clamp_min(torch.finfo(mu.dtype).tiny)
    t_mean = mu + 2.0 * mu * q
    # h^2 / 3 - 4/15 q^2 (12 mu^2 - h^2), with mu^2 q = (h^2 - h^2 q) / 3 put in: no difference of
    # large numbers is left, so that it cannot turn negative far out.
    t_variance = h2 * (1.0 / 3.0 - (4.0 / 15.0) * q * (4.0 - 5.0 * q))
    r_variance = radius[..., None].square() * (0.25 * mu2 + h2 * (5.0 / 12.0 - (4.0 / 15.0) * q))
    mean = torch.addcmul(origins[..., None, :], directions[..., None, :], t_mean[..., None])
    along = (directions[..., :, None] * directions[..., None, :])[..., None, :, :]
    identity = torch.eye(3, dtype=along.dtype, device=along.device)
    covariance = torch.addcmul(
        r_variance[..., None, None] * identity,
        (t_variance - r_variance)[..., None, None],
        along,
    )
    return Gaussians(mean=mean, covariance=covariance)
