"""Fuzz every codec with at least 10^7 mutated bytes, one after another (`make fuzz`).

python -m bench.fuzz_codecs [BYTES] [CODEC ...]      e.g. 1000000 "serial bota" "can xela"
"""

import sys

from bench.drivers.fuzzing import HELD_MOST, WHOLE, all_codecs, fuzz


def main() -> int:
    """Print a line for each codec; 1 if one raised, kept too much or depends on cuts."""
    size = int(sys.argv[1]) if len(sys.argv) > 1 else WHOLE
    bad = 0
    say = sys.stdout.write
    say(f"{'codec':<22}{'bytes':>12}{'exceptions':>12}{'most held':>11}{'cuts':>7}{'CPU s':>8}\n")
    with all_codecs() as codecs:
        for name, make in codecs.items():
            if sys.argv[2:] and name not in sys.argv[2:]:
                continue
            found = fuzz(name, make, size)
            cuts = "differ" if found.uneven else "same"
            say(
                f"{name:<22}{found.bytes:>12}{found.exceptions:>12}{found.held:>11}{cuts:>7}"
                f"{found.seconds:>8.1f}\n"
            )
            sys.stdout.flush()
            bad += bool(found.exceptions or found.held > HELD_MOST or found.uneven)
    return min(bad, 1)


if __name__ == "__main__":
    sys.exit(main())
