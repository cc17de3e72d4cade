"""Differences of two calibrations as data, and what they mean in words: made by `jaxcal.results.compare`."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from jaxcal.results.projection_uncertainty import worst_sigma

Agreement = Literal["agree", "differ", "unknown"]

# A normalised difference up to here is noise: two draws from one covariance stay below it 199 times of 200.
_NOISE = 2.5
_SIGMAS = 4.0


@dataclass(frozen=True)
class ParameterDifference:
    """A number in both calibrations: `difference` is second minus first, `sigma` the two sigmas combined (None: not
    known; 0: held in both). Rotations are compared by the turn from one to the other, its parts in `difference`."""

    group: str
    name: str
    first: float
    second: float
    difference: float
    sigma: float | None
    unit: str

    @property
    def in_sigmas(self) -> float | None:
        """The difference over its sigma; None where that is not known or the parameter was held."""
        return None if not self.sigma else self.difference / self.sigma


@dataclass(frozen=True)
class CameraDifference:
    """Two calibrations of one camera.

    `pixels` (ny, nx, 2) a grid over the image, `ranges_m` (R,) distances (inf: directions); `difference_px`
    (R, ny, nx, 2) the second's projection minus the first's of what the first sees at a pixel, after the move
    `T_second_first` (4, 4) of the camera that explains most of it (`jaxcal.results.implied_pose`); NaN where a lens has
    no answer. `covariance` (R, ny, nx, 2, 2), px^2, is that of the difference from the noise of both calibrations'
    corners, None where neither is known. `observed` (ny, nx) marks where both saw corners (everywhere, where no file
    says), and `at_ranges` (R,) the ranges at which they did.
    """

    name: str
    models: tuple[str, str]
    pixels: np.ndarray
    ranges_m: tuple[float, ...]
    difference_px: np.ndarray
    covariance: np.ndarray | None
    observed: np.ndarray
    at_ranges: np.ndarray
    T_second_first: np.ndarray

    @property
    def size_px(self) -> np.ndarray:
        """(R, ny, nx) lengths of the differences."""
        return np.linalg.norm(self.difference_px, axis=-1)

    @property
    def rms_px(self) -> float:
        """Root mean square difference where corners were seen, at the ranges where they were."""
        return float(np.sqrt(np.mean(self._seen(self.size_px) ** 2)))

    @property
    def worst_px(self) -> float:
        """The largest difference there."""
        return float(np.max(self._seen(self.size_px)))

    @property
    def normalised(self) -> float | None:
        """Root mean square difference there in sigmas of one direction: 1 where corner noise explains it."""
        if self.covariance is None:
            return None
        inverse = np.linalg.pinv(np.nan_to_num(self.covariance), hermitian=True)
        squares = np.einsum("...i,...ij,...j->...", self.difference_px, inverse, self.difference_px) / 2.0
        known = np.isfinite(self.covariance).all(axis=(-1, -2))
        return float(np.sqrt(np.mean(self._seen(np.where(known, squares, np.nan)))))

    @property
    def sigma_px(self) -> float | None:
        """The 1-sigma of a difference that noise explains, in its worst direction: the median there."""
        if self.covariance is None:
            return None
        flat = worst_sigma(self.covariance.reshape(-1, 2, 2)).reshape(self.covariance.shape[:-2])
        return float(np.median(self._seen(flat)))

    @property
    def agreement(self) -> Agreement:
        """Whether the difference is what the noise of the corners makes of one lens."""
        normalised = self.normalised
        if normalised is None or not np.isfinite(normalised):
            return "unknown"
        return "agree" if normalised <= _NOISE else "differ"

    @property
    def sentence(self) -> str:
        """The outcome in words."""
        apart = f"{_short(self.rms_px)} px rms and {_short(self.worst_px)} px at most"
        if not np.isfinite(self.worst_px):
            return f"{self.name}: the two lenses share no part of the image."
        if self.normalised is None or self.sigma_px is None:
            return f"{self.name}: {apart} apart over the image; no uncertainty is known to judge that by."
        noise = (
            f"{self.normalised:.1f} times what the noise of the corners explains ({_short(self.sigma_px)} px, 1-sigma)"
        )
        if self.agreement == "agree":
            return f"{self.name}: the same lens. {apart} apart where both saw corners, {noise}."
        cause = "Either it changed between the recordings, or a model, the board or the detector errs in one of them"
        if self.models[0] != self.models[1]:
            cause = f"The models differ: {self.models[0]} or {self.models[1]}, or both, do not fit it; or it changed"
        return (
            f"{self.name}: not the same lens. {apart} apart where both saw corners, {noise}. {cause}: compare the "
            "mean residuals in their reports."
        )

    @property
    def moved(self) -> tuple[float, float]:
        """The turn (deg) and shift (m) of the move that was taken out."""
        turn = Rotation.from_matrix(self.T_second_first[:3, :3]).magnitude()
        return float(np.degrees(turn)), float(np.linalg.norm(self.T_second_first[:3, 3]))

    def _seen(self, values: np.ndarray) -> np.ndarray:
        chosen = values[self.at_ranges][:, self.observed]
        finite = chosen[np.isfinite(chosen)]
        return finite if len(finite) else np.array([np.nan])


@dataclass(frozen=True)
class RigDifference:
    """All differences of two calibrations: per camera in pixels, per parameter in sigmas; `notes` say what to mind."""

    cameras: tuple[CameraDifference, ...]
    parameters: tuple[ParameterDifference, ...]
    notes: tuple[str, ...]

    @property
    def beyond(self) -> tuple[ParameterDifference, ...]:
        """Poses and time offsets that are further apart than their sigmas explain, the furthest first."""
        far = [p for p in self.parameters if p.in_sigmas is not None and abs(p.in_sigmas) > _SIGMAS]
        rig = [p for p in far if p.group.rpartition(".")[2] not in ("intrinsics", "distortion")]
        return tuple(sorted(rig, key=lambda p: -abs(p.in_sigmas or 0.0)))

    @property
    def headline(self) -> str:
        """The outcome in one sentence."""
        states = {camera.agreement for camera in self.cameras}
        worst = max(self.cameras, key=lambda camera: camera.normalised or camera.worst_px)
        if "differ" in states:
            return f"They differ: {worst.name} by {worst.normalised:.1f} times what the noise of the corners explains."
        if self.beyond:
            p = self.beyond[0]
            return f"The lenses agree, but {p.group} {p.name} differs by {abs(p.in_sigmas or 0.0):.1f} sigma."
        if "unknown" in states:
            return f"They differ by up to {_short(max(c.worst_px for c in self.cameras))} px over the image."
        return (
            f"They agree: no camera differs by more than {worst.normalised:.1f} times what the corners' noise explains."
        )

    def text(self) -> str:
        """Everything, for a terminal, ending with a newline."""
        lines = [self.headline, ""]
        for camera in self.cameras:
            lines += [camera.sentence, *_range_lines(camera), ""]
        group = ""
        lines.append(f"{'':30}{'first':>13}{'second':>13}{'difference':>13}{'1-sigma':>11}{'in sigmas':>11}")
        for p in self.parameters:
            if p.group != group:
                group = p.group
                lines.append(group)
            sigma = "unknown" if p.sigma is None else "held" if p.sigma == 0.0 else f"{p.sigma:.5f}"
            ratio = "" if p.in_sigmas is None else f"{p.in_sigmas:+.1f}"
            label = f"  {p.name}" + (f" [{p.unit}]" if p.unit else "")
            lines.append(f"{label:30}{p.first:13.5f}{p.second:13.5f}{p.difference:13.5f}{sigma:>11}{ratio:>11}")
        return "\n".join([*lines, *(f"note: {note}" for note in self.notes)]) + "\n"

    def to_json(self) -> dict[str, Any]:
        """The outcome without the maps, of plain numbers and texts (null: not known)."""
        return {
            "headline": self.headline,
            "cameras": [
                {
                    "name": camera.name,
                    "models": list(camera.models),
                    "agreement": camera.agreement,
                    "rms_px": _finite(camera.rms_px),
                    "worst_px": _finite(camera.worst_px),
                    "in_sigmas": _finite(camera.normalised),
                    "implied_turn_deg": camera.moved[0],
                    "implied_shift_m": camera.moved[1],
                    "by_range": [
                        {"range_m": _finite(r), "rms_px": _finite(rms), "worst_px": _finite(worst)}
                        for r, rms, worst in by_range(camera)
                    ],
                }
                for camera in self.cameras
            ],
            "parameters": [
                {
                    "group": p.group,
                    "name": p.name,
                    "unit": p.unit,
                    "first": p.first,
                    "second": p.second,
                    "difference": p.difference,
                    "sigma": p.sigma,
                    "in_sigmas": p.in_sigmas,
                }
                for p in self.parameters
            ],
            "notes": list(self.notes),
        }


def by_range(camera: CameraDifference) -> Iterator[tuple[float, float, float]]:
    """Range, rms and largest difference where both saw corners."""
    for k, r in enumerate(camera.ranges_m):
        sizes = camera.size_px[k][camera.observed]
        sizes = sizes[np.isfinite(sizes)]
        if len(sizes):
            yield r, float(np.sqrt(np.mean(sizes**2))), float(sizes.max())


def _range_lines(camera: CameraDifference) -> list[str]:
    turn, shift = camera.moved
    lines = [f"    taken out: a move of the camera by {turn:.4f} deg and {1e3 * shift:.3f} mm"]
    for r, rms, worst in by_range(camera):
        where = "at infinity" if np.isinf(r) else f"{r:g} m away"
        lines.append(f"    {where}: {_short(rms)} px rms, {_short(worst)} px at most")
    return lines


def _short(value: float) -> str:
    """Three digits, without an exponent for what a person meets."""
    return f"{value:.3g}" if value >= 1e-4 or not math.isfinite(value) else "under 0.0001"


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
