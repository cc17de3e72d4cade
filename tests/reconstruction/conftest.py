"""One thread per test process: torch's threads wait for each other by spinning, which costs where cores are few."""

import pytest
import torch


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)
