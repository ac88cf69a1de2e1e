"""What was felt becomes a kind: a small recurrent network, the same for every policy."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from bench.active.episodes import BUDGETS, Episodes

HIDDEN, EPOCHS, BATCH, RATE = 64, 40, 64, 3e-3


class _Recogniser(nn.Module):
    def __init__(self, features: int, kinds: int) -> None:
        super().__init__()
        self.squeeze = nn.Sequential(nn.Linear(features, HIDDEN), nn.GELU(), nn.Dropout(0.2))
        self.remember = nn.GRU(HIDDEN, HIDDEN, batch_first=True)
        self.say = nn.Sequential(nn.Dropout(0.2), nn.Linear(HIDDEN, kinds))

    def forward(self, felt: torch.Tensor) -> torch.Tensor:
        """(episode, step, feature) -> (episode, step, kind) log-probabilities."""
        logits: torch.Tensor = self.say(self.remember(self.squeeze(felt))[0])
        return logits.log_softmax(dim=-1)


def trained(felt: Episodes, kinds: int, seed: int, epochs: int = EPOCHS) -> nn.Module:
    """A recogniser of what was felt, from nothing; every step from the first touch on counts."""
    torch.manual_seed(seed)
    net = _Recogniser(felt.felt.shape[-1], kinds)
    steps = max(epochs * (len(felt) // BATCH + 1), 1)
    optimiser = torch.optim.AdamW(net.parameters(), lr=RATE, weight_decay=0.02)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=steps)
    x, labels = torch.from_numpy(felt.felt), torch.from_numpy(felt.labels)
    counted = torch.from_numpy((felt.touches > 0) & (felt.touches <= max(BUDGETS))).float()
    net.train()
    for _ in range(epochs):
        order = torch.randperm(len(felt))
        for some in torch.split(order, BATCH):
            said = net(x[some])
            right = said.gather(2, labels[some][:, None, None].expand(-1, said.shape[1], 1))[..., 0]
            loss = -(right * counted[some]).sum() / counted[some].sum().clamp(min=1)
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(net.parameters(), 1.0)
            optimiser.step()
            schedule.step()
    return net.eval()


def log_likelihoods(net: nn.Module, felt: Episodes) -> NDArray[np.float64]:
    """(budget, episode, kind) what it says when so many touches have been made, and no more."""
    with torch.inference_mode():
        said = net(torch.from_numpy(felt.felt)).double().numpy()
    at = np.arange(len(felt))
    return np.stack([said[at, felt.steps_at(budget)] for budget in BUDGETS])
