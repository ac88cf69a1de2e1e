"""Alignment of models with barrel cortex: representational similarity to recorded animals.

rdm           RDMs of the six stimuli and their comparison
reliability   split halves, Spearman-Brown, the correction for noise
neural, nwb, nwb_parts, selection   recordings: from NWB files, and in the published layout
strict, paper_code, building   the two protocols: recordings -> a frozen benchmark
benchmark, json_file     the frozen benchmark and its file
scoring, statistics      a model's layers -> score, exact p-value
stimuli_input, layers, activations (torch), onnx_activations, loading   a model -> its layers
example, example_files   a made-up brain with known truth, and its files
metrics/, datasets/      plug-ins: measures of similarity; recordings with license and citation
board, board_page        table of models by datasets and metrics, and its page
fidelity, gate, decoding, results, pictures, report   release tests, stored scores, the report
"""

from tactile_rt.alignment.benchmark import (
    PROTOCOLS,
    Benchmark,
    Consistency,
    Frozen,
    Target,
    benchmark_sha256,
    load_benchmark,
    save_benchmark,
)
from tactile_rt.alignment.building import build
from tactile_rt.alignment.neural import Animal, NeuralSession
from tactile_rt.alignment.rdm import rsa, stimulus_index
from tactile_rt.alignment.scoring import Score, layer_rdms, score, score_rdms
from tactile_rt.core.stream.stimuli import STIMULI

__all__ = [
    "PROTOCOLS",
    "STIMULI",
    "Animal",
    "Benchmark",
    "Consistency",
    "Frozen",
    "NeuralSession",
    "Score",
    "Target",
    "benchmark_sha256",
    "build",
    "layer_rdms",
    "load_benchmark",
    "rsa",
    "save_benchmark",
    "score",
    "score_rdms",
    "stimulus_index",
]
