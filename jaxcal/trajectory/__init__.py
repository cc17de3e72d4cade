"""Continuous-time trajectories: cumulative B-splines on SO(3) x R^3."""

from jaxcal.trajectory.batched import RotationsAt, rotations_at
from jaxcal.trajectory.bspline import (
    Increments,
    PoseSpline,
    RotationPoint,
    basis_matrix,
    cumulative_basis_matrix,
    increments,
    rotation_at,
    weights,
)

__all__ = [
    "Increments",
    "PoseSpline",
    "RotationPoint",
    "RotationsAt",
    "basis_matrix",
    "cumulative_basis_matrix",
    "increments",
    "rotation_at",
    "rotations_at",
    "weights",
]
