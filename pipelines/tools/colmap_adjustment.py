"""Bundle adjustment of a `pycolmap.Reconstruction`, in rounds between which it can be cancelled."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import pycolmap

Run = Callable[[str, Callable[[Any], Any]], Any]
"""`(what, call)`: runs `call(token)` where it can be cancelled, and returns what it returns."""


MANY_IMAGES = 100
"""Images from which an iteration takes so long that rounds have fewer of them."""
MOST_DIRECT_IMAGES = 400
"""Up to which the cameras' equations are solved at once: of 1,000 images that takes ten times as
long as by conjugate gradients, and nobody hears anything meanwhile."""


@dataclass(frozen=True)
class Rounds:
    """When an adjustment ends.

    A round of `iterations` cannot be interrupted; between two of them a cancel is noticed.
    tolerance: relative change of the cost at which all ends.
    """

    iterations: int
    rounds: int
    tolerance: float

    def of(self, num_images: int) -> Rounds:
        """As many iterations in shorter rounds, for a model of many images."""
        each = max(1, self.iterations * MANY_IMAGES // max(num_images, MANY_IMAGES))
        return Rounds(each, math.ceil(self.iterations * self.rounds / each), self.tolerance)


def share_done(rounds: int) -> float:
    """What share of adjustments to report after so many rounds: always more, never all, as nobody
    knows beforehand when they end."""
    return rounds / (rounds + 8.0)


def adjust(
    reconstruction: Any,
    ends: Rounds,
    *,
    what: str,
    run: Run,
    num_threads: int,
    refine_focal: bool = True,
    refine_principal_point: bool = False,
    refine_distortion: bool = True,
    loss_px: float = 1.0,
    priors: Sequence[Any] = (),
) -> None:
    """Adjust poses, points and lenses; errors beyond `loss_px` count less (soft L1).

    priors: `pycolmap.PosePrior`, where images are known to be; they hold the frame then, instead of
    two of the images.
    """
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = refine_focal
    options.refine_principal_point = refine_principal_point
    options.refine_extra_params = refine_distortion
    options.ceres.loss_function_scale = loss_px
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.max_num_images_direct_sparse_cpu_solver = MOST_DIRECT_IMAGES
    options.ceres.solver_options.num_threads = num_threads
    ends = ends.of(reconstruction.num_reg_images())
    options.ceres.solver_options.max_num_iterations = ends.iterations
    options.ceres.solver_options.function_tolerance = ends.tolerance
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in reconstruction.reg_image_ids():
        config.add_image(image_id)
    if not priors:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    for _ in range(ends.rounds):
        if priors:
            adjuster = pycolmap.create_pose_prior_bundle_adjuster(
                options,
                pycolmap.PosePriorBundleAdjustmentOptions(),
                config,
                list(priors),
                reconstruction,
            )
        else:
            adjuster = pycolmap.create_default_bundle_adjuster(options, config, reconstruction)
        summary = run(what, functools.partial(_solve, adjuster))
        if summary.termination_type == pycolmap.BundleAdjustmentTerminationType.CONVERGENCE:
            break


def _solve(adjuster: Any, token: Any) -> Any:
    """One round; it cannot be cancelled by the token."""
    del token
    return adjuster.solve()
