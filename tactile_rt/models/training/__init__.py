"""Training of EAD networks: configurations (`config`, `recipes`) and the training loop (`loop`).

    tactile-rt train data/default24 runs/mine
    tactile-rt train data/default24 runs/simclr --recipe paper-simclr --set width=0.125
    tactile-rt probe runs/simclr/best.pt runs/simclr-probe

A run folder holds `config.json`, `history.csv` (a line per epoch), `last.pt` (the state to resume
from) and `best.pt` (the network with the best validation score).
"""
