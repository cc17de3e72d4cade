"""What a study says: every run's parameters beside a reference, and their scatter beside the sigmas stated."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from jaxcal.studies.estimates import Block, combined
from jaxcal.studies.spec import Study

_QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


@dataclass(frozen=True)
class ParameterSummary:
    """One parameter over the runs of one combination of settings.

    `deviations` (n,) from the reference, `in_sigmas` (n,) the same over each run's own sigma (NaN without one). `bias`
    is their mean; `std` their scatter; `observed_sigma` what that says of one calibration of the whole recording (of
    leave-one-out studies the jackknife's, sqrt((n - 1) / n sum (x - mean)^2)); `stated_sigma` what calibrations say
    themselves. `quantiles` of the deviations at 5, 25, 50, 75 and 95 %.
    """

    settings: Mapping[str, Any]
    block: str
    name: str
    unit: str
    deviations: np.ndarray
    in_sigmas: np.ndarray
    mean: float
    bias: float
    std: float
    observed_sigma: float
    stated_sigma: float
    quantiles: tuple[float, ...]

    @property
    def ratio(self) -> float:
        """Observed over stated sigma: 1 where sigmas are true."""
        return self.observed_sigma / self.stated_sigma if self.stated_sigma > 0 else float("nan")

    @property
    def rms_in_sigmas(self) -> float:
        """Root mean square deviation over each run's own sigma."""
        known = self.in_sigmas[np.isfinite(self.in_sigmas)]
        return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")


@dataclass(frozen=True)
class StudyResult:
    """A study's rows (see `jaxcal.studies.tasks`), and what they are held against: `reference` by block, or None for
    the calibration that the runs came from, or else their mean."""

    study: Study
    rows: Sequence[Mapping[str, Any]]
    reference: Mapping[str, Block] | None = None

    @property
    def failed(self) -> list[Mapping[str, Any]]:
        """Rows of calibrations that were impossible."""
        return [row for row in self.rows if row["status"] != "ok"]

    @property
    def against(self) -> str:
        """What the reference is, in words."""
        if self.reference is not None:
            return f"{self.study.reference}"
        if any(row["run"] < 0 for row in self.rows) and self.study.kind != "sweep":
            return "the calibration that the runs came from"
        return "the mean of the runs"

    @cached_property
    def parameters(self) -> tuple[ParameterSummary, ...]:
        """All parameters of all combinations of settings, in order."""
        return tuple(
            summary
            for number, settings in enumerate(self.study.combinations)
            for summary in self._of_combination(number, settings)
        )

    @property
    def pooled_ratio(self) -> float:
        """Root mean square of observed over stated sigma, over all parameters that have both."""
        ratios = np.array([p.ratio for p in self.parameters if np.isfinite(p.ratio)])
        return float(np.sqrt(np.mean(ratios**2))) if len(ratios) else float("nan")

    def blocks(self, row: Mapping[str, Any]) -> dict[str, Block]:
        """A row's blocks by name; none where it failed."""
        return {content["name"]: Block.from_json(content) for content in row.get("blocks", ())}

    def centre(self, combination: int) -> Mapping[str, Block]:
        """What the deviations of a combination's runs are from."""
        return self._centres[combination]

    @cached_property
    def _centres(self) -> list[Mapping[str, Block]]:
        count = len(self.study.combinations)
        if self.reference is not None:
            return [self._renamed(self.reference)] * count
        if self.study.kind in ("recordings", "sweep"):
            return [self._mean()] * count
        whole = {row["combination"]: self.blocks(row) for row in self.rows if row["run"] < 0}
        return [whole.get(number, {}) for number in range(count)]

    def _renamed(self, reference: Mapping[str, Block]) -> Mapping[str, Block]:
        """The reference with its cameras called as the runs call them; by order, where no name is in both (Kalibr's
        files know cam0, cam1 and so on only)."""
        runs = next((self.blocks(row) for row in self.rows if row["status"] == "ok"), {})
        ours, theirs = _owners(runs), _owners(reference)
        if set(ours) & set(theirs) or len(ours) != len(theirs):
            return reference
        name = dict(zip(theirs, ours, strict=True))
        parts = {key: key.partition(".") for key in reference}
        return {f"{name.get(owner, owner)}{dot}{rest}": reference[key] for key, (owner, dot, rest) in parts.items()}

    def _mean(self) -> dict[str, Block]:
        found: dict[str, list[Block]] = {}
        for row in self.rows:
            for name, block in self.blocks(row).items():
                if name not in found or found[name][0].labels == block.labels:
                    found.setdefault(name, []).append(block)
        return {name: combined(blocks) for name, blocks in found.items()}

    def _of_combination(self, number: int, settings: Mapping[str, Any]) -> list[ParameterSummary]:
        own = [row for row in self.rows if row["combination"] == number]
        runs = [self.blocks(row) for row in own if row["run"] >= 0 or self.study.kind == "sweep"]
        whole = next((self.blocks(row) for row in own if row["run"] < 0), {})
        centre = self.centre(number)
        names = list(dict.fromkeys(name for blocks in runs for name in blocks))
        summaries = []
        for name in names:
            blocks = [run[name] for run in runs if name in run]
            labels = blocks[0].labels
            blocks = [block for block in blocks if block.labels == labels]
            deviations = np.array([block.minus(centre.get(name)) for block in blocks])
            sigma = np.array([np.full(len(labels), np.nan) if b.sigma is None else b.sigma for b in blocks])
            shown = np.array([block.shown for block in blocks])
            base = whole.get(name) if self.study.kind in ("bootstrap", "leave-one-out") else None
            for k, label in enumerate(labels):
                stated = None if base is None or base.sigma is None else float(base.sigma[k])
                part = (deviations[:, k], sigma[:, k], float(np.mean(shown[:, k])), stated)
                summaries.append(self._summary(settings, blocks[0], k, label, *part))
        return summaries

    def _summary(
        self,
        settings: Mapping[str, Any],
        block: Block,
        place: int,
        label: str,
        deviations: np.ndarray,
        sigma: np.ndarray,
        mean: float,
        stated: float | None,
    ) -> ParameterSummary:
        count = len(deviations)
        std = float(np.std(deviations, ddof=1)) if count > 1 else float("nan")
        jackknife = self.study.kind == "leave-one-out"
        observed = std * (count - 1) / np.sqrt(count) if jackknife else std
        known = sigma[np.isfinite(sigma)]
        if stated is None:
            stated = float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")
        with np.errstate(divide="ignore", invalid="ignore"):
            in_sigmas = np.where(sigma > 0, deviations / sigma, np.nan)
        return ParameterSummary(
            settings=settings,
            block=block.name,
            name=label,
            unit=block.units[place],
            deviations=deviations,
            in_sigmas=in_sigmas,
            mean=mean,
            bias=float(np.mean(deviations)),
            std=std,
            observed_sigma=float(observed),
            stated_sigma=stated,
            quantiles=tuple(np.quantile(deviations, _QUANTILES).tolist()),
        )


def _owners(blocks: Mapping[str, Block]) -> list[str]:
    """The cameras that blocks are of, in order."""
    return [name.partition(".")[0] for name in blocks if name.endswith(".intrinsics")]
