"""S4 encoder: structured state spaces on the flattened frame (Gu, Goel & Ré 2022).

Every channel is a linear system x' = A x + B u, y = C x + D u of N = 64 states, A being
HiPPO-LegS in its normal plus low-rank form Λ - P P* (their section 3), discretised by the
bilinear rule. Over an episode that is a convolution with as many taps as the episode has steps,

    K_k = C Ā^k B̄,   Ā = (I - Δ/2 A)^-1 (I + Δ/2 A),   B̄ = (I - Δ/2 A)^-1 Δ B

The taps are computed by running the system itself, O(N) a step by the Woodbury identity, in real
arithmetic: at 22 steps the paper's generating function at roots of unity saves nothing.

Training: nothing bounds the last two linear layers (`out` and a decoder), so at width 1 plain SGD
at 0.1 and AdamW at 1e-2 diverge within ten updates. SGD needs a clipped gradient norm, AdamW a
learning rate of at most 1e-3 (docs/decisions/experiments.md).
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tactile_rt.models.ead_config import MOUSE_FRAME
from tactile_rt.models.encoders.gru import FEATURES

STATES = 64  # N, in conjugate pairs
LAYERS = 4
DROPOUT = 0.2
DT_RANGE = (1e-3, 1e-1)
# For dt, A and B: weight decay would undo HiPPO, and dt has by far the largest gradients.
SSM_OPTIM = {"lr_scale": 0.1, "weight_decay": 0.0}


def hippo_legs(states: int = STATES) -> tuple[Tensor, Tensor, Tensor]:
    """Return Λ, P, B of HiPPO-LegS, one of each conjugate pair, (states / 2,) complex128.

    A = -sqrt((2n+1)(2k+1)) below the diagonal, -(n+1) on it; with p = sqrt(n + 1/2), A + p p^T is
    skew-symmetric but for its diagonal of -1/2, hence unitarily diagonal (their appendix C.1).
    """
    n = torch.arange(states, dtype=torch.float64)
    root = torch.sqrt(2 * n + 1)
    a = -torch.tril(root[:, None] * root[None, :], -1) - torch.diag(n + 1)
    p = torch.sqrt(n + 0.5)
    normal = a + p[:, None] * p[None, :]
    imaginary, vectors = torch.linalg.eigh(-1j * (normal + 0.5 * torch.eye(states)))
    half = imaginary > 0
    vectors = vectors[:, half].conj().T
    eigenvalues = torch.complex(torch.full_like(imaginary[half], -0.5), imaginary[half])
    return eigenvalues, vectors @ p.to(vectors), vectors @ root.to(vectors)


class S4Block(nn.Module):
    """S4 layer: state spaces, GELU, GLU, norm(x + ·). Post-norm, as in the paper's code."""

    def __init__(self, width: int) -> None:
        super().__init__()
        eigenvalues, p, b = hippo_legs()

        def parts(x: Tensor) -> nn.Parameter:
            """Split (state / 2,) complex into real and imaginary parts (channel, 2, state / 2)."""
            return nn.Parameter(torch.stack([x.real, x.imag]).float().repeat(width, 1, 1))

        low, high = map(math.log, DT_RANGE)
        self.log_dt = nn.Parameter(low + (high - low) * torch.rand(width))
        self.log_decay = nn.Parameter((-eigenvalues.real).log().float().repeat(width, 1))
        self.frequency = nn.Parameter(eigenvalues.imag.float().repeat(width, 1))
        self.P, self.B = parts(p), parts(b)
        self.C = nn.Parameter(torch.randn(width, 2, STATES // 2) * math.sqrt(0.5))
        self.D = nn.Parameter(torch.randn(width))
        self.mix = nn.Linear(width, 2 * width)
        self.norm = nn.LayerNorm(width)
        for parameter in (self.log_dt, self.log_decay, self.frequency, self.P, self.B):
            parameter._optim = dict(SSM_OPTIM)  # type: ignore[attr-defined]

    def forward(self, x: Tensor, kernel: Tensor) -> Tensor:
        """Map x (batch, step, channel) to the same shape, given the kernel (channel, tap)."""
        steps, taps = x.shape[1], kernel.shape[1]
        kernel = kernel[:, :steps]
        padded = F.pad(kernel, (steps - 1, max(steps - taps, 0)))
        toeplitz = padded.unfold(1, steps, 1)  # (channel, step out, step in), last input first
        return self.merge(x, torch.einsum("cts,bsc->btc", toeplitz, x.flip(1)))

    def merge(self, x: Tensor, y: Tensor) -> Tensor:
        """Complete the layer for x (..., channel), given the convolution's output y."""
        y = F.dropout(F.gelu(y), DROPOUT, self.training)
        y = F.dropout(F.glu(self.mix(y), -1), DROPOUT, self.training)
        out: Tensor = self.norm(x + y)
        return out


def kernels(blocks: Sequence[S4Block], steps: int) -> Tensor:
    """Compute the first `steps` taps (block, channel, step) of every block; tap 0 includes D.

    All blocks are computed at once, since the recurrence is short and its vectors are small.
    """

    def concatenate(name: str) -> Tensor:
        return torch.cat([getattr(block, name) for block in blocks])

    # log_dt (block * channel,); p, b, c (block * channel, 2, state / 2)
    log_dt, p, b, c = (concatenate(name) for name in ("log_dt", "P", "B", "C"))
    part = torch.arange(2, device=p.device, dtype=p.dtype)[:, None]  # real, imaginary
    conjugate = 1 - 2 * part
    dt = torch.exp(log_dt)[:, None]
    re, im = -torch.exp(concatenate("log_decay")) * dt / 2, concatenate("frequency") * dt / 2
    # r = 1 / (1 - Δ/2 Λ), and e = (1 + Δ/2 Λ) r, the diagonal part's share of Ā
    size = (1 - re) ** 2 + im**2
    r = torch.stack([(1 - re) / size, im / size], 1)
    e = 2 * r - (1 - part)
    # Woodbury: (I - Δ/2 A)^-1 z = r z - v (w · z). A conjugate pair adds twice a real part, so
    # w · z is a sum over real numbers.
    w = 2 * conjugate * multiply_complex(r, p * conjugate)
    pdp = 2 * ((p**2).sum(1) * r[:, 0]).sum(-1)[:, None, None]
    half = dt[:, :, None] / 2
    v = multiply_complex(r, p) * half / (1 + half * pdp)
    b = b * dt[:, :, None]
    x = multiply_complex(r, b) - v * (w * b).sum((1, 2), keepdim=True)
    # Ā x = e x - 2 v (w · x)
    e_re, e_im, v, states = e[:, :1], -conjugate * e[:, 1:], 2 * v, [x]
    for _ in range(steps - 1):
        x = torch.addcmul(
            torch.addcmul(e_re * x, e_im, x.flip(1)),
            v,
            (w * x).sum((1, 2), keepdim=True),
            value=-1.0,
        )
        states.append(x)
    # (step, block * channel, 2, state / 2) -> (block * channel, step)
    taps = torch.einsum("kcpn,cpn->ck", torch.stack(states), 2 * conjugate * c)
    taps = torch.cat([taps[:, :1] + concatenate("D")[:, None], taps[:, 1:]], 1)
    out: Tensor = taps.unflatten(0, (len(blocks), -1))
    return out


class S4Encoder(nn.Module):
    """Encoder by four S4 layers on flattened frames, to 512 * width features per step.

    Args:
        taps: the number of taps of the convolutions, as many as the steps of an episode.
    """

    lag = 0

    def __init__(
        self, width: float = 1.0, frame: tuple[int, ...] = MOUSE_FRAME, taps: int = 22
    ) -> None:
        super().__init__()
        self.features, self.taps = round(FEATURES * width), taps
        self.embed = nn.Linear(math.prod(frame), self.features)
        self.blocks = nn.ModuleList(S4Block(self.features) for _ in range(LAYERS))
        self.out = nn.Linear(self.features, self.features)

    def forward(self, frames: Tensor) -> Tensor:
        """Map all frames of a window to features (batch, step, feature), from a zero state."""
        x = self.embed(frames.flatten(2))  # (batch, step, channel)
        for block, kernel in zip(self.blocks, self.kernels(frames.shape[1]), strict=True):
            x = block(x, kernel)
        features: Tensor = self.out(x)
        return features

    def initial_state(self, batch: int) -> dict[str, Tensor]:
        """Return zeros for every layer's last inputs (batch, layer, tap, channel), newest first."""
        weight = self.out.weight
        return {"s4_inputs": weight.new_zeros(batch, LAYERS, self.taps, self.features)}

    def step(
        self, frame: Tensor, index: Tensor, state: dict[str, Tensor]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Map a frame (batch, channel, row, column) to features (batch, feature) and the state.

        The kernels are computed in each call; `fold_weights` computes them once.
        """
        return self.filter(frame, self.kernels(self.taps), state)

    def kernels(self, steps: int) -> Tensor:
        """Compute every layer's kernel (layer, channel, tap) for an episode of `steps` steps."""
        blocks = [block for block in self.blocks if isinstance(block, S4Block)]
        # In single precision, even under autocast: the state is a long product.
        with torch.autocast(self.out.weight.device.type, enabled=False):
            return kernels(blocks, min(steps, self.taps))

    def filter(
        self, frame: Tensor, kernels: Tensor, state: dict[str, Tensor]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Run `step` with given kernels (layer, channel, tap)."""
        x, inputs = self.embed(frame.flatten(1)), []  # (batch, channel)
        for layer, block in enumerate(self.blocks):
            assert isinstance(block, S4Block)
            # (batch, tap, channel), newest first
            inputs.append(torch.cat([x[:, None], state["s4_inputs"][:, layer, :-1]], 1))
            x = block.merge(x, (inputs[-1] * kernels[layer].t()).sum(1))
        return self.out(x), {"s4_inputs": torch.stack(inputs, 1)}

    def fold_weights(self) -> "FoldedS4":
        """Return the encoder for inference, with kernels computed once."""
        return FoldedS4(self)


class FoldedS4(nn.Module):
    """A trained `S4Encoder` whose kernels (layer, channel, tap) are constants."""

    lag = 0
    kernels: Tensor

    def __init__(self, encoder: S4Encoder) -> None:
        super().__init__()
        self.encoder, self.features = encoder, encoder.features
        with torch.no_grad():
            self.register_buffer("kernels", encoder.kernels(encoder.taps))

    def forward(self, frames: Tensor) -> Tensor:
        """Map frames (batch, step, channel, row, column) to features (batch, step, feature)."""
        features: Tensor = self.encoder(frames)
        return features

    def initial_state(self, batch: int) -> dict[str, Tensor]:
        return self.encoder.initial_state(batch)

    def step(
        self, frame: Tensor, index: Tensor, state: dict[str, Tensor]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Map a frame (batch, channel, row, column) to features (batch, feature) and the state."""
        return self.encoder.filter(frame, self.kernels, state)


def multiply_complex(a: Tensor, b: Tensor) -> Tensor:
    """Multiply complex arrays that are stored as (..., 2, state): real and imaginary parts."""
    (a_re, a_im), (b_re, b_im) = a.unbind(-2), b.unbind(-2)
    return torch.stack([a_re * b_re - a_im * b_im, a_re * b_im + a_im * b_re], -2)
