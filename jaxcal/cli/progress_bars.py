"""Progress on a terminal."""

import sys

from tqdm import tqdm


class ProgressBars:
    """Progress callbacks as tqdm bars, one per stage; silent where nobody watches a terminal."""

    def __init__(self) -> None:
        self._bars: dict[str, tqdm] = {}
        self._silent = not sys.stderr.isatty()

    def __call__(self, stage: str, done: int, total: int) -> None:
        if stage not in self._bars:
            self._bars[stage] = tqdm(desc=stage, total=total, disable=self._silent, leave=True)
        bar = self._bars[stage]
        if bar.total != total:
            bar.reset(total)
        bar.update(done - bar.n)

    def __enter__(self) -> "ProgressBars":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave the bars as they are and start anew."""
        for bar in self._bars.values():
            bar.close()
        self._bars.clear()
