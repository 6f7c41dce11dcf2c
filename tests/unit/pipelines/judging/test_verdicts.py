"""The verdict: jobs that were good stay silent, jobs that were bad are told what to do."""

from __future__ import annotations

import pytest

from pipelines.judging.verdicts import Limits, geometry_warning, model_warning
from pipelines.options import AssessOptions

DEFAULTS = AssessOptions()
LIMITS = Limits(DEFAULTS.min_coverage, DEFAULTS.max_depth_inconsistency)


@pytest.mark.parametrize(
    ("coverage", "inconsistency"), [(0.70, 0.005), (0.98, 0.0005), (0.91, 0.03), (0.66, 0.019)]
)
def test_jobs_whose_surfaces_held_together_pass(coverage: float, inconsistency: float) -> None:
    assert geometry_warning(coverage, inconsistency, LIMITS) is None


@pytest.mark.parametrize(
    ("coverage", "inconsistency"),
    [(0.20, 0.10), (0.15, 0.16), (0.38, 0.036), (0.27, None), (0.41, 0.071), (None, 0.29)],
)
def test_jobs_whose_surfaces_fell_apart_are_warned_of(
    coverage: float | None, inconsistency: float | None
) -> None:
    warning = geometry_warning(coverage, inconsistency, LIMITS)
    assert warning is not None
    assert warning["code"] == "geometry_poor"
    assert warning["hint"]
    assert ("covers" in warning["message"]) == (coverage is not None and coverage < 0.5)
    assert ("see through" in warning["message"]) == (
        inconsistency is not None and inconsistency > 0.05
    )


def test_what_was_not_measured_is_no_reason_to_warn() -> None:
    assert geometry_warning(None, None, LIMITS) is None


@pytest.mark.parametrize("psnr", [18.8, 20.3, 25.4, None])
def test_models_that_came_out_pass(psnr: float | None) -> None:
    assert model_warning(psnr, DEFAULTS.min_psnr) is None


@pytest.mark.parametrize("psnr", [11.8, 12.6, 17.0])
def test_models_that_did_not_come_out_are_warned_of(psnr: float) -> None:
    """Two that were folded, and one of white in front of every camera: surfaces held together."""
    warning = model_warning(psnr, DEFAULTS.min_psnr)
    assert warning is not None
    assert warning["code"] == "model_poor"
    assert f"{psnr:.1f} dB" in warning["message"]
