"""Steps by every engine that is installed, side by side, and the bars on the fastest of them."""

from pathlib import Path

from tactile_rt.classifier.engines import ENGINES
from tactile_rt.evidence.engines import best_engine, engine_records, measure_engines
from tactile_rt.evidence.records import Record

__all__ = ["engine_speed"]

FASTEST = "<= 1"  # onnxruntime over the fastest engine of float32
BF16 = "<= 0.65"  # bfloat16 over onnxruntime in float32
BF16_FLAGS = ("avx512_bf16", "amx_bf16", "bf16")  # of x86-64, and of aarch64


def engine_speed(name: str, path: Path, steps: int) -> list[Record]:
    """Figures of a float32 file: each engine's, and how they compare.

    Args:
        name: of the file in its figures.
        path: the model file.
        steps: of each engine.
    """
    found = measure_engines(path, steps)
    prefix = f"inference.{name}"
    records = engine_records(found, f"{prefix}.by")
    default, able = found[0], [e for e in found if not e.refused]
    missing = dict.fromkeys(e.package for e in ENGINES.values() if not e.version)
    why = f"; not installed: {', '.join(missing)}" if missing else ""
    records.append(Record(f"{prefix}.engines", len(able), f"of {len(ENGINES)}", how=why[2:]))
    others = [e for e in able[1:] if ENGINES[e.engine].exact]
    if others:
        fastest = min([default, *others], key=lambda e: e.over(default))
        records.append(
            Record(
                f"{prefix}.fp32_over_fastest", default.over(fastest), "x", FASTEST,
                f"onnxruntime over the fastest in float32, {fastest.engine}",
                f"`model bench --engines` keeps {best_engine(found).engine}",
            )
        )  # fmt: skip
    records += [
        Record(
            f"{prefix}.bf16_over_fp32", e.over(default), "x", BF16,
            f"{e.engine} over onnxruntime in float32, median of {len(e.ms)} turns", _instructions(),
        )
        for e in able if not ENGINES[e.engine].exact
    ]  # fmt: skip
    return records


def _instructions() -> str:
    """What this processor has for bfloat16."""
    try:
        flags = Path("/proc/cpuinfo").read_text("utf-8").split()
    except OSError:
        return ""
    has = [flag for flag in BF16_FLAGS if flag in flags]
    return f"instructions for bfloat16: {', '.join(has) or 'none'}"
