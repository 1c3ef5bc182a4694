"""Many more faults than the tests have time for: ``make soak`` (`python -m tests.twin.soak`)."""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, as_completed

from tests.twin.faults import DEVICE_FAULTS, LINK_FAULTS, SPIKES, STREAM, Report, torture

EACH = 1000


def main() -> int:
    """Run seeds in parallel; tell what struck, and fail at anything that should not be."""
    parser = argparse.ArgumentParser(prog="python -m tests.twin.soak", description=__doc__)
    parser.add_argument("--cases", type=int, default=100_000, metavar="N", help="default: 100000")
    parser.add_argument("--seed", type=int, default=1000, metavar="N", help="the first one")
    arguments = parser.parse_args()
    runs = -(-arguments.cases // EACH)
    struck: Counter[str] = Counter()
    worst: Counter[str] = Counter()
    silent: dict[str, float] = {}
    corrupt = 0
    with ProcessPoolExecutor() as pool:
        # one run in eight with what makes the device forget its mode: that takes longer;
        # every other one with spikes instead of pixels
        futures = [
            pool.submit(
                torture,
                arguments.seed + n,
                EACH,
                DEVICE_FAULTS if n % 16 in (0, 9) else LINK_FAULTS,
                command=SPIKES if n % 2 else STREAM,
            )
            for n in range(runs)
        ]
        for done, future in enumerate(as_completed(futures), start=1):
            report: Report = future.result()
            struck += report.faults
            corrupt += report.corrupt
            for kind, lost in report.lost.items():
                worst[kind] = max(worst[kind], *lost)
                silent[kind] = max(silent.get(kind, 0.0), *report.silent[kind])
            sys.stdout.write(f"\r{done * EACH} of {runs * EACH} faults, {corrupt} corrupt frames")
            sys.stdout.flush()
    sys.stdout.write("\n")
    for kind, count in sorted(struck.items()):
        sys.stdout.write(f"{kind:18s} {count:7d} times, at most {silent[kind]:.3f} s silent\n")
    late = any(worst[kind] > 2 for kind in LINK_FAULTS)
    late = late or any(silent.get(kind, 0.0) > 0.2 for kind in DEVICE_FAULTS)
    return int(corrupt > 0 or late)


if __name__ == "__main__":
    sys.exit(main())
