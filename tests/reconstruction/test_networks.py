"""The networks: every switch builds and runs, sizes are kept, the state matters, small inputs stay finite."""

import itertools
from typing import Any

import pytest
import torch

from jaxcal.errors import CalibrationError
from reconstruction.networks import (
    E2VIDRecurrent,
    FireNet,
    FoldedFireNet,
    ReconstructionNetwork,
    TwoScaleMemoryNet,
    TwoScaleNet,
)
from reconstruction.networks.blocks import ConvGRU

SMALL = {"base_num_channels": 8, "num_encoders": 2, "num_residual_blocks": 1}
E2VID_SWITCHES = [
    {"skip_type": skip, "recurrent_block_type": block, "norm": norm, "use_upsample_conv": upsample}
    for skip, block, norm, upsample in itertools.product(
        ("sum", "concat"), ("convlstm", "convgru"), ("BN", "IN", None), (True, False)
    )
]
FIRENET_SWITCHES = [
    {"recurrent_block_type": block, "norm": norm, "recurrent_blocks": {"resblock": recurrent}, "kernel_size": kernel}
    for block, norm, recurrent, kernel in itertools.product(
        ("convlstm", "convgru"), ("BN", "IN", None), ([0], [-1], []), (3, 5)
    )
]


BUILDERS: list[tuple[type[ReconstructionNetwork], dict[str, Any]]] = [
    *((E2VIDRecurrent, SMALL | switches) for switches in E2VID_SWITCHES),
    *((FireNet, {"base_num_channels": 8} | switches) for switches in FIRENET_SWITCHES),
    *((FoldedFireNet, {"channels": 4, "fold": fold}) for fold in (1, 2, 4)),
    *((TwoScaleNet, {"channels": 8, "detail": 4, "num_bins": bins, "scaling": "window"}) for bins in (5, 8)),
    (TwoScaleNet, {"channels": 8, "detail": 4, "scaling": "running+scale"}),
    *((TwoScaleMemoryNet, {"channels": 8, "detail": 4, "scaling": how}) for how in ("window", "running+scale")),
]


@pytest.fixture(params=range(len(BUILDERS)))
def network(request: pytest.FixtureRequest) -> ReconstructionNetwork:
    torch.manual_seed(0)
    architecture, settings = BUILDERS[request.param]
    return architecture(**settings).eval().requires_grad_(False)


def planes(network: ReconstructionNetwork) -> int:
    return network.num_bins + (network.scaling == "running+scale")


def test_image_has_the_inputs_size_and_the_state_changes_the_next_image(network: ReconstructionNetwork):
    torch.manual_seed(1)
    voxels = torch.randn(2, planes(network), 2 * network.multiple + 16, 3 * network.multiple + 16)
    first, state = network(voxels, None)
    again, _ = network(voxels, None)
    second, _ = network(voxels, state)
    assert first.shape == (2, 1, *voxels.shape[2:])
    assert torch.isfinite(first).all()
    assert torch.equal(first, again)
    assert not torch.equal(first, second)


def test_settings_rebuild_the_same_network(network: ReconstructionNetwork):
    twin = type(network)(**network.settings)
    twin.load_state_dict(network.state_dict())
    twin.eval()
    voxels = torch.randn(1, planes(network), 32, 32)
    assert torch.equal(network(voxels, None)[0], twin(voxels, None)[0])


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("kernel_size", [3, 5])
def test_the_gru_is_the_same_with_and_without_gradients(kernel_size: int, dtype: torch.dtype):
    torch.manual_seed(0)
    cell = ConvGRU(4, kernel_size)
    inputs = torch.randn(3, 2, 4, 9, 11)
    slow = quick = None
    with torch.autocast("cpu", dtype, enabled=dtype != torch.float32):
        for x in inputs:
            x = x.to(dtype)
            _, slow = cell(x, slow)
            with torch.no_grad():
                before = None if quick is None else quick.clone()
                given = quick
                _, quick = cell(x, quick)
                assert before is None or torch.equal(given, before)  # the state that came in is not written to
            torch.testing.assert_close(quick, slow.detach(), atol=1e-6 if dtype == torch.float32 else 2e-2, rtol=0)


def test_official_defaults_have_the_published_sizes():
    # E2VID with 3 encoders has 10.71 M parameters (Rebecq et al.), FireNet with 16 channels 38 k (Scheerlinck et al.).
    e2vid = sum(tensor.numel() for tensor in E2VIDRecurrent(norm="BN", num_encoders=3).parameters())
    firenet = sum(tensor.numel() for tensor in FireNet(base_num_channels=16).parameters())
    assert e2vid == pytest.approx(10.71e6, rel=0.01)
    assert firenet == pytest.approx(38e3, rel=0.03)


@pytest.mark.parametrize("switch", [{"skip_type": "leap"}, {"norm": "LN"}, {"recurrent_block_type": "rnn"}])
def test_unknown_switch_is_refused(switch: dict[str, str]):
    with pytest.raises(CalibrationError, match=f"{next(iter(switch))} is '{next(iter(switch.values()))}'"):
        E2VIDRecurrent(**switch)
