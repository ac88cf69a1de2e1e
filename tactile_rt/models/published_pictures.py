"""The control augmentations of the paper's code, which treat touches as pictures.

Forces are the three colours of one picture of the array, moments those of a second. The usual
operations on photographs follow: mirrored, colours jittered, greyscale, blurred (Chen et al. 2020).
These operations take colours from 0 to 1, so loads are clipped to that range, as in the paper's
code. There is one random draw for a whole batch.

Source: SimCLRTransform and SimSiamTransform of the published code (neuroagents-lab,
2025-tactile-whisking), whose operations are torchvision's on tensors of floats.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Generator, Tensor
from torch.nn import functional as F

COLOURS = 3
JITTER_CHANCE, GREY_CHANCE, HALF = 0.8, 0.2, 0.5
SIGMA = (0.1, 2.0)  # of the blur, in cells
LUMINANCE = (0.2989, 0.587, 0.114)  # ITU-R BT.601
# for red, green and blue: index of value, falling, rising or low, by sextant of the hue
SEXTANTS = ((0, 1, 3, 3, 2, 0), (2, 0, 0, 1, 3, 3), (3, 3, 2, 0, 0, 1))


@dataclass(frozen=True)
class Jitter:
    """The strength of a colour jitter.

    Attributes:
        strength: The largest deviation from 1 of the factors of brightness, contrast, saturation.
        hue: The largest change of the hue, as a fraction of the colour circle.
    """

    strength: float
    hue: float


JITTERS = {"image-paper": Jitter(0.8, 0.2), "image-paper-weak": Jitter(0.4, 0.1)}


@dataclass(frozen=True)
class Draw:
    """Random parameters of the augmentation of one batch.

    Attributes:
        order: The order of changes to brightness (0), contrast (1), saturation (2) and hue (3);
            empty: no change.
        by: The factors of the first three, and the fraction of a circle added to the hue.
        sigma: The width of the blur, in cells; 0: none.
    """

    mirrored: bool = False
    order: tuple[int, ...] = ()
    by: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 0.0)
    grey: bool = False
    sigma: float = 0.0


def augment(frames: Tensor, generator: Generator, jitter: Jitter) -> Tensor:
    """Augment frames by mirroring, colour jitter, greyscale and blur, drawn once for the batch.

    Args:
        frames: (batch, step, sub-step * channel, row, column); channels in threes are colours.
    """
    device = generator.device

    def even(low: float = 0.0, high: float = 1.0) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator, device=device))

    most = jitter.strength
    done = Draw(
        mirrored=even() < HALF,
        order=tuple(torch.randperm(4, generator=generator, device=device).tolist())
        if even() < JITTER_CHANCE
        else (),
        by=(even(1 - most, 1 + most), even(1 - most, 1 + most), even(1 - most, 1 + most),
            even(-jitter.hue, jitter.hue)),
        grey=even() < GREY_CHANCE,
        sigma=even(*SIGMA) if even() < HALF else 0.0,
    )  # fmt: skip
    return as_drawn(frames, done)


def as_drawn(frames: Tensor, done: Draw) -> Tensor:
    """Augment frames (batch, step, sub-step * channel, row, column) by given parameters."""
    x = frames.unflatten(2, (-1, COLOURS))  # (batch, step, picture, colour, row, column)
    if done.mirrored:
        x = x.flip(-1)
    x = jitter_colours(x, done.order, done.by)
    if done.grey:
        x = grey(x).expand_as(x)
    if done.sigma:
        x = blur_pictures(x, done.sigma)
    return x.flatten(2, 3)


def jitter_colours(
    x: Tensor, order: Sequence[int], by: tuple[float, float, float, float]
) -> Tensor:
    """Change brightness, contrast, saturation and hue of pictures (..., colour, row, column)."""
    brightness, contrast, saturation, hue = by
    for what in order:
        if what == 0:
            x = (brightness * x).clamp(0, 1)
        elif what == 1:
            mean = grey(x).mean((-3, -2, -1), keepdim=True)
            x = (contrast * x + (1 - contrast) * mean).clamp(0, 1)
        elif what == 2:
            x = (saturation * x + (1 - saturation) * grey(x)).clamp(0, 1)
        else:
            x = with_hue(x, hue)
    return x


def grey(x: Tensor) -> Tensor:
    """Return the luminance (..., 1, row, column) of pictures (..., colour, row, column)."""
    weights = torch.tensor(LUMINANCE).to(x)[:, None, None]
    return (x * weights).sum(-3, keepdim=True)


def with_hue(x: Tensor, by: float) -> Tensor:
    """Shift the hue of pictures (..., colour, row, column) by a fraction of its circle."""
    red, green, _ = x.unbind(-3)
    value, least = x.amax(-3), x.amin(-3)
    span, none = value - least, value == least
    saturation = span / torch.where(none, 1.0, value)
    away = (value.unsqueeze(-3) - x) / torch.where(none, 1.0, span).unsqueeze(-3)
    from_red, from_green, from_blue = away.unbind(-3)
    sixths = torch.where(green == value, 2 + from_red - from_blue, 4 + from_green - from_red)
    sixths = torch.where(red == value, from_blue - from_green, sixths)
    hue = ((sixths / 6 + 1).fmod(1) + by) % 1
    sextant = (6 * hue).floor()
    part = 6 * hue - sextant
    falling = (value * (1 - saturation * part)).clamp(0, 1)
    rising = (value * (1 - saturation * (1 - part))).clamp(0, 1)
    low = (value * (1 - saturation)).clamp(0, 1)
    choices = torch.stack([value, falling, rising, low], -3)
    which = torch.tensor(SEXTANTS, device=x.device)[:, sextant.long() % 6]
    return choices.gather(-3, which.movedim(0, -3))


def blur_pictures(x: Tensor, sigma: float) -> Tensor:
    """Blur pictures (..., row, column) by a 3 x 3 Gaussian; mirror cells at edges."""
    at = torch.arange(-1.0, 2.0)
    kernel = torch.exp(-0.5 * (at / sigma) ** 2).to(x)
    kernel = kernel / kernel.sum()
    cells = F.pad(x.flatten(0, -3)[:, None], (1, 1, 1, 1), mode="reflect")
    out = F.conv2d(cells, torch.outer(kernel, kernel)[None, None])
    return out[:, 0].view(x.shape)
