"""What a cross-validation found: how far halves of a recording differ, what that is due to, and on which evidence."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from jaxcal.results.difference import RigDifference

Cause = Literal[
    "lens", "uneven lens", "bent board", "misprinted board", "rolling shutter", "changed lens", "moved camera"
]

# Chance of a false alarm of one whole cross-validation, shared among its tests.
FALSE_ALARMS = 0.01

_WORDS: dict[str, str] = {
    "lens": "the lens model is too lean for the lens",
    "uneven lens": "the lens bends the image in ways that no round model follows",
    "bent board": "the board is not flat",
    "misprinted board": "the board was printed with unequal scales or sheared",
    "rolling shutter": "the shutter rolls, and was taken for global",
    "changed lens": "the lens changed during the recording",
    "moved camera": "the camera moved with respect to the others during the recording",
}
_REMEDIES: dict[str, str] = {
    "lens": "Use a richer model (pinhole-rational8, pinhole-equi for wide ones).",
    "uneven lens": "Use a splined model (splined-3-16-12-FOV).",
    "bent board": "Calibrate with board_warp=True (--board-warp), or use a stiffer board.",
    "misprinted board": "Measure the board along both sides and correct target.yaml.",
    "rolling shutter": "Calibrate with rolling_shutter=True (--rolling-shutter).",
    "changed lens": "Fix focus, zoom and aperture, switch stabilisation and autofocus off, and record again.",
    "moved camera": "Tighten the mount, and record again.",
}


@dataclass(frozen=True)
class Evidence:
    """One possible cause of a model error, tested.

    `gain` is by how much the squared errors, in units of the noise, would fall were it modelled, with `freedom` numbers
    more: chi-squared of so many degrees of freedom where there is only noise, which `p_value` is judged by. `held_back`
    is how much they would fall in views that those numbers were not fitted to (above 0: it is really there).
    `step` says in which order causes were found, each with those before taken into account; None: not found.
    `value` is the estimate of what is told by one number (a line delay, s).
    """

    cause: Cause
    subject: str
    gain: float
    freedom: int
    p_value: float
    held_back: float
    step: int | None = None
    value: float | None = None

    @property
    def found(self) -> bool:
        """Whether it is among the causes that were named."""
        return self.step is not None

    @property
    def sentence(self) -> str:
        """The cause with its evidence, in words."""
        told = f", by {1e6 * self.value:.1f} us a row" if self.cause == "rolling shutter" and self.value else ""
        numbers = "number" if self.freedom == 1 else "numbers"
        return (
            f"{self.subject}: {_WORDS[self.cause]}{told} ({self.freedom} {numbers} more would lower the squared errors "
            f"by {self.gain:.0f}, and by {self.held_back:.0f} in views held back, where noise alone gives "
            f"{self.freedom} and less than nothing). {_REMEDIES[self.cause]}"
        )


@dataclass(frozen=True)
class Halves:
    """Two halves of a recording, calibrated each by itself: how they were taken apart ('in turns', 'in time', 'near and
    far'), and their difference. `gain`, `freedom`, `p_value` as in `Evidence`, of all parameters together."""

    split: str
    difference: RigDifference
    gain: float
    freedom: int
    p_value: float


@dataclass(frozen=True)
class CrossValidation:
    """The outcome: every split and every cause that was tested. `notes` say what could not be tested, and why."""

    halves: tuple[Halves, ...]
    evidence: tuple[Evidence, ...]
    notes: tuple[str, ...] = ()

    @property
    def threshold(self) -> float:
        """p-values below this are no chance."""
        return FALSE_ALARMS / max(len(self.evidence) + len(self.halves), 1)

    @property
    def causes(self) -> tuple[Evidence, ...]:
        """What was found, the strongest first."""
        return tuple(sorted((e for e in self.evidence if e.found), key=lambda e: e.step or 0))

    @property
    def flagged(self) -> bool:
        """Whether there is more than noise."""
        return bool(self.causes) or any(half.p_value < self.threshold for half in self.halves)

    @property
    def headline(self) -> str:
        """The outcome in one sentence."""
        if self.causes:
            first = self.causes[0]
            return f"More than noise: {first.subject}: {_WORDS[first.cause]}."
        if self.flagged:
            worst = min(self.halves, key=lambda half: half.p_value)
            return (
                f"More than noise: halves taken {worst.split} differ, for none of the reasons tested. Corners may be "
                "biased (blur, a detector), or their noise hang together."
            )
        return "Nothing but noise: halves agree within their sigmas, and no model error that was tested shows."

    def text(self) -> str:
        """Everything, for a terminal, ending with a newline."""
        lines = [self.headline, ""]
        lines += [f"{number}. {cause.sentence}" for number, cause in enumerate(self.causes, start=1)]
        lines += [""] * bool(self.causes)
        for half in self.halves:
            lines.append(f"halves {half.split}: chi-squared {half.gain:.1f} of {half.freedom} (p {half.p_value:.2g})")
            lines += [f"    {line}" for line in _camera_lines(half)]
        lines += ["", f"{'tested':34}{'gain':>10}{'numbers':>9}{'held back':>11}{'p':>10}"]
        for e in self.evidence:
            mark = f"  found ({e.step + 1})" if e.step is not None else ""
            name = f"{e.subject}: {e.cause}"
            lines.append(f"  {name:32}{e.gain:10.1f}{e.freedom:9}{e.held_back:11.1f}{e.p_value:10.2g}{mark}")
        lines.append(f"found: p below {self.threshold:.2g}, and a gain in views held back")
        return "\n".join([*lines, *(f"note: {note}" for note in self.notes)]) + "\n"

    def to_json(self) -> dict[str, Any]:
        """The outcome without the maps, of plain numbers and texts."""
        return {
            "headline": self.headline,
            "flagged": self.flagged,
            "causes": [f"{e.subject}: {e.cause}" for e in self.causes],
            "threshold": self.threshold,
            "halves": [
                {
                    "split": half.split,
                    "chi_squared": half.gain,
                    "freedom": half.freedom,
                    "p_value": half.p_value,
                    "cameras": half.difference.to_json()["cameras"],
                }
                for half in self.halves
            ],
            "evidence": [
                {
                    "subject": e.subject,
                    "cause": e.cause,
                    "gain": e.gain,
                    "freedom": e.freedom,
                    "p_value": e.p_value,
                    "held_back": e.held_back,
                    "step": e.step,
                    "value": e.value,
                }
                for e in self.evidence
            ],
            "notes": list(self.notes),
        }


def _camera_lines(half: Halves) -> Iterator[str]:
    for camera in half.difference.cameras:
        sigma, normalised = camera.sigma_px, camera.normalised
        noise = ""
        if sigma is not None and normalised is not None and np.isfinite(normalised):
            noise = f", {normalised:.1f} times what noise explains ({sigma:.3g} px)"
        yield f"{camera.name}: {camera.rms_px:.3g} px rms apart over the image{noise}"
