"""Training: the scenes are what they claim, the loop learns, an interrupted run ends as an unbroken one does."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from reconstruction.networks import ReconstructionNetwork
from reconstruction.training import loop
from reconstruction.training.data import Dataset, load_or_generate
from reconstruction.training.evaluate import CornerErrors, find_corners
from reconstruction.training.losses import displacement_losses, image_loss, weights_of_places
from reconstruction.training.motion import apply_homography, lull, speed_profile
from reconstruction.training.recipe import DataRecipe, Recipe, Stage, fingerprint
from reconstruction.training.sequences import BLACK, WHITE, evaluation_scene, training_scene, windows

TINY = Recipe(
    data=DataRecipe(sequences=3, windows=8, size=32),
    stages=(
        Stage(crop=16, windows=4, segments=1, batch=2, clips=12),
        Stage(crop=32, windows=4, segments=2, batch=1, clips=4),
    ),
    channels=4,
    warm_up_steps=2,
)


@pytest.fixture(scope="module")
def tiny_dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return load_or_generate(TINY.data, TINY.num_bins, tmp_path_factory.mktemp("cache"))


def _train(recipe: Recipe, dataset: Dataset, checkpoint: Path) -> dict[str, torch.Tensor]:
    torch.set_num_threads(1)
    return loop.train(recipe, dataset, checkpoint, checkpoint_every_s=0.0).average.state_dict()


def test_an_interrupted_training_ends_as_an_unbroken_one(
    tiny_dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    assert TINY.steps == 20
    unbroken = _train(TINY, tiny_dataset, tmp_path / "unbroken.pt")

    train_on_clip = loop._train_on_clip

    def power_cut(run: loop.Run, *arguments):
        if run.step == 14:  # within the second stage
            raise KeyboardInterrupt
        train_on_clip(run, *arguments)

    with monkeypatch.context() as context:
        context.setattr(loop, "_train_on_clip", power_cut)
        with pytest.raises(KeyboardInterrupt):
            _train(TINY, tiny_dataset, tmp_path / "broken.pt")
    continued: list[int] = []

    def witness(run: loop.Run, *arguments):
        continued.append(run.step)
        train_on_clip(run, *arguments)

    with monkeypatch.context() as context:
        context.setattr(loop, "_train_on_clip", witness)
        broken = _train(TINY, tiny_dataset, tmp_path / "broken.pt")
    assert continued[0] == 14
    for name, value in unbroken.items():
        assert torch.equal(broken[name], value), name


def test_a_checkpoint_of_another_recipe_is_not_continued(tiny_dataset: Dataset, tmp_path: Path):
    _train(TINY, tiny_dataset, tmp_path / "run.pt")
    other = Recipe(data=TINY.data, stages=TINY.stages[:1], channels=4, seed=9)
    restarted = _train(other, tiny_dataset, tmp_path / "run.pt")
    fresh = _train(other, tiny_dataset, tmp_path / "fresh.pt")
    assert all(torch.equal(restarted[name], fresh[name]) for name in fresh)


@pytest.mark.parametrize("architecture", ["FoldedFireNet", "TwoScaleNet", "TwoScaleMemoryNet"])
def test_training_reduces_the_loss_on_what_it_sees(tiny_dataset: Dataset, tmp_path: Path, architecture: str):
    stage = Stage(crop=32, windows=8, segments=1, batch=2, clips=60)
    recipe = Recipe(
        data=TINY.data,
        stages=(stage,),
        architecture=architecture,
        channels=16,
        warm_up_steps=2,
        learning_rate=5e-3,
    )
    voxels, targets = tiny_dataset.clip(np.random.default_rng(0), stage)

    def loss(network: ReconstructionNetwork) -> float:
        with torch.no_grad():
            weights = torch.ones_like(targets)
            return loop._segment_loss(network, voxels, targets, weights, None, 2, recipe)[0].item()

    before = loss(loop._start(recipe).network)
    trained = loop.train(recipe, tiny_dataset, tmp_path / "run.pt")
    assert loss(trained.average) < 0.6 * before


def test_a_child_that_reads_more_starts_where_its_parent_ended(tiny_dataset: Dataset, tmp_path: Path):
    parent = replace(TINY, architecture="TwoScaleNet", channels=8)
    child = replace(parent, data=replace(TINY.data, scaling="running+scale"), seed=4)
    network = loop.train(parent, tiny_dataset, tmp_path / "run.pt").average
    voxels = torch.randn(1, 5, 16, 16)
    scale = torch.full((1, 1, 16, 16), 0.7)
    grown = loop._start(child, network).network
    with torch.no_grad():
        torch.testing.assert_close(grown(torch.cat([voxels, scale], dim=1), None)[0], network(voxels, None)[0])
    dataset = load_or_generate(child.data, child.num_bins, tmp_path)
    assert dataset.voxels.shape == (3, 8, 6, 32, 32)
    assert torch.equal(dataset.voxels[:, :, 5], dataset.voxels[:, :, 5, :1, :1].expand(-1, -1, 32, 32))
    trained = loop.train(child, dataset, tmp_path / "child.pt", parent=network).average.state_dict()
    assert trained["head.conv2d.weight"][:, -1].abs().max() > 0


def test_a_child_with_a_memory_that_its_parent_lacks_has_the_parents_weights():
    parent = replace(TINY, architecture="TwoScaleNet", channels=8)
    given = loop._start(parent).network
    network = loop._start(replace(parent, architecture="TwoScaleMemoryNet", seed=4), given).network
    grown = network.state_dict()
    for name, values in given.state_dict().items():
        own = grown[name]
        assert torch.equal(own[:, : values.shape[1]] if values.ndim == 4 else own, values)
        assert values.ndim < 4 or not own[:, values.shape[1] :].any()
    assert grown["gate.weight"].any()
    assert (grown["gate.bias"] == 2.0).all()


def test_data_are_generated_once_and_completed_after_an_interruption(tmp_path: Path, tiny_dataset: Dataset):
    stages: list[tuple[int, int]] = []
    first = load_or_generate(TINY.data, 5, tmp_path)
    folder = next(tmp_path.iterdir())
    sequence = folder / "0001.npz"
    kept = (folder / "0000.npz").stat().st_mtime_ns
    voxels = first.voxels.clone()
    for name in ("voxels.npy", "targets.npy", "0001.npz"):
        (folder / name).unlink()
    again = load_or_generate(TINY.data, 5, tmp_path, lambda _, done, total: stages.append((done, total)))
    assert sequence.exists()
    assert (folder / "0000.npz").stat().st_mtime_ns == kept
    assert torch.equal(again.voxels, voxels)
    assert torch.equal(again.voxels, tiny_dataset.voxels)  # and they depend on the recipe only
    assert stages[-1] == (3, 3)
    assert voxels.shape == (3, 8, 5, 32, 32)


def test_several_processes_generate_what_one_does(tiny_dataset: Dataset, tmp_path: Path):
    stages: list[tuple[int, int]] = []
    dataset = load_or_generate(TINY.data, 5, tmp_path, lambda _, done, total: stages.append((done, total)), workers=2)
    assert torch.equal(dataset.voxels, tiny_dataset.voxels)
    assert torch.equal(dataset.targets, tiny_dataset.targets)
    assert stages == [(0, 3), (1, 3), (2, 3), (3, 3)]


def test_a_finished_training_is_taken_from_its_checkpoint(tiny_dataset: Dataset, tmp_path: Path):
    assert loop.finished(TINY, tmp_path / "run.pt") is None
    trained = loop.train(TINY, tiny_dataset, tmp_path / "run.pt")
    found = loop.finished(TINY, tmp_path / "run.pt")
    assert found is not None
    assert found.machine == trained.machine
    assert "CPU thread" in found.machine
    assert (found.step, found.seconds, found.history) == (trained.step, trained.seconds, trained.history)
    for name, value in trained.average.state_dict().items():
        assert torch.equal(found.average.state_dict()[name], value), name
    assert loop.finished(replace(TINY, seed=5), tmp_path / "run.pt") is None


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU here")
def test_replayed_steps_are_the_steps_themselves(tiny_dataset: Dataset):
    recipe = replace(TINY, precision="float32")
    voxels, targets = (tensor.cuda() for tensor in tiny_dataset.clip(np.random.default_rng(0), TINY.stages[0]))
    weights = torch.rand_like(targets)
    gradients = []
    for make in (loop._eager, loop._Replayed):
        network = loop._start(recipe, device="cuda").network
        segment = make(network, recipe)
        _, state = segment(voxels, targets, weights, None, 2)
        segment(voxels, targets, weights, state, 0)
        gradients.append([parameter.grad for parameter in network.parameters()])
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-5)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6), top_speed=st.floats(0.5, 28.0))
def test_a_swinging_hand_never_exceeds_its_top_speed_and_slows_down(seed: int, top_speed: float):
    scene = training_scene(np.random.default_rng(seed), DataRecipe(windows=8, size=32))
    travelled = scene.path.swing(24, top_speed, 16)
    speed = 16 * np.diff(travelled)
    assert travelled.shape == (24 * 16 + 1,)
    assert travelled[0] == 0
    assert (speed >= 0).all()
    assert speed.max() <= top_speed * (1 + 1e-9)
    assert speed.max() > 0


@pytest.mark.parametrize("seed", range(3))
def test_pictures_are_of_no_board(seed: int):
    recipe = DataRecipe(pictures=1.0, windows=3, size=32, slowest_px=2.0)
    scene = training_scene(np.random.default_rng(seed), recipe)
    assert scene.pattern.corners.shape == (0, 2)
    assert 0.0 <= scene.pattern.texture.min() < scene.pattern.texture.max() <= 1.0
    assert len(np.unique(scene.pattern.texture)) > 100  # greys, not a board's two
    for window in windows(scene, seed):
        assert window.corners.shape == window.velocity.shape == (0, 2)
        assert len(window.t_us)


def test_a_setting_at_its_default_leaves_the_fingerprint():
    """What is added later must not disown weights that were trained before."""
    assert fingerprint(Recipe()) == "44136fa355b3"  # of nothing chosen: the SHA-256 of {}
    assert fingerprint(Recipe(detail=16)) == fingerprint(Recipe())
    assert fingerprint(Recipe(data=DataRecipe(pictures=0.0, seed=1))) == fingerprint(Recipe(data=DataRecipe(seed=1)))
    assert fingerprint(Recipe(parent=Recipe())) != fingerprint(Recipe())


def test_fingerprint_changes_with_any_setting():
    assert fingerprint(TINY) != fingerprint(Recipe())
    assert fingerprint(DataRecipe()) != fingerprint(DataRecipe(seed=1))
    assert fingerprint(DataRecipe()) == fingerprint(DataRecipe())


def test_image_loss_is_zero_for_the_truth_and_counts_edges():
    target = torch.zeros(1, 4, 4)
    offset, stripes = torch.full((1, 4, 4), 0.1), 0.1 * (torch.arange(4) % 2 * 2.0 - 1).expand(1, 4, 4)
    weight = torch.ones_like(target)
    assert image_loss(target, target, weight, 0.5).item() == 0.0
    assert image_loss(target + offset, target, weight, 0.5).item() == pytest.approx(0.1)
    assert image_loss(target + stripes, target, weight, 0.5).item() == pytest.approx(0.1 + 0.5 * 0.2)


def shifted_board(dx: float, dy: float) -> torch.Tensor:
    """(60, 60): a checkerboard before a lens, displaced by (dx, dy) pixels."""
    board = np.kron(np.indices((6, 6)).sum(axis=0) % 2, np.ones((80, 80))).astype(np.float32)
    shift = np.array([[1, 0, 8 * dx], [0, 1, 8 * dy]])
    moved = cv2.warpAffine(board, shift, (480, 480), borderMode=cv2.BORDER_REPLICATE)
    blurred = cv2.GaussianBlur(moved, (0, 0), 5.6)
    return torch.from_numpy(cv2.resize(blurred, (60, 60), interpolation=cv2.INTER_AREA))


def displacements_of(images: list[list[torch.Tensor]]) -> tuple[float, float]:
    """Of clips of boards, by windows and clips, that should show the board where it is: each corner's, and shared."""
    predicted = torch.stack([torch.stack(row)[:, None] for row in images])
    target = shifted_board(0.0, 0.0).expand_as(predicted)
    each, shared = displacement_losses(predicted, target, torch.ones_like(predicted))
    return each.item(), shared.item()


@settings(deadline=None, max_examples=20)
@given(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2))
def test_displacement_losses_measure_how_far_a_board_is_displaced(dx: float, dy: float):
    each, shared = displacements_of([[shifted_board(dx, dy)]])
    # A fifth of the lens' blur is where the first order in the displacement ends; the bounds of what a place may say
    # shorten what all share.
    size = np.hypot(dx, dy)
    assert each == pytest.approx(0.15 * (np.hypot(1.0, size / 0.15) - 1.0), rel=0.2, abs=1e-3)
    bounded = size / np.hypot(1.0, size / 0.15)
    assert shared == pytest.approx(2 * 0.02 * (np.hypot(1.0, bounded / 0.02) - 1.0), rel=0.2, abs=1e-3)


def test_displacements_that_cancel_over_an_image_or_a_clip_are_not_shared():
    halves = torch.cat([shifted_board(0.1, 0.0)[:, :30], shifted_board(-0.1, 0.0)[:, 30:]], dim=1)
    together, alternating = shifted_board(0.1, 0.0), [[shifted_board(0.1, 0.0)], [shifted_board(-0.1, 0.0)]]
    each, shared = displacements_of([[halves], [halves]])
    each_together, shared_together = displacements_of([[together], [together]])
    _, shared_in_turns = displacements_of(alternating)
    assert each == pytest.approx(each_together, rel=0.2)
    assert shared < 0.05 * shared_together
    assert shared_in_turns == pytest.approx(0.5 * shared_together, rel=0.1)  # in every image, over no clip


def test_displacement_losses_do_not_mind_wrong_grey_levels_without_edges():
    target = torch.zeros(2, 1, 1, 30, 30)
    each, shared = displacement_losses(target + 0.3, target, torch.ones_like(target))
    assert (each.item(), shared.item()) == (0.0, 0.0)


def test_places_of_no_weight_do_not_count():
    board = torch.from_numpy(np.kron(np.indices((4, 8)).sum(axis=0) % 2, np.ones((10, 10))).astype(np.float32))
    board = board.expand(1, 1, 1, *board.shape)
    wrong = board.clone()
    wrong[..., 40:] = 1.0 - torch.roll(board, 2, dims=-1)[..., 40:]
    weight = torch.zeros_like(board)
    weight[..., :40] = 1.0
    assert image_loss(wrong, board, weight, 0.5).item() == 0.0
    right = slice(0, 30)
    each, shared = displacement_losses(wrong[..., right], board[..., right], weight[..., right])
    assert (each.item(), shared.item()) == (0.0, 0.0)
    everywhere = torch.ones_like(board)
    assert image_loss(wrong, board, everywhere, 0.5).item() > 0.1
    assert displacement_losses(wrong, board, everywhere)[0] > displacement_losses(wrong, board, weight)[0]


def test_places_count_once_an_edge_has_passed_near_them():
    voxels = torch.zeros(6, 1, 4, 40, 60)
    voxels += 0.05 * torch.randn(voxels.shape, generator=torch.Generator().manual_seed(1))  # noise of both signs
    voxels[2, 0, 1, :, 10:12] = 1.0  # an upright edge moves by two pixels, in the third and fourth window
    voxels[3, 0, 2, :, 12:14] = 1.0
    weights = weights_of_places(voxels, 3, 0.1)
    assert weights.shape == (6, 1, 1, 40, 60)
    assert (weights[:2] == 0.1).all()
    assert (weights[2:, ..., 6:16] == 1.0).all()
    assert (weights[..., 25:] == 0.1).all()
    assert (weights.diff(dim=0) >= 0.0).all()  # what has been seen stays so
    assert (weights_of_places(voxels, 3, 1.0) == 1.0).all()


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6), windows_count=st.integers(20, 90))
def test_a_lull_slows_down_what_comes_in_it_and_nothing_before(seed: int, windows_count: int):
    travelled = np.linspace(0.0, 5.0 * windows_count, 16 * windows_count + 1)
    slowed = lull(np.random.default_rng(seed), travelled, 16)
    speed = 16 * np.diff(slowed)
    assert slowed[0] == 0.0
    assert slowed.shape == travelled.shape
    assert 5.0 * 0.02 * (1 - 1e-9) <= speed.min() <= 5.0 * 0.2 * (1 + 1e-9)
    assert speed.max() == pytest.approx(5.0)
    assert (speed < 2.0).sum() >= 16 * 9
    first = int(np.argmax(speed < 5.0 - 1e-9))
    assert 0.1 * windows_count - 1.0 - 1e-9 <= first / 16 <= 0.5 * windows_count
    np.testing.assert_allclose(slowed[:first], travelled[:first])


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 10**6))
def test_scenes_keep_from_the_horizon_where_asked_to(seed: int):
    recipe = DataRecipe(size=40, windows=5, edge_on=False, others=0.4)
    scene = training_scene(np.random.default_rng(seed), recipe)
    x, y = np.meshgrid([0.0, 39.0], [0.0, 39.0])
    pixels = np.stack([x, y, np.ones((2, 2))], axis=-1).reshape(-1, 3)
    depth = np.linalg.inv(scene.path.homographies(scene.travelled))[:, 2] @ pixels.T
    assert (depth.min(axis=1) > 0).all() or (depth.max(axis=1) < 0).all()
    assert 0.0 <= scene.pattern.texture.min() <= scene.pattern.texture.max() <= 1.0


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 10**6))
def test_no_point_of_the_image_moves_faster_than_the_path_says(seed: int):
    rng = np.random.default_rng(seed)
    scene = training_scene(rng, DataRecipe(size=48, windows=6))
    travelled = np.linspace(0.0, float(scene.travelled[-1]), 300)
    homographies = scene.path.homographies(travelled)
    x, y = (values.ravel() for values in np.meshgrid(np.linspace(0, 47, 7), np.linspace(0, 47, 7)))
    pixels = np.stack([x, y], axis=-1)
    texels = apply_homography(np.linalg.inv(homographies[:-1]), pixels)
    moved = np.linalg.norm(apply_homography(homographies[1:], texels) - pixels, axis=-1).max(axis=1)
    step = travelled[1] - travelled[0]
    assert moved.max() <= 1.1 * step + 1e-6
    assert step < 1e-9 or moved.mean() > 0.5 * step


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 10**6), st.floats(0.5, 25.0))
def test_speed_profile_keeps_to_its_top_speed_and_never_turns_back(seed: int, top_speed: float):
    travelled = speed_profile(np.random.default_rng(seed), 12, top_speed)
    steps = np.diff(travelled) * 16
    assert len(travelled) == 12 * 16 + 1
    assert (steps >= 0).all()
    assert steps.max() <= top_speed * (1 + 1e-9)


@settings(deadline=None, max_examples=10)
@given(st.integers(0, 10**6))
def test_windows_hold_their_own_events_and_a_target_between_black_and_white(seed: int):
    scene = training_scene(np.random.default_rng(seed), DataRecipe(size=40, windows=5))
    sequence = list(windows(scene, seed))
    assert len(sequence) == 5
    for index, window in enumerate(sequence):
        assert window.target.shape == (40, 40)
        assert window.target.min() >= BLACK - 1e-6
        assert window.target.max() <= WHITE + 1e-6
        if len(window.t_us):
            assert window.t_us.min() >= index * window.duration_us - 1
            assert window.t_us.max() <= (index + 1) * window.duration_us + 1


@settings(deadline=None, max_examples=10)
@given(st.integers(0, 10**6), st.sampled_from([0.3, 0.5]))
def test_images_of_an_earlier_moment_come_of_the_same_motion(seed: int, shown_at: float):
    recipe = DataRecipe(size=40, windows=5)
    ends = list(windows(training_scene(np.random.default_rng(seed), recipe), seed))
    scene = training_scene(np.random.default_rng(seed), replace(recipe, shown_at=shown_at))
    travelled = np.interp(np.arange(5) + shown_at, np.arange(len(scene.travelled)) / scene.samples, scene.travelled)
    expected = apply_homography(scene.path.homographies(travelled), scene.pattern.corners)
    for index, (window, end) in enumerate(zip(windows(scene, seed), ends, strict=True)):
        start_us, shown_us, end_us = window.span_us
        assert end.span_us == (start_us, end_us, end_us)
        assert shown_us == pytest.approx(start_us + shown_at * window.duration_us)
        np.testing.assert_allclose(window.corners, expected[index], atol=1e-6)


@pytest.mark.parametrize(("seed", "shown_at"), [(0, 1.0), (1, 1.0), (2, 0.5)])
def test_rendered_corners_lie_where_the_homography_says(seed: int, shown_at: float):
    """The truth that the evaluation measures against is that of the pictures, to a few hundredths of a pixel."""
    scene = evaluation_scene(np.random.default_rng(seed), 2, top_speed=6.0, shown_at=shown_at)
    window = list(windows(scene, seed))[-1]
    image = np.round(255 * window.target).astype(np.uint8)
    start = window.corners.astype(np.float32).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
    found = np.asarray(cv2.cornerSubPix(image, start, (5, 5), (-1, -1), criteria)).reshape(-1, 2)
    assert np.sqrt(((found - window.corners) ** 2).sum(axis=1).mean()) < 0.06
    assert np.abs((found - window.corners).mean(axis=0)).max() < 0.02


def test_find_corners_says_when_there_is_no_board():
    assert find_corners(np.full((60, 80), 128, dtype=np.uint8), (9, 6)) is None


def test_corner_errors_measure_latency_and_bias():
    rng = np.random.default_rng(0)
    velocity = rng.normal(0, 300, (500, 2))
    errors = CornerErrors(-2e-3 * velocity + rng.normal(0, 0.01, (500, 2)), velocity, np.full(500, 0.03), 10, 10)
    assert errors.latency_s == pytest.approx(2e-3, rel=0.01)
    assert errors.bias_px == pytest.approx(-2e-3 * np.linalg.norm(velocity, axis=1).mean(), rel=0.02)
    assert errors.rms_px == pytest.approx(2e-3 * np.sqrt((velocity**2).sum(axis=1).mean()), rel=0.01)
    fast = errors.moving(10.0, 1e9)
    assert 0 < len(fast.errors) < 500
    assert fast.rms_px > errors.rms_px
