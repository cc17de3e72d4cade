"""The engine: block-arrow least squares. Knows nothing of cameras or IMUs."""

from typing import TYPE_CHECKING, Any

from jaxcal.estimation.arrays import on_device
from jaxcal.estimation.block_arrow import (
    BlockArrow,
    BlockArrowFactor,
    band_from_windows,
    chain_from_windows,
    factorise,
    gathered_band,
    gathered_chain,
    scattered_band,
    scattered_chain,
    sum_along_chain,
)
from jaxcal.estimation.descent import FIRST_DAMPING, BlockStep, damped_step
from jaxcal.estimation.losses import LOSSES, Loss, barron, huber, robust_loss
from jaxcal.estimation.problem import BlockArrowProblem, State
from jaxcal.estimation.solver import SolveResult, solve, solve_inside
from jaxcal.estimation.threads import single_threaded_blas
from jaxcal.imports import attribute_of

if TYPE_CHECKING:
    from jaxcal.estimation.adjoint import GaussNewtonAdjoint
    from jaxcal.estimation.levenberg_marquardt import BlockArrowDescent, BlockArrowLevenbergMarquardt

# name -> module that defines it; imported when first asked for, since optimistix comes with them.
_LATER = {
    "BlockArrowDescent": "jaxcal.estimation.levenberg_marquardt",
    "BlockArrowLevenbergMarquardt": "jaxcal.estimation.levenberg_marquardt",
    "GaussNewtonAdjoint": "jaxcal.estimation.adjoint",
}

__all__ = [
    "FIRST_DAMPING",
    "LOSSES",
    "BlockArrow",
    "BlockArrowDescent",
    "BlockArrowFactor",
    "BlockArrowLevenbergMarquardt",
    "BlockArrowProblem",
    "BlockStep",
    "GaussNewtonAdjoint",
    "Loss",
    "SolveResult",
    "State",
    "band_from_windows",
    "barron",
    "chain_from_windows",
    "damped_step",
    "factorise",
    "gathered_band",
    "gathered_chain",
    "huber",
    "on_device",
    "robust_loss",
    "scattered_band",
    "scattered_chain",
    "single_threaded_blas",
    "solve",
    "solve_inside",
    "sum_along_chain",
]


def __getattr__(name: str) -> Any:
    if name in _LATER:
        return attribute_of(_LATER[name], name)
    raise AttributeError(f"module 'jaxcal.estimation' has no attribute '{name}'")
