"""Run a tactile_rt model file with numpy and onnxruntime alone: python plain_onnxruntime.py FILE"""

import json
import sys

import numpy as np
import onnxruntime as ort

options = ort.SessionOptions()
options.intra_op_num_threads = 1  # a step is too short for more
session = ort.InferenceSession(sys.argv[1], options, providers=["CPUExecutionProvider"])
card = json.loads(session.get_modelmeta().custom_metadata_map["tactile_rt"])
elements, channels = len((spec := json.loads(card["spec"]))["elements"]), len(spec["channels"])
names = [output.name for output in session.get_outputs()]

# The tare: mean and noise of each element while nothing is touched, here made up. SI units.
floor = np.array(card["floor"], dtype=np.float32)
rng = np.random.default_rng(0)
quiet = rng.normal(size=(50, elements, channels)).astype(np.float32) * floor
offset, sigma = quiet.mean(axis=0)[None], np.maximum(quiet.std(axis=0), floor)[None]

# An episode begins at contact, with a state of zeros.
feed = {"offset": offset, "sigma": sigma}
for state in card["state"]:
    feed[state["name"]] = np.zeros((1, *state["shape"]), dtype=state["dtype"])

for step in range(card["steps"]):
    # Here your array's samples, one every card["period_ns"], with its elements in the order of
    # spec["elements"]; made up: a touch ten times stronger than noise.
    samples = rng.normal(size=(1, card["substeps"], elements, channels)).astype(np.float32)
    samples *= 10 * floor
    out = dict(zip(names, session.run(names, {"samples": samples, **feed}), strict=True))
    for state in card["state"]:
        feed[state["name"]] = out[state["name"] + "_next"]
    evidence = out["logits"][0] / card["temperature"]
    posterior = np.exp(evidence - evidence.max())
    posterior /= posterior.sum()
    best = int(posterior.argmax())
    faults = {*card.get("refusals", ())} - {"unknown"}
    if card.get("unknown") and card["labels"][best] not in faults:
        limits, unknown = card["unknown"]["thresholds"], card["labels"].index("unknown")
        doubt, posterior[unknown] = float(posterior[unknown]), -1  # it has a threshold of its own
        best = unknown if doubt > limits[min(step, len(limits) - 1)] else int(posterior.argmax())
        posterior[unknown] = doubt
    print(f"step {step + 1:2d}: {card['labels'][best]} {posterior[best]:.2f}")  # noqa: T201
