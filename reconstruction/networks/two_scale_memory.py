"""TwoScaleMemoryNet, of patterns_v3 to v5: TwoScaleNet with a second memory, at half of the resolution."""

from reconstruction.networks.two_scale import TwoScaleNet


class TwoScaleMemoryNet(TwoScaleNet):
    """What the tail makes of a window, `detail` numbers for four pixels, is kept, each as far as a gate lets it, and
    body and tail see it in the next window: where nothing moves the image stays."""

    remembers = True
