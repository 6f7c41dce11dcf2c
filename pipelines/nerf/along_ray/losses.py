"""What training minimises.

Symbols: R rays; final histogram (s, w) with S intervals; a proposal's histogram (s^, w^) with S^
intervals; both in s-space, [0, 1]. d the direction of a ray, from the camera into the scene.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pipelines.nerf.along_ray.intervals import bin_midpoints

INTERLEVEL_EPS = 1e-7
TERMINATION_FLOOR = 0.01
"""Light that ends at the known depth by chance: bounds what one wrong depth can ask for."""
_LEAST_AHEAD, _LEAST_LIGHT, _LEAST_DISPARITY = 0.1, 1e-6, 1e-6
"""Rays of a fisheye at 84 degrees to its axis, or more, have no place in a plane picture; the
others keep a division by nothing from being one."""


def color_loss(predicted: Tensor, truth: Tensor) -> Tensor:
    """Mean squared error of colours [R, 3] in [0, 1]; a scalar."""
    return torch.nn.functional.mse_loss(predicted, truth)


def outer_measure(s_edges: Tensor, proposal_edges: Tensor, proposal_weights: Tensor) -> Tensor:
    """Proposal weight in all proposal intervals that overlap each final interval.

    s_edges: [R, S + 1]; proposal_edges: [R, S^ + 1]; proposal_weights: [R, S^]. Returns [R, S].
    Source: Mip-NeRF 360, arXiv:2111.12077, eq. 12.
    """
    total = torch.cumsum(proposal_weights, dim=-1)
    total = torch.cat([torch.zeros_like(total[..., :1]), total], dim=-1)
    last = proposal_weights.shape[-1] - 1
    with torch.no_grad():
        proposal_edges = proposal_edges.contiguous()
        low_edges, high_edges = s_edges[..., :-1].contiguous(), s_edges[..., 1:].contiguous()
        first_bin = torch.searchsorted(proposal_edges, low_edges, right=True) - 1
        end_bin = torch.searchsorted(proposal_edges[..., 1:].contiguous(), high_edges, right=True)
        first_bin, end_bin = first_bin.clamp_(0, last), end_bin.clamp_(0, last)
    return total.gather(-1, end_bin + 1) - total.gather(-1, first_bin)


def interlevel_loss(
    s_edges: Tensor,
    weights: Tensor,
    proposals: Sequence[tuple[Tensor, Tensor]],
) -> Tensor:
    """Penalty where a proposal does not cover the final weights; trains the proposals alone.

    s_edges: [R, S + 1]; weights: [R, S], both taken as constants.
    proposals: (edges [R, S^ + 1], weights [R, S^]) of each round.
    Returns the sum over rounds of mean(max(0, w - W)^2 / (w + 1e-7)), W by `outer_measure`.
    Source: Mip-NeRF 360, arXiv:2111.12077, eq. 13.
    """
    target = weights.detach()
    losses = []
    for proposal_edges, proposal_weights in proposals:
        cover = outer_measure(s_edges, proposal_edges, proposal_weights)
        excess = (target - cover).clamp_min(0.0)
        losses.append((excess.square() / (target + INTERLEVEL_EPS)).mean())
    return torch.stack(losses).sum()


def distortion_loss(s_edges: Tensor, weights: Tensor) -> Tensor:
    """Spread of the weights along the ray, mean over rays; a scalar.

    sum_ij w_i w_j |m_i - m_j| + (1/3) sum_i w_i^2 (s_{i+1} - s_i), m the midpoints. The double sum
    is 2 sum_i w_i (m_i sum_{j<i} w_j - sum_{j<i} w_j m_j), which takes one pass instead of S^2.
    s_edges: [R, S + 1], weights: [R, S]. Source: Mip-NeRF 360, arXiv:2111.12077, eq. 15.
    """
    middles = bin_midpoints(s_edges)
    moments = weights * middles
    weight_before = torch.cumsum(weights, dim=-1) - weights
    moment_before = torch.cumsum(moments, dim=-1) - moments
    between = 2.0 * (moments * weight_before - weights * moment_before).sum(dim=-1)
    within = (weights.square() * (s_edges[..., 1:] - s_edges[..., :-1])).sum(dim=-1) / 3.0
    return (between + within).mean()


def termination_loss(
    weights: Tensor, t_edges: Tensor, distances: Tensor, spread: float | Tensor
) -> Tensor:
    """Penalty on light that does not end where the surface is known to be; a scalar.

    -log(sum_i w_i exp(-((m_i - D) / (s D))^2 / 2) + 0.01), mean over the rays with a known distance
    D, m the midpoints: a surface there is wanted, and nothing is said of rays without one. Where D
    is infinite there is no surface, and the light that goes through is asked for: 1 - sum_i w_i.
    weights: [R, S]. t_edges: [R, S + 1], scene units. distances: [R], scene units, 0 where unknown,
    infinite where nothing stands. spread: s, relative to D; a tensor where a captured step has to
    see it change.
    After DS-NeRF, arXiv:2107.02791, eq. 7, whose sum of logarithms over samples no ray can fulfil
    with all of them; here the ray's whole light is asked for.
    """
    known, void = distances > 0.0, torch.isinf(distances)
    safe = torch.where(known & ~void, distances, 1.0)[:, None]
    off = (bin_midpoints(t_edges) - safe) / (safe * spread)
    near = (weights * torch.exp(-0.5 * off.square())).sum(dim=-1)
    wanted = torch.where(void, 1.0 - weights.sum(dim=-1), near)
    penalty = torch.where(known, -torch.log(wanted + TERMINATION_FLOOR), 0.0)
    return penalty.sum() / known.sum().clamp_min(1)


def bend_loss(
    weights: Tensor, t_edges: Tensor, local: Tensor, plain: Tensor, curve: float, limit: float
) -> Tensor:
    """Penalty on bumps of plain surfaces, by lines of four rays in one picture; a scalar.

    (1/L) sum_l p_l o_l (h(3 (r_1 - r_2)) + c h(r_1 + r_2)) over L lines, where r_1 and r_2 are how
    far the disparities of the inner rays are from the straight line between those of the ends,
    relative to these: what bends evenly has no first term, what is plane none at all. A ray's
    disparity is the mean of 1 / z over the light that ends on it, (sum_i w_i / z_i) / sum_i w_i,
    which on a plane is linear in the picture. o is how much light ends on the least of a line's
    rays, taken as a constant: what lets all light through is no surface yet, and to let it through
    is no way to be even. h(b) = b^2 / (2 limit) / (1 + b^2 / (2 limit)^2) lets go of what bends by
    many limits, which is an edge.
    weights: [4 L, S], of the rays at each place along the lines together, in their order. t_edges:
    [4 L, S + 1], scene units. local: [4 L, 3], unit, the rays in the camera's axes (it looks along
    -Z). plain: [L] in [0, 1]. curve: c.
    The smoothness that RegNeRF (arXiv:2112.00724, eq. 3) asks of depth, here of disparity, along
    lines where the picture is plain; surfaces that bend evenly after Moreton and Sequin, SIGGRAPH
    1992.
    """
    ahead = -local[:, 2]
    usable = ahead > _LEAST_AHEAD
    safe = torch.where(usable, ahead, 1.0)[:, None]
    light = weights.sum(dim=-1)
    disparity = (weights / bin_midpoints(t_edges)).sum(dim=-1) / light.clamp_min(_LEAST_LIGHT)
    disparity = disparity / safe[:, 0]
    ended = torch.stack(light.detach().chunk(4)).amin(dim=0)
    start, first, second, end = disparity.chunk(4)
    origin, *inner, far = (local[:, :2] / safe).chunk(4)
    along = far - origin
    length = along.square().sum(dim=-1)
    is_line = length > 0.0

    def beside(found: Tensor, place: Tensor) -> Tensor:
        share = ((place - origin) * along).sum(dim=-1) / torch.where(is_line, length, 1.0)
        return found - (1.0 - share) * start - share * end

    unit = (0.5 * (start + end)).detach().clamp_min(_LEAST_DISPARITY)
    one, two = beside(first, inner[0]) / unit, beside(second, inner[1]) / unit
    penalty = _forgiving(3.0 * (one - two), limit) + curve * _forgiving(one + two, limit)
    counts = is_line & torch.stack(usable.chunk(4)).all(dim=0)
    return torch.where(counts, plain * ended * penalty, 0.0).mean()


def _forgiving(off: Tensor, limit: float) -> Tensor:
    """Geman and McClure's function: a square for what is small, a constant for what is large."""
    square = off.square()
    return 0.5 * square / limit / (1.0 + 0.25 * square / limit**2)


def orientation_loss(weights: Tensor, normals: Tensor, directions: Tensor) -> Tensor:
    """Penalty on visible normals that face away from the camera; a scalar.

    Mean over rays of sum_i w_i min(0, n_i . (-d))^2, which is w_i max(0, n_i . d)^2.
    weights: [R, S], taken as constants: density is not to vanish where its normal is wrong.
    normals: [R, S, 3], unit, scene axes; what the loss trains. Normals of the density need
        `create_graph` for that: the reference implementation leaves it out, so that there the loss
        is computed but moves nothing.
    directions: [R, 3], unit, scene axes.
    Source: Ref-NeRF, arXiv:2112.03907, eq. 11.
    """
    facing = (normals * -directions[..., None, :]).sum(dim=-1)
    return (weights.detach() * facing.clamp_max(0.0).square()).sum(dim=-1).mean()


def predicted_normal_loss(weights: Tensor, normals: Tensor, predicted: Tensor) -> Tensor:
    """How far predicted normals are from those of the density; trains what predicted them.

    Mean over rays of sum_i w_i (1 - n_i . n^_i), half of Ref-NeRF's w_i |n_i - n^_i|^2 where both
    have length one. weights: [R, S] and normals: [R, S, 3], unit, both taken as constants;
    predicted: [R, S, 3], unit. Nothing reaches the density through its normals here, unlike in
    Ref-NeRF; the density network still learns from it where the prediction was made from its
    features, as in Nerfacto.
    Source: Ref-NeRF, arXiv:2112.03907, eq. 10; Nerfacto, arXiv:2302.04264, section 5.
    """
    agreement = (normals.detach() * predicted).sum(dim=-1)
    return (weights.detach() * (1.0 - agreement)).sum(dim=-1).mean()
