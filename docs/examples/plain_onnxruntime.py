"""Run a tactile_rt model file with numpy and onnxruntime alone: python plain_onnxruntime.py FILE

A file ships: python -c 'from tactile_rt.classifier.model_file import *; print(shipped_model())'"""

import json
import sys

import numpy as np
import onnxruntime as ort

file = sys.argv[1] if len(sys.argv) == 2 else sys.exit(__doc__)
session = ort.InferenceSession(file, providers=["CPUExecutionProvider"])
card = json.loads(session.get_modelmeta().custom_metadata_map["tactile_rt"])
elements, channels = len((spec := json.loads(card["spec"]))["elements"]), len(spec["channels"])
names = [output.name for output in session.get_outputs()]
# The baseline: mean and noise of each element while nothing is touched, here made up. SI units.
floor = np.array(card["floor"], dtype=np.float32)
rng = np.random.default_rng(0)
quiet = rng.normal(size=(50, elements, channels)).astype(np.float32) * floor
offset, sigma = quiet.mean(axis=0)[None], np.maximum(quiet.std(axis=0), floor)[None]

# An episode begins at contact, with a state of zeros.
state = {s["name"]: np.zeros((1, *s["shape"]), dtype=s["dtype"]) for s in card["state"]}
for step in range(card["steps"]):
    # Your samples, one each card["period_ns"], as spec["elements"]; made up: ten times the noise.
    samples = rng.normal(size=(1, card["substeps"], elements, channels)).astype(np.float32)
    samples *= 10 * floor
    feed = {"samples": samples, "offset": offset, "sigma": sigma, **state}
    out = dict(zip(names, session.run(names, feed), strict=True))
    state = {name: out[name + "_next"] for name in state}
    evidence = out["logits"][0] / card["temperature"]
    posterior = np.exp(evidence - evidence.max())
    posterior /= posterior.sum()
    best = int(posterior.argmax())
    if card.get("unknown") and card["labels"][best] not in {*card["refusals"]} - {"unknown"}:
        limits, unknown = card["unknown"]["thresholds"], card["labels"].index("unknown")
        others = np.where(np.arange(len(posterior)) == unknown, -1, posterior)
        doubtful = posterior[unknown] > limits[min(step, len(limits) - 1)]
        best = unknown if doubtful else int(others.argmax())
    print(f"step {step + 1:2d}: {card['labels'][best]} {posterior[best]:.2f}")  # noqa: T201
