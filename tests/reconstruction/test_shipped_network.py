"""The networks that are shipped: each is the file its card speaks of, and cv2 finds the board in its images."""

import hashlib
import re

import numpy as np
import pytest
import torch

import reconstruction
from reconstruction.checkpoints import DEFAULT_NETWORK, MODELS_FOLDER, read_metadata
from reconstruction.training.evaluate import evaluate, find_corners
from reconstruction.training.sequences import evaluation_scene, windows

WEIGHTS = MODELS_FOLDER / f"{DEFAULT_NETWORK}.safetensors"
SHIPPED = sorted(file.stem for file in MODELS_FOLDER.glob("*.safetensors"))
FOR_BOARDS = [name for name in SHIPPED if name != "firenet_pictures"]


@pytest.fixture(autouse=True)
def _one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def test_default_is_found_by_name_and_path():
    default = reconstruction.load_network()
    voxels = torch.randn(1, default.num_bins + (default.scaling == "running+scale"), 16, 16)
    for place in (DEFAULT_NETWORK, WEIGHTS, str(WEIGHTS)):
        assert torch.equal(reconstruction.load_network(place)(voxels, None)[0], default(voxels, None)[0])
    assert not default.training
    assert default.multiple == 4


@pytest.mark.parametrize("name", SHIPPED)
def test_card_speaks_of_this_file(name: str):
    weights = MODELS_FOLDER / f"{name}.safetensors"
    card = weights.with_suffix(".md").read_text(encoding="utf-8")
    assert hashlib.sha256(weights.read_bytes()).hexdigest() in card
    assert f"{weights.stat().st_size} bytes" in card
    assert read_metadata(weights)["licence"] in card
    parameters = sum(tensor.numel() for tensor in reconstruction.load_network(name).parameters())
    assert f"{parameters} parameters" in card


@pytest.mark.slow
def test_card_states_what_a_fresh_measurement_gives():
    """Scenes of two speeds that the card's figures do not contain, held to the card's error with some room."""
    card = WEIGHTS.with_suffix(".md").read_text(encoding="utf-8")
    stated = re.search(r"corner error .*? \| ([\d.]+) \| ([\d.]+) \|", card)
    assert stated
    fresh = evaluate(reconstruction.load_network(), top_speeds=(3.5, 11.0), windows_each=14)
    assert fresh.sharp.found >= 8
    assert fresh.detection_ratio >= 0.95
    assert fresh.reconstructed.rms_px < 1.4 * float(stated[1])
    assert abs(fresh.reconstructed.latency_s) < 0.5e-3


def test_a_network_that_never_saw_a_board_shows_dark_and_bright():
    network = reconstruction.load_network("firenet_pictures")
    scene = evaluation_scene(np.random.default_rng(4), 12, top_speed=8.0, shown_at=network.shown_at)
    reconstructor = reconstruction.Reconstructor(network, scene.view.width, scene.view.height)
    for window in windows(scene, seed=4):
        image = reconstructor(window.x, window.y, window.t_us, window.p, window.span_us)
    seen = window.target[60:-60, 60:-60], image[60:-60, 60:-60]
    assert np.corrcoef(seen[0].ravel(), seen[1].ravel())[0, 1] > 0.6


@pytest.mark.parametrize("name", FOR_BOARDS)
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_board_is_found_in_what_it_reconstructs(precision: str, name: str):
    network = reconstruction.load_network(name)
    scene = evaluation_scene(np.random.default_rng(4), 6, top_speed=8.0, shown_at=network.shown_at)
    reconstructor = reconstruction.Reconstructor(network, scene.view.width, scene.view.height, precision=precision)
    for window in windows(scene, seed=4):
        image = reconstructor(window.x, window.y, window.t_us, window.p, window.span_us)
    corners = find_corners(image, (9, 6))
    assert corners is not None
    distance = np.linalg.norm(corners[:, None] - window.corners[None], axis=-1).min(axis=1)
    assert np.sqrt((distance**2).mean()) < 0.5
    # Black and white are where the targets of the training had them.
    for truth, value in ((window.target < 0.1, 0.05), (window.target > 0.8, 0.9)):
        assert np.median(image[truth]) == pytest.approx(255 * value, abs=18)
