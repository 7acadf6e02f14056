"""What covers the sphere (bubbles, specks, a rod, an unknown glint): connected residuals, whose pixels are not used."""

from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from sphereorient.pose.pixels import Pixels
from sphereorient.pose.residuals import noise_variance, robust_deviation

WINDOW_PX = 5  # over which squared residuals are averaged: noise of single pixels does not reach the limit
MOST_EACH = 25.0  # that one pixel counts, variances: a single outlier is no occluder, robust weights drop it
# Mean of a window, in variances of the disk's own scatter. Of paint whose light is learnt: 5 to 8 at most, along edges
# and the limb; of bubbles and specks, 16 to 25.
COVERED = 10.0
MARGIN_PX = 3  # about such windows' middles: the occluder's blurred border
MOST_HIDDEN = 0.4  # of a disk; where more differs, its pose or light is wrong, and all pixels count
# In half of the pictures: bubbles 0.03, a rod 0.07, a map warped by 3 degrees 0.22. Then the model is wrong in all.
USUALLY_HIDDEN = 0.15


def occluded(pixels: Pixels, expected: Tensor, noise: Tensor, counted: Tensor, most: float) -> Tensor:
    """Return the pixels that something before the sphere shows, (L, P) bool.

    Args:
        pixels: of L disks, all places of their stencil.
        expected: grey levels by the model, (L, P).
        noise: coefficients of the noise's variance, (L, 4); see `Light`.
        counted: (L, P) bool, pixels whose residuals tell something.
        most: share of a disk; where more of it differs, no pixel of it is returned.
    """
    residual = pixels.grey - expected
    variance = noise_variance(expected, noise)
    own = variance * robust_deviation(residual, variance, counted).clamp_min(1.0)[:, None].square()
    differs = (residual.square() / own).clamp_max(MOST_EACH) * counted
    low = pixels.place.amin(1, keepdim=True)
    right, down = pixels.place - low
    width, height = int(right.max()) + 1, int(down.max()) + 1
    cell = down * width + right

    def on_grid(values: Tensor) -> Tensor:
        grid = values.new_zeros(len(values), height * width)
        grid[:, cell] = values
        return grid.reshape(-1, 1, height, width)

    mean = [avg_pool2d(on_grid(part), WINDOW_PX, 1, WINDOW_PX // 2) for part in (differs, counted.to(differs.dtype))]
    # At the border of the stencil a few pixels are no window.
    seeds = (mean[0] > COVERED * mean[1].clamp_min(0.5)).to(differs.dtype)
    hidden = max_pool2d(seeds, 2 * MARGIN_PX + 1, 1, MARGIN_PX).flatten(1)[:, cell] > 0
    share = (hidden & counted).sum(-1) / counted.sum(-1).clamp_min(1)
    return hidden & (share <= most)[:, None]
