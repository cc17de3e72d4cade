"""What the public reference implementation computed from real E2VID checkpoints is reproduced."""

from pathlib import Path

import h5py
import numpy as np
import pytest

import reconstruction

CHECKPOINTS = ("convlstm_bn_transposed", "convlstm_upsample")


@pytest.fixture(params=CHECKPOINTS)
def reference(request: pytest.FixtureRequest, data_folder: Path) -> tuple[Path, dict[str, np.ndarray]]:
    folder = data_folder / "e2vid_parity"
    with h5py.File(folder / f"{request.param}.h5") as file:
        arrays = {name: np.asarray(file[name]) for name in file}
    return folder / f"{request.param}.pth.tar", arrays


def _windows(arrays: dict[str, np.ndarray]) -> list[tuple[np.ndarray, ...]]:
    ends = np.cumsum(arrays["window_sizes"])
    return [
        tuple(arrays[name][start:end] for name in ("x", "y", "t", "p"))
        for start, end in zip(ends - arrays["window_sizes"], ends, strict=True)
    ]


@pytest.mark.real_data
def test_voxels_equal_the_reference(reference: tuple[Path, dict[str, np.ndarray]]):
    _, arrays = reference
    height, width = arrays["images"].shape[1:]
    for events, expected in zip(_windows(arrays), arrays["normalised_voxels"], strict=True):
        voxels = reconstruction.voxel_grid(*events, width=width, height=height, num_bins=5)
        np.testing.assert_allclose(voxels, expected, atol=1e-5)


@pytest.mark.real_data
def test_images_equal_the_reference_window_after_window(reference: tuple[Path, dict[str, np.ndarray]]):
    checkpoint, arrays = reference
    height, width = arrays["images"].shape[1:]
    reconstructor = reconstruction.Reconstructor(reconstruction.load_network(checkpoint), width, height)
    for events, expected in zip(_windows(arrays), arrays["images"], strict=True):
        image = reconstructor(*events)
        assert image.shape == expected.shape
        assert np.abs(image.astype(int) - expected).max() <= 1
    # The reference images differ from window to window far more than the tolerance.
    assert np.abs(np.diff(arrays["images"].astype(int), axis=0)).max() > 3
